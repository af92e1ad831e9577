"""MRCLAM data sets: what the files say is what the log says."""

import tarfile
import zipfile

import numpy as np
import pytest
from paths import real_data

from graphslam.core import records
from graphslam.core.config import Config, OdometryConfig
from graphslam.core.errors import LogError
from graphslam.core.geometry import compose, exp
from graphslam.importers import IMPORTERS
from graphslam.importers.import_mrclam import COMMANDED, MAX_ARC_NS
from graphslam.logs import open_logs, read_truth
from graphslam.pipeline.robot_settings import odometry_settings

START = 1248444187

#: two robots that start two seconds apart, a landmark (6), an unknown barcode (99)
FILES = {
    "Barcodes.dat": "# Subject # Barcode #\n 1 \t 5 \n 2 14\n 6 63\n",
    "Landmark_Groundtruth.dat": "# ...\n 6 \t 0.5 \t -4.25 \t 0.00004 \t 0.0003 \n",
    "Robot1_Odometry.dat": (
        f"# Time v w\n{START}.156 \t 0.1 \t 0.0 \n{START}.656 0.2 -0.4\n"
        f"{START + 1}.156 0.0 0.5\n{START + 2}.156 0.0 0.0\n"
    ),
    "Robot1_Measurement.dat": (
        f"{START}.700 63 2.5 -0.25\n{START}.700 14 1.5 0.125\n{START}.800 99 1.0 0.0\n"
        f"{START}.900 5 1.0 0.0\n"
    ),
    "Robot1_Groundtruth.dat": f"{START}.103 1.5 -3.5 2.25\n",
    "Robot2_Odometry.dat": f"{START + 2}.000 0.1 0.1\n{START + 3}.000 0.1 0.1\n",
    "Robot2_Measurement.dat": f"{START + 2}.500 5 3.0 0.5\n",
}


def write_folder(folder, files):
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    return folder


def imported(source, target):
    summary = IMPORTERS["mrclam"](source, target)
    return summary, list(open_logs([target], Config()).messages())


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path / "set", FILES)


def of(messages, kind, robot):
    return [m for m in messages if isinstance(m, kind) and m.robot == robot]


def test_a_velocity_holds_until_the_next_row(folder, tmp_path):
    """Taking the velocity at the end of an interval, or a straight line for its arc, breaks it."""
    _, messages = imported(folder, tmp_path / "log.mcap")
    odometry = of(messages, records.OdometryPose, "robot1")
    expected = np.zeros(3)
    for twist in ([0.05, 0, 0], [0.1, 0, -0.2], [0, 0, 0.5]):
        expected = compose(expected, exp(np.array(twist, dtype=float)))
    # heading goes through a quaternion and back
    np.testing.assert_allclose(odometry[-1].pose, expected, atol=1e-12)
    np.testing.assert_allclose(odometry[1].pose, [0.05, 0, 0], atol=1e-12)


def test_the_log_says_that_its_odometry_is_commanded(folder, tmp_path):
    """What the log notes applies where the configuration leaves the default."""
    imported(folder, tmp_path / "log.mcap")
    notes = open_logs([tmp_path / "log.mcap"], Config()).notes
    found = odometry_settings(OdometryConfig(k_x_m=0.5), notes)
    assert found.commanded_velocities
    assert found.k_x_m == 0.5
    assert found.k_phi_rad == float(COMMANDED["odometry.k_phi_rad"]) != OdometryConfig().k_phi_rad
    assert odometry_settings(OdometryConfig(), {"format": "carmen"}) == OdometryConfig()


def test_stamps_are_exact_and_each_robot_starts_at_its_own_time(folder, tmp_path):
    """A stamp that went through a float is off by up to 120 ns."""
    _, messages = imported(folder, tmp_path / "log.mcap")
    one, two = (of(messages, records.OdometryPose, f"robot{k}") for k in (1, 2))
    assert [m.stamp_ns for m in one] == [
        1_000_000 * ms for ms in (START * 1000 + d for d in (156, 656, 1156, 2156))
    ]
    assert two[0].stamp_ns == (START + 2) * 1_000_000_000
    assert of(messages, records.Truth, "robot1")[0].stamp_ns == START * 1_000_000_000 + 103_000_000


def test_rows_are_thinned_without_changing_the_motion(tmp_path):
    """At 50 Hz only every fifth row is needed; the path is the same at all of them."""
    rows = [(START * 1000 + 20 * k, 0.1, 0.3 if k < 62 else -0.2) for k in range(125)]
    text = "".join(f"{ms // 1000}.{ms % 1000:03d} {v} {w}\n" for ms, v, w in rows)
    files = {"Barcodes.dat": FILES["Barcodes.dat"], "Robot1_Odometry.dat": text}
    _, messages = imported(write_folder(tmp_path / "set", files), tmp_path / "log.mcap")
    odometry = of(messages, records.OdometryPose, "robot1")
    assert len(odometry) < len(rows) / 4
    assert odometry[-1].stamp_ns == rows[-1][0] * 1_000_000
    assert max(np.diff([m.stamp_ns for m in odometry])) <= MAX_ARC_NS
    turned = compose(exp(np.array([0.124, 0, 0.372])), exp(np.array([0.124, 0, -0.248])))
    np.testing.assert_allclose(odometry[-1].pose, turned, atol=1e-12)


