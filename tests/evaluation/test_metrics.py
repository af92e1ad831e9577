"""Evaluation: every number against a case whose answer is known without it."""

import math
import time

import numpy as np
import pytest
from paths import real_data
from scipy.stats import chi2
from synthetic_results import START_NS, orchard, room, room_walls

from graphslam.core.errors import OutputError
from graphslam.core.geometry import between, compose, exp, transform, wrap
from graphslam.core.records import Landmark, Trajectory, TrueLandmark
from graphslam.evaluation.error_statistics import nees, nees_series, nees_statistics
from graphslam.evaluation.landmark_metrics import landmark_metrics
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.relation_metrics import (
    Relations,
    read_relations,
    relation_errors,
    relation_metrics,
)
from graphslam.evaluation.trajectory_metrics import (
    align,
    pair_poses,
    path_errors,
    relative_errors,
    trajectory_metrics,
)
from graphslam.results.folder import load, save

S = 1_000_000_000


def trajectory(stamps, poses, covs=None):
    n = len(stamps)
    covs = np.tile(np.eye(3), (n, 1, 1)) if covs is None else covs
    return Trajectory(np.array(stamps, dtype=np.int64), np.array(poses, dtype=float), covs)


def circle(n, step_ns=S // 10, start_ns=START_NS):
    """A path of constant twist: 0.2 m and 0.02 rad per step."""
    stamps = start_ns + step_ns * np.arange(n)
    return trajectory(stamps, exp(np.outer(np.arange(n), [0.2, 0.0, 0.02])))


def landmark(number, kind, position, cov, extent=None, line=None, identity=None):
    position = np.array(position, dtype=float)
    extent = np.stack([position[:2]] * 2) if extent is None else np.array(extent, dtype=float)
    return Landmark(number, kind, position, cov, extent, line, 3, 0, 1, identity)


# ---------------------------------------------------------------- pairing in time


def test_truth_between_its_samples_lies_on_the_constant_twist():
    dense = circle(101)
    sparse = trajectory(dense.stamps_ns[::5], dense.poses[::5])
    pairs = pair_poses(dense, sparse)
    assert len(pairs) == 101
    # the path is one constant twist, so interpolation is exact to rounding
    assert np.abs(pairs.truth[:, :2] - dense.poses[:, :2]).max() < 1e-12
    assert np.abs(wrap(pairs.truth[:, 2] - dense.poses[:, 2])).max() < 1e-12


def test_no_truth_is_invented_outside_its_span_or_in_its_gaps():
    truth = trajectory([0, S // 2, 3 * S, 4 * S], np.zeros((4, 3)))
    stamps = [-1, 0, S // 4, S // 2, S // 2 + 1, 2 * S, 3 * S, 3 * S + 1, 4 * S, 4 * S + 1]
    pairs = pair_poses(trajectory(stamps, np.zeros((10, 3))), truth)
    # 3 s..4 s is a gap of exactly 1 s, which is too long; exact hits always count
    assert pairs.stamps_ns.tolist() == [0, S // 4, S // 2, 3 * S, 4 * S]


# ---------------------------------------------------------------- trajectories


@pytest.mark.parametrize("pose", [[3, -4, 0.5], [100, 20, 3.1], [0, 0, -1.6], [-5, 2, 0]])
def test_alignment_finds_a_rigid_motion(pose):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 2)) * 10
    found = align(points, transform(np.array(pose), points))
    assert np.abs(found[:2] - pose[:2]).max() < 1e-11  # rounding at 100 m
    assert abs(wrap(found[2] - pose[2])) < 1e-12


def test_alignment_of_one_point_and_of_equal_points_is_finite():
    assert np.isfinite(align(np.zeros((1, 2)), np.ones((1, 2)))).all()
    assert np.isfinite(align(np.zeros((3, 2)), np.ones((3, 2)))).all()


def test_alignment_beats_every_nearby_motion():
    rng = np.random.default_rng(2)
    a = rng.normal(size=(30, 2))
    b = transform(np.array([1, 2, 0.7]), a) + rng.normal(0, 0.1, (30, 2))
    best = align(a, b)

    def cost(pose):
        return np.sum((transform(pose, a) - b) ** 2)

    for nudge in np.vstack([np.eye(3), -np.eye(3)]) * 1e-4:
        assert cost(best) < cost(best + nudge)


@pytest.mark.parametrize("noise_m", [0.0, 1e-9, 0.002])
def test_a_robot_that_stands_is_aligned_by_its_heading(noise_m):
    """Its positions tell no direction: by them alone a good estimate was up to 180° off."""
    rng = np.random.default_rng(3)
    stamps = START_NS + S // 10 * np.arange(60)
    truth = trajectory(stamps, np.tile([21.5, 17.9, np.pi], (60, 1)))
    noise = np.column_stack([rng.normal(0, noise_m, (60, 2)), rng.normal(0, 0.001, 60)])
    own = trajectory(stamps, noise)  # its frame begins where it stands
    found = trajectory_metrics([path_errors(pair_poses(own, truth))])
    assert found["heading_aligned_rmse_rad"] < 0.002
    assert found["ate_aligned_rmse_m"] <= 2 * noise_m + 1e-9


def test_a_short_way_that_is_known_well_is_aligned_by_its_positions():
    """A few centimetres tell the direction to which a heading that is off is compared."""
    truth = circle(60)
    truth = trajectory(truth.stamps_ns, truth.poses * [0.005, 0.005, 1.0])
    pose = np.array([3.0, 4.0, 2.0])
    off = trajectory(truth.stamps_ns, compose(pose, truth.poses) + np.array([0, 0, 0.1]))
    found = trajectory_metrics([path_errors(pair_poses(off, truth))])
    assert found["heading_aligned_rmse_rad"] == pytest.approx(0.1, abs=1e-9)
    assert found["ate_aligned_rmse_m"] == pytest.approx(0.0, abs=1e-9)


def test_a_shifted_trajectory_has_that_error_and_none_aligned():
    truth = circle(50)
    pose = np.array([3.0, 4.0, 0.0])
    moved = trajectory(truth.stamps_ns, truth.poses + pose)
    found = trajectory_metrics([path_errors(pair_poses(moved, truth))])
    assert found["ate_rmse_m"] == pytest.approx(5.0, abs=1e-12)
    assert found["max_m"] == pytest.approx(5.0, abs=1e-12)
    assert found["ate_aligned_rmse_m"] == pytest.approx(0.0, abs=1e-12)
    assert found["heading_rmse_rad"] == pytest.approx(0.0, abs=1e-12)
    assert found["rpe"]["1_s"]["trans_rmse_m"] == pytest.approx(0.0, abs=1e-12)


def test_heading_errors_are_taken_around_the_circle():
    truth = trajectory([0, 1, 2], [[0, 0, np.pi - 0.01]] * 3)
    turned = trajectory([0, 1, 2], [[0, 0, -np.pi + 0.01]] * 3)
    found = trajectory_metrics([path_errors(pair_poses(turned, truth))])
    assert found["heading_rmse_rad"] == pytest.approx(0.02, abs=1e-12)


def test_relative_errors_of_a_scale_error_are_that_share_of_the_span():
    truth = circle(400)  # 2 m/s
    scaled = exp(np.outer(np.arange(400), [0.2 * 1.01, 0.0, 0.02]))
    pairs = pair_poses(trajectory(truth.stamps_ns, scaled), truth)
    for span, count, chord in [
        ({"seconds": 1.0}, 390, 2.0 * np.sinc(0.1 / np.pi)),
        # measured along chords of 0.2 m arcs: 10 m are 50 steps and a bit, the nearest is 50
        ({"metres": 10.0}, 349, 10.0 * np.sinc(0.5 / np.pi)),
    ]:
        errors = relative_errors(pairs, **span)
        assert len(errors) == count
        translation = np.hypot(errors[:, 0], errors[:, 1])
        assert translation == pytest.approx(np.full(count, 0.01 * chord), rel=1e-9)
        assert np.abs(errors[:, 2]).max() < 1e-12


def test_relative_errors_need_partners():
    pairs = pair_poses(circle(5, step_ns=10 * S), circle(5, step_ns=10 * S))
    assert relative_errors(pairs, seconds=1.0).shape == (0, 3)
    assert relative_errors(pairs, metres=10.0).shape == (0, 3)
    found = trajectory_metrics([path_errors(pairs)])
    assert found["rpe"]["10_m"] == {"pairs": 0, "trans_rmse_m": None, "rot_rmse_rad": None}
    with pytest.raises(ValueError, match="seconds or metres"):
        relative_errors(pairs)


# ---------------------------------------------------------------- consistency


def test_honest_covariances_have_nees_one_and_cover_95_percent():
    rng = np.random.default_rng(4)
    n = 20_000
    A = rng.normal(size=(n, 3, 3))
    covs = A @ A.mT + 0.1 * np.eye(3)
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=(n, 3)))
    found = nees_statistics([nees_series(errors, covs)])
    low, high = found["nees_bounds"]
    assert low < 1 < high
    # independent errors, so the average leaves 99.99 % bounds for one seed in 10 000
    bounds = chi2.ppf([5e-5, 1 - 5e-5], 3 * n) / (3 * n)
    assert bounds[0] < found["nees_per_dof"] < bounds[1]
    assert found["coverage"] == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / n))


