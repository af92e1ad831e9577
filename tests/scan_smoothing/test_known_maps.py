"""A log localised in the map of an earlier result of the same room."""

import json
import shutil

import numpy as np
import pytest
from lab_log import lab
from room_log import START_NS, drive, true_pose
from walls import rectangles

import graphslam
from graphslam.change_detection.visit import load_visit
from graphslam.core.errors import ConfigError, EstimationError, OutputError
from graphslam.core.geometry import between, rotate_cov, rotation3, wrap
from graphslam.core.information_root import InformationRoot
from graphslam.core.records import JointScans, Landmark
from graphslam.mapping.known_map import latest_places
from graphslam.mapping.landmark_records import ALONG, SHORTEST_M
from graphslam.results.folder import JOINT_FILE
from graphslam.results.known_map_file import (
    KNOWN_MAP_FILE,
    known_map_of,
    landmark_covariance,
    load_known_map,
)
from graphslam.results.scans_file import SCANS_FILE
from graphslam.scan_smoothing import batch_optimisation

#: corners of furniture that tell the room from itself turned by half a turn
ODD = ((0, 5.5, 3, 8), (7, 0, 10, 0.8))
FURNISHED = rectangles((0, 0, 10, 8), (4, 3.5, 6, 4.5), *ODD)
#: the drive is 6 m long and 4.6 m wide
SMALL = {"multi_robot.min_place_extent_m": 3.0}
#: told to the first day, so that the map lies where the truth does
SIGMAS = {"start.given_sigma_m": 1e-3, "start.given_sigma_rad": 1e-3}
START = {"start.poses.robot": [5.0, 1.7, 0.0], **SIGMAS}


@pytest.fixture(scope="module")
def first_day(tmp_path_factory):
    """Result folder of a round in the furnished room."""
    folder = tmp_path_factory.mktemp("first")
    log = drive(folder / "first.mcap", room=FURNISHED)
    graphslam.smooth(log, output=folder / "first", config=graphslam.load_config(**START))
    return folder / "first"


def localised(log, known, **settings):
    return graphslam.smooth(log, **{"known_map.directory": str(known)}, **SMALL, **settings)


def test_what_was_compared_with_the_map_is_what_is_solved(tmp_path, first_day, monkeypatch):
    """Its loops are not closed once more from the start, which is as good as unknown: one of 80
    drives through an office then lay 0.37 m farther along a corridor than where it was checked."""

    def again(*_, **__):
        raise AssertionError("closed again")

    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.3, seed=3)
    monkeypatch.setattr(batch_optimisation, "close_paths", again)
    assert localised(log, first_day).summary["known_map"]["seen"] >= 6
    with pytest.raises(AssertionError, match="closed again"):  # as a log without a map is
        graphslam.smooth(log)


@pytest.mark.parametrize("phase", [0.3, 0.8])
def test_a_start_anywhere_is_found_in_the_map(tmp_path, first_day, phase):
    """It is not found where the search leaves out headings, or closures pull the path off."""
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=phase, seed=int(10 * phase))
    result = localised(log, first_day)
    errors = graphslam.evaluate(result)["robots"]["robot"]["final"]
    # scans of 1 cm noise place the robot to a centimetre; three are the bar of known maps
    assert errors["ate_rmse_m"] < 0.03
    assert errors["nees_per_dof"] < errors["nees_bounds"][1]
    told = result.summary["known_map"]
    assert told["seen"] >= 6  # the room's walls, and the box
    assert told["name"] == "first"


def test_a_map_brings_the_verdict_on_its_result_along(tmp_path, first_day):
    """What is placed in a bent map is no better than that."""
    shutil.copytree(first_day, tmp_path / "bent")
    summary = json.loads((tmp_path / "bent" / "summary.json").read_text(encoding="utf-8"))
    summary["verdict"]["verdict"] = "doubtful"
    (tmp_path / "bent" / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.3, seed=3)
    told = localised(log, tmp_path / "bent").summary
    assert told["known_map"]["verdict"] == told["verdict"]["verdict"] == "doubtful"
    assert localised(log, first_day).summary["verdict"]["verdict"] == "good"


def test_a_room_that_looks_the_same_turned_is_refused(tmp_path):
    """Of two starts that explain everything neither may be taken."""
    graphslam.smooth(drive(tmp_path / "first.mcap"), output=tmp_path / "first", **START)
    log = drive(tmp_path / "later.mcap", phase=0.3, seed=3)
    with pytest.raises(EstimationError, match="robot robot: where it begins in the map first is"):
        localised(log, tmp_path / "first")
    # a start that is told decides it
    told = {"start.poses.robot": [7.85, 4.71, 1.97]}
    assert localised(log, tmp_path / "first", **told).summary["known_map"]["seen"] >= 4


