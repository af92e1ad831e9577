"""How good a result is: against true poses, true landmarks, and hand-made relative poses.

Pure functions from records to plain numbers, named with their units. `evaluate` puts them together
in the shape of `evaluate --json`. The world frame of the estimate is taken as that of the truth:
what is not called *aligned* (errors, consistency, landmarks) means something only where the start
was given (``smooth --start truth``). Aligned numbers are after the best rigid motion.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from graphslam.core.errors import OutputError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, between, interpolate, transform, wrap
from graphslam.core.records import Landmark, Result, Trajectory, TrueLandmark
from graphslam.core.worker import parallel_map
from graphslam.results.folder import SavedResult, read_text, stamp_ns

Stamps = np.ndarray[Any, np.dtype[np.int64]]

MAX_TRUTH_GAP_S = 1.0
#: names of two landmarks are exchanged if each lies this many times nearer to the other's place
TIMES_NEARER = 3.0
MATCH_DISTANCE_M = 1.0
MATCH_ANGLE_RAD = 0.35
LOCAL_S = 60.0
#: what nothing can be said about where a robot's place in the world is not known
NO_PLACE = dict.fromkeys(
    ("ate_rmse_m", "max_m", "heading_rmse_rad", "nees_per_dof", "nees_bounds", "coverage")
)


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Estimated and true poses (n, 3) at the same stamps (n,) ns, covariances (n, 3, 3)."""

    stamps_ns: Stamps
    estimate: Array
    covs: Array
    truth: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)


# ---------------------------------------------------------------- trajectories


def pair(estimate: Trajectory, truth: Trajectory, max_gap_s: float = MAX_TRUTH_GAP_S) -> Pairs:
    """Truth at the estimate's stamps, along the constant twist between its neighbours.

    Stamps outside the truth's span, or between two true poses ``max_gap_s`` or more apart, have no
    pair; a stamp that the truth holds exactly always has one. Both must be sorted by stamp.
    """
    stamps, known = estimate.stamps_ns, truth.stamps_ns
    after = np.searchsorted(known, stamps, side="left")
    inside = (after < len(known)) & (stamps >= known[0])
    after = np.minimum(after, len(known) - 1)
    exact = known[after] == stamps
    before = np.where(exact, after, np.maximum(after - 1, 0))
    gap = known[after] - known[before]
    use = inside & (exact | (gap < max_gap_s * 1e9))
    share = (stamps - known[before]) / np.maximum(gap, 1)
    poses = interpolate(truth.poses[before[use]], truth.poses[after[use]], share[use])
    return Pairs(stamps[use], estimate.poses[use], estimate.covs[use], poses)


