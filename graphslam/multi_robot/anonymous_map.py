"""Relative poses of robots from places and points without identity in the maps of both.

Used only between robots that no observation with an identity relates.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.multi_robot.landmark_constellations import relate_points
from graphslam.multi_robot.place_recognition import PlaceMap, relate_places
from graphslam.multi_robot.relative_frames import RelativeFrame


@dataclass(frozen=True, slots=True, eq=False)
class AnonymousMap:
    """Observations of one robot without identity, in the frame of its start.

    ``places``: its submaps; ``points``: means (m, 2), covariances (m, 2, 2).
    """

    places: PlaceMap
    points: tuple[Array, Array]


def relate_anonymous_maps(
    maps: Mapping[str, AnonymousMap], frames: Mapping[str, str], config: Config
) -> tuple[list[RelativeFrame], dict[str, str]]:
    """Relations between robots in different frames, and why there is none: robot -> reason.

    Args:
        maps: of each robot by itself.
        frames: robot -> its frame, from all observations with an identity.
        config: settings.
    """
    relations: list[RelativeFrame] = []
    doubts: dict[str, str] = {}
    for a, b in combinations(sorted(maps), 2):
        if frames[a] == frames[b]:
            continue
        for relation in (
            relate_places(a, b, maps[a].places, maps[b].places, config.multi_robot),
            relate_points(a, b, maps[a].points, maps[b].points, config.association.floor_m),
        ):
            if isinstance(relation, RelativeFrame):
                relations.append(relation)
            elif relation:
                doubts |= dict.fromkeys((a, b), relation)
    return relations, doubts
