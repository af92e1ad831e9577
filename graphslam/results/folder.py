"""The result folder: written whole or not at all, and read back.

The layout is the contract of docs: summary.json, config.toml, trajectories/, landmarks.json,
graph.g2o (with graph_ids.csv naming its vertices) and report.html.
"""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from graphslam.core.config import Config
from graphslam.core.config_io import dump_config, load_config
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array
from graphslam.core.output_folder import atomic_folder
from graphslam.core.records import Landmark, Result, Trajectory
from graphslam.estimation.g2o import graph_g2o, graph_ids

COV_HEADER = "stamp_ns,xx,xy,xphi,yy,yphi,phiphi"
_UPPER = np.triu_indices(3)
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class SavedRobot:
    """One robot's trajectories as saved; scan poses are None where the robot had no scans.

    Scan trajectories have no covariance file: their ``covs`` are NaN.
    """

    final: Trajectory
    causal: Trajectory
    scan_final: Trajectory | None
    scan_causal: Trajectory | None


@dataclass(frozen=True, slots=True, eq=False)
class SavedResult:
    """A result folder read back."""

    robots: Mapping[str, SavedRobot]
    landmarks: tuple[Landmark, ...]
    summary: Mapping[str, Any]
    config: Config


# ---------------------------------------------------------------- writing


def check_target(
    directory: Path, *, force: bool, replaceable: Callable[[Path], bool] | None = None
) -> None:
    """Say before a long computation whether a folder may be written at ``directory``.

    Args:
        directory: the folder to be.
        force: replace what is there.
        replaceable: what ``force`` may replace beside an empty folder; default: result folders.

    Raises:
        OutputError: it exists and ``force`` is not given, it exists and is no such folder, or
            nothing can be written where it is to be.
    """
    parent = directory.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK | os.X_OK)):
        raise OutputError(f"{directory}: cannot be written: {parent} is no folder to write to")
    if not os.path.lexists(directory):
        return
    if not force:
        raise OutputError(f"{directory}: already exists; give --force to replace it")
    empty = directory.is_dir() and not any(directory.iterdir())
    if directory.is_symlink() or not (empty or (replaceable or _is_result)(directory)):
        raise OutputError(
            f"{directory}: is not a result folder of graphslam, so it is not replaced; "
            "choose another name"
        )


def save(
    result: Result,
    config: Config,
    directory: Path,
    *,
    force: bool,
    report: Callable[[Result], str] | None = None,
) -> None:
    """Write the result folder, see `write_folder`.

    ``report`` renders report.html (without it there is none); it is asked last.

    Raises:
        OutputError: the target exists and may not be replaced, a number is not finite, or the
            disk refuses; nothing is left behind.
    """
    check_target(directory, force=force)
    write_folder(directory, _files(result, config, report))


def write_folder(directory: Path, files: Sequence[tuple[str, str]]) -> None:
    """Write files (name, text) as a folder that appears whole or not at all.

    Raises:
        OutputError: the disk refuses; nothing is left behind.
    """
    with atomic_folder(directory) as part:
        for name, text in files:
            path = part / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")


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
    return "".join(
        f"{_seconds(t)} {a:.9f} {b:.9f} 0 0 0 {z:.12f} {w:.12f}\n"
        for t, a, b, z, w in zip(stamps.tolist(), x, y, qz, qw, strict=True)
    )


def cov_text(trajectory: Trajectory) -> str:
    """CSV of covariances ``stamp_ns,xx,xy,xphi,yy,yphi,phiphi``, full precision, sorted by stamp.

    Additive errors along world axes, m², m·rad, rad².
    """
    order = np.argsort(trajectory.stamps_ns, kind="stable")
    upper = trajectory.covs[order][:, *_UPPER].tolist()
    rows = (
        f"{t},{','.join(map(repr, row))}"
        for t, row in zip(trajectory.stamps_ns[order].tolist(), upper, strict=True)
    )
    return "\n".join([COV_HEADER, *rows]) + "\n"


def landmark_json(landmark: Landmark) -> dict[str, Any]:
    """One entry of landmarks.json (contract), plain Python values; a point's phi is null."""
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


