"""Motion between two times: odometry readings, preintegration, calibration, scan odometry."""
