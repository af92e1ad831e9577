"""Sightings (of landmarks, by a camera or another detector) as observations."""

import numpy as np

from graphslam.core.observation_models import MODELS
from graphslam.core.records import Observation, Sighting


def sighting_observation(message: Sighting) -> Observation:
    """A sighting as an observation: a point, or with a direction the pose of the landmark."""
    if len(message.z) == 2:
        return Observation("point", message.z, message.cov, None, message.identity)
    sighted, origin = message.z[:2], np.zeros(3)
    z = np.append(MODELS["point"].invert(sighted, origin), message.z[2])
    J = np.eye(3)
    _, J[:2, :2] = MODELS["point"].invert_jacobians(sighted, origin)
    return Observation("segment", z, J @ message.cov @ J.T, np.zeros(2), message.identity)


def is_unnamed_robot(message: Sighting) -> bool:
    """Whether it may be of any robot."""
    return message.seen_robot is None and message.may_be != "landmark"


def may_be_robot(message: Sighting) -> bool:
    """Whether it may be of a robot, named or not."""
    return message.seen_robot is not None or message.may_be != "landmark"


def may_be_landmark(message: Sighting) -> bool:
    """Whether it may be of a landmark, named or not."""
    return message.seen_robot is None and message.may_be != "robot"
