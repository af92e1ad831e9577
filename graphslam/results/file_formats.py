"""The text formats of the result folder, written and read back: TUM, covariances as CSV, JSON."""

import json
from collections.abc import Iterable, Mapping
from decimal import Decimal, InvalidOperation
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array
from graphslam.core.number_text import rows_as_text
from graphslam.core.records import Landmark, Trajectory

COV_HEADER = "stamp_ns,xx,xy,xphi,yy,yphi,phiphi"
_UPPER = np.triu_indices(3)
_NS = 1_000_000_000

# ---------------------------------------------------------------- writing


def tum_text(trajectory: Trajectory) -> str:
    """TUM lines ``sec.nnnnnnnnn x y 0 0 0 qz qw``, sorted by stamp.

    Stamps are written from integer nanoseconds; positions to 1e-9 m, the quaternion to 1e-12.

    Raises:
        OutputError: a pose is not finite; the message names its stamp.
    """
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    stamps, poses = trajectory.stamps_ns[order], trajectory.poses[order]
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        raise OutputError(f"the pose at {_seconds(int(stamps[bad][0]))} s is not finite")
    x, y = poses[:, 0].tolist(), poses[:, 1].tolist()
    half = poses[:, 2] / 2
    qz, qw = np.sin(half).tolist(), np.cos(half).tolist()
    times = map(_seconds, stamps.tolist())
    return _lines("%s %.9f %.9f 0 0 0 %.12f %.12f\n", zip(times, x, y, qz, qw, strict=True))


def cov_text(trajectory: Trajectory) -> str:
    """CSV of covariances ``stamp_ns,xx,xy,xphi,yy,yphi,phiphi``, full precision, sorted by stamp.

    Additive errors along world axes, m², m·rad, rad².
    """
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    upper = trajectory.covs[order][:, *_UPPER]
    rows = zip(trajectory.stamps_ns[order].tolist(), rows_as_text(upper, ","), strict=True)
    return f"{COV_HEADER}\n" + _lines("%d,%s\n", rows)


def _lines(form: str, rows: Iterable[tuple[object, ...]]) -> str:
    """A line of each row; many at a time, which takes half the time."""
    values = list(rows)
    return form * len(values) % tuple(chain.from_iterable(values))


def landmark_json(landmark: Landmark) -> dict[str, Any]:
    """An entry of landmarks.json (docs/formats.md) as plain Python values; phi of a point: None."""
    x, y, phi = landmark.position.tolist()
    entry: dict[str, Any] = {
        "id": landmark.id,
        "kind": landmark.kind,
        "x": x,
        "y": y,
        "phi": None if landmark.kind == "point" else phi,
        "extent": landmark.extent.tolist(),
        "covariance": landmark.cov.tolist(),
        "sightings": landmark.sightings,
        "first_ns": landmark.first_ns,
        "last_ns": landmark.last_ns,
        "identity": landmark.identity,
    }
    if landmark.frame is not None:
        entry["frame"] = landmark.frame
    if landmark.line is not None:
        normal, offset, cov = landmark.line
        entry["line"] = {
            "normal_rad": float(normal),
            "offset_m": float(offset),
            "covariance": cov.tolist(),
        }
    return entry


def to_json(value: object, where: str) -> str:
    """JSON text; numpy scalars and arrays as plain values.

    Raises:
        OutputError: a number is not finite or a value has no JSON form; names ``where``.
    """
    try:
        text = json.dumps(value, indent=1, default=_plain, allow_nan=False, ensure_ascii=False)
    except (ValueError, TypeError) as error:
        raise OutputError(f"{where}: cannot be written: {error}") from error
    return text + "\n"


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")


def _seconds(stamp_ns: int) -> str:
    if stamp_ns < 0:
        return f"-{_seconds(-stamp_ns)}"
    return f"{stamp_ns // _NS}.{stamp_ns % _NS:09d}"


# ---------------------------------------------------------------- reading


