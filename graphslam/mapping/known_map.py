"""A map that is known before a log is read: landmarks with their joint covariance, and places.

It is what a later log needs of an earlier result. Trajectories are marginalised out: of the days
before only their landmarks are left, and one submap of each place, by which a start is found. So it
grows with the building, not with the number of days.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array, between, wrap
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.records import Landmark
from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.submaps import SubmapPose
from graphslam.perception.scan_matching import make_submap

#: in place of a robot's name in the states of places
MAP_ROBOT = "\0map"
#: m, rad: a place shows the same as a later one that is nearer and turned less
SAME_PLACE_M, SAME_PLACE_RAD = 1.5, np.radians(45.0)


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """What is known of a building.

    ``name`` of the result that it is of, ``sha256`` of its content. ``landmarks``: all of them;
    ``known``: their joint Gaussian as a day sees them, each wall with an error of its own across
    it, of sigma ``bias_m``; ``itself``: that without this error, which the next map is made from
    (None in older files, where it has to do with what is left of ``known``). What the sparse form
    of ``known`` neglects is small against the error of a day, but not against what is known of
    walls. ``places``: submaps at poses in the world. ``parents``: the maps that
    it continues, the first one first, name and sha256 each. ``is_world_given``: whether its world
    frame was told by a start, and not only the first pose of a robot. ``verdict`` on that result.
    """

    name: str
    sha256: str
    landmarks: tuple[Landmark, ...]
    known: KnownLandmarks
    places: tuple[SubmapPose, ...]
    bias_m: float = 0.0
    itself: KnownLandmarks | None = None
    parents: tuple[tuple[str, str], ...] = ()
    is_world_given: bool = False
    verdict: str = "good"

    @property
    def ancestry(self) -> tuple[tuple[str, str], ...]:
        """Of a map that continues this one: `parents`."""
        return (*self.parents, (self.name, self.sha256))

    def entries(self, robot: str) -> dict[int, Entry]:
        """Number -> entry of the landmark map; ``robot`` stands for who saw them."""
        return {mark.id: _entry(mark, robot) for mark in self.landmarks}

    @property
    def next_number(self) -> int:
        """Of the first landmark that is new."""
        return 1 + max((mark.id for mark in self.landmarks), default=-1)


def _entry(mark: Landmark, robot: str) -> Entry:
    mean = np.array([*mark.position[:2], 0.0 if mark.kind == "point" else mark.position[2]])
    extent = np.zeros(2)
    if mark.kind != "point":
        extent = np.sort([between(mean, np.array([*end, 0.0]))[0] for end in mark.extent])
    return Entry(
        mark.id, mark.kind, mean, np.zeros((3, 3)), extent, mark.first_ns, mark.last_ns,
        mark.identity, mark.sightings, True, {robot: 0.0},
    )  # fmt: skip


def latest_places(submaps: Sequence[SubmapPose]) -> tuple[SubmapPose, ...]:
    """One submap of each place, the first of them in this order, as a place of a map."""
    poses = np.array([place.pose for place in submaps]).reshape(-1, 3)
    kept: list[int] = []
    for k, pose in enumerate(poses):
        off = poses[kept] - pose
        near = np.hypot(off[:, 0], off[:, 1]) < SAME_PLACE_M
        if not (near & (np.abs(wrap(off[:, 2])) < SAME_PLACE_RAD)).any():
            kept.append(k)
    return tuple(
        map_place(n, one.pose, one.submap.poses, one.submap.clouds, one.submap.config)
        for n, one in enumerate(submaps[k] for k in kept)
    )


def map_place(
    number: int, pose: Array, poses: Array, clouds: Sequence[Array], config: ScanMatchingConfig
) -> SubmapPose:
    """Place ``number`` of a map at ``pose`` (3,): scans ``clouds`` from ``poses`` (k, 3) in it.

    It is matched by ``config``.
    """
    # places have no path; negative times put them before everything that is new
    time_ns = number - 1_000_000_000
    submap = make_submap(poses, clouds, config)
    return SubmapPose((MAP_ROBOT, time_ns), pose, 0.0, (time_ns, time_ns), submap)