def test_a_start_is_found_in_a_small_room(tmp_path):
    """Default settings refused it: places of a room of 7 m cannot extend over 6 m."""
    room = rectangles((1.3, 1.0, 8.7, 7.0), (1.3, 6.0, 2.5, 7.0), (8.2, 1.0, 8.7, 3.0))
    known = tmp_path / "first"
    graphslam.smooth(drive(tmp_path / "first.mcap", room=room), output=known)
    log = drive(tmp_path / "later.mcap", room=room, phase=0.3, seed=3)
    result = graphslam.smooth(log, **{"known_map.directory": str(known)})
    assert graphslam.evaluate(result)["robots"]["robot"]["final"]["ate_aligned_rmse_m"] < 0.03


def test_another_building_is_refused_and_nothing_written(tmp_path, first_day):
    """A map in which hardly anything is recognised must not bend the path."""
    other = rectangles((-3, -1, 17, 11), (4, 3.5, 6, 4.5), (10, 2, 11, 7))
    log = drive(tmp_path / "later.mcap", room=other)
    with pytest.raises(EstimationError, match="give another map"):
        localised(log, first_day, output=tmp_path / "later")
    told = {"start.poses.robot": [5.0, 1.7, 0.0]}
    with pytest.raises(EstimationError, match="does not begin in the map first where"):
        localised(log, first_day, output=tmp_path / "later", **told)
    assert not (tmp_path / "later").exists()


@pytest.mark.parametrize(("off_m", "doubted"), [(0.3, False), (0.6, True)])
def test_a_start_that_is_told_wrong_does_not_move_the_map(tmp_path, off_m, doubted):
    """A map whose own start is known to decimetres followed the told one, by as much as that."""
    loose = {**START, "start.given_sigma_m": 0.3, "start.given_sigma_rad": 0.03}
    graphslam.smooth(
        drive(tmp_path / "first.mcap", room=FURNISHED), output=tmp_path / "first", **loose
    )
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.3, seed=3)
    told = true_pose(0.0, 0.3) + np.array([0.6, -0.8, 0.0]) * off_m
    settings = {"start.poses.robot": told.tolist()}
    result = localised(log, tmp_path / "first", **settings)
    final = result.robots["robot"].final
    off = final.poses[:, :2] - [true_pose(1e-9 * (t - START_NS), 0.3)[:2] for t in final.stamps_ns]
    # the first day began where it was told, and three centimetres are the bar of known maps
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.03
    # 0.05 m is what a start is told to by default, and the mount of the laser is known to 0.06
    assert bool(result.summary["known_map"]["doubt"]) == doubted
    assert (result.summary["verdict"]["verdict"] == "doubtful") == doubted


def test_a_start_told_half_a_turn_wrong_is_doubted_and_the_right_one_named(tmp_path):
    """In a room that a cupboard alone tells from itself turned: each place fits well enough."""
    room = rectangles((0, 0, 10, 8), (4, 3.5, 6, 4.5), (0, 7, 1.3, 8))
    log = drive(tmp_path / "first.mcap", room=room)
    graphslam.smooth(log, output=tmp_path / "first", config=graphslam.load_config(**START))
    log = drive(tmp_path / "later.mcap", room=room, phase=0.3, seed=3)
    right = true_pose(0.0, 0.3)
    turned = np.array([10.0, 8.0, np.pi]) - right * [1, 1, -1]
    for told, is_doubted in ((right, False), (turned, True)):
        found = localised(log, tmp_path / "first", **{"start.poses.robot": told.tolist()}).summary
        assert ("robot" in found["starts_better"]) == is_doubted
        verdict = found["verdict"]
        assert (verdict["verdict"] == "doubtful") == is_doubted
    better = found["starts_better"]["robot"]
    np.testing.assert_allclose([better["x"], better["y"]], right[:2], atol=0.05)
    assert abs(wrap(better["phi"] - right[2])) < 0.02
    assert [reason["check"] for reason in verdict["reasons"]] == ["starts"]
    assert f"begins at {better['x']:.2f}" in verdict["reasons"][0]["text"]