def test_stated_sigmas_half_as_large_show_as_four_times_the_nees():
    errors, covs = np.ones((5, 3)), np.tile(np.eye(3), (5, 1, 1))
    assert nees_statistics([nees_series(errors, covs)])["nees_per_dof"] == pytest.approx(1.0)
    assert nees_statistics([nees_series(errors, covs / 4)])["nees_per_dof"] == pytest.approx(4.0)


def test_unusable_covariances_are_left_out():
    covs = np.stack([np.eye(3), np.full((3, 3), np.nan), np.zeros((3, 3)), -np.eye(3)])
    values = nees(np.ones((4, 3)), covs)
    assert values[0] == pytest.approx(3.0)
    assert np.isnan(values[1:]).all()
    nothing = nees_statistics([nees_series(np.ones((2, 3)), np.full((2, 3, 3), np.nan))])
    assert set(nothing.values()) == {None}
    assert {"nees_per_dof", "nees_bounds", "nees_verdict", "coverage"} <= set(nothing)


# ---------------------------------------------------------------- landmarks


def test_points_match_by_identity_even_when_another_is_nearer():
    true = [
        TrueLandmark("", 0, 0, name, "point", np.array([x, 0.0, np.nan]), None)
        for name, x in (("a", 0.0), ("b", 0.4))
    ]
    found = [landmark(7, "point", [0.4, 0, np.nan], 0.04 * np.eye(2), identity="a")]
    metrics = landmark_metrics(found, true)
    assert metrics["rmse_m"] == pytest.approx(0.4)
    assert metrics["nees_per_dof"] == pytest.approx(0.16 / 0.04 / 2)
    assert (metrics["matched"], metrics["missed"], metrics["extra"]) == (1, 1, 0)


