"""Cooperative 2-D graph SLAM: robot logs in; trajectories, landmarks and covariances out."""

__version__ = "0.1.0"
