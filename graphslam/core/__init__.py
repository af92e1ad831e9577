"""What every other package builds on: settings, records, errors, geometry, Gaussians, models.

It knows no file format, no estimator and no robot log. Internal but for what `graphslam` exports.
"""
