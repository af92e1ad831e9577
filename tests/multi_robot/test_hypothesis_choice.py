"""Which of several hypotheses about a path in a map is believed."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.config import LoopClosureConfig, MultiRobotConfig
from graphslam.multi_robot.hypothesis_choice import best_explanation, choose, contradiction, doubt
from graphslam.multi_robot.map_localisation import Support

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
        0.1 * (np.arange(6) < contradicted),
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
    assert "more than one way" in chosen(hypothesis(0.9, 0), rival).text


def test_another_beginning_of_one_path_is_no_rival():
    """Hypotheses that end at the same path are one."""
    assert chosen(hypothesis(0.9, 0), hypothesis(0.85, 0, 0.2)) == 0


def test_too_little_is_refused():
    """Few places, places of one room, and places that contradict the map."""
    few = replace(hypothesis(0.9, 0), confirmed=np.arange(6) < 3)
    assert "only 3 of 6" in chosen(few).text
    assert (
        "extend over 15.0 m only"
        in choose([hypothesis(0.9, 0)], PLACES, MultiRobotConfig(min_place_extent_m=20.0)).text
    )
    assert "3 of 6 places contradict it" in chosen(hypothesis(0.9, 3)).text


def test_what_accepts_places_that_are_near_each_other_is_named_and_does():
    """The setting was named without a value, and without how it is given."""
    near = [SimpleNamespace(pose=pose * [0.17, 1.0, 1.0]) for pose in POSES]
    refusal = choose([hypothesis(0.9, 0)], near, MultiRobotConfig())
    (told,) = re.findall(r"--set multi_robot.min_place_extent_m=([0-9.]+) accepts", refusal.text)
    assert 2.0 < float(told) < 2.55  # of 2.55 m
    assert choose([hypothesis(0.9, 0)], near, MultiRobotConfig(min_place_extent_m=float(told))) == 0


@pytest.mark.parametrize(
    ("seen_m", "absent", "accepted"),
    [(6.0, 0.02, True), (6.0, 0.05, False), (7.0, 0.0, False), (np.inf, 0.0, False)],
)
def test_a_small_room_is_enough_if_nobody_saw_more_and_nothing_contradicts_it(
    seen_m, absent, accepted
):
    """Places over 2.55 m, 0.4 of 6.4 m. A mirrored room of 4 m contradicts places by 0.05, less
    than the 0.07 from which a place contradicts; so it would be taken for the same."""
    near = [SimpleNamespace(pose=pose * [0.17, 1.0, 1.0]) for pose in POSES]
    one = replace(hypothesis(0.9, 0), absent=np.full(6, absent))
    for alone in (False, True):
        chosen = choose([one], near, MultiRobotConfig(), seen_m, may_contradict=alone)
        if accepted:
            assert chosen == 0
        else:
            assert "rooms look alike (--set" in chosen.text
    assert choose([one], PLACES, MultiRobotConfig(), seen_m) == 0  # of a building


@pytest.mark.parametrize(
    ("confirmed", "against", "is_doubted"), [(16, 0, False), (16, 3, False), (4, 1, False),
                                             (10, 3, True), (8, 2, True), (0, 2, True)],
)  # fmt: skip
def test_a_place_that_some_contradict_is_a_doubt_and_one_thing_that_moved_is_none(
    confirmed, against, is_doubted
):
    yes = np.arange(18) < confirmed
    no = np.arange(18) >= 18 - against
    said = doubt(
        Support(np.zeros((18, 3)), np.ones(18), yes, no, 0.1 * no), [], LoopClosureConfig()
    )
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


CONFIG = MultiRobotConfig()
#: twelve places along it
LONG = np.column_stack([3.0 * np.arange(12), np.zeros(12), np.zeros(12)])
LONG_PLACES = [SimpleNamespace(pose=pose) for pose in LONG]


def laid(scores, shift_m=0.0, contradicted=0):
    """A hypothesis whose places have scores (12,); where they are 0, the map has nothing."""
    scores = np.array(scores, dtype=float)
    off = np.array([shift_m, 0.0, 0.0])
    return Support(LONG + off, scores, scores > 0, np.arange(12) < contradicted, np.zeros(12))


def said(found):
    """Why the best explanation is not believed, if it is not."""
    refusal = best_explanation(found, LONG_PLACES, CONFIG)[1]
    return refusal.text if refusal else ""


RIGHT = laid([0.8] * 8 + [0] * 4)


def test_a_place_that_fits_worse_is_no_evidence_of_a_rival():
    """A building that is turned has walls everywhere too, and more places may see some."""
    turned = laid([0.5] * 12, 20.0)
    assert best_explanation([turned, laid([0.8] * 12)], LONG_PLACES, CONFIG) == (1, None)
    # where most of it fits as well it is undecided
    assert (
        "more than one way"
        in best_explanation([RIGHT, laid([0.75] * 8 + [0] * 4, 20.0)], LONG_PLACES, CONFIG)[1].text
    )


def test_what_is_contradicted_all_over_is_not_thebest_explanation():
    """It may explain more than the right one if it puts the drive where the map has more."""
    turned = laid([0.5] * 12, 20.0, contradicted=6)
    found = [turned, laid([0.7] * 8 + [0] * 4)]
    assert best_explanation(found, LONG_PLACES, CONFIG) == (1, None)


def test_laying_more_of_a_drive_into_the_map_does_not_make_a_rival_of_what_is_contradicted():
    """Of two hypotheses that explain about as much in all, one leaves the last places where the map
    has nothing, and the other puts them into it, at the price of contradictions. It is no rival
    where the best one is contradicted half as much at most, or not at all; else it is."""
    elsewhere = [0.3] * 8 + [0.9] * 4  # as a rival three quarters of the best one, 0.7 would do
    best = [0.6] * 8 + [0] * 4
    for contradicted, against, is_rival in ((6, 0, False), (6, 1, False), (4, 2, True)):
        found = [laid(elsewhere, 20.0, contradicted), laid(best, contradicted=against)]
        assert ("more than one way" in said(found)) == is_rival
    # what it has in common with the best one counts all the same
    found = [laid([0.55] * 8 + [0.9] * 4, 20.0, 6), laid(best)]
    assert "more than one way" in best_explanation(found, LONG_PLACES, CONFIG)[1].text


def test_much_may_have_been_moved_where_nothing_else_explains_anything():
    """Ten of twelve places contradict it; it is taken only where nearly all are recognised and no
    other relative pose explains a tenth as much, as parts of the office turned round do."""
    moved = laid([0.4] * 12, contradicted=10)
    faint, less_faint = (laid([score] * 2 + [0] * 10, 20.0, 2) for score in (0.2, 0.3))
    assert best_explanation([moved, faint], LONG_PLACES, CONFIG) == (0, None)
    for found in ([moved, less_faint], [laid([0.4] * 8 + [0] * 4, contradicted=6)]):
        assert "places contradict it" in best_explanation(found, LONG_PLACES, CONFIG)[1].text
    # where all are contradicted nothing is explained, and the right pose may be as contradicted
    nothing = Support(
        LONG, np.zeros(12), np.ones(12, dtype=bool), np.ones(12, dtype=bool), np.zeros(12)
    )
    turned = replace(nothing, poses=np.add(LONG, [20.0, 0, 0]), confirmed=np.arange(12) < 7)
    for found in ([nothing], [moved, turned]):
        assert "places contradict it" in best_explanation(found, LONG_PLACES, CONFIG)[1].text
    # few places, or places of one room, are refused whatever speaks for them
    assert "extend over 0.0 m only" in (
        best_explanation([moved], [SimpleNamespace(pose=np.zeros(3))] * 12, CONFIG)[1].text
    )