def test_landmarks_that_bear_each_others_names_are_told_and_compared_by_place():
    """A table of names may be wrong; the map is not. One that is merely wrong is not excused."""
    true = [
        TrueLandmark("", 0, 0, name, "point", np.array([x, 0.0, np.nan]), None)
        for name, x in (("a", 0.0), ("b", 4.0), ("c", 8.0))
    ]

    def metrics(**places):
        return landmark_metrics(
            [
                landmark(k, "point", [x, 0, np.nan], 0.01 * np.eye(2), identity=name)
                for k, (name, x) in enumerate(places.items())
            ],
            true,
        )

    found = metrics(a=4.1, b=0.1, c=8.1)
    assert found["exchanged"] == [("a", "b")]
    assert found["rmse_m"] == pytest.approx(0.1)
    found = metrics(a=4.1, b=4.1, c=8.1)
    assert found["exchanged"] == []
    assert found["rmse_m"] > 1


def test_exchanged_names_among_thousands_are_found_without_looking_at_every_pair():
    """Breaks when all pairs are compared one by one: 17 s instead of 0.4 s."""
    rng = np.random.default_rng(4)
    places = np.column_stack([rng.uniform(0, 300, (3000, 2)), np.full(3000, np.nan)])
    bears = np.arange(3000)
    bears[:100] = bears[:100].reshape(50, 2)[:, ::-1].ravel()
    true = [TrueLandmark("", 0, 0, str(k), "point", at, None) for k, at in enumerate(places)]
    cov = 0.01 * np.eye(2)
    found = [
        landmark(k, "point", places[bears[k]], cov, identity=str(k)) for k in range(len(places))
    ]
    began = time.process_time()
    metrics = landmark_metrics(found, true)
    assert time.process_time() - began < 5
    assert metrics["exchanged"] == [(str(k), str(k + 1)) for k in range(0, 100, 2)]
    assert metrics["rmse_m"] == 0


