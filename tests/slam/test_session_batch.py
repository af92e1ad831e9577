"""Sessions of one room, solved as one batch: joined by what the whole drives show, or refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from room_log import drive, true_pose
from walls import rectangles

import graphslam
from graphslam.change_detection.visit import load_visit
from graphslam.core.config import Config
from graphslam.core.errors import EstimationError, OutputError
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs, read_truth
from graphslam.multi_robot.map_localisation import Support
from graphslam.slam.log_reader import is_session_log
from graphslam.slam.session_joining import _best, _Laid
from graphslam.slam.start_priors import start_poses

BOX = (0, 0, 10, 8), (4, 3.5, 6, 4.5)
#: corners of furniture that tell the room from itself turned by half a turn
ODD = ((0, 5.5, 3, 8), (7, 0, 10, 0.8))
FURNISHED = rectangles(*BOX, *ODD)
#: the drive is 6 m long and 4.6 m wide
SAME_PLACE = graphslam.load_config(
    **{"logs.same_place": True, "multi_robot.min_place_extent_m": 3.0}
)


def sessions(tmp_path, *rooms):
    """A round in each room, each begun elsewhere on it."""
    return [
        drive(tmp_path / f"day{n}.mcap", room=room, phase=0.3 * n, seed=n)
        for n, room in enumerate(rooms)
    ]


def test_sessions_that_begin_anywhere_are_one_map(tmp_path):
    """One frame, one set of walls, errors over all days as in one drive, and honest sigmas."""
    days = sessions(tmp_path, FURNISHED, FURNISHED, FURNISHED)
    assert is_session_log(open_logs(days, SAME_PLACE), SAME_PLACE)
    told = {
        "start.poses.day0": true_pose(0.0).tolist(),
        "start.given_sigma_m": 1e-3,
        "start.given_sigma_rad": 1e-3,
    }
    result = graphslam.smooth(days, config=SAME_PLACE, **told)
    assert set(result.summary["frames"].values()) == {"day0"}
    assert {one["seen_with"] for one in result.summary["starts_found"].values()} == {"day0"}
    errors = evaluate(result, read_truth(days, SAME_PLACE).trajectories)["joint"]["final"]
    # scans of 1 cm noise place the robot to a centimetre; three are the bar of sessions
    assert errors["ate_rmse_m"] < 0.03
    assert errors["nees_per_dof"] < errors["nees_bounds"][1]
    # four walls of the room, four of the box, and four of the furniture; a wall that each day
    # would have for itself makes three of it
    assert len(result.landmarks) < 20


def test_a_room_that_looks_the_same_turned_is_refused(tmp_path):
    """Of two relative poses that explain everything neither may be taken; it is said why."""
    days = sessions(tmp_path, rectangles(*BOX), rectangles(*BOX))
    result = graphslam.smooth(days, config=SAME_PLACE)
    assert result.summary["frames"] == {"day0": "day0", "day1": "day1"}
    (why,) = [line for line in result.summary["warnings"] if line.startswith("day1: ")]
    assert "more than one way" in why
    assert "--start day1=x,y,phi places it" in why
    assert result.summary["sessions"]["apart"].keys() == {"day1"}
    assert result.summary["verdict"]["verdict"] == "doubtful"
    with pytest.raises(OutputError, match="separate frames: it is no map of one place"):
        load_visit(SimpleNamespace(summary=result.summary), tmp_path)  # changes of what map?
    # told starts decide it
    told = {f"start.poses.day{n}": true_pose(0.0, 0.3 * n).tolist() for n in range(2)}
    result = graphslam.smooth(days, config=SAME_PLACE, **told)
    assert set(result.summary["frames"].values()) == {"day0"}
    assert not result.summary["sessions"]["apart"]
    errors = evaluate(result, read_truth(days, SAME_PLACE).trajectories)["joint"]["final"]
    assert errors["ate_aligned_rmse_m"] < 0.03


def test_a_start_that_contradicts_another_one_is_refused(tmp_path):
    """Two told starts 2 m off would lay one room into another one beside it, without a word."""
    days = sessions(tmp_path, FURNISHED, FURNISHED)
    told = {"start.poses.day0": [5.0, 1.7, 0.0], "start.poses.day1": [5.0, 3.7, 1.5]}
    with pytest.raises(EstimationError, match="day1: --start contradicts that of day0: "):
        graphslam.smooth(days, config=SAME_PLACE, **told)


def test_the_first_recording_is_at_the_origin_whatever_its_name(tmp_path):
    """A map must not move when a recording is added whose name comes before the others'."""
    days = sessions(tmp_path, FURNISHED, FURNISHED)
    late = days[0].rename(tmp_path / "zebra.mcap")
    log = open_logs([late, days[1]], SAME_PLACE)
    assert list(start_poses(log, SAME_PLACE)) == ["zebra"]
    assert list(start_poses(open_logs([days[1], late], SAME_PLACE), SAME_PLACE)) == ["day1"]


