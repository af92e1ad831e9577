"""The factor graph in g2o's text format, and the table that identifies its vertices.

g2o has neither robots nor stamps, and readers differ in their treatment of comments, so vertices
are numbered and `graph_ids` is the table of numbers. The format has no robust kernels either: edges
have the plain Gaussian weights, and comments say to which of them a kernel applies.

What the format has no edge for is written as one that is equal at the estimate: same error, same
derivatives. So the file's error is that of the estimate, and where the estimate is a minimum, so it
is of the file.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter

import numpy as np

from graphslam.core.config import RobustConfig
from graphslam.core.errors import OutputError
from graphslam.core.geometry import (
    Array,
    between,
    inverse,
    is_positive,
    log,
    rotate_cov,
    rotation3,
    transform_each,
    wrap,
)
from graphslam.core.number_text import rows_as_text
from graphslam.core.observation_models import LineModel
from graphslam.core.records import Estimate, Step
from graphslam.estimation.factors import LINE_HELD_SIGMA_M, NO_KERNEL, line_rows
from graphslam.estimation.m_estimators import LOSSES

# of n edges: tag, measurements (n, k), information matrices (n, m, m) of the last m entries; the
# entries before them have no information
_EdgeParts = tuple[str, Array, Array]

# Information of a direction without any, instead of zero: GTSAM refuses a zero on the diagonal of
# an information matrix ("looks like this is not G2O matrix order"), and it and Ceres compute a
# Cholesky factor, which needs a positive definite matrix. One sigma is then 1000 km.
NO_INFORMATION = 1e-12


@dataclass(frozen=True, slots=True)
class GraphIds:
    """Vertex numbers: ``states[robot, stamp_ns]`` and ``landmarks[landmark id]``.

    States come first, robots in alphabetical order, each in order of time; then landmarks.
    """

    states: Mapping[tuple[str, int], int]
    landmarks: Mapping[int, int]


def number_vertices(estimate: Estimate) -> GraphIds:
    """Consecutive numbers of every state and landmark of the estimate, the same for equal input."""
    states = [
        (robot, stamp)
        for robot in sorted(estimate.states)
        for stamp in estimate.states[robot].stamps_ns.tolist()
    ]
    landmarks = sorted(estimate.landmarks)
    return GraphIds(
        {state: i for i, state in enumerate(states)},
        {landmark: len(states) + i for i, landmark in enumerate(landmarks)},
    )


def graph_ids(estimate: Estimate) -> str:
    """CSV ``id,robot,stamp_ns,landmark`` naming the vertices of `graph_g2o`; unused cells empty."""
    ids = number_vertices(estimate)
    # a quote in a quoted cell is doubled (RFC 4180)
    names = {robot: robot.replace('"', '""') for robot, _ in ids.states}
    rows = [f'{i},"{names[robot]}",{stamp},' for (robot, stamp), i in ids.states.items()]
    rows += [f"{i},,,{landmark}" for landmark, i in ids.landmarks.items()]
    return "\n".join(["id,robot,stamp_ns,landmark", *rows]) + "\n"


def graph_g2o(steps: Sequence[Step], estimate: Estimate, kernel: RobustConfig = NO_KERNEL) -> str:
    """The graph at its estimate in g2o's text format, every number to full double precision.

    Vertices are the estimate's states (VERTEX_SE2) and landmarks (VERTEX_XY for points,
    VERTEX_SE2 for lines and segments). Edges: EDGE_PRIOR_SE2 for starts, EDGE_SE2 for motions,
    closures, segments, lines, their gauges and robots seen, EDGE_SE2_XY for points. Information
    matrices are the inverse covariance along the axes of the *end* frame of an edge, because the
    residual lives there, while the records hold it along the start frame's. A direction without
    information has 1e-12 in its place (see the module). Associations whose state or landmark is not
    in the estimate (a landmark deleted later) have no edge, nor has what is known of landmarks
    beforehand (`Step.known`), for which the format has none. A comment
    ``# kernel NAME SCALE FIRST COUNT`` says that a kernel applies to so many edges from number
    FIRST (the first edge of the file is 0). They are the last lines: GTSAM ends where it meets one.

    Residuals are GTSAM's: of poses the logarithm of z^-1 x_i^-1 x_j, to first order g2o's own.
    `gtsam.readG2o` reads vertices and EDGE_SE2; it skips EDGE_SE2_XY and EDGE_PRIOR_SE2.

    Source: R. Kümmerle et al., g2o: A general framework for graph optimization, ICRA 2011,
    DOI 10.1109/ICRA.2011.5979949.

    Raises:
        OutputError: a covariance cannot be inverted; the message names the edge.
    """
    ids = number_vertices(estimate)
    states = _states(estimate, ids)
    wrapped = _wrapped(_padded(states)).tolist()
    lines = [_vertex(i, x[: len(states[i])]) for i, x in enumerate(wrapped)]
    comments, edges = [], 0
    # edges without a kernel first, each kind in the order of time
    for scale, alike in groupby(
        sorted(_groups(steps, estimate, kernel), key=attrgetter("scale")), attrgetter("scale")
    ):
        first = edges
        for group in alike:
            lines += _edge_lines(group)
            edges += len(group.ends)
        if scale:
            comments.append(f"# kernel {kernel.kernel} {scale!r} {first} {edges - first}")
    return "\n".join([*lines, *comments]) + "\n"


def _edge_lines(group: "_Group") -> list[str]:
    """The lines of a group's edges."""
    i, j = np.triu_indices(group.z.shape[1])
    numbers = np.column_stack([_wrapped(group.z), group.info[:, i, j]])
    form = " ".join([group.tag, *["%d"] * len(group.ends[0]), "%s"])
    rows = rows_as_text(numbers, " ")
    return [form % (*ends, row) for ends, row in zip(group.ends, rows, strict=True)]


