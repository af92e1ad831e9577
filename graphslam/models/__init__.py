"""What the estimators know about the world: motion, and one observation model per kind."""

from graphslam.models.motion import MOTION_SOURCES, compound
from graphslam.models.observation import MODELS, ObservationModel, transport

__all__ = ["MODELS", "MOTION_SOURCES", "ObservationModel", "compound", "transport"]
