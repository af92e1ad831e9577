"""Loops closed in the order of the path: which visits of a place are compared."""

import numpy as np

from graphslam.core.config import LoopClosureConfig
from graphslam.core.gaussian import symmetric
from graphslam.mapping import sequential_closing
from graphslam.mapping.sequential_closing import MAX_VISITS, _Closer
from graphslam.mapping.submap_graph import SubmapConstraints, SubmapGraph
from graphslam.mapping.submaps import SubmapPose

PER_LAP, STEP_M = 20, 2.0


def laps(count, driven_last=0):
    """Submaps once every 2 m of rounds on one circle, each round a little beside the others.

    ``driven_last``: so many of the first rounds are another robot's, after all others.
    """
    n = count * PER_LAP
    angle = 2 * np.pi * np.arange(n) / PER_LAP
    radius = STEP_M * PER_LAP / (2 * np.pi)
    radius = radius + 0.5 * np.random.default_rng(0).random(n)
    poses = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle + np.pi / 2])
    begin = np.arange(n - 1)
    delta = np.tile([STEP_M, 0.0, 2 * np.pi / PER_LAP], (n - 1, 1))
    cov = np.diag([0.1, 0.1, 0.05]) ** 2
    chain = SubmapConstraints(begin, begin + 1, delta, np.tile(cov, (n - 1, 1, 1)))
    graph = SubmapGraph(poses, chain, [0], symmetric(1e-8 * np.eye(3))[None])
    late = driven_last * PER_LAP
    states = [("a", k + n) if k < late else ("r", k) for k in range(n)]
    submaps = [
        SubmapPose(state, pose, STEP_M * k, (state[1],) * 2, None)
        for k, (state, pose) in enumerate(zip(states, poses, strict=True))
    ]
    return _Closer(submaps, np.arange(n), graph, LoopClosureConfig())


def test_a_place_is_compared_with_its_first_visits(monkeypatch):
    """However many visits there are, and whichever is nearest: joined to the nearest ones, visits
    hang from each other, and the factor of the graph grows with their number."""
    monkeypatch.setattr(
        sequential_closing, "SubmapPair", lambda later, earlier, *_: (later, earlier)
    )
    closer = laps(8)
    last = np.arange(7 * PER_LAP + 2, 8 * PER_LAP)
    pairs = closer.candidates(last)
    assert len(pairs) == MAX_VISITS * len(last)
    for later, earlier in pairs:
        # neighbours of the place itself may be of the visit before or after it
        assert earlier.state[1] < (MAX_VISITS + 0.5) * PER_LAP < later.state[1]


def test_a_place_is_compared_with_what_was_driven_before_it(monkeypatch):
    """Sessions come in the order of their names: what comes first may have been driven last, and
    the graph does not have it yet when the others are closed."""
    monkeypatch.setattr(
        sequential_closing, "SubmapPair", lambda later, earlier, *_: (later, earlier)
    )
    closer = laps(4, driven_last=2)
    pairs = closer.candidates(np.arange(4 * PER_LAP))
    assert {(a.state[0], b.state[0]) for a, b in pairs} == {("a", "r"), ("a", "a"), ("r", "r")}
    assert all(b.state[1] < a.state[1] for a, b in pairs)
