"""Maps of a result: right against true walls, read by map_server's rules, written whole."""

import csv
import errno
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call, check_one_line
from maps import map_errors
from synthetic_results import orchard, room
from walls import rectangles

from graphslam.core.errors import ConfigError, OutputError
from graphslam.core.geometry import compose, polar_points
from graphslam.results import occupancy_grid
from graphslam.results.folder import save
from graphslam.results.grid_map import grid_map_files
from graphslam.results.line_map import svg_text
from graphslam.results.map_files import make_map
from graphslam.results.occupancy_grid import GridMap, OccupancyGrid, fan, grid_map
from graphslam.results.scans_file import PlacedScan, place_scans, read_scans, scans_bytes
from graphslam.simulation.raycast import BeamFan, cast_beams
from graphslam.simulation.world import Shapes

FAN = BeamFan(-np.radians(120), np.radians(0.5), 481)
ROOMS = rectangles((0, 0, 9, 6), (3, 2, 3.1, 6), (3.1, 2, 4.6, 2.1), (6, 3, 7, 4))
SENSOR = np.array([0.15, 0.0, 0.02])


def scans_in(walls, poses, rng=None, sigma=0.0, circles=None):
    """Scans as a run leaves them: points with range noise in the frame of each state."""
    circles = np.zeros((0, 3)) if circles is None else circles
    lasers = np.array([compose(pose, SENSOR) for pose in poses])
    shapes = Shapes(np.asarray(walls, dtype=float), circles)
    ranges = cast_beams(lasers, FAN, shapes, 30.0).ranges
    if rng is not None:
        ranges = ranges + rng.normal(0, sigma, ranges.shape)
    scans = []
    for k, (pose, r) in enumerate(zip(poses, ranges, strict=True)):
        known = np.isfinite(r)
        points = compose(SENSOR, np.column_stack([polar_points(r, FAN.angles), 0 * r])[known])
        scans.append(PlacedScan("robot", k, pose, SENSOR, points[:, :2].astype(np.float32)))
    return scans


def drive(steps=60):
    """Poses (n, 3) along the rooms, turning as it goes."""
    s = np.linspace(0, 1, steps)
    return np.column_stack([1 + 7 * s, 1.2 + 0.3 * np.sin(9 * s), 4 * np.sin(5 * s)])


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved") / "out"
    result = room(keyframes=60, beams=91)[0]
    save(result, folder, force=False)
    return folder, result


# ---------------------------------------------------------------- cells


def test_a_map_of_rooms_is_right_cell_by_cell():
    """With range noise of 2 cm and poses 1 cm off, as a good run has them. Breaks if beams are not
    followed to their ends, walls are erased by beams along them, or space behind walls is free."""
    rng = np.random.default_rng(2)
    scans = scans_in(ROOMS, drive(), rng, 0.02)
    shifted = [replace(s, pose=s.pose + rng.normal(0, [0.01, 0.01, 0.002])) for s in scans]
    grid = grid_map(shifted, 0.05)
    found = map_errors(grid, scans, Shapes(ROOMS, np.zeros((0, 3))))
    assert found["precision"] > 0.9
    assert found["recall"] > 0.95
    assert found["free"] > 0.99
    assert found["known"] > 0.9


def test_what_moves_is_not_in_the_map():
    """A person walks along: wherever scans later look through, nothing is left."""
    poses = np.repeat(drive(2)[:1], 30, axis=0)
    scans = []
    for k, x in enumerate(np.linspace(1.5, 2.8, 30)):
        scans += scans_in(ROOMS, poses[k : k + 1], circles=np.array([[x, 4.0, 0.2]]))
    alone = scans_in(ROOMS, poses)
    still = grid_map(alone, 0.05)
    moving = grid_map(scans, 0.05)

    def occupied_near(grid):
        j, i = np.nonzero(grid.occupied)
        x, y = grid.origin_m[0] + i * grid.cell_m, grid.origin_m[1] + j * grid.cell_m
        return int(((x > 1.2) & (x < 2.6) & (y > 3.5) & (y < 4.5)).sum())

    assert occupied_near(grid_map(scans[:1], 0.05)) > 3  # a single scan shows the person
    assert occupied_near(moving) == occupied_near(still) == 0


