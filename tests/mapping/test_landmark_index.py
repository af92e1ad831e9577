"""Landmarks that may be near what is seen: none that a gate would pass is left out."""

import numpy as np
import pytest

from graphslam.core.config import AssociationConfig
from graphslam.core.records import Observation
from graphslam.mapping.gating import candidate_pairs
from graphslam.mapping.landmark_index import reach
from graphslam.mapping.landmark_map import LandmarkMap, means_and_extents

CONFIG = AssociationConfig()


def seen_at_random(rng, size_m, n=8):
    """Observations of points, and of walls whose origins may lie far beside them."""
    made = []
    for kind in rng.choice(["point", "line", "segment"], n):
        if kind == "point":
            z = np.array([rng.uniform(-np.pi, np.pi), rng.uniform(0.1, size_m)])
            made.append(Observation("point", z, np.eye(2)))
        else:
            z = np.append(rng.uniform(-size_m, size_m, 2), rng.uniform(-np.pi, np.pi))
            extent = np.sort(rng.uniform(-size_m, size_m, 2))
            made.append(Observation(str(kind), z, np.eye(3), extent))
    return made


def filled(rng, n, size_m):
    """A map of n landmarks around the origin."""
    landmarks = LandmarkMap()
    while len(landmarks) < n:
        pose = np.append(rng.uniform(-size_m, size_m, 2), rng.uniform(-np.pi, np.pi))
        for o in seen_at_random(rng, 0.2 * size_m):
            landmarks.add(o, pose, 0)
    return landmarks


def pairs_with(entries, seen, pose, config):
    kinds = np.array([e.kind for e in entries])
    found = candidate_pairs(
        seen, pose, *means_and_extents(entries), kinds == "point", kinds == "segment", config
    )
    ids = [entries[j].id for j in found.landmark]
    return set(zip(found.observation.tolist(), ids, found.model, strict=True))


@pytest.mark.parametrize("nearness", ["across", "middle"])
def test_candidates_are_those_of_the_whole_map(nearness):
    """Walls that begin far from where they are seen, turned ones, and what moved since included."""
    rng, passed, given = np.random.default_rng(0), 0, 0
    config = AssociationConfig(nearness=nearness)
    landmarks = filled(rng, 600, 30.0)
    for _ in range(60):
        pose = np.append(rng.uniform(-30, 30, 2), rng.uniform(-np.pi, np.pi))
        seen = seen_at_random(rng, 6.0, n=3)
        for o in seen[:1]:  # the index has neither a new landmark nor one that grew
            entry = landmarks.add(o, pose, 0)
            landmarks.record_observation(entry, o, pose, 0, "r", 0.0)
        near = landmarks.near(reach(seen, pose, config))
        every = pairs_with(list(landmarks.entries.values()), seen, pose, config)
        assert pairs_with(near, seen, pose, config) == every
        passed, given = passed + len(every), given + len(near)
    assert passed > 100  # else it tells nothing
    assert given < 0.7 * 60 * len(landmarks)


def test_landmarks_that_are_moved_are_found_where_they_are():
    rng = np.random.default_rng(1)
    landmarks = filled(rng, 50, 5.0)
    far = np.array([[99.0, 99.0], [101.0, 101.0]])
    assert not landmarks.near(far)

    class Backend:
        def landmark_means(self, ids):
            return [np.array([100.0, 100.0, 0.0]) for _ in ids]

    landmarks.refresh(Backend(), [7])
    assert [e.id for e in landmarks.near(far)] == [7]


def test_what_a_large_map_has_elsewhere_is_not_compared():
    """With all of it the cost of a log grew with the square of its length."""
    rng = np.random.default_rng(2)
    landmarks = LandmarkMap()
    for place in range(400):
        pose = np.array([50.0 * place, 0.0, 0.0])
        for o in seen_at_random(rng, 3.0):
            landmarks.add(o, pose, 0)
    seen = seen_at_random(rng, 3.0)
    near = landmarks.near(reach(seen, np.array([5000.0, 0.0, 0.0]), CONFIG))
    assert 0 < len(near) <= 3 * 8
