"""MRCLAM data sets (UTIAS Multi-Robot Cooperative Localization and Mapping) to MCAP.

A data set is a folder, or an archive of it: per robot commanded velocities, sightings of barcodes
and optionally ground truth. One table maps barcodes to subjects (robots or landmarks).

Format: K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative
localization and mapping dataset, IJRR 30(8), 2011, DOI 10.1177/0278364911398404.
"""

import heapq
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path

import numpy as np

from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, compose, exp
from graphslam.importers.import_carmen import parse_stamp_ns
from graphslam.importers.import_summary import ImportSummary
from graphslam.logs.source_files import first_and_all, text_files
from graphslam.logs.writer import Event, LogWriter

#: subjects 1 .. 5 are robots, the others landmarks; part of the format
ROBOTS = 5
#: Noise of one sighting, assumed: the files do not state it. The camera measures a barcode's
#: bearing to a few pixels and its range by the apparent height, so range errors grow with range.
BEARING_SIGMA_RAD = 0.015
RANGE_SIGMA_M, RANGE_SIGMA_SHARE = 0.05, 0.03
#: Motion noise of commanded velocities, variances per m or rad (see OdometryConfig). The motors
#: follow with a varying delay of 0.1 to 0.3 s, so a turn of some tenths of a rad errs by some
#: hundredths; speeds are reached to a few per cent.
COMMANDED = {
    "odometry.commanded_velocities": "true",
    "odometry.k_x_m": "2e-3",
    "odometry.k_y_m": "5e-4",
    "odometry.k_phi_m": "2e-3",
    "odometry.k_phi_rad": "5e-3",
}
#: ns: longest time between two written poses; rows in between are left out. In 0.1 s it hardly
#: matters when exactly the velocity changed.
MAX_ARC_NS = 100_000_000

_FILES = re.compile(
    r"(Barcodes|Landmark_Groundtruth|Robot(\d+)_(Odometry|Measurement|Groundtruth))\.dat"
)

Rows = list[tuple[int, list[float]]]


def import_mrclam(source: Path, target: Path) -> ImportSummary:
    """Convert an MRCLAM data set (folder, .zip, .tar or compressed .tar) to ``target``.

    Robots are ``robot1``, ``robot2``, ...; landmarks have their subject's number as identity. A
    velocity holds until the robot's next row, so each row but the last is an arc; Odometry poses
    compound these arcs from the origin, at most 0.1 s apart. The motion noise of commanded
    velocities goes into the log's notes as ``odometry.*``, from which `smooth` takes it. True poses
    and landmarks are written where present. Unusable lines are counted by reason in the summary's
    warnings.

    Raises:
        LogError: ``source`` cannot be read, or has no odometry or no table of barcodes.
        OutputError: ``target`` cannot be written.
    """
    texts = text_files(source, _FILES)
    numbers = [int(f[2]) for name in texts if (f := _FILES.fullmatch(name)) and f[3] == "Odometry"]
    if not numbers:
        raise LogError(
            f"{source}: has no RobotN_Odometry.dat; is it MRCLAM? Name the folder or "
            "archive of one data set"
        )
    if "Barcodes.dat" not in texts:
        raise LogError(f"{source}: has no Barcodes.dat, the table of barcodes; add it")
    problems: Counter[str] = Counter()
    subjects = _subjects(texts["Barcodes.dat"], problems)
    streams: list[Iterator[Event]] = []
    for number in sorted(numbers):
        files = {kind: f"Robot{number}_{kind}.dat" for kind in ("Odometry", "Measurement")}
        truth = f"Robot{number}_Groundtruth.dat"
        odometry = _rows(files["Odometry"], texts, 2, problems)
        seen = _rows(files["Measurement"], texts, 3, problems)
        streams.append(_odometry(number, odometry))
        streams.append(_sightings(number, seen, subjects, problems))
        streams.append(_truth(number, _rows(truth, texts, 3, problems)))
        problems.update({f"{name} is missing": 1 for name in files.values() if name not in texts})
    first, events = first_and_all(
        heapq.merge(*streams, key=lambda event: event.stamp_ns),
        f"{source}: no line of its files can be read; is it MRCLAM?",
    )
    notes = {
        "format": "mrclam",
        "source": source.name,
        "stamps": "those of the files, exact",
        "sighting noise": f"assumed, bearing {BEARING_SIGMA_RAD} rad, range {RANGE_SIGMA_M} m + "
        f"{RANGE_SIGMA_SHARE:.0%}",
        **COMMANDED,
    }
    with LogWriter(target, notes) as log:
        for subject, x, y in _landmarks(texts.get("Landmark_Groundtruth.dat", ""), problems):
            log.true_landmark(first.stamp_ns, str(subject), "point", (x, y, np.nan))
        for event in events:
            event.write(log)
    warnings = [f"{source}: {n} x {reason}" for reason, n in sorted(problems.items())]
    return ImportSummary(source, target, log.counts, tuple(warnings))


