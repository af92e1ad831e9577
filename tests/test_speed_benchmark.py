"""The speed benchmark: what it concludes from its measurements, and what it measures on."""

import json
import sys
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from common import measured_process, peak_mb
from paths import ROOT
from speed_jobs import all_jobs, moved_vertices
from speed_logs import BLOCKS, PITCH_M, building, grid_pose_graph, rings, robots
from speed_runs import gtsam_isam2, gtsam_lm, step_statistics
from speed_tables import (
    SECTIONS,
    TOLERANCE,
    YARDSTICK_S,
    bars_missed,
    baseline_of,
    cost,
    exponents,
    failures,
    regressions,
    tables,
    with_tables,
)

from graphslam.simulation.scene import prepare_visits


def run(wall=2.0, cpu=3.0, yardstick=1.0, **more):
    return {
        "wall_s": wall,
        "cpu_s": cpu,
        "peak_mb": 100.0,
        "yardstick_wall_s": yardstick,
        "yardstick_cpu_s": yardstick,
        **more,
    }


def measured(**groups):
    seconds = {"wall_s": {"gtsam": 1.0, "all": 1.0}, "cpu_s": {"gtsam": 1.0, "all": 1.0}}
    return {
        "made": "2003-06-01",
        "machine": {"cores": 2},
        "versions": {},
        "repeats": 1,
        "yardstick": [seconds],
        "groups": groups,
    }


# ---------------------------------------------------------------- conclusions


def test_exponents_are_of_doublings_only():
    found = exponents({1: 1.0, 2: 4.0, 4: 8.0, 12: 1.0})
    assert found == {2: 2.0, 4: 1.0}


def test_a_slow_minute_of_the_machine_does_not_change_a_ratio():
    """The second run and its yardstick took three times as long. Breaks with means."""
    calm, slow = run(2.0, 3.0), run(6.0, 9.0, yardstick=3.0)
    found = cost([calm, slow])
    assert (found.wall_ratio, found.cpu_ratio) == (2.0, 3.0)
    assert (found.wall_s, found.wall_spread) == (2.0, 2.0)


def test_a_fast_moment_in_which_only_the_yardstick_ran_does_not_change_a_ratio():
    """Breaks if the least time of a job is divided by the least of the yardsticks."""
    found = cost([run(2.0, 3.0), run(2.0, 3.0), run(2.0, 3.0, yardstick=0.7)])
    assert (found.wall_ratio, found.cpu_ratio) == (2.0, 3.0)


def test_a_faster_machine_does_not_hide_a_regression_and_a_slower_one_makes_none():
    baseline = baseline_of(measured(jobs={"lab": {"what": "", "runs": [run()]}}))

    def against(**changed):
        return regressions(
            baseline_of(measured(jobs={"lab": {"what": "", "runs": [run(**changed)]}})), baseline
        )

    assert not against(wall=20.0, cpu=30.0, yardstick=10.0)
    (line,) = against(wall=1.0, cpu=1.5 * 1.3, yardstick=0.5)
    assert line.startswith("lab: cpu_ratio")


@pytest.mark.parametrize(("factor", "lines"), [(0.5, 0), (0.99, 0), (1.01, 1)])
def test_the_gate_fails_above_its_tolerance(factor, lines):
    now = {"lab": {"cpu_ratio": factor * TOLERANCE * 2.0}, "new": {"cpu_ratio": 99.0}}
    assert len(regressions(now, {"lab": {"cpu_ratio": 2.0}, "gone": {"cpu_ratio": 1.0}})) == lines


def test_bars_in_seconds_are_scaled_by_the_yardstick_and_memory_is_not():
    bars = {"wall_s": 15.0, "cpu_s": 25.0, "peak_mb": 99.0}
    here = cost([run(wall=20.0, cpu=20.0, yardstick=YARDSTICK_S)])
    assert bars_missed(here, bars) == ["wall_s", "peak_mb"]
    slow = cost([run(wall=20.0, cpu=20.0, yardstick=2 * YARDSTICK_S)])
    assert bars_missed(slow, bars) == ["peak_mb"]


def test_growth_of_steps_is_that_of_their_ends():
    found = step_statistics(np.concatenate([np.full(20, 1.0), np.full(60, 9.0), np.full(20, 3.0)]))
    assert (found["first_fifth_ms"], found["last_fifth_ms"]) == (1.0, 3.0)
    assert found["p50_ms"] == 9.0


# ---------------------------------------------------------------- tables