def test_a_start_beside_the_map_is_a_doubt(tmp_path, first_day):
    """A sign mistaken. Nothing of the map is seen, so nothing contradicts it either."""
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.3, seed=3)
    told = true_pose(0.0, 0.3) + np.array([60.0, -40.0, 0.0])
    found = localised(log, first_day, **{"start.poses.robot": told.tolist()}).summary
    assert found["known_map"]["seen"] == 0
    assert found["verdict"]["verdict"] == "doubtful"
    assert "no place of it is recognised" in found["verdict"]["reasons"][0]["text"]


@pytest.mark.parametrize("is_continued", [False, True])
def test_pushed_across_the_one_wall_in_sight_is_a_doubt(tmp_path, is_continued):
    """All furniture of the lab was pushed by 10 cm across the west wall, the one of those walls
    that both days see: the day lies as far off, and was good, as a map was not asked from which
    side its walls were seen. Also in a map that was continued, whose first day's path is gone."""
    pushed, stays = (0.1, 0.0), (0.0, 0.0)
    days = ((stays, 2), (stays, 5), (pushed, 3))
    logs = [lab(tmp_path / f"day{n}.mcap", *day, 1) for n, day in enumerate(days)]
    told = {**SIGMAS, "start.poses.vehicle": [7.2, 1.6, np.pi / 2]}
    graphslam.smooth(logs[0], output=tmp_path / "day0", **told)
    known = tmp_path / "day0"
    if is_continued:
        known = tmp_path / "day1"
        localised(logs[1], tmp_path / "day0", output=known, **told, **{"known_map.update": True})
    result = localised(logs[2], known, **told)
    errors = graphslam.evaluate(result)["robots"]["vehicle"]["final"]
    assert errors["ate_rmse_m"] > 0.05  # else there would be nothing to doubt
    (reason,) = result.summary["verdict"]["reasons"]
    assert reason["check"] == "doubled walls"
    assert "displaced alike by 0.10 m" in reason["text"]


def test_the_map_of_a_localised_result_is_the_earlier_one(tmp_path, first_day):
    """Localisation alone leaves the map as it was; a continued one names its parent."""
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.4, seed=4)
    before = load_known_map(first_day)
    localised(log, first_day, output=tmp_path / "later")
    after = load_known_map(tmp_path / "later")
    assert (after.name, after.sha256) == (before.name, before.sha256)
    assert len(after.places) == len(before.places)
    for one, other in zip(before.known.rows(), after.known.rows(), strict=True):
        assert one[0] == other[0]
        assert np.array_equal(one[1], other[1])
    for one, other in zip(before.landmarks, after.landmarks, strict=True):
        assert np.array_equal(one.cov, other.cov)
        assert np.array_equal(one.extent, other.extent)


def test_a_continued_map_is_better_and_names_its_parent(tmp_path, first_day):
    """Two rounds tell more of every wall than one; numbers of landmarks stay."""
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.4, seed=4)
    before = load_known_map(first_day)
    update = {"known_map.update": True}
    localised(log, first_day, output=tmp_path / "later", **update)
    after = load_known_map(tmp_path / "later")
    assert after.parents == (("first", before.sha256),)
    assert after.name == "later"
    kept = [mark.id for mark in before.landmarks if mark.id in after.known.means]
    assert len(kept) >= len(before.landmarks) - 1
    was, now = (known_map.known.covariance(kept) for known_map in (before, after))
    dims = np.cumsum([0, *(len(before.known.means[number]) for number in kept)])[:-1]
    # widening may cost a wall that was not seen again a little
    assert np.median(np.diag(now)[dims + 1] / np.diag(was)[dims + 1]) < 1.0


def test_where_a_map_is_in_the_world_no_later_day_tells(tmp_path):
    """Of a start that was told with the default sigmas, or the map would seem to be known better.

    Nor does it move: a start in the map that is pulled to the world would turn all of it.
    """
    told = {"start.poses.robot": [5.0, 1.7, 0.0]}
    log = drive(tmp_path / "first.mcap", room=FURNISHED)
    first = graphslam.smooth(log, output=tmp_path / "day0", **told)
    sigma = graphslam.load_config().start.given_sigma_rad
    for day in (1, 2):
        log = drive(tmp_path / f"{day}.mcap", room=FURNISHED, phase=0.4 * day, seed=day)
        update = {"known_map.update": True, "output": tmp_path / f"day{day}"}
        later = localised(log, tmp_path / f"day{day - 1}", **update)
        # a start tells a hundredth of that again, by its inflation, and the drive next to nothing
        assert later.robots["robot"].final.covs[0, 2, 2] ** 0.5 > 0.95 * sigma
        common = later.estimate.landmarks.keys() & first.estimate.landmarks.keys()
        walls = [n for n in common if len(later.estimate.landmarks[n][0]) == 3]
        was, now = (
            np.array([one.estimate.landmarks[n][0][2] for n in walls]) for one in (first, later)
        )
        # it is held by a tenth of its sigmas, and nothing pulls that far
        assert abs(np.median(wrap(now - was))) < 0.05 * sigma


