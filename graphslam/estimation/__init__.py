"""The estimators: factors, back ends behind one protocol, batch calibration, replay, g2o output.

`gtsam` is known to this package only.
"""