def graph_error(
    steps: Sequence[Step], estimate: Estimate, kernel: RobustConfig
) -> tuple[float, float]:
    """Half the weighted squared residual of the graph: under its kernels, and without them.

    It is that of the edges of `graph_g2o`, and of what is known of landmarks beforehand.

    Raises:
        OutputError: a covariance cannot be inverted; the message names the edge.
    """
    total = plain = 0.0
    loss = LOSSES[kernel.kernel]
    for group in _groups(steps, estimate, kernel):
        squared = group.squared_residuals()
        plain += 0.5 * float(squared.sum())
        robust = loss(np.sqrt(squared), group.scale) if group.scale else 0.5 * squared
        total += float(robust.sum())
    for step in steps:
        if step.known is not None:
            known = 0.5 * step.known.squared_residual(estimate.landmarks)
            total, plain = total + known, plain + known
    return total, plain


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Edges of one kind: measurements (n, k), information (n, k, k), estimates (n, 3) of both ends.

    ``scale`` of their kernel, 0 without one.
    """

    tag: str
    ends: list[tuple[int, ...]]
    z: Array
    info: Array
    x: Array
    t: Array
    scale: float

    def squared_residuals(self) -> Array:
        """Squared Mahalanobis distances (n,)."""
        if self.tag == "EDGE_SE2_XY":
            r = transform_each(inverse(self.x), self.t[:, :2]) - self.z
        else:
            seen = self.t if len(self.ends[0]) == 1 else between(self.x, self.t)
            r = log(between(self.z, seen))
        return np.asarray(np.maximum(np.einsum("ni,nij,nj->n", r, self.info, r), 0.0))


def _states(estimate: Estimate, ids: GraphIds) -> list[Array]:
    """States (3,) and landmarks (2,) or (3,) in the order of their numbers."""
    states = [pose for robot in sorted(estimate.states) for pose in estimate.states[robot].poses]
    return states + [estimate.landmarks[landmark][0] for landmark in ids.landmarks]


def _groups(steps: Sequence[Step], estimate: Estimate, kernel: RobustConfig) -> Iterator[_Group]:
    """All edges, by kind and kernel."""
    ids = number_vertices(estimate)
    states = _padded(_states(estimate, ids))
    alike: dict[tuple[str, float], list[_Edge]] = defaultdict(list)
    first: set[int] = set()
    for step in steps:
        for edge in _edges(step, ids, kernel, first):
            alike[edge.model, edge.scale].append(edge)
    for (model, scale), group in alike.items():
        z, cov = (np.array([getattr(edge, name) for edge in group]) for name in ("z", "cov"))
        ends = [edge.ends for edge in group]
        # the prior of a start has one end, and needs neither
        x, t = (states[[own[end] for own in ends]] for end in (0, -1))
        try:
            tag, z, part = EDGES[model](z, cov, x, t)
        except np.linalg.LinAlgError as error:
            bad = next(edge for edge in group if not is_positive(edge.cov))
            what = f"{bad.model} of {bad.robot} at {bad.time_ns}"
            raise OutputError(f"graph.g2o: the covariance of {what} is not positive") from error
        k, m = z.shape[1], part.shape[1]
        info = np.zeros((len(z), k, k))
        info[:, range(k), range(k)] = NO_INFORMATION
        info[:, k - m :, k - m :] = part
        yield _Group(tag, ends, z, info, x, t, scale)


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """An edge before it is written: a row of `EDGES`, vertices, measurement and covariance.

    ``robot`` and ``time_ns`` are of its later end; ``scale`` is its kernel's, 0 without one.
    """

    model: str
    ends: tuple[int, ...]
    z: Array
    cov: Array
    robot: str
    time_ns: int
    scale: float = 0.0


def _edges(
    step: Step, ids: GraphIds, kernel: RobustConfig, introduced: set[int]
) -> Iterator[_Edge]:
    """Edges of one step whose ends are all in the estimate; ``introduced``: lines seen before."""
    scale = 0.0 if kernel.kernel == "none" else kernel.scale
    states = ids.states
    for robot, start in sorted(step.starts.items()):
        if (robot, step.time_ns) in states:
            ends = (states[robot, step.time_ns],)
            # along world axes, as the prior is given
            yield _Edge("start", ends, start.pose, start.cov, robot, step.time_ns)
    for robot, motion in sorted(step.motions.items()):
        a, b = states.get((robot, motion.start_ns)), states.get((robot, motion.end_ns))
        if a is not None and b is not None:
            yield _Edge("motion", (a, b), motion.delta, motion.cov, robot, motion.end_ns)
    for closure in step.closures:
        a = states.get((closure.other, closure.other_time_ns))
        b = states.get((closure.robot, closure.time_ns))
        if a is not None and b is not None:
            found = closure.delta, closure.cov, closure.robot, closure.time_ns
            own = 0.0 if closure.verified else scale * math.sqrt(closure.scan_count)
            yield _Edge("closure", (a, b), *found, own)
    for seen in step.associations:
        a = states.get((seen.robot, seen.time_ns))
        if isinstance(seen.target, str):
            b = states.get((seen.target, seen.time_ns))
        else:
            b = ids.landmarks.get(seen.target)
        if a is not None and b is not None:
            if seen.model == "line" and b not in introduced:
                introduced.add(b)
                yield _Edge("gauge", (a, b), seen.z, seen.cov, seen.robot, seen.time_ns)
            yield _Edge(seen.model, (a, b), seen.z, seen.cov, seen.robot, seen.time_ns, scale)


def _padded(states: Sequence[Array]) -> Array:
    """States (n, 3): points get a heading, which is not used."""
    return np.array([state if len(state) == 3 else (*state, 0.0) for state in states])


def _inverse(cov: Array) -> Array:
    """Inverses (n, m, m) of covariances.

    Raises:
        LinAlgError: one is not positive definite.
    """
    half = np.linalg.inv(np.linalg.cholesky(cov))
    return np.asarray(half.mT @ half)


def _point_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Bearing and range as Cartesian."""
    return "EDGE_SE2_XY", *_cartesian(z, cov, x, t)


