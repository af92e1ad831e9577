"""Logs of scans solved as a whole: keyframes, tracking, loop closure, all states at once."""