def test_biases_of_surfaces_are_not_in_what_is_known_of_a_map():
    """On another day they are the same, and do the same to the path: see docs/known-maps.md."""
    one, none = np.array([3]), np.zeros(0, dtype=np.int64)
    shared = np.array([[0.0], [0.3], [0.1]])
    root = InformationRoot(
        one - 4, one, 0 * one, none, np.eye(3).ravel(), {}, {7: 0}, shared=shared
    )
    at, none_seen = np.array([1.0, 0.0, 1.6]), (None, 0, 0, 0, None)
    wall = Landmark(7, "line", at, np.eye(3), np.zeros((2, 2)), *none_seen)
    joint = JointScans(root, {}, {})
    own = landmark_covariance(joint, [wall], biases=False)
    np.testing.assert_allclose(own, np.eye(3))
    np.testing.assert_allclose(landmark_covariance(joint, [wall]), own + shared @ shared.T)


def test_landmarks_of_a_continued_map_are_those_of_its_joint_gaussian(tmp_path, first_day):
    """Their means, and their covariances but for the widening, without the error of a later day."""
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.4, seed=4)
    localised(log, first_day, output=tmp_path / "later", **{"known_map.update": True})
    after = load_known_map(tmp_path / "later")
    assert after.bias_m == graphslam.load_config().front_end.floor_normal_m
    for mark in after.landmarks:
        mean = after.known.means[mark.id]
        np.testing.assert_array_equal(mark.position[: len(mean)], mean)
        own = after.itself.covariance([mark.id]) / after.itself.root.widening
        stated = mark.cov if mark.kind == "point" else rotate_cov(mark.cov, -mark.position[2])
        # parents that are left out change it a little
        np.testing.assert_allclose(np.diag(stated), np.diag(own), rtol=0.15)


def test_what_is_gone_is_retired_and_what_is_new_added(tmp_path, first_day):
    """A box that was moved: neither may its old place stay a wall, nor any other wall go."""
    boxes = ((0, 0, 10, 8), (4, 3.5, 6, 4.5), ODD[0])
    log = drive(tmp_path / "later.mcap", room=rectangles(*boxes, (7, 7, 10, 8)), phase=0.4, seed=4)
    before = load_known_map(first_day)
    # in so small a room every place shows the box, and would contradict a start that is found
    told = {"start.poses.robot": true_pose(0.0, 0.4).tolist(), "known_map.update": True}
    result = localised(log, first_day, output=tmp_path / "later", **told)
    retired = result.summary["known_map"]["retired"]
    # two sides of the box were seen; the third is in line with nothing
    assert retired
    for entry in retired:
        middle = np.mean(entry["extent"], axis=0)
        assert 6.9 < middle[0] < 10.1
        assert -0.1 < middle[1] < 0.9
        assert entry["last_seen_ns"]
        assert entry["gone_ns"]
    after = load_known_map(tmp_path / "later")
    numbers = {mark.id for mark in after.landmarks}
    assert not numbers & {entry["id"] for entry in retired}
    assert len({mark.id for mark in before.landmarks} - numbers) == len(retired)
    # changes of the day are those from what it saw, not from what its map knew before
    unseen = set(result.summary["known_map"]["unseen"])
    visit = load_visit(graphslam.load_result(tmp_path / "later"), tmp_path / "later")
    assert unseen >= {entry["id"] for entry in retired}
    assert {mark.id for mark in visit.landmarks} == numbers - unseen
    new = [mark for mark in after.landmarks if mark.id >= before.next_number]
    assert any(np.hypot(*(mark.extent.mean(axis=0) - [8.5, 7.0])) < 0.3 for mark in new)


def test_a_result_is_judged_in_the_frame_of_its_map(tmp_path, first_day):
    """A map whose start nobody told is in a frame of its own, and so is what is started in it.
    Good paths were judged to be metres off."""
    own = tmp_path / "own"
    graphslam.smooth(drive(tmp_path / "first.mcap", room=FURNISHED), output=own)
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.3, seed=3)
    there = between(true_pose(0.0), true_pose(0.0, 0.3))
    update = {"known_map.update": True}
    result = localised(
        log, own, output=tmp_path / "later", **update, **{"start.poses.robot": there.tolist()}
    )
    found = graphslam.evaluate(result)
    assert not found["common_frame"]
    errors = found["robots"]["robot"]["final"]
    assert errors["ate_rmse_m"] is None
    assert errors["ate_aligned_rmse_m"] < 0.03
    assert not load_known_map(tmp_path / "later").is_world_given
    assert load_known_map(first_day).is_world_given
    localised(log, first_day, output=tmp_path / "told", **update)
    assert load_known_map(tmp_path / "told").is_world_given