def _robot_point_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Robots' positions as pose edges that say nothing about the heading.

    The residual of EDGE_SE2 is along the axes of the measured heading. There is none, so that of
    the estimate is used. The logarithm turns the residual e of the position by half of the
    heading's; so that the heading has no influence, e Ω times that is taken back by mixed terms.
    """
    xy, info = _cartesian(z, cov, x, t)
    h = between(x, t)
    R = rotation3(-h[:, 2])[:, :2, :2]
    wide = np.zeros((len(xy), 3, 3))
    wide[:, :2, :2] = R @ info @ R.mT
    e = R @ (h[:, :2] - xy)[:, :, None]
    turned = np.concatenate([e[:, 1:], -e[:, :1]], axis=1) / 2  # d log / d heading
    mixed = -wide[:, :2, :2] @ turned
    wide[:, :2, 2:], wide[:, 2:, :2] = mixed, mixed.mT
    # the least that leaves the matrix positive definite
    wide[:, 2, 2] = NO_INFORMATION - (turned.mT @ mixed)[:, 0, 0] * (1 + 1e-9)
    return "EDGE_SE2", np.column_stack([xy, h[:, 2]]), wide


def _pose_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Relative poses: motions, closures, segments, robots with direction; priors likewise."""
    return "EDGE_SE2", z, _inverse(rotate_cov(cov, -z[:, 2]))


