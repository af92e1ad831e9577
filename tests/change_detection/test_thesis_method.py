"""The thesis' change detection, equation by equation (chapter 5)."""

import numpy as np
import pytest

from graphslam.change_detection.grid import Grid
from graphslam.change_detection.thesis_changes import nearest_scans, thesis_changes
from graphslam.change_detection.thesis_folder import write_folder
from graphslam.change_detection.thesis_method import (
    VOLUME,
    LaserNoise,
    changed_beams,
    consecutive_runs,
    expected_measurements,
    make_dents,
    occlusion_map,
    point_covariances,
    scan_points,
    squared_mahalanobis,
)
from graphslam.change_detection.visit import visit_from_scans
from graphslam.core.config import ChangesConfig
from graphslam.core.geometry import rotation, wrap
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.world import Outline, make_world

GRID = Grid((-1.0, -5.0), 0.025, (400, 400))
ANGLES = np.radians(np.arange(-90, 90.1, 0.5))
NOISE = LaserNoise()
HERE = np.zeros(3)
KNOWN = np.diag([0.005, 0.005, 0.002]) ** 2


def wall(distance=4.0, shift=None):
    """Ranges to a wall across the x axis, 2 m to each side; ``shift`` where part of it moved."""
    with np.errstate(divide="ignore"):
        ranges = np.where(np.abs(np.tan(ANGLES)) < 0.5, distance / np.cos(ANGLES), np.nan)
    if shift is not None:
        part = np.abs(ANGLES) < 0.1
        ranges[part] = (distance - shift) / np.cos(ANGLES[part])
    return ranges


def reference(ranges, cov=KNOWN):
    covs = point_covariances(HERE, cov, ANGLES, np.nan_to_num(ranges, nan=1.0), NOISE)
    dents = make_dents(GRID, scan_points(HERE, ANGLES, ranges), covs)
    return dents, occlusion_map(GRID, HERE, ANGLES, ranges, 0.1)


def test_a_points_covariance_is_that_of_its_beam_turned_and_moved():
    """5.1-5.6 by hand for a beam along the y axis of the world."""
    pose, cov = np.array([1.0, 2.0, np.pi / 2]), np.diag([0.01, 0.02, 0.003]) ** 2
    (P,) = point_covariances(pose, cov, np.zeros(1), np.array([5.0]), NOISE)
    across = NOISE.phi1_m + (NOISE.phi2_rad + 0.003) * 5.0
    np.testing.assert_allclose(P, np.diag([across**2, NOISE.range_m**2]) + cov[:2, :2], atol=1e-15)


@pytest.mark.parametrize("sigma", [0.03, 0.05, 0.08])
def test_a_round_covariance_comes_back_as_it_went_in(sigma):
    """The round trip 5.12, 5.13: breaks with the printed 5.13, which is too large by d²_thres."""
    point = GRID.centers(GRID.cells(np.array([[2.0, 0.0]])))
    dents = make_dents(GRID, point, sigma**2 * np.eye(2)[None], threshold=9.0)
    ranges, covs = expected_measurements(dents, np.array([0, point[0, 1], 0.0]), np.zeros(1), 5.0)
    np.testing.assert_allclose(covs[0], sigma**2 * np.eye(2), rtol=1e-12)
    assert ranges[0] == pytest.approx(point[0, 0], abs=GRID.cell_m)


def test_every_dent_has_the_reference_volume():
    """5.7-5.12, summed over the cells; a tilted ellipse."""
    R = rotation(0.6)
    cov = R @ np.diag([0.10, 0.05]) ** 2 @ R.T
    dents = make_dents(GRID, np.array([[2.0, 0.3]]), cov[None])
    # a paraboloid summed over cells of a fifth of its short semi-axis: a per cent
    assert dents.depth.sum() * GRID.cell_m**2 == pytest.approx(VOLUME, rel=0.01)


def test_where_dents_meet_the_deeper_wins():
    points = np.array([[2.0, 0.0], [2.05, 0.0]])
    covs = np.array([0.05**2, 0.02**2])[:, None, None] * np.eye(2)
    dents = make_dents(GRID, points, covs)
    swapped = make_dents(GRID, points[::-1], covs[::-1])
    assert dents.winner[GRID.cells(points[1:])] == 1
    assert dents.bottom[1] > dents.bottom[0]
    np.testing.assert_allclose(dents.depth, swapped.depth)  # the order of points does not matter


