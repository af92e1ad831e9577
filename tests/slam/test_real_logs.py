"""Real logs from end to end: the bars that the README names, where a test can afford them.

The long logs (intel and aces whole) are run by benchmarks/real_logs.py.
"""

from pathlib import Path

import numpy as np
import outlier_closures as outliers
import pytest
import victoria_park
from paths import real_data

import graphslam
from graphslam.core.config import Config
from graphslam.core.records import Trajectory
from graphslam.estimation.isam2 import Isam2Backend
from graphslam.estimation.replay import replay
from graphslam.evaluation.relation_metrics import read_relations, relation_metrics
from graphslam.importers import IMPORTERS
from graphslam.logs import open_logs
from graphslam.results.folder import save
from graphslam.slam.smooth import smooth


def error_of_all_poses(source, folder):
    """GTSAM's error of the file's own factors at our result."""
    graph, own = victoria_park.file_graph(source)
    directory = victoria_park.smooth_all_poses(source, folder)
    return graph.error(victoria_park.values_of(directory, own))


def test_part_of_victoria_park_reaches_its_optimum(tmp_path):
    """Its first 2700 poses: 1075.15; Levenberg-Marquardt from odometry stops at 2175."""
    part = tmp_path / "part.txt"
    rows = [line.split() for line in Path(victoria_park.SOURCE).read_text().splitlines()]
    kept = [row for row in rows if max(int(number) for number in row[1:3]) < 2700]
    part.write_text("".join(" ".join(row) + "\n" for row in kept))
    assert victoria_park.optimum(*victoria_park.file_graph(str(part))) > 2000
    assert error_of_all_poses(str(part), tmp_path) <= 1076.2


@pytest.mark.slow
def test_victoria_park_reaches_its_optimum(tmp_path):
    """The optimum is 2339.22; Levenberg-Marquardt from odometry stops at 106 084. 0.1 % more is
    allowed: our sightings are transported to the base frame, and stamps and poses go through
    text."""
    assert error_of_all_poses(victoria_park.SOURCE, tmp_path) <= victoria_park.BAR


@pytest.mark.slow
def test_victoria_park_by_default_is_near_its_optimum(tmp_path):
    """From odometry alone a batch ends in a local minimum, 105 797 by the file's factors. Other
    weights and fewer poses than the file's: 8 300 here, and 10 000 is allowed."""
    log = tmp_path / "log.mcap"
    IMPORTERS["isam"](Path(victoria_park.SOURCE), log)
    save(victoria_park.smooth_log(log, Config()), tmp_path / "result", force=False)
    graph, own = victoria_park.file_graph()
    assert graph.error(victoria_park.values_of(tmp_path / "result", own)) < 10_000


def test_mit_reaches_its_optimum(tmp_path):
    """The optimum is 20.60347; Levenberg-Marquardt from odometry ends at 385."""
    source = real_data("graphs/MIT.g2o")
    assert error_of_all_poses(str(source), tmp_path) <= 20.7


def test_isam2_solves_mit_though_cholesky_fails_on_the_way(tmp_path, monkeypatch):
    """It calls the graph indeterminate with Cholesky at pose 165 and goes on with QR."""
    IMPORTERS["g2o"](real_data("graphs/MIT.g2o"), tmp_path / "log.mcap")
    result = smooth(open_logs([tmp_path / "log.mcap"], Config()), Config())
    fallbacks = []
    use_qr = Isam2Backend._use_qr

    def counted(backend, error):
        fallbacks.append(str(error))
        use_qr(backend, error)

    monkeypatch.setattr(Isam2Backend, "_use_qr", counted)
    found = replay(result.steps, Isam2Backend(Config())).estimate
    assert fallbacks
    assert found.error <= 20.7 and abs(found.error - result.estimate.error) < 1e-5


@pytest.fixture(scope="module")
def intel():
    log = open_logs([real_data("mcap/intel_first600s.mcap")], Config())
    return smooth(log, Config())


def test_the_first_ten_minutes_of_intel_as_a_ros_2_log(intel):
    """Read through the same path as our own logs: every scan has a pose, lines are found and found
    again (several observations per landmark), nothing is dropped but what was never seen again."""
    summary, counts = intel.summary, intel.summary["counts"]
    found = intel.robots["robot"]
    assert counts["messages"] == 9036
    assert counts["scans"] == 3035 == len(found.scan_final)
    assert np.all(np.diff(found.scan_final.stamps_ns) > 0)
    assert 300 < counts["keyframes"] < 1500
    assert 50 < counts["landmarks"] < 250 and counts["observations"] > 10 * counts["landmarks"]
    assert set(summary["dropped"]) <= {
        "tentative landmark: not seen often enough",
        "range: of a thing that moves",  # people
    }
    assert sum(summary["rejected"].values()) < 0.1 * counts["observations"]
    assert counts["loop_closures"] > 0
    # the models say what the residuals are: a factor of two in chi-square either way
    assert 0.25 < summary["graph"]["error"] / (0.5 * summary["graph"]["dof"]) < 2.0


