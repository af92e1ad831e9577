"""Estimators: factors, back ends behind one protocol, batch calibration, replay, g2o output.

Only this package imports `gtsam`.
"""