def test_points_without_identity_match_optimally_within_one_metre():
    # Greedy would pair the estimate at 0.6 with the truth at 0.8 and leave the other two apart.
    true = [
        TrueLandmark("", 0, 0, name, "point", np.array([x, 0.0, np.nan]), None)
        for name, x in (("a", 0.0), ("b", 0.8), ("c", 50.0))
    ]
    found = [landmark(i, "point", [x, 0, np.nan], np.eye(2)) for i, x in enumerate((0.6, 1.4, 60))]
    metrics = landmark_metrics(found, true)
    assert (metrics["matched"], metrics["missed"], metrics["extra"]) == (2, 1, 1)
    assert metrics["rmse_m"] == pytest.approx(0.6)


def test_a_line_is_judged_by_its_normal_and_offset_only():
    cov = np.zeros((3, 3))
    # seen part 2 m up the wall, on the line x = 5.1 where truth has x = 5: 0.1 m off
    line = (0.0, 5.1, np.diag([0.01**2, 0.1**2]))
    found = [landmark(0, "line", [5.1, 2, -np.pi / 2], cov, [[5.1, 3], [5.1, 1]], line)]
    for heading in (np.pi / 2, -np.pi / 2):  # truth may run along the wall either way
        true = [
            TrueLandmark(
                "", 0, 0, "w", "line", np.array([5.0, 0, heading]), np.array([[5, -4], [5, 4.0]])
            )
        ]
        metrics = landmark_metrics(found, true)
        assert metrics["rmse_m"] == pytest.approx(0.1)
        assert metrics["nees_per_dof"] == pytest.approx(0.5)
        assert metrics["matched"] == 1


@pytest.mark.parametrize(
    ("pose", "extent"),
    [
        ([5.0, 0.0, 0.0], [[1.0, 0.0], [9.0, 0.0]]),  # crosses it
        ([7.0, 0.0, np.pi / 2], [[7.0, -4.0], [7.0, 4.0]]),  # parallel, 2 m away
        ([5.0, 20.0, np.pi / 2], [[5.0, 16.0], [5.0, 24.0]]),  # same line, other wall
    ],
)
def test_other_walls_are_not_matched(pose, extent):
    line = (0.0, 5.0, np.eye(2))
    found = [landmark(0, "line", [5, 0, np.pi / 2], np.eye(3), [[5, -1], [5, 1]], line)]
    true = [TrueLandmark("", 0, 0, "w", "line", np.array(pose), np.array(extent))]
    metrics = landmark_metrics(found, true)
    assert (metrics["matched"], metrics["missed"], metrics["extra"]) == (0, 1, 1)
    assert metrics["rmse_m"] is None
    assert metrics["nees_per_dof"] is None


def test_the_landmark_that_makes_the_mean_is_named():
    """By its NEES, not by its error: the farther one knows that it is far. One without a valid
    covariance is no one's worst."""
    covs = {3: 1e-4 * np.eye(2), 5: np.eye(2), 8: np.full((2, 2), np.nan)}
    true = [
        TrueLandmark("", 0, 0, str(i), "point", np.array([10.0 * i, 0.0, np.nan]), None)
        for i in covs
    ]
    found = [
        landmark(i, "point", [10.0 * i + off, 0, np.nan], covs[i], identity=str(i))
        for i, off in zip(covs, (0.1, 0.3, 0.2), strict=True)
    ]
    metrics = landmark_metrics(found, true)
    assert metrics["worst"] == {
        "id": 3,
        "nees_per_dof": pytest.approx(50.0),
        "error_m": pytest.approx(0.1),
    }
    assert metrics["nees_per_dof"] == pytest.approx((100 + 0.09) / 4)
    assert landmark_metrics([], true)["worst"] is None


def true_line(pose, extent):
    return TrueLandmark("", 0, 0, "", "line", np.array(pose), np.array(extent))


def test_a_wall_seen_beside_a_door_matches_the_wall_not_the_door_in_its_middle():
    wall = [true_line([x, 0.0, 0.0], [[x, 0.0], [x + 4, 0.0]]) for x in (0.0, 5.0)]
    door = true_line([4.0, 0.1, 0.0], [[4.0, 0.1], [5.0, 0.1]])
    cov = np.diag([1.0, 1e-4, 1e-4])
    line = (np.pi / 2, 0.0, np.diag([1e-4, 1e-4]))
    seen = landmark(0, "line", [4.5, 0.0, 0.0], cov, [[1.0, 0.0], [8.0, 0.0]], line)
    found = landmark_metrics([seen], [door, *wall])
    assert found["rmse_m"] < 1e-9
    assert found["missed"] == 2