def test_what_is_no_map_is_one_clear_line(tmp_path, first_day):
    """Folders that are no results, of earlier versions, of later formats; nothing to continue."""
    with pytest.raises(OutputError, match="not a result folder"):
        load_known_map(tmp_path)
    log = tmp_path / "later.mcap"
    with pytest.raises(ConfigError, match="no map to continue"):
        graphslam.smooth(drive(log), **{"known_map.update": True})
    with pytest.raises(ConfigError, match="back end batch"):
        localised(log, first_day, backend="ekf")
    old = tmp_path / "old"
    old.mkdir()
    for path in first_day.rglob("*"):
        target = old / path.relative_to(first_day)
        if path.is_dir():
            target.mkdir()
        else:
            target.write_bytes(path.read_bytes())
    with np.load(first_day / JOINT_FILE) as file:
        arrays = {name: file[name] for name in file.files if not name.startswith("landmark")}
    np.savez(old / JOINT_FILE, **arrays)
    with pytest.raises(OutputError, match="made by an earlier version"):
        load_known_map(old)
    (old / SCANS_FILE).rename(tmp_path / SCANS_FILE)
    (old / JOINT_FILE).write_bytes((first_day / JOINT_FILE).read_bytes())
    with pytest.raises(ConfigError, match="is of a log without scans"):
        localised(log, old)
    summary = old / "summary.json"
    summary.write_text(summary.read_text().replace("graphslam-result-1", "graphslam-result-9"))
    with pytest.raises(OutputError, match=r"is of another version .*result-9, not graphslam"):
        load_known_map(old)
    np.savez(old / KNOWN_MAP_FILE, format=np.array(99))
    with pytest.raises(OutputError, match="is of format 99"):
        load_known_map(old)
    (old / KNOWN_MAP_FILE).write_bytes(b"no archive")
    with pytest.raises(OutputError, match=KNOWN_MAP_FILE):
        load_known_map(old)


def test_places_of_a_map_are_matched_by_the_settings_of_the_log(tmp_path, first_day):
    """Made of a result, read from a file, or of sessions: else only half of the matcher's settings
    are in force, those of the new scans."""
    log = drive(tmp_path / "later.mcap", room=FURNISHED, phase=0.3, seed=3)
    localised(log, first_day, output=tmp_path / "later")
    coarse = {"scan_matching.cell_m": 0.1}
    for folder in (first_day, tmp_path / "later"):
        config = graphslam.load_config(**{"known_map.directory": str(folder)}, **coarse)
        places = known_map_of(config).places
        assert {place.submap.config for place in places} == {config.scan_matching}
        default = load_known_map(folder).places
        assert len(places[0].submap.points) < 0.7 * len(default[0].submap.points)
        again = latest_places(places)
        assert {place.submap.config for place in again} == {config.scan_matching}


def test_the_joint_covariance_has_the_marginals_of_the_landmarks(first_day):
    """The common error of the world, which the mount places, is in it as in landmarks.json."""
    saved = graphslam.load_result(first_day)
    known = load_known_map(first_day)
    assert [mark.id for mark in known.landmarks] == [mark.id for mark in saved.landmarks]
    entries = json.loads((first_day / "landmarks.json").read_text())
    bias = saved.config.front_end.floor_normal_m**2
    cov = landmark_covariance(saved.joint, known.landmarks)
    end = 0
    for mark, entry in zip(known.landmarks, entries, strict=True):
        begin, end = end, end + len(mark.cov)
        own, told = cov[begin:end, begin:end], np.array(entry["covariance"])
        if mark.kind != "point":
            # along a wall is a gauge, of which a heading that settles by 1e-5 rad has a part
            turn = rotation3(-mark.position[2])
            length = max(float(np.hypot(*(mark.extent[1] - mark.extent[0]))), SHORTEST_M)
            own = own[1:, 1:] + bias * np.diag([1.0, (ALONG / length) ** 2])
            told = (turn @ told @ turn.T)[1:, 1:]
        np.testing.assert_allclose(own, told, rtol=1e-3, atol=1e-7)
