"""Errors of relative poses between scans against hand-made reference relations.

Source: R. Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27,
2009, DOI 10.1007/s10514-009-9155-6.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array, between
from graphslam.core.records import Trajectory
from graphslam.results.file_formats import read_text, stamp_ns

Stamps = np.ndarray[Any, np.dtype[np.int64]]

#: relations over at most this time are called local, the others loops
LOCAL_S = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class Relations:
    """Reference poses (n, 3) of the laser at ``to_ns`` in its frame at ``from_ns``, (n,) ns."""

    from_ns: Stamps
    to_ns: Stamps
    poses: Array

    @property
    def local(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """(n,) which relations span at most 60 s; the others are loops."""
        return np.asarray(np.abs(self.to_ns - self.from_ns) <= LOCAL_S * 1e9)


def read_relations(path: Path) -> Relations:
    """A relations file: ``t1 t2 x y z roll pitch yaw``, the pose of t2 in the frame of t1.

    Stamps become integer nanoseconds from their decimal text; t1 may be later than t2.

    Raises:
        OutputError: the file cannot be read or a line is malformed; names file and line.
    """
    stamps, poses = [], []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        try:
            if len(fields) != 8:
                raise ValueError(f"expected 8 numbers, got {len(fields)}")
            stamps.append([stamp_ns(text) for text in fields[:2]])
            poses.append([float(fields[k]) for k in (2, 3, 7)])
        except ValueError as error:
            raise OutputError(f"{path}:{number}: {error}") from error
        if not np.isfinite(poses[-1]).all():
            raise OutputError(f"{path}:{number}: not a pose: {line.strip()}")
    if not poses:
        raise OutputError(f"{path}: holds no relation")
    t1, t2 = np.array(stamps, dtype=np.int64).T
    return Relations(t1, t2, np.array(poses))


def relation_errors(relations: Relations, scans: Trajectory) -> Array:
    """Errors (n, 2): |translation| m and |rotation| degrees per relation, NaN where unmatched.

    ``scans`` are poses of the laser; a relation matches where both of its stamps are among theirs,
    to the nanosecond. The error is the estimated relative pose in the frame of the reference one:
    Kümmerle et al. eq. 3-5 with the absolute (not squared) error, as in their tables.
    """
    first, has_first = find_stamps(relations.from_ns, scans.stamps_ns)
    second, has_second = find_stamps(relations.to_ns, scans.stamps_ns)
    measured = between(scans.poses[first], scans.poses[second])
    error = between(relations.poses, measured)
    rotation = np.degrees(np.abs(error[:, 2]))
    errors = np.column_stack([np.hypot(error[:, 0], error[:, 1]), rotation])
    return np.where((has_first & has_second)[:, None], errors, np.nan)


def relation_metrics(relations: Relations, scans: Trajectory) -> dict[str, dict[str, Any]]:
    """Numbers of `relation_errors` over ``all`` relations, ``local`` ones (<= 60 s) and ``loops``.

    Standard deviations are those of the sample (n, not n - 1). A group without matches has None.
    """
    errors = relation_errors(relations, scans)
    groups = {
        "all": np.ones(len(errors), dtype=bool),
        "local": relations.local,
        "loops": ~relations.local,
    }
    return {name: _relation_group(errors[group]) for name, group in groups.items()}


def _relation_group(errors: Array) -> dict[str, Any]:
    matched = errors[np.isfinite(errors[:, 0])]
    counts = {"n": len(matched), "unmatched": len(errors) - len(matched)}
    if not len(matched):
        names = ("trans_mean_m", "trans_std_m", "trans_median_m", "rot_mean_deg", "rot_std_deg")
        return {**counts, **dict.fromkeys(names)}
    translation, rotation = matched.T
    return {
        **counts,
        "trans_mean_m": float(translation.mean()),
        "trans_std_m": float(translation.std()),
        "trans_median_m": float(np.median(translation)),
        "rot_mean_deg": float(rotation.mean()),
        "rot_std_deg": float(rotation.std()),
    }


def find_stamps(wanted: Stamps, stamps: Stamps) -> tuple[Any, Any]:
    """Index (k,) of wanted stamps (k,) among sorted ``stamps`` (n,), and which are there (k,)."""
    index = np.minimum(np.searchsorted(stamps, wanted), len(stamps) - 1)
    return index, stamps[index] == wanted
