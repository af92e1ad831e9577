"""How good a result is: metrics against truth, comparison of back ends, Monte Carlo experiments."""
