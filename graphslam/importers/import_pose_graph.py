"""Pose graphs (iSAM text, TORO .graph, g2o) to MCAP.

Measurements and noise are interpreted exactly as by gtsam's `load2D` (`readG2o` for g2o files), so
that results can be compared with the file's own factors. Such files have no times: stamps are
invented, one second apart, and the log's notes say so.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from graphslam.core.errors import LogError
from graphslam.core.geometry import Array, adjoint, inverse, is_positive, rotate_cov, wrap
from graphslam.importers.import_summary import ImportSummary
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.source_files import text_lines
from graphslam.logs.writer import LogWriter

_UNEQUAL = "landmark lines have unequal variances; sigmas of 1 rad and 1 m are used"
_NO_INFORMATION = "noises have a direction without information; it is taken as a very weak one"
_STAMPS = "invented: the source has none; pose number k (from 0) is stamped k+1 seconds"

#: information of a direction without any, relative to that of the others: weaker could not be told
#: from them once the matrix is inverted and turned
WEAKEST = 1e-12
#: eigenvalues more negative, relative to the largest, are not due to a file's few digits
ROUNDING = 1e-5


@dataclass(frozen=True, slots=True)
class PoseGraphEdge:
    """Pose (3,) of ``end`` in the frame of ``start``; ``cov`` (3, 3) along the axes of *end*.

    This is gtsam's convention: the error is the logarithm of measured^-1 * predicted.
    """

    start: int
    end: int
    delta: Array
    cov: Array


@dataclass(frozen=True, slots=True)
class LandmarkEdge:
    """Bearing and range (2,) of a landmark from a pose, with their covariance (2, 2)."""

    pose: int
    landmark: int
    z: Array
    cov: Array


@dataclass
class PoseGraph:
    """Contents of a file in its order; ``ignored`` counts lines by tag, ``assumed`` by reason."""

    edges: list[PoseGraphEdge] = field(default_factory=list)
    sightings: list[LandmarkEdge] = field(default_factory=list)
    ignored: Counter[str] = field(default_factory=Counter)
    assumed: Counter[str] = field(default_factory=Counter)


def pose_stamp_ns(number: int) -> int:
    """Invented stamp, ns, of pose ``number`` of the odometry chain, counted from 0."""
    return (number + 1) * 10**9


def import_pose_graph(source: Path, target: Path) -> ImportSummary:
    """Convert a pose graph to the MCAP file ``target``.

    Edges between consecutive poses become OdometryIncrement, other edges RelativePose, landmarks
    Sighting with the landmark's number as its identity. Initial values (VERTEX) are ignored.
    Where two consecutive poses have no edge, the odometry of one robot ends and that of the next
    begins; nothing else separates robots. They are named ``robot1``, ``robot2``, ...

    Raises:
        LogError: ``source`` cannot be read, a line or its noise is invalid, it has no edges, or a
            pose has no odometry.
        OutputError: ``target`` cannot be written.
    """
    graph = read_pose_graph(source)
    poses = sorted({pose for edge in graph.edges for pose in (edge.start, edge.end)})
    if not poses:
        raise LogError(f"{source}: has no edge between two poses; is it a pose graph in 2-D?")
    number = {pose: k for k, pose in enumerate(poses)}
    odometry, others = split_odometry(graph.edges, poses)
    robots = assign_robots(source, odometry, poses)
    closures: dict[int, list[PoseGraphEdge]] = {}
    for edge in others:
        closures.setdefault(edge.end, []).append(edge)
    sightings: dict[int, list[LandmarkEdge]] = {}
    for seen in graph.sightings:
        sightings.setdefault(seen.pose, []).append(seen)
    notes = {"format": "pose graph", "source": source.name, "stamps": _STAMPS}
    if others:
        # closures refer to poses of the graph, so every one of them must be a keyframe
        notes["keyframe.mode"] = "all"
    with LogWriter(target, notes) as log:
        for pose in poses:
            robot = robots[pose]
            if pose in odometry:
                _write(partial(log.increment, robot), number, odometry[pose])
            for edge in closures.get(pose, ()):
                other = robots[edge.start] if robots[edge.start] != robot else None
                _write(partial(log.relative_pose, robot, other=other), number, edge)
            for seen in sightings.get(pose, ()):
                stamp_ns = pose_stamp_ns(number[pose])
                log.sighting(robot, stamp_ns, seen.z, seen.cov, identity=str(seen.landmark))
    warnings = [f"{source}: {n} {tag} lines are not used" for tag, n in graph.ignored.items()]
    warnings += [f"{source}: {n} {reason}" for reason, n in graph.assumed.items() if n]
    warnings += [
        f"{source}: no edge from pose {a} to pose {b}: assumed to be the start of {robots[b]}"
        for a, b in pairwise(poses)
        if robots[a] != robots[b]
    ]
    unlinked = sum(len(seen) for pose, seen in sightings.items() if pose not in number)
    if unlinked:
        warnings.append(f"{source}: {unlinked} sightings from poses without an edge are not used")
    return ImportSummary(source, target, log.counts, (*warnings, f"{source}: stamps are {_STAMPS}"))


def _write(write: Callable[..., None], number: dict[int, int], edge: PoseGraphEdge) -> None:
    """Write an edge; covariances of a log are along the axes of its start, gtsam's of its end."""
    start_ns, end_ns = pose_stamp_ns(number[edge.start]), pose_stamp_ns(number[edge.end])
    cov = rotate_cov(edge.cov, float(edge.delta[2]))
    write(start_ns, end_ns, delta=edge.delta, cov=cov)


