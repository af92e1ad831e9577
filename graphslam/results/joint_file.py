"""joint.npz: what the joint covariance of any scans of a result follows from.

All of their covariances would be as many numbers as there are pairs. The root of the information of
the final states is sparse; `graphslam.estimation.joint_covariances` computes from it what is asked
for. The layout is documented in docs/formats.md.
"""

import zlib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array
from graphslam.core.information_root import InformationRoot
from graphslam.core.mount_covariances import MountCovariances
from graphslam.core.record import replace
from graphslam.core.records import Estimate, JointScans, RobotResult, ScanTies, Trajectory

#: what reading a damaged file of arrays (.npz) and their contents raises: an empty one, one that is
#: cut, one with wrong bytes, one that lacks arrays
UNREADABLE = (OSError, EOFError, BadZipFile, zlib.error, ValueError, KeyError, IndexError)

FORMAT = 2
_UPPER = np.triu_indices(3)


def joint_scans(estimate: Estimate, robots: Mapping[str, RobotResult]) -> JointScans | None:
    """Of a result; None without a root, or if no scan follows from the final states.

    Of logs of sightings there are no scans, see `joint_landmarks`.
    """
    ties = {name: own.scan_ties for name, own in robots.items() if own.scan_ties is not None}
    if estimate.root is None or not ties:
        return None
    states = {name: estimate.states[name] for name in ties}
    mounts = estimate.mounts and replace(estimate.mounts, states={})
    return JointScans(estimate.root, states, ties, mounts)


def joint_landmarks(estimate: Estimate, robots: Mapping[str, RobotResult]) -> JointScans | None:
    """`joint_scans`, or that of landmarks alone; None if neither is known."""
    found = joint_scans(estimate, robots)
    if found is not None or estimate.root is None or estimate.root.states:
        return found
    return JointScans(estimate.root, {}, {})


def joint_bytes(joint: JointScans) -> bytes:
    """The content of the file."""
    root = joint.root
    arrays = {
        "format": np.array(FORMAT),
        "robots": np.array(sorted(joint.ties)),
        "above": root.above.astype(np.int32),
        "own": root.own.astype(np.int32),
        "width": root.width.astype(np.int32),
        "separators": root.separators.astype(np.int32),
        "values": root.values,
    }
    if root.shared.size:
        arrays["shared"] = root.shared.astype(np.float32)
    for n, name in enumerate(sorted(joint.ties)):
        states, ties = joint.states[name], joint.ties[name]
        arrays |= {
            f"state_stamps_ns_{n}": states.stamps_ns,
            f"state_poses_{n}": states.poses,
            f"state_rows_{n}": root.states[name].astype(np.int32),
            f"scan_state_{n}": ties.state.astype(np.int32),
            f"scan_share_{n}": ties.share,
            f"scan_mount_{n}": _once(ties.mounts),
            f"scan_cov_{n}": ties.covs[:, *_UPPER].astype(np.float32),
        }
        if not np.array_equal(ties.covs, ties.odometry_covs):
            arrays[f"scan_odometry_cov_{n}"] = ties.odometry_covs[:, *_UPPER].astype(np.float32)
    numbers = sorted(root.landmarks)
    arrays["landmark_ids"] = np.array(numbers, dtype=np.int64)
    arrays["landmark_rows"] = np.array([root.landmarks[n] for n in numbers], dtype=np.int32)
    if joint.mounts is not None:
        mounts, names = joint.mounts, sorted(joint.ties)
        width = len(mounts.cov)
        of_landmarks = np.zeros((len(numbers), 3, width))
        for k, number in enumerate(numbers):
            cross = mounts.landmarks[number]
            of_landmarks[k, : len(cross)] = cross
        held = np.full(3, -1)
        arrays |= {
            "mount_robots": np.array(mounts.robots),
            "mount_cov": mounts.cov,
            "mount_rows": np.array([root.mounts.get(n, held) for n in mounts.robots], np.int32),
            "landmark_mount": of_landmarks,
        }
        if mounts.placing:
            arrays["mount_placing"] = np.array([mounts.placing[name] for name in names])
    made = BytesIO()
    np.savez(made, **arrays)  # type: ignore[arg-type]  # its stub takes the names for options
    return made.getvalue()


def _once(rows: Array) -> Array:
    """Rows (n, d), or the first (1, d) if all are equal, as those of a robot's only laser are."""
    return rows[:1] if (rows == rows[:1]).all() else rows


def read_joint(path: Path) -> JointScans:
    """The file read back; the covariances of the states are not in it (NaN).

    Raises:
        OutputError: it cannot be read.
    """
    try:
        with path.open("rb") as stream, np.load(stream) as file:
            return _joint({name: file[name] for name in file.files})
    except UNREADABLE as error:
        raise OutputError(f"{path}: {error}") from error


def _joint(arrays: Mapping[str, Array]) -> JointScans:
    def integers(name: str) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        return arrays[name].astype(np.int64)

    def symmetric(name: str) -> Array:
        upper = arrays[name].astype(float)
        made = np.empty((len(upper), 3, 3))
        made[:, *_UPPER] = made[:, _UPPER[1], _UPPER[0]] = upper
        return made

    names = [str(name) for name in arrays["robots"]]
    states, rows, ties = {}, {}, {}
    for n, name in enumerate(names):
        poses, stamps = arrays[f"state_poses_{n}"], integers(f"state_stamps_ns_{n}")
        states[name] = Trajectory(stamps, poses, np.full((len(poses), 3, 3), np.nan))
        rows[name] = integers(f"state_rows_{n}")
        covs = symmetric(f"scan_cov_{n}")
        # where nothing is known better than by odometry, and in earlier versions, it is not there
        of_odometry = f"scan_odometry_cov_{n}"
        odometry_covs = symmetric(of_odometry) if of_odometry in arrays else covs
        state, share = integers(f"scan_state_{n}"), arrays[f"scan_share_{n}"]
        mounts = np.broadcast_to(arrays[f"scan_mount_{n}"], (len(state), 3))
        ties[name] = ScanTies(state, share, mounts, covs, odometry_covs)
    above, own, width, separators = map(integers, ("above", "own", "width", "separators"))
    marks: dict[int, int] = {}
    known: MountCovariances | None = None
    mount_rows: dict[str, IntArray] = {}
    # earlier versions kept the scans only, or the mount of a single robot in another way
    if "landmark_ids" in arrays and ("mount_cov" not in arrays or "mount_robots" in arrays):
        numbers = integers("landmark_ids").tolist()
        marks = dict(zip(numbers, integers("landmark_rows").tolist(), strict=True))
        if "mount_robots" in arrays:
            mounted = tuple(str(name) for name in arrays["mount_robots"])
            mount_rows = dict(
                zip(mounted, list(arrays["mount_rows"].astype(np.int64)), strict=True)
            )
            placing = arrays.get("mount_placing", ())
            known = MountCovariances(
                mounted,
                arrays["mount_cov"],
                {},
                dict(zip(numbers, arrays["landmark_mount"], strict=True)),
                dict(zip(names, placing, strict=True)) if len(placing) else {},
            )
    # earlier versions took what walls' observations share for independent
    shared = arrays.get("shared", np.zeros((0, 0))).astype(float)
    root = InformationRoot(
        above, own, width, separators, arrays["values"], rows, marks, mount_rows, shared
    )
    return JointScans(root, states, ties, known)