def test_beams_between_two_ends_clear_no_farther_than_the_nearer_one():
    """A post before a far wall, few beams: what is behind the post was not seen."""
    bearings = np.radians([-4, -2, 0, 2, 4.0])
    points = polar_points(np.array([8.0, 8.0, 2.0, 8.0, 8.0]), bearings)
    scan = PlacedScan("robot", 0, np.zeros(3), np.zeros(3), points)
    grid = grid_map([scan, scan], 0.1)

    def at(x, y):
        i = np.floor((np.array([x, y]) - grid.origin_m) / grid.cell_m).astype(int)
        return grid.log_odds[i[1], i[0]]

    assert at(1.0, 0.0) < 0 and at(6.0, 0.31) < 0  # before the post; before the wall
    assert np.isnan(at(5.0, 0.0)) and np.isnan(at(7.0, 0.1))
    assert at(2.0, 0.0) > 0


def test_missing_beams_clear_nothing_between_their_neighbours():
    bearings = np.radians([*range(-40, -9), *range(10, 41)])
    points = polar_points(np.full(len(bearings), 3.0), bearings)
    scan = PlacedScan("robot", 0, np.zeros(3), np.zeros(3), points)
    grid = grid_map([scan, scan], 0.1)
    ahead = int(-grid.origin_m[1] / grid.cell_m), int((2.0 - grid.origin_m[0]) / grid.cell_m)
    assert np.isnan(grid.log_odds[ahead])


def test_free_space_that_was_seen_through_walls_is_unknown():
    """An end that overshoots leaves free cells behind a wall, which nothing joins to the robot."""
    scans = scans_in(rectangles((0, 0, 4, 4)), np.tile([2.0, 2.0, 0.3], (12, 1)))
    k = int(np.argmin(np.abs(np.arctan2(*scans[0].points.T[::-1]))))
    for scan in scans[:2]:
        scan.points[k] *= 1.6
    grid = grid_map(scans, 0.05)
    x = grid.origin_m[0] + np.nonzero(grid.free)[1] * grid.cell_m
    assert x.max() < 4.0


@pytest.mark.parametrize("tile", [16, 100])
def test_tiles_do_not_show(tile, monkeypatch):
    """Equal counts with any tile; their memory is of where scans are, not of all between them."""
    scans = scans_in(ROOMS, drive(8))
    whole = grid_map(scans, 0.05)
    monkeypatch.setattr(occupancy_grid, "TILE", tile)
    small = grid_map(scans, 0.05)
    assert whole.origin_m == small.origin_m
    np.testing.assert_array_equal(whole.log_odds, small.log_odds)
    counts = OccupancyGrid(0.05)
    for away in ([0, 0, 0], [1e4, 1e4, 0]):
        counts.add(fan(replace(scans[0], pose=scans[0].pose + away)))
    assert len(counts.tiles) * (tile * 0.05) ** 2 < 4 * (9 + 2 * tile * 0.05) ** 2


@pytest.mark.parametrize("cell_m", [0.025, 0.01])
def test_walls_have_no_holes_where_cells_are_finer_than_beams(cell_m):
    """Beams are 5 cm apart here, ends and poses a centimetre off. Of the cells of a map as the
    scans allow, 5 cm, in which a wall is, hardly any shows free space and no wall in the finer map:
    a twentieth, where a wall at a cell's edge is in the next one. And what is drawn between ends
    is a wall: within 8 cm, four sigmas, of a true one."""
    rng = np.random.default_rng(3)
    scans = scans_in(ROOMS, drive(40), rng, 0.01)
    noise = [0.01, 0.01, 0.002]
    scans = [
        replace(s, pose=s.pose + rng.normal(0, noise), points=s.points[::3].copy()) for s in scans
    ]
    coarse, fine = grid_map(scans), grid_map(scans, cell_m)
    assert coarse.cell_m == 0.05

    def within(cells):
        """Which cells of the coarse map (rows, columns) hold such ones of the fine map."""
        found = np.zeros(coarse.log_odds.shape, dtype=bool)
        j, i = np.nonzero(cells)
        middle = np.column_stack([i + 0.5, j + 0.5]) * cell_m + fine.origin_m
        x, y = np.floor((middle - coarse.origin_m) / coarse.cell_m).astype(int).T
        inside = (x >= 0) & (y >= 0) & (x < found.shape[1]) & (y < found.shape[0])
        found[y[inside], x[inside]] = True
        return found

    walls = within(fine.occupied)
    holes = coarse.occupied & ~walls & within(fine.free)
    assert holes.sum() < 0.05 * coarse.occupied.sum()
    j, i = np.nonzero(fine.occupied)
    at = (np.column_stack([i, j]) + 0.5) * cell_m + fine.origin_m
    begin, along = ROOMS[:, 0], np.diff(ROOMS, axis=1)[:, 0]
    off = at[:, None] - begin
    share = np.clip((off * along).sum(axis=-1) / (along**2).sum(axis=-1), 0, 1)
    assert np.linalg.norm(off - share[..., None] * along, axis=-1).min(axis=1).max() < 0.08