def test_a_job_that_could_not_run_says_why_and_a_failed_one_counts():
    found = measured(
        jobs={
            "intel": {"what": "", "runs": [], "absent": "no data"},
            "lab": {"what": "", "runs": [], "failed": "exit code 1"},
        }
    )
    text = "\n".join(tables(found))
    assert "no data" in text
    assert "exit code 1" in text
    assert failures(found) == ["lab: failed, exit code 1"]


def test_tables_of_a_page_are_replaced_and_nothing_else():
    laps = {
        f"laps-{n}": {"what": str(n), "runs": [run(cpu=n**2, keyframes=10 * n, error_m=0.01)]}
        for n in (1, 2)
    }
    page = (
        "before\n<!-- speed: laps -->\nold\n<!-- end -->\nbetween\n"
        "<!-- speed: peers -->\nstays\n<!-- end -->\n"
    )
    made = with_tables(page, measured(laps=laps))
    assert made.startswith("before\n<!-- speed: laps -->\n| rounds |")
    assert "old" not in made
    assert made.endswith("between\n<!-- speed: peers -->\nstays\n<!-- end -->\n")
    assert "| 2.00 |" in made  # the exponent
    assert with_tables(made, measured(laps=laps)) == made
    with pytest.raises(ValueError, match="lap"):
        with_tables("<!-- speed: lap -->\n<!-- end -->", measured(laps=laps))


def test_the_page_has_every_table_and_the_baseline_only_jobs_that_there_are(tmp_path):
    page = (ROOT / "docs/performance.md").read_text(encoding="utf-8")
    assert all(f"<!-- speed: {name} -->" in page for name in SECTIONS)
    with_tables(page, measured())
    lengths = (1, 2, 4, 8, 16, 32)
    jobs = {job.name for job in all_jobs(tmp_path, lengths, lengths, "lab")}
    baseline = json.loads((ROOT / "benchmarks/speed_baseline.json").read_text(encoding="utf-8"))
    assert baseline
    assert set(baseline) <= jobs


# ---------------------------------------------------------------- what is measured


def test_memory_is_that_of_the_command_and_not_of_who_starts_it():
    """Breaks when this process, which has libraries in memory, starts the command itself."""
    printed, used = measured_process([sys.executable, "-S", "-c", "print('x' * 3)"])
    assert printed == b"xxx\n"
    assert used.peak_mb < 30 < 60 < peak_mb()
    assert 0 < used.cpu_s < 10


def test_a_drive_of_n_laps_is_n_times_as_long():
    def path_m(laps):
        (visit,) = prepare_visits(rings(laps))
        return visit.actors["vehicle"].drive.at(np.array([visit.duration_s])).travel[0]

    assert path_m(2) == pytest.approx(2 * path_m(1), rel=0.02)


def test_every_corridor_of_the_building_is_driven_and_places_are_seen_again():
    vehicle = building().robots["vehicle"]
    points = np.array([vehicle.start_m, *vehicle.drive[0].through_m]) / PITCH_M
    driven = []
    for a, b in pairwise(points.round().astype(int)):
        count = abs(b - a).max()
        assert min(abs(b - a)) == 0 < count
        driven += [tuple(sorted(map(tuple, (a + (b - a) * [[k], [k + 1]] // count).tolist())))
                   for k in range(count)]  # fmt: skip
    columns, rows = BLOCKS
    assert len(set(driven)) == columns * (rows + 1) + rows * (columns + 1)
    assert min(driven.count(corridor) for corridor in set(driven)) >= 2


def test_five_robots_do_not_collide():
    (visit,) = prepare_visits(robots(2))
    assert len(visit.actors) == 5


def test_the_noise_of_the_pose_graph_is_what_the_file_says(tmp_path):
    """Twice the error that is left is chi-square distributed; both loops get there."""
    path = tmp_path / "grid.g2o"
    path.write_text(grid_pose_graph(400), encoding="utf-8")
    graph, _ = gtsam.readG2o(str(path), False)
    dof = 3 * (graph.size() - 399)
    assert dof > 100
    found = gtsam_lm(str(path))
    assert abs(2 * found["error"] - dof) < 4 * np.sqrt(2 * dof)
    assert gtsam_isam2(str(path))["error"] == pytest.approx(found["error"], rel=0.02)
    start = tmp_path / "start.g2o"
    start.write_text(moved_vertices(path.read_text(encoding="utf-8")), encoding="utf-8")
    assert gtsam_lm(str(start))["error"] == pytest.approx(found["error"], rel=1e-4)


def test_moved_vertices_leave_the_measurements_and_the_frame():
    before = grid_pose_graph(30).splitlines()
    after = moved_vertices("\n".join(before)).splitlines()
    assert after[0] == before[0]
    assert after[30:] == before[30:]
    assert all(a != b for a, b in zip(after[1:30], before[1:30], strict=True))
