"""What robots have in common that bears no name: places and points, and what that relates.

Looked at only where nothing with a name says how robots' frames lie.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

from graphslam.core.config import AssociationConfig
from graphslam.core.geometry import Array
from graphslam.mapping.submaps import SubmapPose
from graphslam.multi_robot.landmark_constellations import relate_points
from graphslam.multi_robot.place_recognition import relate_places
from graphslam.multi_robot.relative_frames import RelativeFrame


@dataclass(frozen=True, slots=True, eq=False)
class AnonymousMap:
    """What one robot saw by itself that bears no name, in the frame in which it began.

    ``places`` by its scans, ``cov`` (3n, 3n) the joint covariance of their poses, errors along each
    one's own axes; ``points`` means (m, 2), covariances (m, 2, 2).
    """

    places: Sequence[SubmapPose]
    cov: Array
    points: tuple[Array, Array]


def relate_anonymous_maps(
    seen: Mapping[str, AnonymousMap], frames: Mapping[str, str], config: AssociationConfig
) -> tuple[list[RelativeFrame], dict[str, str]]:
    """Relations between robots in different frames, and why there is none: robot -> reason.

    Args:
        seen: what each robot saw by itself.
        frames: whose frame each robot is in, by all that bears a name.
        config: floors of what is seen.
    """
    relations: list[RelativeFrame] = []
    doubts: dict[str, str] = {}
    for a, b in combinations(sorted(seen), 2):
        if frames[a] == frames[b]:
            continue
        here, there = seen[a], seen[b]
        for found in (
            relate_places(a, b, here.places, there.places, here.cov, there.cov),
            relate_points(a, b, here.points, there.points, config),
        ):
            if isinstance(found, RelativeFrame):
                relations.append(found)
            elif found:
                doubts |= dict.fromkeys((a, b), found)
    return relations, doubts
