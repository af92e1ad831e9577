"""An experiment whose runs take milliseconds: two robots, three steps, two back ends."""

SMALL = """
runs = 2
noise_scales = [0.1]
settings = ["robust.kernel=none"]
[variants]
dead-reckoning = ["backend.name=dead-reckoning"]
batch = ["backend.name=batch"]
[bench]
meet_every = 2
points_m = [[2.0, 1.0], [3.0, -1.0]]
walls_m = [[[0.0, 2.0], [6.0, 2.0]]]
sigma = { start_m = 0.1, start_deg = 3.0, along_m = 0.05, across_m = 0.02, turn_deg = 2.0, \
bearing_deg = 2.0, range_m = 0.1, line_m = 0.05, line_deg = 2.0 }
[bench.robots.a]
start_m = [0.0, 0.0]
path = [{ steps = 3, forward_m = 0.8, turn_deg = 5.0 }]
[bench.robots.b]
start_m = [0.0, 1.0]
path = [{ steps = 3, forward_m = 0.6 }]
"""