def test_a_map_has_at_most_so_many_cells(saved, monkeypatch, tmp_path):
    """Refused in a line that names a resolution which is possible, and hardly finer ones are; by
    itself a map of two robots far apart has the cells for which there is room."""
    scan = scans_in(ROOMS, drive(1))[0]
    monkeypatch.setattr(occupancy_grid, "MOST_CELLS", 250_000)
    with pytest.raises(ConfigError, match=r"--resolution 0\.01: .* more than 250000 cells") as said:
        grid_map([scan], 0.01)
    finest = float(str(said.value).rpartition(" ")[2])
    cells = grid_map([scan], finest).log_odds.size
    assert 200_000 < cells <= 250_000  # two digits are a tenth at most, of the area a fifth
    for away in ([3000, 0, 0], [2100, 2100, 0], [1e6, 3e5, 0]):
        both = grid_map([scan, replace(scan, pose=scan.pose + away)])
        assert both.log_odds.size <= 250_000
    out = check_one_line(call("map", saved[0], "--resolution", "0.001", "-o", tmp_path / "a"))
    assert "the finest possible is 0.0" in out and not (tmp_path / "a").exists()


def test_an_order_of_scans_is_as_good_as_another():
    scans = scans_in(ROOMS, drive(10))
    one, other = grid_map(scans, 0.05), grid_map(scans[::-1], 0.05)
    np.testing.assert_array_equal(one.log_odds, other.log_odds)


# ---------------------------------------------------------------- map_server