# ---------------------------------------------------------------- the graph


def split_odometry(
    edges: Iterable[PoseGraphEdge], poses: Sequence[int]
) -> tuple[dict[int, PoseGraphEdge], list[PoseGraphEdge]]:
    """Odometry edges by the pose that they lead to, and all other edges.

    The first edge between two neighbours in ``poses`` is odometry. Every edge is made to lead from
    the earlier pose to the later one, see `reverse_edge`.
    """
    following = dict(pairwise(poses))
    odometry: dict[int, PoseGraphEdge] = {}
    others = []
    for edge in edges:
        forward = edge if edge.start < edge.end else reverse_edge(edge)
        if following.get(forward.start) == forward.end and forward.end not in odometry:
            odometry[forward.end] = forward
        else:
            others.append(forward)
    return odometry, others


def assign_robots(
    source: Path, odometry: Mapping[int, PoseGraphEdge], poses: Sequence[int]
) -> dict[int, str]:
    """Pose -> its robot; a new robot begins at each pose that no odometry leads to.

    Raises:
        LogError: a pose has odometry neither before nor after it; the message has its number.
    """
    first_poses = [pose for pose in poses if pose not in odometry]
    for pose, following in pairwise([*poses, -1]):
        if pose not in odometry and following not in odometry:
            raise LogError(
                f"{source}: pose {pose} has no odometry: no edge to either of its neighbours; "
                "remove the pose or add an edge"
            )
    if len(first_poses) == 1:
        return dict.fromkeys(poses, DEFAULT_ROBOT)
    number = np.searchsorted(first_poses, poses, side="right")
    digits = len(str(len(first_poses)))
    return {p: f"robot{n:0{digits}}" for p, n in zip(poses, number, strict=True)}


def reverse_edge(edge: PoseGraphEdge) -> PoseGraphEdge:
    """The same measurement as the pose of ``start`` in the frame of ``end``.

    Exact for gtsam's error: with h = z exp(e) the inverse is h^-1 = z^-1 exp(-Ad_z e).
    """
    Ad = adjoint(edge.delta)
    cov = np.asarray(Ad @ edge.cov @ Ad.T)
    return PoseGraphEdge(edge.end, edge.start, inverse(edge.delta), cov)


# ---------------------------------------------------------------- the file


def read_pose_graph(source: Path) -> PoseGraph:
    """Read the lines of a pose graph.

    Raises:
        LogError: the file cannot be read, or a line is invalid; the message has its number.
    """
    graph = PoseGraph()
    is_g2o = ".g2o" in source.suffixes
    lines = enumerate(text_lines(source), start=1)
    for count, line in ((n, part) for n, whole in lines for part in _MISSING_BREAK.split(whole)):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        tag = fields[0]
        if tag not in _LINES:
            graph.ignored[tag] += 1
            continue
        try:
            _LINES[tag](graph, fields[1:], is_g2o or tag in _G2O_TAGS)
        except (ValueError, IndexError, np.linalg.LinAlgError) as error:
            raise LogError(f"{source}: line {count} ({tag}): {error}; correct the file") from error
    return graph


def _edge(graph: PoseGraph, fields: Sequence[str], is_g2o: bool) -> None:
    """TAG start end x y phi and six numbers of noise."""
    start, end, delta, noise = int(fields[0]), int(fields[1]), _numbers(fields[2:5], 3), fields[5:]
    if start == end:
        raise ValueError("start and end are the same pose")
    cov, assumed = _pose_covariance(tuple(_numbers(noise, 6).tolist()), is_g2o)
    graph.edges.append(PoseGraphEdge(start, end, delta, cov))
    graph.assumed[_NO_INFORMATION] += assumed


