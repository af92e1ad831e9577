"""A result as the known map of later logs: made of its files, or kept in known_map.npz.

The joint covariance of the landmarks follows from the root of the information in joint.npz, places
from scans.npz. A result that was itself made with a known map has all of it in known_map.npz: of
the days before nothing else is left. What the biases of surfaces leave of the landmarks' errors is
not in it: on another day they are the same, and do the same to its path. The layout is documented
in docs/formats.md.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.config import Config, ScanMatchingConfig
from graphslam.core.errors import ConfigError, OutputError
from graphslam.core.geometry import Array, moved_by_world, rotation3
from graphslam.core.known_landmarks import KnownLandmarks, SparseRoot
from graphslam.core.record import replace
from graphslam.core.records import JointScans, KeyframeScan, Landmark, Result, Trajectory
from graphslam.core.sparse_gaussian import sparse_root
from graphslam.estimation.joint_covariances import joint_covariance, mount_errors
from graphslam.mapping.known_map import KnownMap, latest_places, map_place
from graphslam.mapping.map_update import (
    with_covariances,
    with_surface_biases,
    without_days_biases,
)
from graphslam.mapping.submaps import SubmapPose, build_submaps
from graphslam.results.file_formats import landmark_from_json, landmark_json, read_json
from graphslam.results.folder import SavedResult, check_one_frame, load
from graphslam.results.joint_file import UNREADABLE, joint_landmarks
from graphslam.results.scans_file import SCANS_FILE, read_scans
from graphslam.slam.summary import FORMAT as RESULT_FORMAT

FORMAT = 1
#: names of arrays of the landmarks without the error of a day begin so
ITSELF = "itself_"
KNOWN_MAP_FILE = "known_map.npz"


def load_known_map(directory: Path, matching: ScanMatchingConfig | None = None) -> KnownMap:
    """The map that a result folder holds for later logs.

    Args:
        directory: of the result.
        matching: how later scans are matched with its places; default settings without it.

    Raises:
        OutputError: it is no result folder, or one that cannot be used as a map: the line says why.
        ConfigError: its config.toml is not valid.
    """
    matching = matching or ScanMatchingConfig()
    if (directory / KNOWN_MAP_FILE).exists():
        return _read(directory / KNOWN_MAP_FILE, directory.absolute().name, matching)
    saved = load(directory)
    if saved.summary["format"] != RESULT_FORMAT:
        raise OutputError(
            f"{directory}: is of another version of graphslam ({saved.summary['format']}, not "
            f"{RESULT_FORMAT}); smooth its log again"
        )
    check_one_frame(saved, directory)
    if "live" in saved.summary:
        raise OutputError(
            f"{directory}: is of `graphslam follow`, which keeps no joint covariance of its "
            "landmarks; smooth the recording, and use that result as the map"
        )
    if saved.joint is None or not saved.joint.root.landmarks:
        raise OutputError(
            f"{directory}: has no joint covariance of its landmarks: it was made by an earlier "
            "version or by a filter; smooth its log again"
        )
    landmarks = tuple(
        mark
        for mark in saved.landmarks
        if mark.frame is None and mark.id in saved.joint.root.landmarks
    )
    bias_m = saved.config.front_end.floor_normal_m
    cov = landmark_covariance(saved.joint, landmarks, biases=False)
    # the log saw the walls with the errors of its own day
    cov = with_surface_biases(landmarks, cov, bias_m)
    itself, known = known_on_a_day(landmarks, cov, bias_m)
    places = latest_places(_submaps(directory, saved, matching))
    name, sha256 = directory.absolute().name, _digest(directory)
    given = saved.config.start.from_truth or bool(saved.config.start.poses)
    return KnownMap(name, sha256, landmarks, known, places, bias_m, itself, is_world_given=given)


def known_map_of(config: Config) -> KnownMap | None:
    """The map that the settings name, if any.

    Raises:
        ConfigError: ``known_map.update`` without one.
        OutputError: see `load_known_map`.
    """
    if not config.known_map.directory:
        if config.known_map.update:
            raise ConfigError(
                "known_map.update (--update): there is no map to continue; give --prior-map DIR"
            )
        return None
    directory = Path(config.known_map.directory)
    known_map = load_known_map(directory, config.scan_matching)
    # results of earlier versions had none
    verdict = read_json(directory / "summary.json").get("verdict", {}).get("verdict", "good")
    return replace(known_map, verdict=verdict)


def known_map_files(result: Result, earlier: KnownMap | None) -> list[tuple[str, bytes]]:
    """Name and content of the file of a result in an earlier map: that map, or its continuation.

    None for a result without an earlier map: its map is made of its other files.
    """
    if earlier is None:
        return []
    told = earlier if not result.config.known_map.update else continued(result, earlier)
    return [(KNOWN_MAP_FILE, known_map_bytes(told))]


def continued(result: Result, earlier: KnownMap) -> KnownMap:
    """The map after a result that was made with it: its landmarks, and the latest of each place.

    Raises:
        OutputError: the result has no joint covariance.
    """
    joint = joint_landmarks(result.estimate, result.robots)
    if joint is None:
        raise OutputError("known_map.update: the result has no joint covariance")
    bias_m = result.config.front_end.floor_normal_m
    cov = landmark_covariance(joint, result.landmarks, biases=False)
    landmarks, cov = without_days_biases(
        earlier.known, earlier.itself, earlier.bias_m, result.landmarks, cov
    )
    itself, known = known_on_a_day(landmarks, cov, bias_m)
    landmarks = with_covariances(landmarks, cov)
    found = build_submaps(result.estimate.states, result.keyframe_scans, result.config)
    places = latest_places([*found, *earlier.places])
    # named by its folder, identified by its content
    return KnownMap(
        "", "", landmarks, known, places, bias_m, itself, earlier.ancestry, earlier.is_world_given
    )


def landmark_covariance(
    joint: JointScans, landmarks: Sequence[Landmark], *, biases: bool = True
) -> Array:
    """Joint covariance (D, D) of landmarks, errors of walls along each one's own axes.

    ``biases``: with what the biases of surfaces leave of them.
    """
    root, mounts = joint.root, joint.mounts
    if not biases:
        root = replace(root, shared=np.zeros((0, 0)))
    dims = [2 if mark.kind == "point" else 3 for mark in landmarks]
    first = [root.landmarks[mark.id] for mark in landmarks]
    rows = np.concatenate(
        [np.zeros(0), *(np.arange(row, row + dim) for row, dim in zip(first, dims, strict=True))]
    ).astype(np.int64)
    cov = joint_covariance(root, rows)
    if mounts is None or not mounts.placing:
        return cov
    # a mount places the world: an error of it moves all landmarks together
    twist = next(iter(mounts.placing.values()))  # there is one world
    own_axes = [_own_axes(mark)[:dim, :dim] for mark, dim in zip(landmarks, dims, strict=True)]
    cross, placing = (
        np.concatenate([axes @ one[: len(axes)] for axes, one in zip(own_axes, parts, strict=True)])
        for parts in (
            [mounts.landmarks[mark.id] for mark in landmarks],
            [moved_by_world(np.nan_to_num(mark.position)) @ twist for mark in landmarks],
        )
    )
    of_mounts = mounts.cov
    if not biases and joint.root.shared.size:
        by_mounts = mount_errors(joint.root, mounts)
        cross = cross - joint.root.shared[rows] @ by_mounts.T
        of_mounts = of_mounts - by_mounts @ by_mounts.T
    mixed = cross @ placing.T
    return np.asarray(cov + mixed + mixed.T - placing @ of_mounts @ placing.T)


def _own_axes(mark: Landmark) -> Array:
    return np.eye(3) if mark.kind == "point" else rotation3(-mark.position[2])


def known_landmarks(landmarks: Sequence[Landmark], cov: Array) -> KnownLandmarks:
    """Landmarks and their joint covariance (D, D), see `landmark_covariance`, for a graph."""
    means = {mark.id: mark.position[: 2 if mark.kind == "point" else 3] for mark in landmarks}
    # their numbers are those of the path along which they were found
    root = sparse_root(cov, [len(mean) for mean in means.values()])
    return KnownLandmarks(means, tuple(means), root)


def known_on_a_day(
    landmarks: Sequence[Landmark], cov: Array, bias_m: float
) -> tuple[KnownLandmarks, KnownLandmarks]:
    """Landmarks with their joint covariance (D, D), and as a day sees them, with its error (m).

    The latter is of the former's sparse form, so that it is nowhere more certain with the error.
    """
    itself = known_landmarks(landmarks, cov)
    cov = itself.covariance([mark.id for mark in landmarks])
    return itself, known_landmarks(landmarks, with_surface_biases(landmarks, cov, bias_m))


def _submaps(directory: Path, saved: SavedResult, matching: ScanMatchingConfig) -> list[SubmapPose]:
    """Submaps along the paths of a result; none without scans."""
    if not (directory / SCANS_FILE).exists():
        return []
    placed = read_scans(directory / SCANS_FILE)
    states: dict[str, Trajectory] = {}
    for robot in sorted({scan.robot for scan in placed}):
        own = [scan for scan in placed if scan.robot == robot]
        times = np.array([scan.time_ns for scan in own], dtype=np.int64)
        poses = np.array([scan.pose for scan in own])
        states[robot] = Trajectory(times, poses, np.full((len(own), 3, 3), np.nan))
    scans = [KeyframeScan(s.robot, s.time_ns, s.points, s.sensor) for s in placed]
    return build_submaps(states, scans, replace(saved.config, scan_matching=matching))


def _digest(directory: Path) -> str:
    found = hashlib.sha256()
    for name in ("landmarks.json", "joint.npz", SCANS_FILE):
        path = directory / name
        if path.exists():
            found.update(path.read_bytes())
    return found.hexdigest()


# ---------------------------------------------------------------- the file


def known_map_bytes(known: KnownMap) -> bytes:
    """The content of the file."""
    clouds = [cloud for p in known.places for cloud in p.submap.clouds]
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT),
        "name": np.array(known.name),
        "sha256": np.array(known.sha256),
        "landmarks": np.frombuffer(
            json.dumps([landmark_json(mark) for mark in known.landmarks]).encode(), dtype=np.uint8
        ),
        "parents": np.array([list(p) for p in known.parents], dtype=np.str_).reshape(-1, 2),
        **_root_arrays(known.known.root, ""),
        **(_root_arrays(known.itself.root, ITSELF) if known.itself else {}),
        "bias_m": np.array(known.bias_m),
        "is_world_given": np.array(known.is_world_given),
        "place_pose": np.array([p.pose for p in known.places]).reshape(-1, 3),
        "place_scans": np.array([len(p.submap.clouds) for p in known.places], dtype=np.int32),
        "sensor": np.concatenate([np.zeros((0, 3)), *(p.submap.poses for p in known.places)]),
        "count": np.array([len(cloud) for cloud in clouds], dtype=np.int32),
        "points": np.concatenate([np.zeros((0, 2)), *clouds], dtype=np.float32),
    }
    made = BytesIO()
    np.savez(made, **arrays)
    return made.getvalue()


def _root_arrays(root: SparseRoot, prefix: str) -> dict[str, Array]:
    return {
        f"{prefix}parent_count": np.array([len(p) for p in root.parents], dtype=np.int32),
        f"{prefix}parent": np.array([n for p in root.parents for n in p], dtype=np.int32),
        f"{prefix}rows": np.concatenate([np.zeros(0), *(row.ravel() for row in root.rows)]),
        f"{prefix}widening": np.array(root.widening),
    }


def _root(arrays: Mapping[str, Array], prefix: str, dims: Sequence[int]) -> SparseRoot:
    parent_count, parent, values = (
        arrays[f"{prefix}{name}"] for name in ("parent_count", "parent", "rows")
    )
    parents = [tuple(part.tolist()) for part in np.split(parent, np.cumsum(parent_count)[:-1])][
        : len(dims)
    ]
    shapes = [
        (dim, dim + sum(dims[n] for n in before)) for dim, before in zip(dims, parents, strict=True)
    ]
    sizes = np.cumsum([a * b for a, b in shapes], dtype=np.int64)[:-1]
    rows = [
        part.reshape(shape)
        for part, shape in zip(np.split(values, sizes), shapes, strict=bool(shapes))
    ]
    return SparseRoot(tuple(parents), tuple(rows), float(arrays[f"{prefix}widening"]))


def _read(path: Path, name: str, matching: ScanMatchingConfig) -> KnownMap:
    try:
        data = path.read_bytes()
        with np.load(BytesIO(data)) as file:
            arrays = {key: file[key] for key in file.files}
        if int(arrays["format"]) != FORMAT:
            raise OutputError(
                f"{path}: is of format {int(arrays['format'])}, this version reads {FORMAT}; "
                "smooth its logs again"
            )
        return _known_map(arrays, name, hashlib.sha256(data).hexdigest(), matching)
    except UNREADABLE as error:
        raise OutputError(f"{path}: {error}") from error


def _known_map(
    arrays: Mapping[str, Array], name: str, sha256: str, matching: ScanMatchingConfig
) -> KnownMap:
    landmarks = tuple(map(landmark_from_json, json.loads(arrays["landmarks"].tobytes())))
    means = {mark.id: mark.position[: 2 if mark.kind == "point" else 3] for mark in landmarks}
    dims = [len(mean) for mean in means.values()]
    clouds = np.split(arrays["points"].astype(float), np.cumsum(arrays["count"])[:-1])
    first = np.concatenate([[0], np.cumsum(arrays["place_scans"])]).tolist()
    places = tuple(
        map_place(k, pose, arrays["sensor"][begin:end], clouds[begin:end], matching)
        for k, (pose, (begin, end)) in enumerate(
            zip(arrays["place_pose"], pairwise(first), strict=True)
        )
    )
    known = KnownLandmarks(means, tuple(means), _root(arrays, "", dims))
    itself = None
    if f"{ITSELF}rows" in arrays:
        itself = replace(known, root=_root(arrays, ITSELF, dims))
    told = tuple((str(a), str(b)) for a, b in arrays["parents"])
    if str(arrays["name"]):  # a copy
        name, sha256 = str(arrays["name"]), str(arrays["sha256"])
    bias_m = float(arrays.get("bias_m", 0.0))  # of older ones it is not known
    given = bool(arrays.get("is_world_given", False))
    return KnownMap(name, sha256, landmarks, known, places, bias_m, itself, told, given)