def test_the_first_ten_minutes_of_intel_against_its_relations(intel):
    """Ten minutes do better than the bars of the whole log (loops' median 0.3 m, local 0.0185 m).

    The file's stamps went through a float, so they match the relations' to 1 µs; and it was sorted
    by stamp, so scans that were stamped late stand where their stamps say and cannot be placed:
    they are the tail that takes the mean of 0.017 m (from the CARMEN log) to 0.026 m."""
    relations = read_relations(real_data("freiburg/intel.relations"))
    scans = intel.robots["robot"].scan_final
    stamps = (scans.stamps_ns + 500) // 1000 * 1000
    metrics = relation_metrics(relations, Trajectory(stamps, scans.poses, scans.covs))
    assert metrics["local"]["n"] > 200 and metrics["loops"]["n"] > 100
    assert metrics["local"]["trans_median_m"] < 0.0185
    assert metrics["local"]["trans_mean_m"] < 0.035
    assert metrics["loops"]["trans_median_m"] < 0.1
    assert metrics["all"]["rot_mean_deg"] < 2.0


@pytest.mark.parametrize("robots", [1, 2])
def test_csail_among_250_false_closures(robots):
    """All false closures are refused and all true ones kept, whether the graph is of one robot or
    of two of which the second starts nobody knows where, and what comes out is the optimum (20.275
    with the odometry from 522 to 523, which the two robots' files lack; 20.159 without). 0.01 is
    more than the digits and the convergence of either."""
    real_data(f"graphs/{outliers.CLEAN}")
    run = outliers.run(real_data("graphs"), outliers.ONE if robots == 1 else outliers.TWO)
    assert (run.true, run.kept, run.false, run.believed) == (128, 128, 250, 0)
    assert run.error <= run.best + 0.01
    assert run.best == pytest.approx(20.275 if robots == 1 else 20.159, abs=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("start_sigma_m", [0.01, 0.0101])
def test_five_robots_find_landmarks_without_names(tmp_path, start_sigma_m):
    """The 15 landmarks of MRCLAM 6, of which groups of two or three stand 18 cm apart, and 0.105 m.

    Where association is near its limits the end hangs on rounding: it was 0.11 m with one start
    prior and 0.8 m with another, a hundredth wider.
    """
    log = tmp_path / "log.mcap"
    IMPORTERS["mrclam"](real_data("mrclam/MRCLAM_Dataset6.tar.xz"), log)
    settings = {"from_truth": True, "truth_sigma_m": start_sigma_m}
    result = graphslam.smooth(log, association={"identities": "ignore"}, start=settings)
    errors = graphslam.evaluate(result, truth=log)
    assert errors["joint"]["final"]["ate_rmse_m"] < 0.105
    assert (errors["landmarks"]["missed"], errors["landmarks"]["extra"]) == (0, 0)


def test_two_drives_through_a_lab_full_of_legs_of_tables_are_one_map(tmp_path):
    """Nearly all places of the second are recognised at one relative pose. Most have something in
    free space of the first, but so have the places that the second drive itself passes again: that
    is no doubt. Change detection, which aligns all scans, puts the second drive there too."""
    logs = [tmp_path / "monday.mcap", tmp_path / "tuesday.mcap"]
    for number, log in enumerate(logs, 1):
        IMPORTERS["tinyslam"](real_data(f"tinyslam/exp{number}.dat.xz"), log)
    config = graphslam.load_config(**{"logs.same_place": True})
    result = smooth(open_logs(logs, config), config)
    assert result.summary["frames"] == {"monday": "monday", "tuesday": "monday"}
    start = result.summary["starts_found"]["tuesday"]
    off = np.array([start["x"], start["y"], start["phi"]]) - [1.35, -0.32, 0.03]
    assert (np.abs(off) < [0.15, 0.15, 0.03]).all()  # the drives bend by a few decimetres
    assert not any("places contradict" in line for line in result.summary["warnings"])
    assert result.summary["verdict"]["verdict"] == "good"
