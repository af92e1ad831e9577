"""How well places agree with a map, and with each other."""

import numpy as np
import pytest
from walls import L_ROOM, cloud, rectangles

from graphslam.core.config import LoopClosureConfig
from graphslam.mapping.submaps import SubmapPose
from graphslam.multi_robot import hypothesis_choice
from graphslam.multi_robot.hypothesis_choice import doubt
from graphslam.multi_robot.map_localisation import Support, self_contradictions, support
from graphslam.perception.scan_matching import make_submap

BOX = rectangles((-3.5, -2.0, -2.5, -1.0))


def places(seen, spacing_m=3.0, box=BOX):
    """Places (n) of one path, all from about the same pose; ``seen`` (n): whether with the box."""
    made = []
    for k, with_box in enumerate(seen):
        pose = np.array([0.1 * k - 2.0, 1.0, 0.3 * k])
        walls = np.concatenate([L_ROOM, box]) if with_box else L_ROOM
        submap = make_submap(np.zeros((1, 3)), [cloud(pose, walls)])
        made.append(SubmapPose(("r", k), pose, spacing_m * k, (k, k), submap))
    return made


def test_what_is_there_one_time_and_not_the_next_contradicts_places_themselves():
    """A box that every other visit sees; in a room that stays as it is nothing does. Without the
    box a visit misses what others see; with it there are others that see it too."""
    apart_m = 6.0
    assert self_contradictions(places([False] * 5), apart_m).max() < 0.01
    shares = self_contradictions(places([True, False, True, False, True, False]), apart_m)
    assert len(shares) == 6
    assert shares[1::2].min() > 0.03  # those without the box, which others see


def test_only_visits_that_share_no_scan_are_compared():
    """Places one after the other are no second visit."""
    assert len(self_contradictions(places([True] * 3, spacing_m=1.0), 6.0)) == 0


@pytest.mark.parametrize(
    ("usual", "absent", "is_doubted"),
    [([0.15] * 5, 0.12, False), ([0.15] * 5, 0.3, True), ([0.15] * 3, 0.12, True),
     ([0.02] * 5, 0.12, True)],
)  # fmt: skip
def test_places_that_contradict_a_map_no_more_than_each_other_are_no_doubt(
    monkeypatch, usual, absent, is_doubted
):
    """Legs of tables are seen from some poses only. Few visits, or clean ones, are no excuse."""
    monkeypatch.setattr(hypothesis_choice, "self_contradictions", lambda *_: np.array(usual))
    n = 16
    yes, against = np.ones(n, dtype=bool), np.arange(n) < 9
    placed = Support(np.zeros((n, 3)), np.ones(n), yes, against, absent * against)
    said = doubt(placed, [], LoopClosureConfig())
    assert bool(said) == is_doubted


def test_what_was_pushed_as_much_as_is_said_contradicts_nothing():
    """A visit that was displaced onto the walls: the box is where it was but for the push. Pushed
    otherwise it is where nothing was, and nothing is where it was."""
    push = np.array([0.3, 0.2])
    before, after = places([True] * 2), places([True] * 2, box=BOX + push)
    shares = [
        support(before, after, motions).absent.max()
        for motions in ([push], [], [np.array([0.6, -0.1])])
    ]
    # of what is seen the box is some two per cent
    assert shares[0] < 0.004
    assert min(shares[1:]) > 0.01
