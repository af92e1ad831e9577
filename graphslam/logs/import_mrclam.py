"""MRCLAM data sets (UTIAS Multi-Robot Cooperative Localization and Mapping) to MCAP.

A set is a folder, or an archive of it: per robot velocities, sightings of barcodes and, where
there is any, truth; one table says which subject (a robot or a landmark) bears which barcode.

Format: K. Y. K. Leung, Y. Halpern, T. D. Barfoot, H. H. T. Liu, The UTIAS multi-robot cooperative
localization and mapping dataset, IJRR 30(8), 2011, DOI 10.1177/0278364911398404.
"""

import heapq
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, compose, exp
from graphslam.logs.import_carmen import parse_stamp_ns
from graphslam.logs.import_summary import ImportSummary
from graphslam.logs.source_files import text_files
from graphslam.logs.writer import LogWriter

#: subjects up to this number are robots, the others landmarks
ROBOTS = 5
#: noise of one sighting; the files do not state it. The camera sees a barcode's direction to a few
#: pixels and takes the range from its apparent height, so errors of range grow with it.
BEARING_SIGMA_RAD = 0.015
RANGE_SIGMA_M, RANGE_SIGMA_SHARE = 0.05, 0.03
#: noise of driving what was commanded, variances per m or rad (see OdometryConfig). Motors follow
#: after 0.1 to 0.3 s, not always the same, so a turn of some tenths of a rad misses by some
#: hundredths; speeds are met to a few per cent.
COMMANDED = {
    "odometry.commanded_velocities": "true",
    "odometry.k_x_m": "2e-3",
    "odometry.k_y_m": "5e-4",
    "odometry.k_phi_m": "2e-3",
    "odometry.k_phi_rad": "5e-3",
}
#: ns: poses are written this far apart at most, and not nearer than needed for that. Within so
#: short a time it hardly matters when exactly the velocity changed
LONGEST_ARC_NS = 100_000_000

_FILES = re.compile(
    r"(Barcodes|Landmark_Groundtruth|Robot(\d+)_(Odometry|Measurement|Groundtruth))\.dat"
)

Rows = list[tuple[int, list[float]]]
#: what to write, and the stamp that it is written at
Entry = tuple[int, Callable[[LogWriter], None]]


