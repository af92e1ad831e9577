"""Metrics against ground truth, comparison of back ends, Monte Carlo experiments."""