def _start_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Priors on poses."""
    return "EDGE_PRIOR_SE2", *_pose_edges(z, cov, x, t)[1:]


def _line_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Lines, slid along themselves to face the landmarks' origins; no information along them."""
    model = LineModel()
    rows = line_rows(z, x, t)
    info = rows.mT @ _inverse(model.noise(z, cov, x, t)) @ rows
    info[:, 0, 0] += NO_INFORMATION
    return "EDGE_SE2", model.facing(z, x, t), info


def _gauge_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Where lines' origins are along them: where the estimate has them; see `LINE_HELD_SIGMA_M`."""
    along = np.diag([LINE_HELD_SIGMA_M**-2, NO_INFORMATION, NO_INFORMATION])
    return "EDGE_SE2", between(x, t), np.tile(along, (len(z), 1, 1))


def _cartesian(z: Array, cov: Array, x: Array, t: Array) -> tuple[Array, Array]:
    """Bearings and ranges (n, 2) as x and y (n, 2) in the base frame, information (n, 2, 2).

    With r the residual of bearing and range at the estimate and J its derivative by the position
    h there, the residual J⁻¹ r of h - J⁻¹ r with information JᵀV⁻¹J has the same square, and the
    same derivatives.
    """
    h = transform_each(inverse(x), t[:, :2])
    distance = np.hypot(h[:, 0], h[:, 1])
    r = np.column_stack([wrap(np.arctan2(h[:, 1], h[:, 0]) - z[:, 0]), distance - z[:, 1]])
    across = np.column_stack([-h[:, 1], h[:, 0]]) / distance[:, None] ** 2
    J = np.stack([across, h / distance[:, None]], axis=1)
    offset = np.linalg.solve(J, r[:, :, None])[:, :, 0]
    return h - offset, J.mT @ _inverse(cov) @ J


#: dimension of a state -> its tag
VERTICES: Mapping[int, str] = {2: "VERTEX_XY", 3: "VERTEX_SE2"}
#: kind of measurement -> its edges, from measurements (n, k), their covariances, and the estimates
#: (n, 3) of both ends; the rows are those of `MODELS`, the other contents of steps, and gauges
EDGES: Mapping[str, Callable[[Array, Array, Array, Array], _EdgeParts]] = {
    "start": _start_edges,
    "motion": _pose_edges,
    "closure": _pose_edges,
    "point": _point_edges,
    "line": _line_edges,
    "gauge": _gauge_edges,
    "segment": _pose_edges,
    "robot-pose": _pose_edges,
    "robot-point": _robot_point_edges,
}


def _vertex(number: int, values: list[float]) -> str:
    """The line of a state."""
    return f"{VERTICES[len(values)]} {number} {' '.join(map(repr, values))}"


def _wrapped(z: Array) -> Array:
    """Measurements or states (n, k), of poses (k = 3) with the heading wrapped."""
    return np.column_stack([z[:, :2], wrap(z[:, 2])]) if z.shape[1] == 3 else z
