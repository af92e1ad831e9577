"""Logs of tinySLAM's robot (wheel encoders and a Hokuyo URG-04LX) to MCAP.

One line per scan, numbers only: field 0 is the time in us, 2 and 3 are the accumulated ticks of the
left and the right wheel, 24 to 705 the ranges in mm over 240 degrees, 0 = no return. All logs are
of the same robot, so its geometry is part of the format.

Source: B. Steux, O. El Hamzaoui, tinySLAM: a SLAM algorithm in less than 200 lines C-language
program, ICARCV 2010, DOI 10.1109/ICARCV.2010.5707402.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from graphslam.core.geometry import Array
from graphslam.importers.import_summary import ImportSummary
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import first_and_all, text_lines
from graphslam.logs.writer import LogWriter

WHEEL_RADIUS_M, AXLE_M, TICKS_PER_TURN = 0.077, 2 * 0.165, 2000
LASER_FORWARD_M = 0.145
BEAMS, SECTOR_RAD = 682, np.deg2rad(240.0)
RANGE_MAX_M = 5.6  # of the URG-04LX

_LEFT, _RIGHT, _FIRST_RANGE = 2, 3, 24  # fields of a line


def import_tinyslam(source: Path, target: Path) -> ImportSummary:
    """Convert a tinySLAM log (plain, .gz, .bz2, .xz) to the MCAP file ``target``.

    Ticks become JointState in rad, ranges LaserScan, the laser's mount tf_static. The wheel
    geometry goes into the log's notes as ``robots.robot.*``, from which `smooth` takes it.

    Raises:
        LogError: ``source`` cannot be read, or no line of it holds a scan.
        OutputError: ``target`` cannot be written.
    """
    malformed: list[int] = []
    first, rows = first_and_all(
        _rows(source, malformed),
        f"{source}: no line has the {_FIRST_RANGE + BEAMS} numbers; is it tinySLAM?",
    )
    notes = {
        "format": "tinyslam",
        "source": source.name,
        "stamps": "those of the file; they count from the robot's start",
        f"robots.{DEFAULT_ROBOT}.wheel_radius_left_m": f"{WHEEL_RADIUS_M}",
        f"robots.{DEFAULT_ROBOT}.wheel_radius_right_m": f"{WHEEL_RADIUS_M}",
        f"robots.{DEFAULT_ROBOT}.axle_m": f"{AXLE_M}",
    }
    with LogWriter(target, notes) as log:
        log.mount(DEFAULT_ROBOT, first[0], (LASER_FORWARD_M, 0.0, 0.0))
        for stamp_ns, left, right, ranges_mm in rows:
            turn = 2 * np.pi / TICKS_PER_TURN
            log.wheel_angles(DEFAULT_ROBOT, stamp_ns, turn * left, turn * right)
            log.scan(
                DEFAULT_ROBOT,
                stamp_ns,
                ranges_mm / 1000.0,
                angle_min_rad=-SECTOR_RAD / 2,
                angle_step_rad=SECTOR_RAD / (BEAMS - 1),
                range_max_m=RANGE_MAX_M,
            )
    problem = f"{source}: {len(malformed)} lines cannot be read, the first is"
    warnings = tuple(f"{problem} {number}" for number in malformed[:1])
    return ImportSummary(source, target, log.counts, warnings)


def _rows(source: Path, malformed: list[int]) -> Iterator[tuple[int, int, int, Array]]:
    """Stamp ns, ticks left and right, ranges (682,) mm; other line numbers: ``malformed``."""
    for number, line in enumerate(text_lines(source), start=1):
        fields = line.split()
        if not fields:
            continue
        try:
            ranges = np.array(fields[_FIRST_RANGE : _FIRST_RANGE + BEAMS], dtype=float)
            # NaN too is not smaller; a log holds ranges as float32
            if len(ranges) != BEAMS or not (np.abs(ranges) < np.finfo(np.float32).max).all():
                raise ValueError("too few numbers")
            yield 1000 * int(fields[0]), int(fields[_LEFT]), int(fields[_RIGHT]), ranges
        except ValueError:
            malformed.append(number)
