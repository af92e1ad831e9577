"""Visits whose results share recordings: a scan that is compared with itself is no second visit."""

import numpy as np
import pytest
from room_log import drive, true_pose
from walls import rectangles

import graphslam
from graphslam.change_detection import changes_between
from graphslam.change_detection.folder import load_visits
from graphslam.core.config import ChangesConfig
from graphslam.core.errors import OutputError
from graphslam.core.geometry import between

CONFIG = ChangesConfig()
#: corners of furniture that tell the room from itself turned by half a turn
ROOM = (0, 0, 10, 8), (4, 3.5, 6, 4.5), (0, 5.5, 3, 8), (7, 0, 10, 0.8)
#: a cabinet on the second day
CABINET = (9.2, 4.0, 10, 5.2)
#: in sight of all places, the cabinet contradicts a start that is found
SESSIONS = {
    "logs.same_place": True,
    "start.poses.day0": [0.0, 0.0, 0.0],
    "start.poses.day1": between(true_pose(0.0), true_pose(0.0, 0.3)).tolist(),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Folders ``first``, ``second`` and ``both`` (as sessions), and ``again``, the first anew."""
    folder = tmp_path_factory.mktemp("shared")
    logs = [
        drive(folder / f"day{n}.mcap", room=rectangles(*boxes), phase=0.3 * n, seed=n)
        for n, boxes in enumerate((ROOM, (*ROOM, CABINET)))
    ]
    for name, log in zip(("first", "second"), logs, strict=True):
        graphslam.smooth(log, output=folder / name)
    graphslam.smooth(logs[0], output=folder / "again", **{"scan_matching.cell_m": 0.07})
    joined = graphslam.smooth(logs, output=folder / "both", **SESSIONS)
    assert set(joined.summary["frames"].values()) == {"day0"}
    return folder


def loaded(folder, one, other, *spans):
    spans = spans or (None, None)
    return load_visits(folder / one, folder / other, CONFIG, *spans)


@pytest.mark.parametrize("later", ["again", "first"])
def test_the_same_recording_twice_is_refused(results, later):
    """Whatever the settings; also as two equal spans of one run."""
    spans = ((0.0, 20.0), (0.0, 20.0)) if later == "first" else ()
    with pytest.raises(OutputError, match=r"is of the same scans as .*first; compare results of"):
        loaded(results, "first", later, *spans)


def test_what_both_have_is_left_out_of_the_later_one(results):
    """Also of its map; simulated days have the same stamps, which alone say nothing."""
    visits = loaded(results, "first", "both")
    (said,) = visits.warnings
    assert said == "61 of 122 scans of both are left out: the other visit has the same ones"
    assert set(visits.later.names) == {"day1"}
    assert visits.later.robots == 1
    assert set(loaded(results, "first", "second").later.stamps_ns) == set(visits.later.stamps_ns)
    assert not loaded(results, "first", "second").warnings


def test_or_out_of_the_reference_if_the_later_one_has_nothing_else(results):
    visits = loaded(results, "both", "second")
    assert set(visits.reference.names) == {"day0"}
    assert len(visits.later.stamps_ns) == len(loaded(results, "first", "second").later.stamps_ns)


def test_only_true_changes_are_found_between_results_that_share_a_recording(results):
    """The cabinet, and nothing else; the shared day speaks for its absence and would hide it."""
    found = changes_between(results / "first", results / "both", CONFIG)
    assert "are left out" in found.warnings[0]
    assert found.to_dict()["warnings"] == list(found.warnings)
    (cabinet,) = found.changes
    assert cabinet.kind == "appeared"
    # the frame of the reference begins at the first pose of the first day, (5, 1.7, 0)
    assert np.hypot(*(cabinet.polygon.mean(axis=0) - [4.4, 2.9])) < 0.5


def test_the_overlap_of_two_spans_is_left_out(results):
    whole = loaded(results, "first", "first", (0.0, 20.0), (10.0, 30.0))
    assert not set(whole.later.stamps_ns.tolist()) & set(whole.reference.stamps_ns.tolist())
    assert whole.warnings
    # numbers of landmarks relate the two spans
    assert len(whole.later.landmarks) == len(whole.reference.landmarks)