def import_mrclam(source: Path, target: Path) -> ImportSummary:
    """Convert an MRCLAM data set (folder, .zip, .tar or compressed .tar) to ``target``.

    Robots are ``robot1``, ``robot2``, ...; landmarks have their subject's number as identity. A
    velocity holds until the robot's next row, so each row but the last is an arc; Odometry is the
    poses that these arcs compound to, from the origin, every 0.1 s. How well commands are driven
    goes into the log's notes as ``odometry.*``, where reading finds it. True poses and landmarks go
    in where present. What cannot be used is counted by reason in the summary's warnings.

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
        raise LogError(f"{source}: has no Barcodes.dat, the table of who bears which barcode")
    odd: Counter[str] = Counter()
    subjects = _subjects(texts["Barcodes.dat"], odd)
    streams: list[Iterator[Entry]] = []
    for number in sorted(numbers):
        files = {kind: f"Robot{number}_{kind}.dat" for kind in ("Odometry", "Measurement")}
        truth = f"Robot{number}_Groundtruth.dat"
        odometry = _rows(files["Odometry"], texts, 2, odd)
        seen = _rows(files["Measurement"], texts, 3, odd)
        streams.append(_odometry(number, odometry))
        streams.append(_sightings(number, seen, subjects, odd))
        streams.append(_truth(number, _rows(truth, texts, 3, odd)))
        odd.update({f"{name} is missing": 1 for name in files.values() if name not in texts})
    entries = heapq.merge(*streams, key=lambda entry: entry[0])
    first = next(entries, None)
    if first is None:
        raise LogError(f"{source}: no line of its files can be read; is it MRCLAM?")
    notes = {
        "format": "mrclam",
        "source": source.name,
        "stamps": "those of the files, exact",
        "sighting noise": f"assumed, bearing {BEARING_SIGMA_RAD} rad, range {RANGE_SIGMA_M} m + "
        f"{RANGE_SIGMA_SHARE:.0%}",
        **COMMANDED,
    }
    with LogWriter(target, notes) as log:
        for subject, x, y in _landmarks(texts.get("Landmark_Groundtruth.dat", ""), odd):
            log.true_landmark(first[0], str(subject), "point", (x, y, np.nan))
        for _, write in (first, *entries):
            write(log)
    warnings = [f"{source}: {n} x {reason}" for reason, n in sorted(odd.items())]
    return ImportSummary(source, target, log.counts, tuple(warnings))


# ---------------------------------------------------------------- what goes into the log


def _odometry(number: int, rows: Rows) -> Iterator[Entry]:
    """Poses that the velocities compound to: each holds until the next row."""
    times = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    seconds = np.diff(times) * 1e-9
    speeds = np.array([row for _, row in rows]).reshape(-1, 2)[:-1]
    twists = np.column_stack([speeds[:, 0], np.zeros(len(speeds)), speeds[:, 1]])
    poses = _compounded(twists * seconds[:, None])
    for k in _kept(times.tolist()):
        stamp_ns, pose = int(times[k]), poses[k]
        yield (
            stamp_ns,
            partial(LogWriter.odometry, robot=_name(number), stamp_ns=stamp_ns, pose=pose),
        )


def _kept(times: list[int]) -> Iterator[int]:
    """Places of the rows that are written: the ends, and what is needed between."""
    kept: int | None = None
    for k, time_ns in enumerate(times):
        # dropped only if the arc would not become longer than allowed without it
        last = k == len(times) - 1
        if kept is None or last or times[k + 1] - kept > LONGEST_ARC_NS:
            kept = time_ns
            yield k


def _compounded(twists: Array) -> Array:
    """Poses (n + 1, 3) after 0 .. n arcs ``exp(twist)``, twists (n, 3), from the origin."""
    step = exp(twists)
    heading = np.concatenate([[0.0], np.cumsum(step[:, 2])])
    turned = np.column_stack([np.zeros((len(step), 2)), heading[:-1]])
    moved = compose(turned, step)[:, :2] if len(step) else np.zeros((0, 2))
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(moved, axis=0)]), heading])


def _sightings(
    number: int, rows: Rows, subjects: Mapping[int, int], odd: Counter[str]
) -> Iterator[Entry]:
    """Sightings of subjects; barcodes that nobody bears, or the robot itself, are counted."""
    for stamp_ns, (barcode, range_m, bearing) in rows:
        subject = subjects.get(int(barcode))
        if subject is None:
            odd[f"sighting by {_name(number)} of unknown barcode {barcode:g}"] += 1
        elif subject == number:
            odd[f"sighting by {_name(number)} of its own barcode {barcode:g}"] += 1
        elif range_m <= 0:
            odd[f"sighting by {_name(number)} with a range that is not positive"] += 1
        else:
            sigmas = [BEARING_SIGMA_RAD, RANGE_SIGMA_M + RANGE_SIGMA_SHARE * range_m]
            yield (
                stamp_ns,
                partial(
                    LogWriter.sighting,
                    robot=_name(number),
                    stamp_ns=stamp_ns,
                    z=(bearing, range_m),
                    cov=np.diag(np.square(sigmas)),
                    identity=None if subject <= ROBOTS else str(subject),
                    seen_robot=_name(subject) if subject <= ROBOTS else None,
                ),
            )


def _truth(number: int, rows: Rows) -> Iterator[Entry]:
    for stamp_ns, pose in rows:
        yield stamp_ns, partial(LogWriter.truth, robot=_name(number), stamp_ns=stamp_ns, pose=pose)


def _name(subject: int) -> str:
    return f"robot{subject}"


# ---------------------------------------------------------------- the files


def _lines(text: str) -> Iterator[list[str]]:
    """Fields of the lines that are neither empty nor comments."""
    for line in text.splitlines():
        fields = line.split()
        if fields and not fields[0].startswith("#"):
            yield fields


def _rows(name: str, texts: Mapping[str, str], columns: int, odd: Counter[str]) -> Rows:
    """Stamp and numbers of each line of a file, sorted by stamp; others are counted.

    Sorting is stable: what was seen in one image stays in its order. Of two rows of odometry with
    one stamp the first holds for no time at all.
    """
    rows: Rows = []
    for fields in _lines(texts.get(name, "")):
        try:
            values = [float(field) for field in fields[1:]]
            if len(values) != columns or not all(map(math.isfinite, values)):
                raise ValueError
            rows.append((parse_stamp_ns(fields[0]), values))
        except ValueError:
            odd[f"{name}: a line that cannot be read"] += 1
    back = sum(after[0] < before[0] for before, after in pairwise(rows))
    if back:
        odd[f"{name}: stamp earlier than the one before, sorted"] += back
        rows.sort(key=lambda row: row[0])
    return rows


def _subjects(text: str, odd: Counter[str]) -> dict[int, int]:
    """Barcode -> subject; of two subjects with one barcode the first."""
    subjects: dict[int, int] = {}
    for fields in _lines(text):
        try:
            subject, barcode = map(int, fields)
        except ValueError:
            odd["Barcodes.dat: a line that cannot be read"] += 1
            continue
        if subjects.setdefault(barcode, subject) != subject:
            odd[f"Barcodes.dat: barcode {barcode} is borne by two subjects; the first counts"] += 1
    return subjects


def _landmarks(text: str, odd: Counter[str]) -> Iterator[tuple[int, float, float]]:
    """Subject, x m, y m; the two standard deviations behind them are not used."""
    for fields in _lines(text):
        try:
            yield int(fields[0]), float(fields[1]), float(fields[2])
        except (ValueError, IndexError):
            odd["Landmark_Groundtruth.dat: a line that cannot be read"] += 1