def stamp_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exactly; digits beyond the ninth are rounded.

    Raises:
        ValueError: not a decimal number, or beyond the 292 years of 64-bit nanoseconds.
    """
    try:
        stamp = int(Decimal(text).scaleb(9).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError):
        stamp = 2**63
    if abs(stamp) >= 2**63:
        raise ValueError(f"{text!r} is not a time in seconds")
    return stamp


def read_trajectory(path: Path, cov_path: Path | None = None) -> Trajectory:
    """A TUM file ``stamp x y z qx qy qz qw``, of this or another tool, sorted by stamp.

    The heading is the yaw of the quaternion; z, roll and pitch are ignored. Covariances come
    from ``cov_path`` (see `cov_text`), which must have the same stamps; they are NaN without it.

    Raises:
        OutputError: the file cannot be read or a line is malformed; names file and line.
    """
    stamps, rows = [], []
    for number, fields in _table_rows(path, None):
        try:
            if len(fields) != 8:
                raise ValueError(f"expected 8 numbers, got {len(fields)}")
            stamps.append(stamp_ns(fields[0]))
            rows.append([float(field) for field in fields[1:]])
        except ValueError as error:
            raise OutputError(f"{path}:{number}: {error}") from error
        if not (np.isfinite(rows[-1]).all() and any(rows[-1][3:])):
            raise OutputError(f"{path}:{number}: not a pose: {' '.join(fields)}")
    if not rows:
        raise OutputError(f"{path}: holds no pose")
    x, y, _, qx, qy, qz, qw = np.array(rows).T
    phi = np.arctan2(2 * (qw * qz + qx * qy), qw**2 + qx**2 - qy**2 - qz**2)
    order = np.argsort(np.array(stamps), kind="stable")
    times = np.array(stamps, dtype=np.int64)[order]
    poses = np.column_stack([x, y, phi])[order]
    covs = np.full((len(times), 3, 3), np.nan)
    if cov_path is not None:
        covs = _read_covs(cov_path, times)
    return Trajectory(times, poses, covs)


def read_landmarks(path: Path) -> tuple[Landmark, ...]:
    """landmarks.json as records.

    Raises:
        OutputError: the file cannot be read or an entry is malformed; names file and entry.
    """
    entries = read_json(path)
    if not isinstance(entries, list):
        raise OutputError(f"{path}: expected a list of landmarks")
    landmarks = []
    for index, entry in enumerate(entries):
        try:
            landmarks.append(landmark_from_json(entry))
        except (KeyError, TypeError, ValueError) as error:
            raise OutputError(f"{path}: entry {index}: malformed landmark: {error!r}") from error
    return tuple(landmarks)


def _read_covs(path: Path, stamps: np.ndarray[Any, Any]) -> Array:
    """Covariances (n, 3, 3) for ``stamps``, which the file must hold in the same order."""
    rows, times = [], []
    for number, fields in _table_rows(path, ","):
        if number == 1 and ",".join(fields) == COV_HEADER:
            continue
        try:
            times.append(int(fields[0]))
            rows.append([float(field) for field in fields[1:]])
            if len(rows[-1]) != 6:
                raise ValueError(f"expected 7 numbers, got {len(fields)}")
        except ValueError as error:
            raise OutputError(f"{path}:{number}: {error}") from error
    if not np.array_equal(times, stamps):
        raise OutputError(f"{path}: its stamps are not those of the trajectory beside it")
    covs = np.empty((len(rows), 3, 3))
    covs[:, *_UPPER] = rows
    covs[:, _UPPER[1], _UPPER[0]] = rows
    return covs


def landmark_from_json(entry: Mapping[str, Any]) -> Landmark:
    """The record of an entry of landmarks.json."""
    kind = str(entry["kind"])
    size = 2 if kind == "point" else 3
    phi = np.nan if entry["phi"] is None else float(entry["phi"])
    line = entry.get("line")
    return Landmark(
        int(entry["id"]),
        kind,
        np.array([float(entry["x"]), float(entry["y"]), phi]),
        np.array(entry["covariance"], dtype=float).reshape(size, size),
        np.array(entry["extent"], dtype=float).reshape(2, 2),
        None
        if line is None
        else (
            float(line["normal_rad"]),
            float(line["offset_m"]),
            np.array(line["covariance"], dtype=float).reshape(2, 2),
        ),
        int(entry["sightings"]),
        int(entry["first_ns"]),
        int(entry["last_ns"]),
        entry["identity"],
        entry.get("frame"),
    )


def _table_rows(path: Path, separator: str | None) -> list[tuple[int, list[str]]]:
    """Line numbers and fields of a text table, without blank lines and comments (#)."""
    lines = read_text(path).splitlines()
    return [
        (number, line.split(separator))
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.startswith("#")
    ]


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        OutputError: it cannot be read or is not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise OutputError(f"{path}: not a text file: {error.reason}") from error


def read_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        OutputError: it cannot be read or is not valid JSON.
    """
    try:
        return json.loads(read_text(path))
    except ValueError as error:
        raise OutputError(f"{path}: not valid JSON: {error}") from error