def test_a_start_that_is_off_does_not_change_which_wall_a_landmark_is():
    """Two walls 0.3 m apart, 40 m from a start that is off by 0.02 rad: 0.8 m there."""
    start = np.array([0.0, 0.0, 0.02])
    true = [true_line([40.0, y, 0.0], [[39.0, y], [41.0, y]]) for y in (0.0, 0.3)]
    there = [true_line(compose(start, t.pose), transform(start, t.extent)) for t in true]
    cov = np.diag([1.0, 1e-4, 1e-4])
    seen = []
    for k, t in enumerate(there):
        normal = t.pose[2] + np.pi / 2
        offset = float(np.array([np.cos(normal), np.sin(normal)]) @ t.pose[:2])
        line = (normal, offset, np.diag([1e-4, 1e-4]))
        seen.append(landmark(k, "line", t.pose, cov, t.extent, line))
    found = landmark_metrics(seen, true, there)
    assert found["missed"] == 0
    assert found["rmse_m"] == pytest.approx(0.8, abs=0.01)
    assert landmark_metrics(seen, true)["missed"] == 1


def test_pieces_of_a_wall_all_match_it():
    """Furniture cuts a wall into pieces. One to one, all but one would be judged by other walls."""
    walls = [
        TrueLandmark("", 0, 0, "long", "segment", np.zeros(3), np.array([[-5.0, 0], [5, 0]])),
        TrueLandmark(
            "", 0, 0, "other", "segment", np.array([3, 0.8, 0.1]), np.array([[2.0, 0.7], [4, 0.9]])
        ),
        TrueLandmark(
            "", 0, 0, "far", "segment", np.array([0, 9.0, 0]), np.array([[-1.0, 9], [1, 9]])
        ),
    ]
    cov = 1e-4 * np.eye(3)
    pieces = [
        landmark(
            k,
            "line",
            (x, 0.01, 0.0),
            cov,
            [[x - 1, 0.01], [x + 1, 0.01]],
            (np.pi / 2, 0.01, cov[:2, :2]),
        )
        for k, x in enumerate((-4.0, 0.0, 3.0))
    ]
    metrics = landmark_metrics(pieces, walls)
    assert (metrics["matched"], metrics["missed"], metrics["extra"]) == (3, 2, 0)
    assert metrics["rmse_m"] == pytest.approx(0.01)


def wall(name, *ends):
    """A true wall between two points."""
    ends = np.array(ends, dtype=float)
    heading = math.atan2(*(ends[1] - ends[0])[::-1])
    return TrueLandmark("", 0, 0, name, "segment", np.array([*ends.mean(axis=0), heading]), ends)


def seen_line(number, *ends):
    """A line landmark that lies exactly between two points."""
    ends = np.array(ends, dtype=float)
    middle, heading = ends.mean(axis=0), math.atan2(*(ends[1] - ends[0])[::-1])
    normal = heading + np.pi / 2
    offset = float(middle @ [math.cos(normal), math.sin(normal)])
    cov = 1e-4 * np.eye(3)
    return landmark(number, "line", (*middle, heading), cov, ends, (normal, offset, cov[:2, :2]))


def test_a_line_that_reaches_beyond_its_wall_is_judged_where_it_lies_on_it():
    """A Hough line reaches to its last return, so its middle may be where nothing was seen."""
    cupboard = wall("cupboard", (4.4, 7.5), (6.4, 7.5))
    board = wall("board", (1.5, 7.62), (3.1, 7.82))  # beside the middle of the line, 7 degrees off
    metrics = landmark_metrics([seen_line(0, (0.0, 7.5), (6.4, 7.5))], [board, cupboard])
    assert metrics["matched"] == 1
    assert metrics["rmse_m"] == pytest.approx(0, abs=1e-9)
    assert metrics["nees_per_dof"] == pytest.approx(0, abs=1e-9)