def _files(
    result: Result, config: Config, report: Callable[[Result], str] | None
) -> list[tuple[str, str]]:
    """Names and contents of every file of the folder."""
    files = [
        ("summary.json", to_json(result.summary, "summary.json")),
        ("config.toml", dump_config(config)),
        (
            "landmarks.json",
            to_json([landmark_json(landmark) for landmark in result.landmarks], "landmarks.json"),
        ),
        ("graph.g2o", graph_g2o(result.steps, result.estimate)),
        ("graph_ids.csv", graph_ids(result.estimate)),
    ]
    for name, robot in result.robots.items():
        stem = f"trajectories/{_file_name(name)}"
        files += [
            (f"{stem}.tum", tum_text(robot.final)),
            (f"{stem}.causal.tum", tum_text(robot.causal)),
            (f"{stem}.cov.csv", cov_text(robot.final)),
            (f"{stem}.causal.cov.csv", cov_text(robot.causal)),
        ]
        for kind, scan in (("scan", robot.scan_final), ("scan.causal", robot.scan_causal)):
            if scan is not None:
                files.append((f"{stem}.{kind}.tum", tum_text(scan)))
    if report is not None:
        files.append(("report.html", report(result)))
    return files


def to_json(value: object, where: str) -> str:
    """JSON text; numpy scalars and arrays as plain values.

    Raises:
        OutputError: a number is not finite or a value has no form in JSON; names ``where``.
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
    sign = "-" if stamp_ns < 0 else ""
    return f"{sign}{abs(stamp_ns) // _NS}.{abs(stamp_ns) % _NS:09d}"


def _file_name(robot: str) -> str:
    """A robot's name as a file name: namespaces hold slashes, and a dot would read as a suffix."""
    return quote(robot, safe="").replace(".", "%2E")


def _is_result(directory: Path) -> bool:
    """A folder with our summary and trajectories; anything else is never replaced."""
    try:
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return (
        isinstance(summary, dict) and "format" in summary and (directory / "trajectories").is_dir()
    )


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
    """A TUM file ``stamp x y z qx qy qz qw``, ours or another tool's, sorted by stamp.

    The heading is the yaw of the quaternion; z, roll and pitch are left out. Covariances come
    from ``cov_path`` (see `cov_text`), which must have the same stamps; they are NaN without it.

    Raises:
        OutputError: the file cannot be read or a line is malformed; names file and line.
    """
    stamps, rows = [], []
    for number, fields in _table(path, None):
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
    entries = _read_json(path)
    if not isinstance(entries, list):
        raise OutputError(f"{path}: expected a list of landmarks")
    landmarks = []
    for index, entry in enumerate(entries):
        try:
            landmarks.append(_landmark(entry))
        except (KeyError, TypeError, ValueError) as error:
            raise OutputError(f"{path}: entry {index}: malformed landmark: {error!r}") from error
    return tuple(landmarks)


def load(directory: Path) -> SavedResult:
    """Read a result folder back.

    Raises:
        OutputError: it is not a result folder, or a file of it is malformed.
        ConfigError: its config.toml is not valid.
    """
    if not _is_result(directory):
        raise OutputError(f"{directory}: not a result folder of graphslam (no summary.json)")
    folder = directory / "trajectories"
    stems = sorted(p.name.removesuffix(".tum") for p in folder.glob("*.tum"))
    robots = {unquote(stem): _load_robot(folder / stem) for stem in stems if "." not in stem}
    if not robots:
        raise OutputError(f"{folder}: holds no trajectory")
    return SavedResult(
        robots,
        read_landmarks(directory / "landmarks.json"),
        _read_json(directory / "summary.json"),
        load_config(directory / "config.toml"),
    )


def _load_robot(stem: Path) -> SavedRobot:
    def path(suffix: str) -> Path:
        return stem.with_name(stem.name + suffix)

    def scan(suffix: str) -> Trajectory | None:
        return read_trajectory(path(suffix)) if path(suffix).exists() else None

    return SavedRobot(
        read_trajectory(path(".tum"), path(".cov.csv")),
        read_trajectory(path(".causal.tum"), path(".causal.cov.csv")),
        scan(".scan.tum"),
        scan(".scan.causal.tum"),
    )


def _read_covs(path: Path, stamps: np.ndarray[Any, Any]) -> Array:
    """Covariances (n, 3, 3) for ``stamps``, which the file must hold in the same order."""
    rows, times = [], []
    for number, fields in _table(path, ","):
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


def _landmark(entry: Mapping[str, Any]) -> Landmark:
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


def _table(path: Path, separator: str | None) -> list[tuple[int, list[str]]]:
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


def _read_json(path: Path) -> Any:
    try:
        return json.loads(read_text(path))
    except ValueError as error:
        raise OutputError(f"{path}: not valid JSON: {error}") from error