def test_barcodes_become_subjects(folder, tmp_path):
    """Identities are subjects, not barcodes; subjects 1 to 5 are robots; range and bearing swap."""
    _, messages = imported(folder, tmp_path / "log.mcap")
    seen = of(messages, records.Sighting, "robot1")
    assert [(s.identity, s.seen_robot) for s in seen] == [("6", None), (None, "robot2")]
    np.testing.assert_array_equal(seen[0].z, [-0.25, 2.5])
    assert of(messages, records.Sighting, "robot2")[0].seen_robot == "robot1"


def test_what_cannot_be_used_is_counted_and_named(folder, tmp_path):
    """Unknown barcodes, a robot's own, and lines that cannot be read: one warning each."""
    with (folder / "Robot2_Measurement.dat").open("a") as file:
        file.write("nonsense\n1248444190.0 63 nan 0.0\n")
    summary, messages = imported(folder, tmp_path / "log.mcap")
    text = "\n".join(summary.warnings)
    assert "1 x sighting by robot1 of unknown barcode 99" in text
    assert "1 x sighting by robot1 of its own barcode 5" in text
    assert "2 x Robot2_Measurement.dat: a line that cannot be read" in text
    assert len(of(messages, records.Sighting, "robot2")) == 1


def test_truth_goes_in_where_present(folder, tmp_path):
    """Robot 2 has none; landmarks are points with their subject as identity."""
    target = tmp_path / "log.mcap"
    imported(folder, target)
    truth = read_truth([target], Config())
    assert list(truth.trajectories) == ["robot1"]
    np.testing.assert_array_equal(truth.trajectories["robot1"].poses, [[1.5, -3.5, 2.25]])
    assert [(lm.identity, lm.kind) for lm in truth.landmarks] == [("6", "point")]
    np.testing.assert_array_equal(truth.landmarks[0].pose[:2], [0.5, -4.25])


@pytest.mark.parametrize("ending", ["zip", "tar", "tar.gz", "tar.xz"])
def test_an_archive_gives_the_log_that_its_folder_gives(ending, folder, tmp_path):
    """Byte for byte, but for the source's name in the notes."""
    packed = tmp_path / f"set.{ending}"
    if ending == "zip":
        with zipfile.ZipFile(packed, "w") as archive:
            for name in FILES:
                archive.write(folder / name, f"set/{name}")
    else:
        with tarfile.open(packed, f"w:{ending.partition('.')[2]}") as archive:
            archive.add(folder, "set")
    counts, messages = imported(packed, tmp_path / "packed.mcap")
    same, known = imported(folder, tmp_path / "log.mcap")
    assert counts.counts == same.counts and counts.warnings
    assert [(type(m), m.robot, m.stamp_ns) for m in messages] == [
        (type(m), m.robot, m.stamp_ns) for m in known
    ]


@pytest.mark.parametrize(
    ("missing", "why"), [("Barcodes.dat", "Barcodes.dat"), ("Robot", "Odometry")]
)
def test_a_set_without_its_essentials_is_refused(missing, why, tmp_path):
    """One line that names the source and what it lacks; no file is left."""
    files = {name: text for name, text in FILES.items() if not name.startswith(missing)}
    source = write_folder(tmp_path / "set", files)
    with pytest.raises(LogError, match=why) as caught:
        IMPORTERS["mrclam"](source, tmp_path / "log.mcap")
    assert str(source) in str(caught.value) and not (tmp_path / "log.mcap").exists()


def test_two_sets_in_one_archive_are_refused(folder, tmp_path):
    """Mixing the files of two runs would give a log of neither."""
    write_folder(folder / "again", FILES)
    with pytest.raises(LogError, match="two files"):
        IMPORTERS["mrclam"](folder, tmp_path / "log.mcap")


def test_real_set(tmp_path):
    """Set 6: five robots, fifteen landmarks; every sighting but the six unknown barcodes."""
    source = real_data("mrclam/MRCLAM_Dataset6.tar.xz")
    summary = IMPORTERS["mrclam"](source, tmp_path / "log.mcap")
    counts = summary.counts
    assert [counts[f"/robot{k}/sightings"] for k in range(1, 6)] == [1941, 4031, 5625, 2396, 5378]
    assert counts["/true_landmarks"] == 15
    assert sum(int(w.split(": ")[1].split(" x ")[0]) for w in summary.warnings) == 6
