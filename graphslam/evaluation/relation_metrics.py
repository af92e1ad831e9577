"""Errors of relative poses between scans against hand-made reference relations.

Source: R. Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27,
2009, DOI 10.1007/s10514-009-9155-6.
"""

import os
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.errors import OutputError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, between, compose, inverse
from graphslam.core.records import JointScans, Trajectory
from graphslam.evaluation.error_statistics import PROBABILITY, nees
from graphslam.evaluation.relation_covariances import relative_covariances
from graphslam.results.file_formats import read_text, stamp_ns

Stamps = np.ndarray[Any, np.dtype[np.int64]]

#: what is allowed for the error of a reference relation, per axis: two scans were laid on each
#: other by hand. What the relations show themselves (`closing_sigmas`) is 0.010 m and 0.23 deg in
#: Intel's, 0.031 m and 0.47 deg in those of ACES
REFERENCE_SIGMA_M, REFERENCE_SIGMA_RAD = 0.02, np.radians(0.35)
#: numbers of a group of relations
_NUMBERS = (
    "trans_mean_m", "trans_std_m", "trans_median_m", "rot_mean_deg", "rot_std_deg",
    "trans_inside", "rot_inside", "trans_inside_closing", "rot_inside_closing",
)  # fmt: skip
#: triangles of relations from which on they tell the error of the reference: a sigma by 20 of them
#: is known to a tenth (of two axes) and to a sixth (of the heading)
MIN_TRIANGLES = 20
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


def relations_given(relations: Relations | str | os.PathLike[str] | None) -> Relations | None:
    """Relations as a caller gives them: already read, the path of a file, or none.

    Raises:
        OutputError: see `read_relations`.
    """
    if isinstance(relations, str | os.PathLike):
        return read_relations(Path(relations))
    return relations


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


@dataclass(frozen=True, slots=True, eq=False)
class MatchedRelations:
    """Errors (n, 3) of relations whose scans are both there, along the axes of the second one.

    ``covs`` (n, 3, 3) are stated for them, None if unknown; ``matched`` (m,): which of all
    relations they are.
    """

    errors: Array
    covs: Array | None
    matched: np.ndarray[Any, np.dtype[np.bool_]]


def match_relations(
    relations: Relations, scans: Trajectory, joint: JointScans | None = None, robot: str = ""
) -> MatchedRelations:
    """The estimated relative poses in the frames of the reference ones.

    ``scans`` are poses of the laser; a relation matches where both of its stamps are among theirs,
    to the nanosecond. ``joint``: of all scans of ``robot``.
    """
    first, has_first = find_stamps(relations.from_ns, scans.stamps_ns)
    second, has_second = find_stamps(relations.to_ns, scans.stamps_ns)
    matched = np.asarray(has_first & has_second)
    pairs = np.column_stack([first, second])[matched]
    measured = between(scans.poses[pairs[:, 0]], scans.poses[pairs[:, 1]])
    errors = between(relations.poses[matched], measured)
    covs = None if joint is None else relative_covariances(joint, robot, scans, pairs)
    return MatchedRelations(errors, covs, matched)


def one_after_another(sessions: Sequence[Trajectory]) -> Trajectory:
    """The poses of several sessions as one trajectory; covariances are left out, NaN."""
    stamps = np.concatenate([one.stamps_ns for one in sessions])
    order = np.argsort(stamps, kind="stable")
    poses = np.concatenate([one.poses for one in sessions])[order]
    return Trajectory(stamps[order], poses, np.full((len(order), 3, 3), np.nan))


def relation_errors(relations: Relations, scans: Trajectory) -> Array:
    """Errors (n, 2): |translation| m and |rotation| degrees per relation, NaN where unmatched.

    Kümmerle et al. eq. 3-5 with the absolute (not squared) error, as in their tables.
    """
    found = match_relations(relations, scans)
    errors = np.full((len(found.matched), 2), np.nan)
    errors[found.matched] = _sizes(found.errors)
    return errors


def _sizes(errors: Array) -> Array:
    """|translation| m and |rotation| degrees (n, 2) of errors (n, 3)."""
    return np.column_stack([np.hypot(errors[:, 0], errors[:, 1]), np.degrees(np.abs(errors[:, 2]))])


