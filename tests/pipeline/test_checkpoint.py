"""A run that goes on where a killed one was: the same result, and nothing of others."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from room_log import START_NS, S, drive

import graphslam
from graphslam.core.errors import OutputError
from graphslam.logs import LogWriter, open_logs
from graphslam.pipeline import checkpoint

COMPARED = ("trajectories/*", "landmarks.json", "graph.g2o", "graph_ids.csv", "*.npz")


class Killed(BaseException):
    """What a run ends with right after it kept something."""


def sightings(path):
    """Two robots that see the same points, and each other's start."""
    rng = np.random.default_rng(3)
    with LogWriter(path) as log:
        for robot, side in (("a", 0.0), ("b", 1.0)):
            for k in range(40):
                x, stamp = 0.15 * k, START_NS + k * S // 5
                log.odometry(robot, stamp, (1.02 * x, 0, 0))
                for name, (px, py) in {"p": (2.0, 3.0), "q": (5.0, -2.0), "r": (8.0, 4.0)}.items():
                    d = px - x, py - side
                    z = np.array([np.arctan2(d[1], d[0]), np.hypot(*d)]) + rng.normal(0, 0.01, 2)
                    log.sighting(robot, stamp, z, np.diag([1e-4, 1e-4]), identity=name)
    return path


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    return {
        "scans": drive(folder / "room.mcap", seconds=8),
        "two lasers": drive(folder / "lasers.mcap", seconds=8, rear=True),
        "sightings": sightings(folder / "sightings.mcap"),
    }


def content(result):
    paths = [path for pattern in COMPARED for path in sorted(result.glob(pattern))]
    return {path.name: path.read_bytes() for path in paths}


@pytest.fixture()
def killed(monkeypatch):
    """Runs until a stage was kept, as a process does that is killed then."""
    keep = checkpoint.Checkpoint._keep

    def run(*arguments, **settings):
        def and_die(self, name, value):
            keep(self, name, value)
            self._lock.close()  # as the system does for the dead
            raise Killed

        with monkeypatch.context() as patch:
            patch.setattr(checkpoint.Checkpoint, "_keep", and_die)
            patch.setattr(checkpoint.Checkpoint, "close", lambda _self, remove: None)
            with pytest.raises(Killed):
                graphslam.smooth(*arguments, resume=True, **settings)

    return run


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("scans", {}),
        ("two lasers", {}),
        ("sightings", {"start": {"poses": {"a": [0, 0, 0]}}}),
        ("sightings", {"association": {"identities": "ignore"}, "backend": "isam2"}),
    ],
)
def test_killed_after_every_stage_the_result_is_the_same_to_the_byte(
    logs, kind, settings, killed, tmp_path
):
    graphslam.smooth(logs[kind], output=tmp_path / "whole", **settings)
    stages = []
    for _ in range(3):
        killed(logs[kind], output=tmp_path / "out", **settings)
        stages = sorted(p.name for p in (tmp_path / ".out.checkpoint").glob("*.records"))
    assert stages == ["pass-1.records", "result.records", "starts.records"]
    done = graphslam.smooth(logs[kind], output=tmp_path / "out", resume=True, **settings)
    assert content(tmp_path / "out") == content(tmp_path / "whole")
    assert done.summary["resumed"] == ["result"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "whole"]


def test_what_another_log_or_setting_or_a_damaged_disk_left_is_not_used(logs, killed, tmp_path):
    out, kept = tmp_path / "out", tmp_path / ".out.checkpoint"
    killed(logs["scans"], output=out)

    def resumed(*arguments, **settings):
        with pytest.MonkeyPatch.context() as patch:  # what is kept stays for the next case
            patch.setattr(checkpoint.Checkpoint, "_keep", lambda *_: None)
            patch.setattr(checkpoint.shutil, "rmtree", lambda *_, **__: None)
            log = open_logs([logs["scans"]], graphslam.load_config())
            with checkpoint.checkpoint(out, log, *arguments, resume=True, **settings) as one:
                one.stage("starts", lambda: None)
        return one.resumed

    assert resumed(graphslam.load_config()) == ["starts"]
    assert resumed(graphslam.load_config(keyframe={"distance_m": 0.5})) == []
    whole = (kept / "starts.records").read_bytes()
    (kept / "starts.records").write_bytes(whole[:-1])
    assert resumed(graphslam.load_config()) == []
    (kept / "starts.records").write_bytes(whole)
    graphslam.smooth(logs["scans"], output=out)  # not asked to go on
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


HOLD = """
import sys
from pathlib import Path
from graphslam.pipeline.checkpoint import _locked
held = _locked(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def test_where_another_process_is_at_work_a_run_is_refused_or_keeps_nothing(logs, tmp_path):
    out, folder = tmp_path / "out", tmp_path / ".out.checkpoint"
    folder.mkdir()
    root = str(Path(graphslam.__file__).parents[1])
    words = [sys.executable, "-c", HOLD, str(folder / "lock")]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={"PYTHONPATH": root}
    ) as other:
        other.stdout.readline()
        with pytest.raises(OutputError, match="another process is at work"):
            graphslam.smooth(logs["scans"], output=out, resume=True)
        graphslam.smooth(logs["scans"], output=out)
        assert out.is_dir() and folder.is_dir()
        other.stdin.close()


def test_a_long_run_keeps_its_stages_unasked_and_they_go_with_it(logs, monkeypatch, tmp_path):
    monkeypatch.setattr(checkpoint, "LONG_S", 0.0)
    found, keep = [], checkpoint.Checkpoint._keep

    def seen(self, name, value):
        keep(self, name, value)
        found.extend(p.name for p in (tmp_path / ".out.checkpoint").glob("*.records"))

    monkeypatch.setattr(checkpoint.Checkpoint, "_keep", seen)
    graphslam.smooth(logs["scans"], output=tmp_path / "out")
    assert "result.records" in found
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_resume_without_an_output_is_an_error(logs):
    with pytest.raises(OutputError, match="resume"):
        graphslam.smooth(logs["scans"], resume=True)