def load_as_map_server(folder):
    """Cells (rows, columns), first row in the south, as nav2's map_server reads them."""
    fields = {}
    for line in (folder / "map.yaml").read_text().splitlines():
        if not line.startswith("#"):
            key, _, value = line.partition(": ")
            fields[key] = value
    assert set(fields) == {
        *("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
    }
    image = cv2.imread(str(folder / fields["image"]), cv2.IMREAD_UNCHANGED)
    shade = (image if image.ndim == 2 else image[..., 0]) / 255
    occupied = shade if int(fields["negate"]) else 1 - shade
    low, high = float(fields["free_thresh"]), float(fields["occupied_thresh"])
    cells = np.full(shade.shape, -1)
    if fields["mode"] == "scale":
        cells = np.rint((occupied - low) / (high - low) * 100)
    cells[occupied > high] = 100
    cells[occupied < low] = 0
    if fields["mode"] == "scale":
        cells[image[..., 3] < 255] = -1
    origin = json.loads(fields["origin"])
    return cells[::-1].astype(int), float(fields["resolution"]), origin


def test_map_server_reads_what_the_map_says(tmp_path):
    """Rows from the north, origin at the lower left corner, thresholds, unknown cells.

    In mode scale that is 100 times the probability, to half of the 1 % that map_server rounds to
    and half of the 1/255 of the image: less than 1.
    """
    odds = np.array([[np.nan, -1.5, 3.0], [-0.4, 0.5, np.nan]], dtype=np.float32)
    grid = GridMap(odds, 0.05, (-1.5, 2.25))
    for mode, expected in (
        ("trinary", [[-1, 0, 100], [-1, -1, -1]]),
        ("scale", np.where(np.isnan(odds), -1, 100 / (1 + np.exp(-odds)))),
    ):
        for name, content in grid_map_files(grid, "map", mode):
            (tmp_path / name).write_bytes(
                content if isinstance(content, bytes) else content.encode()
            )
        cells, resolution, origin = load_as_map_server(tmp_path)
        assert (resolution, origin) == (0.05, [-1.5, 2.25, 0.0])
        assert np.abs(cells - expected).max() < (1 if mode == "scale" else 1e-9)


# ---------------------------------------------------------------- files


def test_scans_are_read_back_as_they_were(saved):
    folder, result = saved
    back = read_scans(folder / "scans.npz")
    placed = place_scans(result.keyframe_scans, result.estimate.states)
    assert len(back) == len(placed) > 50
    for a, b in zip(placed, back, strict=True):
        assert (a.robot, a.time_ns) == (b.robot, b.time_ns)
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_array_equal(a.sensor, b.sensor)
        np.testing.assert_allclose(a.points, b.points, atol=1e-6)
    assert read_scans(folder / "missing.npz") == ()
    assert scans_bytes(back) == (folder / "scans.npz").read_bytes()


def test_drawings_and_tables_hold_every_landmark_and_path(saved, tmp_path):
    folder, result = saved
    names = [name for name, _ in make_map(folder, tmp_path / "new").files]
    assert sorted(names) == sorted(p.name for p in (tmp_path / "new").iterdir())
    walls = np.sort([m.extent.ravel() for m in result.landmarks], axis=0)

    dxf = (tmp_path / "new/map.dxf").read_text().split("\n")[:-1]
    pairs = list(zip(map(int, dxf[::2]), dxf[1::2], strict=True))
    assert pairs[-1] == (0, "EOF") and (9, "$INSUNITS") in pairs
    lines = [k for k, pair in enumerate(pairs) if pair == (0, "LINE")]
    ends = [[float(v) for c, v in pairs[k : k + 8] if c in (10, 20, 11, 21)] for k in lines]
    np.testing.assert_allclose(np.sort(ends, axis=0), walls, atol=1e-6)

    found = json.loads((tmp_path / "new/map.geojson").read_text())
    lines = [f for f in found["features"] if f["properties"]["layer"] == "walls"]
    ends = [np.ravel(f["geometry"]["coordinates"]) for f in lines]
    np.testing.assert_allclose(np.sort(ends, axis=0), walls, atol=1e-6)

    svg = ET.fromstring((tmp_path / "new/map.svg").read_text())
    space = "{http://www.w3.org/2000/svg}"
    assert len(svg.findall(f".//{space}line")) == len(walls)
    _, _, width, height = map(float, svg.get("viewBox").split())
    for line in svg.iter(f"{space}line"):
        assert 0 < float(line.get("x1")) < width and 0 < float(line.get("y1")) < height

    rows = list(csv.DictReader((tmp_path / "new/landmarks.csv").read_text().splitlines()))
    assert [int(row["id"]) for row in rows] == [m.id for m in result.landmarks]
    assert float(rows[3]["xx_m2"]) == result.landmarks[3].cov[0, 0]
    rows = list(csv.DictReader((tmp_path / "new/trajectories.csv").read_text().splitlines()))
    final = result.robots["robot"].final
    assert [int(row["stamp_ns"]) for row in rows] == final.stamps_ns.tolist()
    np.testing.assert_allclose([float(row["x_m"]) for row in rows], final.poses[:, 0], atol=1e-9)
    sigma = np.sqrt(final.covs[:, 1, 1])
    np.testing.assert_allclose([float(row["y_sigma_m"]) for row in rows], sigma)


def test_without_scans_there_are_drawings_and_tables_of_points(tmp_path):
    save(orchard(keyframes=30, trees=9)[0], tmp_path / "out", force=False)
    made = make_map(tmp_path / "out", tmp_path / "out")
    assert made.grid is None and made.to_dict()["grid"] is None
    assert not (tmp_path / "out/map.yaml").exists()
    dxf = (tmp_path / "out/map.dxf").read_text()
    assert dxf.count("\nPOINT\n") == 9 and dxf.count("\nPOLYLINE\n") == 2


def test_robots_that_nothing_places_are_in_no_map(saved, tmp_path):
    """Their poses are in frames of their own: drawn together they would look like one map."""
    _, result = saved
    summary = {**result.summary, "world": "other", "frames": {"robot": "robot", "other": "other"}}
    save(replace(result, summary=summary), tmp_path / "out", force=False)
    made = make_map(tmp_path / "out", tmp_path / "out")
    assert made.grid is None
    assert "POLYLINE" not in (tmp_path / "out/map.dxf").read_text()
    assert (tmp_path / "out/trajectories.csv").read_text().count("\nrobot,") == 60


def test_a_table_of_poses_says_in_which_frame_they_are(saved, tmp_path):
    """As landmarks.csv does. Drawn from the table alone, two frames would look like one world."""
    _, result = saved
    robots = dict.fromkeys(("robot", "other"), result.robots["robot"])
    summary = {**result.summary, "world": "robot", "frames": {"robot": "robot", "other": "other"}}
    save(replace(result, robots=robots, summary=summary), tmp_path / "out", force=False)
    make_map(tmp_path / "out", tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "out/trajectories.csv").read_text().splitlines()))
    assert list(rows[0])[-1] == "frame"  # columns are only added, at the end
    assert {(row["robot"], row["frame"]) for row in rows} == {("robot", ""), ("other", "other")}