def test_a_short_edge_across_a_long_line_is_no_better_match_for_lying_in_its_middle():
    door = wall("door", (0.02, -0.5), (0.02, 0.5))
    edge = wall("edge", (0.0, -0.06), (0.02, 0.06))  # 10 degrees off, through the middle
    metrics = landmark_metrics([seen_line(0, (0.01, -0.5), (0.01, 0.5))], [edge, door])
    assert metrics["rmse_m"] == pytest.approx(0.01)  # the door's, not 0
    assert metrics["nees_per_dof"] == pytest.approx(0.5)  # one sigma of offset, none of direction


def test_an_empty_map_is_all_missed():
    true = [TrueLandmark("", 0, 0, "a", "point", np.zeros(3), None)]
    assert landmark_metrics([], true)["missed"] == 1
    assert landmark_metrics([], [])["matched"] == 0


# ---------------------------------------------------------------- relations


def write_relations(path, rows):
    path.write_text("".join(f"{a} {b} {x} {y} 0 0 0 {yaw}\n" for a, b, x, y, yaw in rows))
    return read_relations(path)


def test_a_relation_is_the_second_pose_in_the_frame_of_the_first(tmp_path):
    scans = circle(200, step_ns=S)
    # 976052857.337284123 and three others, forwards and backwards in time, near and far
    pairs = [(0, 10), (10, 0), (0, 100), (150, 20)]
    rows = [
        (f"{s0 // S}.{s0 % S:09d}", f"{s1 // S}.{s1 % S:09d}", *between(p0, p1))
        for (s0, p0), (s1, p1) in (
            [(scans.stamps_ns[k].item(), scans.poses[k]) for k in ab] for ab in pairs
        )
    ]
    relations = write_relations(tmp_path / "r", rows)
    # rounding of nothing but repr floats
    assert np.nanmax(relation_errors(relations, scans)) < 1e-10
    assert relations.local.tolist() == [True, True, False, False]


def test_the_error_is_seen_in_the_frame_of_the_reference():
    # reference: 1 m ahead; measured: 1 m ahead and turned by 90 degrees, 0.3 m too far
    scans = trajectory([1, 2], [[0, 0, 0], [1.3, 0, np.pi / 2]])
    relations = Relations(np.array([1]), np.array([2]), np.array([[1.0, 0, 0]]))
    assert relation_errors(relations, scans)[0] == pytest.approx([0.3, 90.0])
    # backwards: reference pose of state 1 seen from state 2
    back = Relations(np.array([2]), np.array([1]), between(scans.poses[[1]], scans.poses[[0]]))
    assert relation_errors(back, scans)[0] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_stamps_match_exactly_or_not_at_all(tmp_path):
    scans = trajectory([1_000_000_001, 2 * S], np.zeros((2, 3)))
    rows = [("1.000000001", "2", 0, 0, 0), ("1.000000002", "2", 0, 0, 0), ("1", "2.0", 0, 0, 0)]
    found = relation_metrics(write_relations(tmp_path / "r", rows), scans)
    assert (found["all"]["n"], found["all"]["unmatched"]) == (1, 2)
    assert (found["loops"]["n"], found["loops"]["trans_mean_m"]) == (0, None)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 0 0 0 0 0\n", "r:1: expected 8"),
        ("1 2 0 0 0 0 0 0\na 2 0 0 0 0 0 0\n", "r:2: 'a' is not a time"),
        ("1 2 nan 0 0 0 0 0\n", "r:1: not a pose"),
        ("\n", "holds no relation"),
    ],
)
def test_malformed_relations_name_file_and_line(tmp_path, text, message):
    (tmp_path / "r").write_text(text)
    with pytest.raises(OutputError, match=message):
        read_relations(tmp_path / "r")


def test_intel_raw_odometry_has_the_known_relation_error():
    import bz2

    folder = real_data("freiburg")
    stamps, poses = [], []
    with bz2.open(folder / "intel.clf.bz2", "rt") as log:
        for line in log:
            if line.startswith("FLASER"):
                fields = line.rsplit(maxsplit=9)
                seconds, digits = fields[-3].split(".")
                stamps.append(int(seconds) * S + int(digits.ljust(9, "0")))
                poses.append([float(v) for v in fields[-6:-3]])
    order = np.argsort(stamps, kind="stable")
    scans = trajectory(np.array(stamps)[order], np.array(poses)[order])
    found = relation_metrics(read_relations(folder / "intel.relations"), scans)
    # published figures of raw odometry, quoted to these digits
    assert (found["all"]["n"], found["all"]["unmatched"]) == (2984, 0)
    assert found["all"]["trans_mean_m"] == pytest.approx(7.37, abs=0.005)
    assert found["local"]["trans_mean_m"] == pytest.approx(0.0246, abs=5e-5)