def relation_metrics(
    relations: Relations, scans: Trajectory, joint: JointScans | None = None, robot: str = ""
) -> dict[str, dict[str, Any]]:
    """Numbers of `relation_errors` over ``all`` relations, ``local`` ones (<= 60 s) and ``loops``.

    Standard deviations are those of the sample (n, not n - 1). The
    ``inside`` shares are of errors within what is stated for 95 %: of translations within their
    ellipse, of rotations within their interval, each by the relative covariance of the two scans
    and that of the reference (`REFERENCE_SIGMA_M`, `REFERENCE_SIGMA_RAD`). Those of ``closing``
    take the sigmas of the reference that its own triangles show, see `closing_errors`; what they
    are is in ``reference``. A group without matches has None.
    """
    found = match_relations(relations, scans, joint, robot)
    closing = closing_errors(relations)
    sigmas = closing_sigmas(closing)
    groups = {
        "all": np.ones(len(found.matched), dtype=bool),
        "local": relations.local,
        "loops": ~relations.local,
    }
    return {
        **{name: _relation_group(found, group, sigmas) for name, group in groups.items()},
        "reference": {
            "triangles": len(closing),
            "sigma_m": None if sigmas is None else sigmas[0],
            "sigma_deg": None if sigmas is None else float(np.degrees(sigmas[1])),
        },
    }


def closing_errors(relations: Relations) -> Array:
    """By how much (n, 3) any three relations among three scans do not close.

    Along the axes of the latest scan. O(relations x relations of one scan).
    """
    known: dict[int, dict[int, Array]] = defaultdict(dict)
    ends = zip(relations.from_ns.tolist(), relations.to_ns.tolist(), strict=True)
    for (first, second), pose in zip(ends, relations.poses, strict=True):
        if second >= first:
            known[first][second] = pose
        else:
            known[second][first] = inverse(pose)
    three = [
        (direct[last], direct[middle], pose)
        for direct in list(known.values())
        for middle in direct
        for last, pose in known.get(middle, {}).items()
        if last in direct
    ]
    if not three:
        return np.zeros((0, 3))
    direct, first, second = np.array(three).transpose(1, 0, 2)
    return between(direct, compose(first, second))


def closing_sigmas(errors: Array) -> tuple[float, float] | None:
    """Error of one relation by n triangles of them (n, 3): m per axis, rad; None if too few.

    Root mean squares divided by sqrt(3): each triangle has the errors of three relations.
    """
    if len(errors) < MIN_TRIANGLES:
        return None
    x, y, phi = np.mean(errors**2, axis=0) / 3
    return float(np.sqrt((x + y) / 2)), float(np.sqrt(phi))


def _relation_group(
    found: MatchedRelations,
    group: np.ndarray[Any, np.dtype[np.bool_]],
    closing: tuple[float, float] | None,
) -> dict[str, Any]:
    use = group[found.matched]
    errors = found.errors[use]
    counts = {"n": len(errors), "unmatched": int(group.sum()) - len(errors)}
    if not len(errors):
        return {**counts, **dict.fromkeys(_NUMBERS)}
    translation, rotation = _sizes(errors).T
    inside: list[float | None] = []
    for sigmas in ((REFERENCE_SIGMA_M, REFERENCE_SIGMA_RAD), closing):
        if found.covs is None or sigmas is None:
            inside += [None, None]
            continue
        S = found.covs[use] + np.diag([sigmas[0] ** 2] * 2 + [sigmas[1] ** 2])
        inside += [_share_inside(errors[:, k], S[:, k, k]) for k in (slice(0, 2), slice(2, 3))]
    numbers = (
        float(translation.mean()),
        float(translation.std()),
        float(np.median(translation)),
        float(rotation.mean()),
        float(rotation.std()),
        *inside,
    )
    return {**counts, **dict(zip(_NUMBERS, numbers, strict=True))}


def _share_inside(errors: Array, covs: Array) -> float:
    """Share of errors (n, d) inside the ellipsoids that 95 % are to be in."""
    limit = chi2_quantile(PROBABILITY, errors.shape[1])
    return float(np.mean(nees(errors, covs) <= limit))


def find_stamps(wanted: Stamps, stamps: Stamps) -> tuple[Any, Any]:
    """Index (k,) of wanted stamps (k,) among sorted ``stamps`` (n,), and which are there (k,)."""
    index = np.minimum(np.searchsorted(stamps, wanted), len(stamps) - 1)
    return index, stamps[index] == wanted