# ---------------------------------------------------------------- messages of one robot


def _odometry(number: int, rows: Rows) -> Iterator[Event]:
    """Poses that result from the velocities, each of which holds until the next row."""
    times = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    seconds = np.diff(times) * 1e-9
    speeds = np.array([row for _, row in rows]).reshape(-1, 2)[:-1]
    twists = np.column_stack([speeds[:, 0], np.zeros(len(speeds)), speeds[:, 1]])
    poses = _integrate(twists * seconds[:, None])
    for k in _thinned(times.tolist()):
        yield Event.of(LogWriter.odometry, _name(number), int(times[k]), pose=poses[k])


def _thinned(times: list[int]) -> Iterator[int]:
    """Indices of the rows to write: both ends, and as few others as `MAX_ARC_NS` allows."""
    kept: int | None = None
    for k, time_ns in enumerate(times):
        last = k == len(times) - 1
        if kept is None or last or times[k + 1] - kept > MAX_ARC_NS:
            kept = time_ns
            yield k


def _integrate(twists: Array) -> Array:
    """Poses (n + 1, 3) after 0 .. n arcs ``exp(twist)`` from the origin, twists (n, 3)."""
    step = exp(twists)
    heading = np.concatenate([[0.0], np.cumsum(step[:, 2])])
    turned = np.column_stack([np.zeros((len(step), 2)), heading[:-1]])
    moved = compose(turned, step)[:, :2] if len(step) else np.zeros((0, 2))
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(moved, axis=0)]), heading])


def _sightings(
    number: int, rows: Rows, subjects: Mapping[int, int], problems: Counter[str]
) -> Iterator[Event]:
    """Sightings of subjects; unknown barcodes and the robot's own are counted."""
    for stamp_ns, (barcode, range_m, bearing) in rows:
        subject = subjects.get(int(barcode))
        if subject is None:
            problems[f"sighting by {_name(number)} of unknown barcode {barcode:g}"] += 1
        elif subject == number:
            problems[f"sighting by {_name(number)} of its own barcode {barcode:g}"] += 1
        elif range_m <= 0:
            problems[f"sighting by {_name(number)} with a range that is not positive"] += 1
        else:
            sigmas = [BEARING_SIGMA_RAD, RANGE_SIGMA_M + RANGE_SIGMA_SHARE * range_m]
            yield Event.of(
                LogWriter.sighting,
                _name(number),
                stamp_ns,
                z=(bearing, range_m),
                cov=np.diag(np.square(sigmas)),
                identity=None if subject <= ROBOTS else str(subject),
                seen_robot=_name(subject) if subject <= ROBOTS else None,
            )


def _truth(number: int, rows: Rows) -> Iterator[Event]:
    for stamp_ns, pose in rows:
        yield Event.of(LogWriter.truth, _name(number), stamp_ns, pose=pose)


def _name(subject: int) -> str:
    return f"robot{subject}"


# ---------------------------------------------------------------- the files


def _lines(text: str) -> Iterator[list[str]]:
    """Fields of the lines that are neither empty nor comments."""
    for line in text.splitlines():
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            yield fields


def _rows(name: str, texts: Mapping[str, str], columns: int, problems: Counter[str]) -> Rows:
    """Stamp and numbers of each line of a file, sorted by stamp; malformed lines are counted.

    Sorting is stable: sightings of one image keep their order. Of two odometry rows with the same
    stamp the first has no effect.
    """
    rows: Rows = []
    for fields in _lines(texts.get(name, "")):
        try:
            values = [float(field) for field in fields[1:]]
            if len(values) != columns or not all(map(math.isfinite, values)):
                raise ValueError
            rows.append((parse_stamp_ns(fields[0]), values))
        except ValueError:
            problems[f"{name}: a line that cannot be read"] += 1
    back = sum(after[0] < before[0] for before, after in pairwise(rows))
    if back:
        problems[f"{name}: stamp earlier than the one before, sorted"] += back
        rows.sort(key=lambda row: row[0])
    return rows


def _subjects(text: str, problems: Counter[str]) -> dict[int, int]:
    """Barcode -> subject; of two subjects with the same barcode the first."""
    subjects: dict[int, int] = {}
    for fields in _lines(text):
        try:
            subject, barcode = map(int, fields)
        except ValueError:
            problems["Barcodes.dat: a line that cannot be read"] += 1
            continue
        if subjects.setdefault(barcode, subject) != subject:
            problems[f"Barcodes.dat: barcode {barcode} has two subjects; the first is used"] += 1
    return subjects


def _landmarks(text: str, problems: Counter[str]) -> Iterator[tuple[int, float, float]]:
    """Subject, x m, y m of each true landmark; the standard deviations are not used."""
    for fields in _lines(text):
        try:
            yield int(fields[0]), float(fields[1]), float(fields[2])
        except (ValueError, IndexError):
            problems["Landmark_Groundtruth.dat: a line that cannot be read"] += 1