def _landmark(graph: PoseGraph, fields: Sequence[str], is_g2o: bool) -> None:
    """TAG pose landmark x y and three numbers of noise; x, y in the frame of the pose.

    load2D: "in our experience, the x-y covariance on landmark sightings is not very good, so
    assume it describes the uncertainty at a range of 10 m". Sigmas are sqrt(v/10) and sqrt(v), or
    1 where the two variances differ. There is no such rule for g2o, whose lines `readG2o` drops:
    their information matrix is propagated to bearing and range.
    """
    (x, y), noise = _numbers(fields[2:4], 2), _numbers(fields[4:7], 3)
    squared = x * x + y * y
    if not squared > 0:
        raise ValueError("the landmark coincides with the pose")
    if is_g2o:
        info = np.array([[noise[0], noise[1]], [noise[1], noise[2]]])
        cov_xy, assumed = _from_information(info)
        graph.assumed[_NO_INFORMATION] += assumed
        J = np.array([[-y / squared, x / squared], [x, y] / np.sqrt(squared)])
        cov = np.asarray(J @ cov_xy @ J.T)
    elif abs(noise[0] - noise[2]) < 1e-4:
        cov = np.diag([noise[0] / 10.0, noise[0]])
    else:
        cov = np.eye(2)
        graph.assumed[_UNEQUAL] += 1
    z = np.array([np.arctan2(y, x), np.sqrt(squared)])
    graph.sightings.append(LandmarkEdge(int(fields[0]), int(fields[1]), z, _checked(cov)))


def _bearing_range(graph: PoseGraph, fields: Sequence[str], _is_g2o: bool) -> None:
    """BR pose landmark bearing range and their sigmas, rad and m."""
    (bearing, distance), sigmas = _numbers(fields[2:4], 2), _numbers(fields[4:6], 2)
    z, cov = np.array([wrap(bearing), distance]), _checked(np.diag(sigmas**2))
    graph.sightings.append(LandmarkEdge(int(fields[0]), int(fields[1]), z, cov))


@lru_cache(maxsize=1024)  # most files have few different ones
def _pose_covariance(v: tuple[float, ...], is_g2o: bool) -> tuple[Array, bool]:
    """Covariance (3, 3) from six numbers of noise, whose layout is guessed as load2D does.

    The second value is that of `_from_information`.

    g2o has the upper triangle of the information matrix. Otherwise the zeros decide: [a 0 b c 0 0]
    is TORO's order xx xy yy phiphi xphi yphi, [a 0 0 b 0 c] the upper triangle; load2D reads both
    as covariances.
    """
    upper = np.array([[v[0], v[1], v[2]], [v[1], v[3], v[4]], [v[2], v[4], v[5]]])
    if is_g2o:
        return _from_information(upper)
    zero = tuple(value == 0 for value in v)
    if zero == (False, True, False, False, True, True):
        toro = np.array([[v[0], v[1], v[4]], [v[1], v[2], v[5]], [v[4], v[5], v[3]]])
        return _checked(toro), False
    if zero == (False, True, True, False, True, False):
        return _checked(upper), False
    raise ValueError(
        "the noise is neither TORO's nor a diagonal covariance (g2o files end in .g2o)"
    )


def _from_information(info: Array) -> tuple[Array, bool]:
    """Covariance (k, k) of an information matrix, and whether a direction had no information.

    Files round: with ten digits a matrix whose eigenvalues span eleven decades may have a negative
    one. Nothing is known of such a direction; it gets `WEAKEST` of the information of the others.

    Raises:
        ValueError: a number on the diagonal is not positive (`readG2o` refuses that too), or an
            eigenvalue is more negative than rounding makes it.
    """
    own = np.diag(info)
    if not (own > 0).all():
        raise ValueError("the noise is not positive definite")
    # along axes in which each direction has information 1: metres and radians are not compared
    scale = np.sqrt(own)
    values, axes = np.linalg.eigh(info / np.outer(scale, scale))
    if values[0] < -ROUNDING:
        raise ValueError("the noise is not positive definite")
    axes /= scale[:, None]
    cov = (axes / np.maximum(values, WEAKEST)) @ axes.T
    return _checked((cov + cov.T) / 2), bool(values[0] < WEAKEST)


def _checked(matrix: Array) -> Array:
    if not is_positive(matrix):
        raise ValueError("the noise is not positive definite")
    return matrix


def _numbers(fields: Sequence[str], count: int) -> Array:
    values = np.array([float(field) for field in fields[:count]])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"needs {count} finite numbers where it has {' '.join(fields) or 'none'}")
    return values


#: concatenated files without a line break in between: a tag follows a number immediately
_MISSING_BREAK = re.compile(r"(?<=[0-9])(?=[A-Z]{2})")
# the tags that load2D reads, and their synonyms in g2o and similar formats
_LINES: dict[str, Callable[[PoseGraph, Sequence[str], bool], None]] = {
    "ODOMETRY": _edge,
    "EDGE": _edge,
    "EDGE2": _edge,
    "EDGE_SE2": _edge,
    "LANDMARK": _landmark,
    "LANDMARK2": _landmark,
    "EDGE_SE2_XY": _landmark,
    "BR": _bearing_range,
}
_G2O_TAGS = frozenset({"EDGE_SE2", "EDGE_SE2_XY", "LANDMARK2"})
