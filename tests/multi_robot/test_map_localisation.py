"""Which of several hypotheses about a start in a known map is believed."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.config import MultiRobotConfig
from graphslam.multi_robot.map_localisation import Support, choose, contradiction, doubt

#: places along a corridor, 3 m apart
POSES = np.column_stack([3.0 * np.arange(6), np.zeros(6), np.zeros(6)])
PLACES = [SimpleNamespace(pose=pose) for pose in POSES]


def hypothesis(score, contradicted, shift_m=0.0):
    """All places confirmed with a score, the first few contradicted."""
    return Support(
        POSES + np.array([shift_m, 0.0, 0.0]),
        np.full(6, score),
        np.ones(6, bool),
        np.arange(6) < contradicted,
    )


def chosen(*found):
    return choose(found, PLACES, MultiRobotConfig())


def test_the_best_is_taken_where_others_are_contradicted():
    """A building that repeats itself in part must not be refused for it."""
    assert chosen(hypothesis(0.5, 3, 8.0), hypothesis(0.9, 0)) == 1


@pytest.mark.parametrize(
    "rival",
    [
        pytest.param(hypothesis(0.5, 0, 8.0), id="not contradicted"),
        pytest.param(hypothesis(0.8, 5, 8.0), id="nearly as good whatever contradicts it"),
    ],
)
def test_a_rival_leaves_it_undecided(rival):
    """The right one of two may be the one that furniture contradicts."""
    assert "more than one way" in chosen(hypothesis(0.9, 0), rival)


def test_another_beginning_of_one_path_is_no_rival():
    """Hypotheses that end at the same path are one."""
    assert chosen(hypothesis(0.9, 0), hypothesis(0.85, 0, 0.2)) == 0


def test_too_little_is_refused():
    """Few places, places of one room, and places that contradict the map."""
    few = replace(hypothesis(0.9, 0), confirmed=np.arange(6) < 3)
    assert "only 3 of 6" in chosen(few)
    wide = MultiRobotConfig(min_place_extent_m=20.0)
    assert "extend over less" in choose([hypothesis(0.9, 0)], PLACES, wide)
    assert "3 of 6 places contradict it" in chosen(hypothesis(0.9, 3))


@pytest.mark.parametrize(
    ("confirmed", "against", "is_doubted"), [(16, 0, False), (16, 3, False), (4, 1, False),
                                             (10, 3, True), (8, 2, True), (0, 2, True)],
)  # fmt: skip
def test_a_place_that_some_contradict_is_a_doubt_and_one_thing_that_moved_is_none(
    confirmed, against, is_doubted
):
    yes = np.arange(18) < confirmed
    no = np.arange(18) >= 18 - against
    said = doubt(Support(np.zeros((18, 3)), np.ones(18), yes, no))
    assert bool(said) == is_doubted
    assert not said or said.startswith(f"{against} of 18 places contradict")


def test_a_given_start_is_refused_where_more_contradicts_it_than_agrees():
    """Another building; but not furniture in sight of all places, nor places outside of the map."""
    moved = hypothesis(0.5, 6)
    assert not contradiction(moved)
    outside = replace(moved, confirmed=np.zeros(6, bool), contradicted=np.zeros(6, bool))
    assert not contradiction(outside)
    elsewhere = replace(moved, confirmed=np.arange(6) < 2)
    assert contradiction(elsewhere) == "6 of 6 places contradict it, 2 agree with it"