# ---------------------------------------------------------------- all of it


def test_evaluate_has_the_keys_of_the_contract(tmp_path):
    result, truths, xy = orchard(keyframes=120, trees=20)
    save(result, tmp_path / "out", force=False)
    true = [
        TrueLandmark("", 0, 0, str(i), "point", np.array([*p, np.nan]), None)
        for i, p in enumerate(xy)
    ]
    found = evaluate(load(tmp_path / "out"), truths, true)
    assert set(found) == {"common_frame", "robots", "joint", "landmarks"}
    keys = {"ate_rmse_m", "ate_aligned_rmse_m", "max_m", "heading_rmse_rad", "rpe"}
    keys |= {"nees_per_dof", "nees_bounds", "coverage"}
    for both in (*found["robots"].values(), found["joint"]):
        assert set(both) == {"final", "causal"}
        for numbers in both.values():
            assert keys <= set(numbers)
            # errors are independent and drawn from the stated covariance: 99.99 % bounds
            n = 3 * numbers["poses"]
            low, high = chi2.ppf([5e-5, 1 - 5e-5], n) / n
            assert low < numbers["nees_per_dof"] < high
    assert found["joint"]["final"]["poses"] == 240
    assert found["landmarks"]["matched"] == 20
    low, high = chi2.ppf([5e-5, 1 - 5e-5], 40) / 40
    assert low < found["landmarks"]["nees_per_dof"] < high


def test_one_alignment_of_all_robots_leaves_what_is_between_them(tmp_path):
    truth = circle(50)
    pose = np.array([5.0, 1.0, 0.4])
    moved = trajectory(truth.stamps_ns, compose(pose, truth.poses))
    both = [pair_poses(moved, truth), pair_poses(moved, truth)]
    assert trajectory_metrics(list(map(path_errors, both)))["ate_aligned_rmse_m"] < 1e-12
    both[1] = pair_poses(
        trajectory(truth.stamps_ns, compose(pose, truth.poses) + np.array([0, 1, 0])), truth
    )
    assert (
        trajectory_metrics(list(map(path_errors, both)))["ate_aligned_rmse_m"] > 0.4
    )  # half of the metre each


def test_room_lines_are_consistent_and_relations_are_answered(tmp_path):
    result, truth = room(keyframes=80, beams=5)
    save(result, tmp_path / "out", force=False)
    saved = load(tmp_path / "out")
    a, b = result.robots["robot"].scan_final.stamps_ns[[3, 40]]
    relations = Relations(np.array([a]), np.array([b]), np.zeros((1, 3)))
    true = [wall_truth(str(i), wall) for i, wall in enumerate(room_walls())]
    found = evaluate(saved, {"robot": truth}, true, relations)
    assert found["relations"]["all"]["n"] == found["relations"]["causal"]["all"]["n"] == 1
    assert found["robots"]["robot"]["final"]["ate_rmse_m"] < 0.05
    assert (found["landmarks"]["matched"], found["landmarks"]["extra"]) == (12, 0)
    # errors are drawn from the stated (normal, offset) covariance: 99.99 % bounds of 24 dof
    low, high = chi2.ppf([5e-5, 1 - 5e-5], 24) / 24
    assert low < found["landmarks"]["nees_per_dof"] < high


def wall_truth(name, wall):
    middle, direction = wall.mean(axis=0), wall[1] - wall[0]
    pose = np.array([*middle, np.arctan2(direction[1], direction[0])])
    return TrueLandmark("", 0, 0, name, "line", pose, wall)


def test_truth_of_another_time_or_robot_is_one_line(tmp_path):
    result, truths, _ = orchard(keyframes=30, trees=5)
    save(result, tmp_path / "out", force=False)
    saved = load(tmp_path / "out")
    with pytest.raises(OutputError, match="within the span of the truth"):
        evaluate(saved, {"robot1": circle(5, start_ns=0)})
    with pytest.raises(OutputError, match=r"truth is of robot9, the result of robot1"):
        evaluate(saved, {"robot9": truths["robot1"]})
    with pytest.raises(OutputError, match="has none"):
        evaluate(saved, relations=Relations(np.array([1]), np.array([2]), np.zeros((1, 3))))
    assert evaluate(saved) == {}