def align(source: Array, target: Array) -> Array:
    """Pose (3,) that moves points ``source`` (n, 2) best onto ``target`` (n, 2), no scale.

    Least squares over positions in closed form.

    Source: S. Umeyama, Least-squares estimation of transformation parameters between two point
    patterns, IEEE PAMI 13(4), 1991, DOI 10.1109/34.88573, with scale 1, in the plane.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    cross = np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    phi = float(np.arctan2(cross, np.sum(a * b)))
    turned = transform(np.array([0.0, 0.0, phi]), source.mean(axis=0)[None])[0]
    return np.array([*(target.mean(axis=0) - turned), phi])


def nees(errors: Array, covs: Array) -> Array:
    """Normalised estimation error squared (n,) of errors (n, d) with covariances (n, d, d).

    NaN where a covariance is not finite or not positive definite. For an honest estimate the
    expectation is d.

    Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation, 2001, section 5.4, DOI 10.1002/0471221279.
    """
    values = np.full(len(errors), np.nan)
    good = np.flatnonzero(np.isfinite(covs).all(axis=(1, 2)))
    good = good[np.linalg.eigvalsh(covs[good])[:, 0] > 0]
    solved = np.linalg.solve(covs[good], errors[good][..., None])[..., 0]
    values[good] = np.sum(errors[good] * solved, axis=1)
    return values


def consistency(errors: Array, covs: Array) -> dict[str, Any]:
    """``nees_per_dof``, its two-sided 95 % ``nees_bounds`` and ``coverage`` of the 95 % ellipsoids.

    Of errors (n, d) with covariances (n, d, d) along the same axes.

    The bounds are the chi-square quantiles of an average of n *independent* poses. Poses of one
    run are strongly correlated, so one run leaves the bounds far more often than 5 %: they are a
    scale to read the number on; a test of consistency needs many runs. Without a usable
    covariance all three are None.
    """
    values = nees(errors, covs)
    values = values[np.isfinite(values)]
    if not len(values):
        return {"nees_per_dof": None, "nees_bounds": None, "coverage": None}
    dof = errors.shape[1]
    n = dof * len(values)
    return {
        "nees_per_dof": float(values.mean() / dof),
        "nees_bounds": [float(q) for q in chi2_quantile([0.025, 0.975], n) / n],
        "coverage": float(np.mean(values <= chi2_quantile(0.95, dof))),
    }


def relative_errors(
    pairs: Pairs, *, seconds: float | None = None, metres: float | None = None
) -> Array:
    """Errors (k, 3) of the motion over ``seconds`` or over ``metres`` of true path (give one).

    For each pose the partner is the pose nearest to that time or path later, if within half of it
    in time or a tenth in path; the error is the estimated motion seen from the true one.

    Source: time: J. Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012,
    DOI 10.1109/IROS.2012.6385773; path: A. Geiger, P. Lenz, R. Urtasun, CVPR 2012,
    DOI 10.1109/CVPR.2012.6248074.
    """
    if (seconds is None) == (metres is None):
        raise ValueError("give seconds or metres")
    if len(pairs) < 2:
        return np.empty((0, 3))
    if seconds is not None:
        axis, delta, slack = (pairs.stamps_ns - pairs.stamps_ns[0]) / 1e9, seconds, 0.5 * seconds
    else:
        assert metres is not None  # narrows the type; checked above
        steps = np.hypot(*np.diff(pairs.truth[:, :2], axis=0).T)
        axis, delta, slack = np.concatenate([[0.0], np.cumsum(steps)]), metres, 0.1 * metres
    wanted = axis + delta
    after = np.clip(np.searchsorted(axis, wanted), 1, len(axis) - 1)
    nearer = np.abs(axis[after - 1] - wanted) < np.abs(axis[after] - wanted)
    end = np.where(nearer, after - 1, after)
    # the last pose is nobody's partner before its time, or the end would count many times over
    reached = wanted <= axis[-1] + 1e-9
    start = np.flatnonzero(reached & (np.abs(axis[end] - wanted) <= slack))
    end = end[start]
    true_motion = between(pairs.truth[start], pairs.truth[end])
    return between(true_motion, between(pairs.estimate[start], pairs.estimate[end]))


def trajectory_metrics(robots: Sequence[Pairs]) -> dict[str, Any]:
    """All trajectory numbers of one robot, or of several under one common alignment.

    Absolute errors: ``ate_rmse_m`` and ``max_m`` as estimated, ``ate_aligned_rmse_m`` after one
    `align` of all positions. Heading and consistency are of the poses as estimated. ``rpe`` as in
    `relative_errors`, per 1 s and 10 m. Numbers that nothing supports are None.

    Raises:
        ValueError: there is no pair at all.
    """
    estimate = np.concatenate([p.estimate for p in robots])
    truth = np.concatenate([p.truth for p in robots])
    if not len(truth):
        raise ValueError("no pair of poses")
    errors = estimate - truth
    errors[:, 2] = wrap(errors[:, 2])
    distance = np.hypot(errors[:, 0], errors[:, 1])
    moved = transform(align(estimate[:, :2], truth[:, :2]), estimate[:, :2])
    spans: dict[str, dict[str, float]] = {"1_s": {"seconds": 1.0}, "10_m": {"metres": 10.0}}
    rpe = {
        name: _rpe(np.concatenate([relative_errors(p, **span) for p in robots]))
        for name, span in spans.items()
    }
    return {
        "poses": len(truth),
        "ate_rmse_m": _rms(distance),
        "ate_aligned_rmse_m": _rms(np.hypot(*(moved - truth[:, :2]).T)),
        "max_m": float(distance.max()),
        "heading_rmse_rad": _rms(errors[:, 2]),
        "rpe": rpe,
        **consistency(errors, np.concatenate([p.covs for p in robots])),
    }


def _rpe(errors: Array) -> dict[str, Any]:
    return {
        "pairs": len(errors),
        "trans_rmse_m": _rms(np.hypot(errors[:, 0], errors[:, 1])),
        "rot_rmse_rad": _rms(errors[:, 2]),
    }


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


# ---------------------------------------------------------------- landmarks


def landmark_metrics(estimated: Sequence[Landmark], true: Sequence[TrueLandmark]) -> dict[str, Any]:
    """``rmse_m``, ``nees_per_dof``, ``worst``, ``matched``, ``missed``, ``extra`` of a map.

    Landmarks match by identity where both have one. Other points match by the assignment with the
    smallest sum of distances among pairs within 1 m; other lines and segments each with the nearest
    true one within 1 m and 0.35 rad modulo pi, for a wall may be seen in several pieces. ``missed``
    are true ones that nothing matches, ``extra`` landmarks without a true one. Errors are the
    distance for points; for lines and segments the distance of the seen part's middle from the
    true line, and their NEES has two degrees of freedom (direction and offset of the normal),
    since a position along a wall is a gauge. ``worst`` is the landmark of the largest NEES per
    degree of freedom, ``id``, ``nees_per_dof`` and ``error_m``: one that is not what it is taken
    for can make the mean.
    ``exchanged``: pairs of identities of points that lie
    where the other one truly is, so that their names are wrong and not their places; they match
    the places.
    """
    pairs, exchanged = _unchanged(_match(estimated, true), estimated, true)
    errors, values, dofs = [], [], []
    for i, j in pairs:
        error, difference, cov = _landmark_error(estimated[i], true[j])
        errors.append(error)
        values.append(float(nees(difference[None], cov[None])[0]))
        dofs.append(len(difference))
    squares, dof = np.array(values), np.array(dofs)
    usable = np.flatnonzero(np.isfinite(squares))
    mean = worst = None
    if len(usable):
        mean = float(squares[usable].sum() / dof[usable].sum())
        k = usable[(squares[usable] / dof[usable]).argmax()]
        worst = {
            "id": estimated[pairs[k][0]].id,
            "nees_per_dof": float(squares[k] / dof[k]),
            "error_m": errors[k],
        }
    return {
        "rmse_m": _rms(np.array(errors)),
        "nees_per_dof": mean,
        "worst": worst,
        "matched": len(pairs),
        "missed": len(true) - len({j for _, j in pairs}),
        "extra": len(estimated) - len(pairs),
        "exchanged": exchanged,
    }


def _unchanged(
    pairs: Sequence[tuple[int, int]], estimated: Sequence[Landmark], true: Sequence[TrueLandmark]
) -> tuple[list[tuple[int, int]], list[tuple[str, str]]]:
    """Matches with exchanged names undone, and those names."""
    place = dict(pairs)
    named = [i for i, j in pairs if estimated[i].identity and estimated[i].kind == "point"]
    found = []
    for a, b in itertools.combinations(named, 2):
        ways = ((a, b), (b, a))
        if all(
            _apart(estimated[i], true[place[i]])
            > TIMES_NEARER * _apart(estimated[i], true[place[k]])
            for i, k in ways
        ):
            place[a], place[b] = place[b], place[a]
            found.append((str(estimated[a].identity), str(estimated[b].identity)))
    return [(i, place[i]) for i, _ in pairs], found


def _apart(estimated: Landmark, true: TrueLandmark) -> float:
    return float(np.hypot(*(estimated.position[:2] - true.pose[:2])))


def _match(estimated: Sequence[Landmark], true: Sequence[TrueLandmark]) -> list[tuple[int, int]]:
    named = {landmark.identity: j for j, landmark in enumerate(true) if landmark.identity}
    pairs, taken = [], set()
    for i, landmark in enumerate(estimated):
        j = named.get(landmark.identity or "")
        if j is not None and j not in taken:
            pairs.append((i, j))
            taken.add(j)
    rows = [i for i, landmark in enumerate(estimated) if landmark.identity not in named]
    columns = [j for j in range(len(true)) if j not in taken]
    if not rows or not columns:
        return pairs
    cost = np.array([[_distance(estimated[i], true[j]) for j in columns] for i in rows])
    wall = np.array([estimated[i].kind != "point" for i in rows])
    nearest = cost.argmin(axis=1)
    pairs += [
        (rows[r], columns[nearest[r]]) for r in np.flatnonzero(wall & np.isfinite(cost.min(axis=1)))
    ]
    rows, cost = [i for i, is_wall in zip(rows, wall, strict=True) if not is_wall], cost[~wall]
    if not rows:
        return pairs
    # A forbidden pair costs more than all allowed ones together, so as many as possible match.
    forbidden = MATCH_DISTANCE_M * (1 + min(cost.shape))
    chosen = linear_sum_assignment(np.where(np.isfinite(cost), cost, forbidden))
    matched = [
        (rows[r], columns[c]) for r, c in zip(*chosen, strict=True) if np.isfinite(cost[r, c])
    ]
    return pairs + matched


def _distance(estimated: Landmark, true: TrueLandmark) -> float:
    """Distance between a landmark and a true one, m; infinite where they cannot match."""
    if (estimated.kind == "point") != (true.kind == "point"):
        return np.inf
    if estimated.kind == "point":
        distance = float(np.hypot(*(estimated.position[:2] - true.pose[:2])))
    else:
        turn = float(wrap(2 * (estimated.position[2] - true.pose[2]))) / 2  # modulo pi
        x, y = between(true.pose, np.array([*estimated.extent.mean(axis=0), 0.0]))[:2]
        beyond = 0.0
        if true.extent is not None:
            ends = between(true.pose, np.column_stack([true.extent, np.zeros(2)]))[:, 0]
            beyond = float(x - np.clip(x, ends.min(), ends.max()))
        distance = float(np.hypot(beyond, y)) if abs(turn) <= MATCH_ANGLE_RAD else np.inf
    return distance if distance <= MATCH_DISTANCE_M else np.inf


def _landmark_error(estimated: Landmark, true: TrueLandmark) -> tuple[float, Array, Array]:
    """Error in metres; difference (2,) of the parameters that have a truth; its covariance."""
    if estimated.line is None or estimated.kind == "point":
        difference = estimated.position[:2] - true.pose[:2]
        return float(np.hypot(*difference)), difference, estimated.cov[:2, :2]
    normal, offset, cov = estimated.line
    # The same line has two normals; take the truth's that is nearer to the estimate's.
    true_normal = true.pose[2] + np.pi / 2
    true_normal += np.pi * np.round((normal - true_normal) / np.pi)
    n = np.array([np.cos(true_normal), np.sin(true_normal)])
    true_offset = float(n @ true.pose[:2])
    error = abs(float(n @ estimated.extent.mean(axis=0)) - true_offset)
    difference = np.array([normal - true_normal, offset - true_offset])
    return error, difference, cov


# ---------------------------------------------------------------- relations


@dataclass(frozen=True, slots=True, eq=False)
class Relations:
    """Reference poses (n, 3) of the laser at ``to_ns`` in its frame at ``from_ns``, (n,) ns."""

    from_ns: Stamps
    to_ns: Stamps
    poses: Array

    @property
    def local(self) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Which span at most 60 s; the rest are loops."""
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
    to the nanosecond. The error is the measured relative pose seen from the reference one.

    Source: R. Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots
    27, 2009, DOI 10.1007/s10514-009-9155-6, eq. 3-5 with the absolute (not squared) error, as in
    the tables of that paper.
    """
    first, first_known = _find(relations.from_ns, scans.stamps_ns)
    second, second_known = _find(relations.to_ns, scans.stamps_ns)
    known = first_known & second_known
    measured = between(scans.poses[first], scans.poses[second])
    error = between(relations.poses, measured)
    rotation = np.degrees(np.abs(error[:, 2]))
    errors = np.column_stack([np.hypot(error[:, 0], error[:, 1]), rotation])
    return np.where(known[:, None], errors, np.nan)


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


def _find(wanted: Stamps, known: Stamps) -> tuple[Any, Any]:
    """Index of each wanted stamp among sorted known ones, and whether it is there."""
    index = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    return index, known[index] == wanted


# ---------------------------------------------------------------- all of it


def robots_apart(summary: Mapping[str, Any]) -> set[str]:
    """Robots of a result that have a frame of their own: where it lies in the world is unknown."""
    world = summary.get("world")
    return {robot for robot, frame in summary.get("frames", {}).items() if frame != world}


def evaluate(
    result: Result | SavedResult,
    truth: Mapping[str, Trajectory] | None = None,
    true_landmarks: Sequence[TrueLandmark] = (),
    relations: Relations | None = None,
) -> dict[str, Any]:
    """Everything that `evaluate --json` prints (see the contract), from what there is.

    ``robots`` and ``joint`` are there with ``truth`` (robots without truth are left out; of robots
    in a frame of their own there are only aligned and relative errors, and no joint ones),
    ``landmarks`` with ``true_landmarks``, ``relations`` with ``relations``; those are of the final
    poses, and their key ``causal`` holds the same of the causal ones. Relations name no robot:
    they are compared with the one whose scans match most.

    Raises:
        OutputError: no pose lies within the truth's span, or relations come without scans.
    """
    found: dict[str, Any] = {}
    if truth:
        pairs = {
            name: {k: pair(getattr(robot, k), truth[name]) for k in ("final", "causal")}
            for name, robot in result.robots.items()
            if name in truth and len(truth[name])
        }
        pairs = {name: both for name, both in pairs.items() if all(map(len, both.values()))}
        if not pairs:
            raise OutputError(
                f"no pose of {', '.join(result.robots)} lies within the span of the truth, "
                f"which is of {', '.join(truth)}"
            )
        apart = robots_apart(result.summary)
        asked: dict[tuple[str | None, str], list[Pairs]] = {
            (name, kind): [p] for name, both in pairs.items() for kind, p in both.items()
        }
        together = [both for name, both in pairs.items() if name not in apart]
        if together:
            asked |= {(None, kind): [both[kind] for both in together] for kind in together[0]}
        metrics = dict(
            zip(asked, parallel_map(trajectory_metrics, list(asked.values())), strict=True)
        )
        found["robots"] = {
            name: {kind: metrics[name, kind] | (NO_PLACE if name in apart else {}) for kind in both}
            for name, both in pairs.items()
        }
        if together:
            found["joint"] = {kind: metrics[None, kind] for kind in together[0]}
    if true_landmarks:
        marks = [mark for mark in result.landmarks if mark.frame is None]
        found["landmarks"] = landmark_metrics(marks, true_landmarks)
    if relations is not None:
        found["relations"] = _relations(result, relations)
    return found


def _relations(result: Result | SavedResult, relations: Relations) -> dict[str, Any]:
    scans = [
        (robot.scan_final, robot.scan_causal)
        for robot in result.robots.values()
        if robot.scan_final is not None and robot.scan_causal is not None
    ]
    if not scans:
        raise OutputError("relations need the poses of scans, and this result has none")
    final, causal = max(scans, key=lambda s: int(_find(relations.from_ns, s[0].stamps_ns)[1].sum()))
    return {**relation_metrics(relations, final), "causal": relation_metrics(relations, causal)}
