"""Loops closed in the order of the path: which visits of a place are compared."""

import numpy as np

from graphslam.core.config import LoopClosureConfig
from graphslam.core.gaussian import symmetric
from graphslam.core.records import Closure
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


#: m, m, rad: of a matched pair of submaps, and of tracking from one to the next
SIGMAS, TRACKED = np.array([0.022, 0.022, 0.005]), np.array([0.07, 0.03, 0.02])


def beside(places, false_m, slip_m=0.0):
    """Two drives along a corridor of 20 submaps, and closures between them at some ``places``.

    The second drive begins where the first one does. Its chain says so but for ``slip_m`` at each
    submap. Its first place is matched with another one ``false_m`` farther along.
    """
    n = 20
    along = np.column_stack([2.0 * np.arange(n), np.zeros(n), np.zeros(n)])
    begin = np.concatenate([np.arange(n - 1), n + np.arange(n - 1)])
    delta = np.tile([2.0, 0.0, 0.0], (2 * n - 2, 1))
    delta[n - 1 :, 0] += slip_m
    cov = np.diag(TRACKED) ** 2
    chain = SubmapConstraints(begin, begin + 1, delta, np.tile(cov, (2 * n - 2, 1, 1)))
    starts = np.array([np.diag([1e-4] * 3), np.diag([0.6, 0.6, 0.07])]) ** 2
    graph = SubmapGraph(np.concatenate([along, along]), chain, [0, n], starts)
    states = [("a", k) for k in range(n)] + [("b", 100 + k) for k in range(n)]
    submaps = [
        SubmapPose(state, pose, 2.0 * (k % n), (state[1],) * 2, None)
        for k, (state, pose) in enumerate(zip(states, graph.poses, strict=True))
    ]
    closer = _Closer(submaps, np.arange(2 * n), graph, LoopClosureConfig())
    for k in places:
        off = np.array([false_m if k == 0 else 0.0, 0.0, 0.0])
        closure = Closure("b", 100 + k, "a", k, off, np.diag(SIGMAS) ** 2)
        closer.accepted[closure.pair] = closure
        closer.correcting.add(closure.pair)
    closer.solve()
    return closer


def test_a_closure_that_all_later_ones_contradict_is_taken_back():
    """A corner that looks like another one, 2 m off, at the beginning of a day: nothing else was
    known then. Later closures bend the path around it so that its residual stays below 0.2 m; it
    was kept, and the map was doubted for it in the end, where walls had it overruled."""
    closer = beside(range(0, 20, 2), false_m=1.9)
    false = ("b", 100), ("a", 0)
    assert len(closer.accepted) == 10  # by residuals alone nothing is wrong
    closer.judge_again()
    assert closer.refused == {false}
    assert false not in closer.accepted.keys() | closer.correcting
    # and the path is straight again, to a sigma
    assert np.abs(closer.graph.poses[20:, 0] - 2.0 * np.arange(20)).max() < SIGMAS[0]


def test_closures_that_drift_makes_disagree_with_the_path_stay():
    """Tracking that slips by a sigma at each submap, always forwards: closures correct that, and
    none contradicts the others by what they are known to."""
    closer = beside(range(0, 20, 5), false_m=0.0, slip_m=TRACKED[0])
    closer.judge_again()
    assert len(closer.accepted) == 4
    assert not closer.refused
