"""Several robots: how their frames relate, robots detected in scans, place recognition."""