def test_a_narrow_dent_is_not_lost_between_cells():
    dents = make_dents(GRID, np.array([[2.012, 0.011]]), 1e-6 * np.eye(2)[None])
    assert (dents.winner >= 0).sum() == 1


def test_the_distance_is_that_of_mahalanobis():
    z, e = np.array([[1.0, 2.0], [0, 0], [np.nan, 0]]), np.array([[1.1, 2.0], [0, 0], [0, 0]])
    S = np.tile(np.diag([0.005, 0.1]), (3, 1, 1))
    d2 = squared_mahalanobis(z, S, e, S)
    np.testing.assert_allclose(d2[:2], [0.01 / 0.01, 0.0], atol=1e-12)
    assert np.isnan(d2[2])


def test_behind_what_was_hit_is_occluded():
    visible = occlusion_map(GRID, HERE, ANGLES, wall(), 0.1)
    for point, seen in (((2.0, 0.0), True), ((4.0, 0.0), True), ((4.5, 0.0), False),
                        ((1.0, 3.0), False), ((-0.5, 0.0), False)):  # fmt: skip
        assert visible[GRID.cells(np.array([point]))[0]] == seen, point


#: a room with two boxes, and a laser that is not in its middle, as (start, end) of walls
OCCLUDERS = [((-2, -2), (3, -2)), ((3, -2), (3, 2.5)), ((3, 2.5), (-2, 2.5)), ((-2, 2.5), (-2, -2)),
             ((0.9, 0.4), (1.5, 0.4)), ((1.5, 0.4), (1.5, 1.1)), ((1.5, 1.1), (0.9, 1.1)),
             ((0.9, 1.1), (0.9, 0.4)), ((-1.2, -1.0), (-0.7, -1.5))]  # fmt: skip
FINE = Grid((-2.5, -2.5), 0.025, (240, 240))


def free_sight(start, ends):
    """Which of ``ends`` (n, 2) are seen from ``start``: no wall crosses the way there."""
    seen = np.ones(len(ends), dtype=bool)
    way = ends - start
    for a, b in np.array(OCCLUDERS, float):
        along, across = b - a, start - a
        bend = way[:, 0] * along[1] - way[:, 1] * along[0]
        t = (along[0] * across[1] - along[1] * across[0]) / bend
        s = (way[:, 0] * across[1] - way[:, 1] * across[0]) / bend
        seen &= ~((t > 0) & (t < 1) & (s >= 0) & (s <= 1))
    return seen


@pytest.mark.parametrize("field_deg", [100, 180, 270, 359.5, 360])
@pytest.mark.parametrize("heading_deg", [0, 120, -100])
def test_what_is_occluded_is_so_by_casting_rays(field_deg, heading_deg):
    """To 1 % of the cells, whatever the field of view: breaks if bearings relative to the first
    beam are wrapped (34 % of the visible cells are lost at 270 deg) or taken modulo a turn (what is
    just before the first beam). 360: the last beam is the first one again."""
    pose = np.array([0.2037, 0.1041, np.radians(heading_deg)])  # in line with no cell
    step = 0.25
    angles = np.radians(np.arange(-field_deg / 2, field_deg / 2 + 1e-9, step))
    walls = make_world([Outline(f"wall {n}", np.array(ends, float)) for n, ends in
                        enumerate(OCCLUDERS)])  # fmt: skip
    fan = BeamFan(angles[0], np.radians(step), len(angles))
    ranges = cast_beams(pose[None], fan, walls.shapes, 50.0).ranges[0]
    found = occlusion_map(FINE, pose, angles, ranges, 0.0)
    cells = np.arange(FINE.shape[0] * FINE.shape[1])
    centers = FINE.centers(cells)
    away = centers - pose[:2]
    off_axis = np.abs(wrap(np.arctan2(away[:, 1], away[:, 0]) - pose[2]))
    seen = free_sight(pose[:2], centers) & (off_axis <= np.radians(field_deg / 2))
    assert seen.sum() > 3000
    assert np.mean(found[seen]) > 0.99 and np.mean(found[~seen]) < 0.01


