"""Trajectory files are what evo reads: its rules, and evo itself where it is installed."""

import csv
import importlib.util

import numpy as np
import pytest
from synthetic_results import orchard, room

from graphslam.results.folder import save


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("evo")
    for name, made in (("room", room(40, 21)[0]), ("orchard", orchard(30, 6)[0])):
        save(made, folder / name, force=False)
    found = sorted(folder.rglob("*.tum"))
    assert len(found) == 5 + 2 * 3
    return found


def test_files_keep_the_rules_of_evos_parser(files):
    """Eight numbers with one space between, none at the end of a line, no line without; stamps
    ascend and differ as floats; quaternions of unit length (evo.tools.file_interface and
    PoseTrajectory3D.check)."""
    for path in files:
        with path.open(encoding="utf-8") as stream:
            rows = list(csv.reader(stream, delimiter=" "))
        assert rows and {len(row) for row in rows} == {8}, path
        table = np.array(rows).astype(float)
        assert (np.diff(table[:, 0]) > 0).all()
        assert np.allclose(np.linalg.norm(table[:, 4:], axis=1), 1.0)


@pytest.mark.skipif(not importlib.util.find_spec("evo"), reason="needs evo")
def test_evo_reads_every_file(files):
    from evo.core import metrics, sync
    from evo.tools.file_interface import read_tum_trajectory_file

    for path in files:
        valid, details = read_tum_trajectory_file(path).check()
        assert valid, (path, details)
    final, odometry = (
        read_tum_trajectory_file(next(p for p in files if p.name == name))
        for name in ("robot.tum", "robot.odometry.tum")
    )
    final, odometry = sync.associate_trajectories(final, odometry)
    error = metrics.APE(metrics.PoseRelation.translation_part)
    error.process_data((final, odometry))
    assert error.get_statistic(metrics.StatisticsType.rmse) > 0