def test_a_resolution_is_kept_and_a_result_without_its_scans_says_so(saved, tmp_path):
    folder, _ = saved
    made = make_map(folder, tmp_path / "a", resolution_m=0.2)
    assert made.to_dict()["grid"]["resolution_m"] == 0.2
    assert "resolution: 0.2\n" in (tmp_path / "a/map.yaml").read_text()
    old = tmp_path / "old"
    old.mkdir()
    for path in folder.rglob("*.*"):
        if path.name != "scans.npz":
            (old / path.relative_to(folder)).parent.mkdir(exist_ok=True)
            (old / path.relative_to(folder)).write_bytes(path.read_bytes())
    with pytest.raises(OutputError, match="run smooth again"):
        make_map(old, tmp_path / "b")
    assert not (tmp_path / "b").exists()


# ---------------------------------------------------------------- whole or not at all


def test_files_that_exist_are_kept_without_force(saved, tmp_path):
    folder, _ = saved
    (tmp_path / "map.yaml").write_text("edited")
    with pytest.raises(OutputError, match=r"map.yaml: already exists; give --force"):
        make_map(folder, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["map.yaml"]
    make_map(folder, tmp_path, force=True)
    assert (tmp_path / "map.yaml").read_text() != "edited"


@pytest.mark.parametrize(
    "problem",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EROFS, "Read-only file system"),
        KeyboardInterrupt(),
    ],
    ids=str,
)
def test_a_full_disk_or_ctrl_c_leaves_what_was_there(saved, tmp_path, monkeypatch, problem):
    """Breaks if files are written under their names: a half map looks like a whole one."""
    folder, _ = saved
    make_map(folder, tmp_path / "old")
    before = {p: p.read_bytes() for p in (tmp_path / "old").iterdir()}
    write, written = Path.write_bytes, []

    def fails(path, content):
        written.append(path)
        if len(written) == 3:
            write(path, content[: len(content) // 2])
            raise problem
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", fails)
    for target in ("old", "new"):
        written.clear()
        with pytest.raises((OutputError, KeyboardInterrupt)):
            make_map(folder, tmp_path / target, resolution_m=0.3, force=True)
    assert {p: p.read_bytes() for p in (tmp_path / "old").iterdir()} == before
    assert [p.name for p in tmp_path.iterdir()] == ["old"]


def test_a_target_that_is_no_folder_is_an_error_in_one_line(saved, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="cannot be written"):
        make_map(saved[0], tmp_path / "file" / "map")


def test_a_drawing_is_as_large_as_the_map_wherever_that_is(saved):
    """The world's origin was always in it: of a building kilometres away nothing could be seen."""
    _, result = saved
    far = np.array([1000.0, -2000.0])
    moved = [replace(m, extent=m.extent + far) for m in result.landmarks]

    def size(landmarks):
        svg = ET.fromstring(svg_text(landmarks, {}))
        return [float(v) for v in svg.get("viewBox").split()[2:]]

    assert size(moved) == pytest.approx(size(result.landmarks), abs=1e-3)
    assert min(size([])) > 0