def test_a_wall_that_came_nearer_is_flagged_and_the_rest_is_not():
    dents, visible = reference(wall())
    compared, marked = changed_beams(
        dents, visible, HERE, KNOWN, ANGLES, wall(shift=0.3), NOISE, 9.21, 3
    )
    part = np.abs(ANGLES) < 0.1
    assert compared[part].mean() > 0.9
    assert marked[part & compared].all()
    # two beams beside it may meet the wall's end
    assert marked[~part].sum() <= 2


def test_what_was_hidden_in_front_of_the_expected_is_dismissed():
    """A thing that the reference could not see, as something stood before it, seen from aside."""
    front = wall()
    front[np.abs(ANGLES) < 0.05] = 2.0
    dents, visible = reference(front)
    aside = np.array([3.0, -1.0, 0.9])
    ranges = np.full(len(ANGLES), np.nan)
    behind = np.abs(ANGLES - (np.arctan2(1.0, 0.6) - 0.9)) < 0.02
    ranges[behind] = np.hypot(0.6, 1.0)  # ends at (3.6, 0): hidden; the wall is at (4, 0.67)
    _, marked = changed_beams(dents, visible, aside, KNOWN, ANGLES, ranges, NOISE, 9.21)
    assert not marked.any()
    everywhere = np.ones_like(visible)
    _, marked = changed_beams(dents, everywhere, aside, KNOWN, ANGLES, ranges, NOISE, 9.21)
    assert marked.any()  # so that the test above can fail


def test_consecutive_beams():
    marked = np.array([1, 0, 1, 1, 0, 1, 1, 1], dtype=bool)
    assert list(consecutive_runs(marked, 1)) == list(marked)
    assert list(np.nonzero(consecutive_runs(marked, 2))[0]) == [2, 3, 5, 6, 7]
    assert list(np.nonzero(consecutive_runs(marked, 3))[0]) == [5, 6, 7]
    assert not consecutive_runs(np.zeros(0, dtype=bool), 2).any()


# ------------------------------------------------------------ two visits


def two_visits(shift):
    """Three scans each of a wall, of which a part moved by ``shift`` before the later visit."""
    rng = np.random.default_rng(4)

    def visit(ranges, first_ns):
        poses = np.array([HERE, [0.02, 0.01, 0.01], [0.0, -0.02, -0.01]])
        sweeps = [(ANGLES, ranges + 0.005 * rng.normal(size=len(ANGLES))) for _ in poses]
        covs = np.broadcast_to(KNOWN, (3, 3, 3)).copy()
        return visit_from_scans(first_ns + np.arange(3, dtype=np.int64), poses, covs, sweeps)

    return visit(wall(), 0), visit(wall(shift=shift), 100)


def test_the_whole_method_finds_what_moved_and_where():
    """Chapter 5 top to bottom: one region where the part of the wall stands now."""
    config = ChangesConfig(consecutive_beams=3)
    found = thesis_changes(*two_visits(0.4), config, same_frame=True)
    largest = found.regions[0]
    assert largest.kind == "appeared" and largest.first_seen_ns == 100
    np.testing.assert_allclose(largest.polygon.mean(axis=0), [3.6, 0.0], atol=0.1)
    told = found.to_dict()
    assert told["method"] == "thesis" and told["beams_flagged"] == found.marked.sum() > 0
    assert told["changes"][0]["probability"] is None  # the thesis states none


def test_every_later_scan_is_compared_with_the_nearest_one():
    a, b = two_visits(0.0)
    assert list(nearest_scans(a, b)) == [0, 1, 2]
    turned = b.transformed(np.array([0.0, 0.0, 2 * np.pi]), np.zeros((3, 3)))
    assert list(nearest_scans(a, turned)) == [0, 1, 2]


def test_the_folder_has_the_maps_and_a_line_per_compared_beam(tmp_path):
    found = thesis_changes(*two_visits(0.4), ChangesConfig(), same_frame=True)
    write_folder(found, ChangesConfig(), tmp_path / "out", ("before", "after"), None)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    maps = {f"{name}.{end}" for name in ("reference_map", "occlusion_map", "changes")
            for end in ("pgm", "yaml")}  # fmt: skip
    assert names == {"changes.json", "decision.csv", "report.html"} | maps
    rows = (tmp_path / "out/decision.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) - 1 == found.expected.compared.sum()
    assert sum(row.endswith(",1") for row in rows[1:]) == found.marked.sum()
    page = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    for picture in ("Reference map", "Expected scan", "Occlusion map", "Decision"):
        assert picture in page