@pytest.mark.parametrize(("setting", "value"), [("backend.name", "ekf"), ("backend.causal", True)])
def test_filters_and_causal_estimates_take_the_other_way(tmp_path, setting, value):
    """What needs every message in its order is not solved session by session."""
    config = graphslam.load_config(SAME_PLACE, **{setting: value})
    days = [drive(tmp_path / f"day{n}.mcap", seconds=5, phase=0.3 * n) for n in range(2)]
    assert not is_session_log(open_logs(days, config), config)


def test_a_session_by_itself_is_the_log_of_one_robot(tmp_path):
    """The same messages, and nothing of the others."""
    days = [drive(tmp_path / f"day{n}.mcap", seconds=5, phase=0.3 * n, seed=n) for n in range(2)]
    log = open_logs(days, SAME_PLACE)
    own = list(log.of_robot("day1").messages())
    every = [message for message in log.messages() if message.robot == "day1"]
    assert [(type(m), m.time_ns) for m in own] == [(type(m), m.time_ns) for m in every]
    assert log.of_robot("day1").opened == [log.opened[1]]


#: places along a corridor, 3 m apart
POSES = np.column_stack([3.0 * np.arange(12), np.zeros(12), np.zeros(12)])
PLACES = [SimpleNamespace(pose=pose) for pose in POSES]


def laid(scores, shift_m=0.0, contradicted=0):
    """A hypothesis whose places have scores (12,); where they are 0, the map has nothing."""
    scores = np.array(scores, dtype=float)
    return _Laid(
        {},
        [],
        Support(
            POSES + np.array([shift_m, 0.0, 0.0]), scores, scores > 0, np.arange(12) < contradicted
        ),
    )


RIGHT = laid([0.8] * 8 + [0] * 4)


def test_a_place_that_fits_worse_is_no_evidence_of_a_rival():
    """A building that is turned has walls everywhere too, and more places may see some."""
    turned = laid([0.5] * 12, 20.0)
    best, why = _best([turned, laid([0.8] * 12)], PLACES, Config())
    assert (best.support.total, why) == (pytest.approx(12 * 0.8), "")
    # where most of it fits as well it is undecided
    assert (
        "more than one way" in _best([RIGHT, laid([0.75] * 8 + [0] * 4, 20.0)], PLACES, Config())[1]
    )


def test_what_is_contradicted_all_over_is_not_the_best():
    """It may explain more than the right one if it puts the drive where the map has more."""
    turned = laid([0.5] * 12, 20.0, contradicted=6)
    best, why = _best([turned, laid([0.7] * 8 + [0] * 4)], PLACES, Config())
    assert (best.support.total, why) == (pytest.approx(5.6), "")


def test_laying_more_of_a_drive_into_the_map_does_not_make_a_rival_of_what_is_contradicted():
    """Of two hypotheses that explain about as much in all, one leaves the last places where the map
    has nothing, and the other puts them into it, at the price of contradictions. It is no rival
    where the best one is contradicted half as much at most, or not at all; else it is."""
    elsewhere = [0.3] * 8 + [0.9] * 4  # as a rival three quarters of the best one, 0.7 would do
    best = [0.6] * 8 + [0] * 4
    for contradicted, against, is_rival in ((6, 0, False), (6, 1, False), (4, 2, True)):
        found = [laid(elsewhere, 20.0, contradicted), laid(best, contradicted=against)]
        assert ("more than one way" in _best(found, PLACES, Config())[1]) == is_rival
    # what it has in common with the best one counts all the same
    found = [laid([0.55] * 8 + [0.9] * 4, 20.0, 6), laid(best)]
    assert "more than one way" in _best(found, PLACES, Config())[1]


def test_much_may_have_been_moved_where_nothing_else_explains_anything():
    """Ten of twelve places contradict it; it is taken only where nearly all are recognised and no
    other relative pose explains a tenth as much, as parts of the office turned round do."""
    moved = laid([0.4] * 12, contradicted=10)
    faint, less_faint = (laid([score] * 2 + [0] * 10, 20.0, 2) for score in (0.2, 0.3))
    assert _best([moved, faint], PLACES, Config()) == (moved, "")
    for found in ([moved, less_faint], [laid([0.4] * 8 + [0] * 4, contradicted=6)]):
        assert "places contradict it" in _best(found, PLACES, Config())[1]
    # where all are contradicted nothing is explained, and the right pose may be as contradicted
    nothing = Support(POSES, np.zeros(12), np.ones(12, dtype=bool), np.ones(12, dtype=bool))
    turned = replace(nothing, poses=np.add(POSES, [20.0, 0, 0]), confirmed=np.arange(12) < 7)
    for found in ([_Laid({}, [], nothing)], [moved, _Laid({}, [], turned)]):
        assert "places contradict it" in _best(found, PLACES, Config())[1]
    # few places, or places of one room, are refused whatever speaks for them
    assert (
        "less than multi_robot.min_place_extent_m"
        in (_best([moved], [SimpleNamespace(pose=np.zeros(3))] * 12, Config())[1])
    )
