"""The factor graph in g2o's text format, and the table that identifies its vertices.

g2o has neither robots nor stamps, and readers differ in their treatment of comments, so vertices
are numbered and `graph_ids` is the table of numbers. The format has no robust kernels: the file
contains the plain Gaussian weights.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.errors import OutputError
from graphslam.core.geometry import Array, between, is_positive, rotate_cov, rotation, wrap
from graphslam.core.observation_models import MODELS, LineModel
from graphslam.core.records import Estimate, Step

# of n edges: tag, measurements (n, k), covariances (n, m, m) of the last m entries; the entries
# before them have no information
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
    rows = [f'{i},"{robot}",{stamp},' for (robot, stamp), i in ids.states.items()]
    rows += [f"{i},,,{landmark}" for landmark, i in ids.landmarks.items()]
    return "\n".join(["id,robot,stamp_ns,landmark", *rows]) + "\n"


def graph_g2o(steps: Sequence[Step], estimate: Estimate) -> str:
    """The graph at its estimate in g2o's text format, every number to full double precision.

    Vertices are the estimate's states (VERTEX_SE2) and landmarks (VERTEX_XY for points,
    VERTEX_SE2 for lines and segments). Edges: EDGE_PRIOR_SE2 for starts, EDGE_SE2 for motions,
    closures, segments, lines and robots seen, EDGE_SE2_XY for points. Information matrices are
    the inverse covariance along the axes of the *end* frame of an edge, because g2o's residual
    ``z^-1 * (x_i^-1 * x_j)`` lives there, while the records hold it along the start frame's.
    A direction without information has 1e-12 in its place (see the module). Associations whose
    state or landmark is not in the estimate (a landmark deleted later) have no edge.

    `gtsam.readG2o` reads vertices and EDGE_SE2; it skips EDGE_SE2_XY and EDGE_PRIOR_SE2.

    Source: R. Kümmerle et al., g2o: A general framework for graph optimization, ICRA 2011,
    DOI 10.1109/ICRA.2011.5979949.

    Raises:
        OutputError: a covariance cannot be inverted; the message names the edge.
    """
    ids = number_vertices(estimate)
    states = [pose for robot in sorted(estimate.states) for pose in estimate.states[robot].poses]
    states += [estimate.landmarks[landmark][0] for landmark in ids.landmarks]
    wrapped = _wrapped(_padded(states)).tolist()
    lines = [_vertex(i, x[: len(states[i])]) for i, x in enumerate(wrapped)]
    edges = [edge for step in steps for edge in _edges(step, ids)]
    rows = [""] * len(edges)
    alike: dict[str, list[int]] = defaultdict(list)
    for place, edge in enumerate(edges):
        alike[edge.model].append(place)
    for model, places in alike.items():
        group = [edges[place] for place in places]
        z, cov = (np.array([getattr(edge, name) for edge in group]) for name in ("z", "cov"))
        # the prior of a start has one end, and needs neither
        x, t = (_padded([states[edge.ends[end]] for edge in group]) for end in (0, -1))
        tag, z, cov = EDGES[model](z, cov, x, t)
        infos = _informations(cov, z.shape[1], group)
        numbers = np.column_stack([_wrapped(z), infos])
        form = " ".join([tag, *["%d"] * len(group[0].ends), *["%r"] * numbers.shape[1]])
        for place, edge, values in zip(places, group, numbers.tolist(), strict=True):
            rows[place] = form % (*edge.ends, *values)
    return "\n".join(lines + rows) + "\n"


@dataclass(frozen=True, slots=True, eq=False)
class _Edge:
    """An edge before it is written: a row of `EDGES`, vertices, measurement and covariance.

    ``robot`` and ``time_ns`` are of its later end.
    """

    model: str
    ends: tuple[int, ...]
    z: Array
    cov: Array
    robot: str
    time_ns: int


def _edges(step: Step, ids: GraphIds) -> Iterator[_Edge]:
    """Edges of one step whose ends are all in the estimate."""
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
            yield _Edge("closure", (a, b), *found)
    for seen in step.associations:
        a = states.get((seen.robot, seen.time_ns))
        if isinstance(seen.target, str):
            b = states.get((seen.target, seen.time_ns))
        else:
            b = ids.landmarks.get(seen.target)
        if a is not None and b is not None:
            yield _Edge(seen.model, (a, b), seen.z, seen.cov, seen.robot, seen.time_ns)


def _padded(states: Sequence[Array]) -> Array:
    """States (n, 3): points get a heading, which is not used."""
    return np.array([state if len(state) == 3 else (*state, 0.0) for state in states])


def _point_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Bearing and range as Cartesian."""
    return "EDGE_SE2_XY", *_cartesian(z, cov)


def _robot_point_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Robots' positions as pose edges without information on the heading.

    The residual of EDGE_SE2 is rotated by the measured heading. There is none, so that of the
    estimate is used, which is exact at the estimate and first order elsewhere.
    """
    xy, cov = _cartesian(z, cov)
    phi = between(x, t)[:, 2]
    R = np.array([rotation(-angle) for angle in phi.tolist()])
    wide = np.zeros((len(xy), 3, 3))
    wide[:, :2, :2] = R @ cov @ R.mT
    wide[:, 2, 2] = 1.0 / NO_INFORMATION
    return "EDGE_SE2", np.column_stack([xy, phi]), wide


def _pose_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Relative poses: motions, closures, segments, robots with direction; priors likewise."""
    return "EDGE_SE2", z, rotate_cov(cov, -z[:, 2])


def _start_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Priors on poses."""
    return "EDGE_PRIOR_SE2", *_pose_edges(z, cov, x, t)[1:]


def _line_edges(z: Array, cov: Array, x: Array, t: Array) -> _EdgeParts:
    """Lines, slid along themselves to face the landmarks' origins; no information along them."""
    model = LineModel()
    return "EDGE_SE2", model.facing(z, x, t), model.noise(z, cov, x, t)


def _cartesian(z: Array, cov: Array) -> tuple[Array, Array]:
    """Bearings and ranges (n, 2) as x and y (n, 2) in the base frame, covariances (n, 2, 2)."""
    model, origin = MODELS["point"], np.zeros((len(z), 3))
    _, J = model.invert_jacobians(z, origin)
    return model.invert(z, origin), J @ cov @ J.mT


#: dimension of a state -> its tag
VERTICES: Mapping[int, str] = {2: "VERTEX_XY", 3: "VERTEX_SE2"}
#: kind of measurement -> its edges, from measurements (n, k), their covariances, and the estimates
#: (n, 3) of both ends; the rows are those of `MODELS` and the other contents of steps
EDGES: Mapping[str, Callable[[Array, Array, Array, Array], _EdgeParts]] = {
    "start": _start_edges,
    "motion": _pose_edges,
    "closure": _pose_edges,
    "point": _point_edges,
    "line": _line_edges,
    "segment": _pose_edges,
    "robot-pose": _pose_edges,
    "robot-point": _robot_point_edges,
}


def _informations(cov: Array, size: int, edges: Sequence[_Edge]) -> Array:
    """Upper triangles (n, k), by rows, of the inverses of covariances (n, m, m), m <= ``size``."""
    try:
        half = np.linalg.inv(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError as error:
        bad = next(edge for edge, P in zip(edges, cov, strict=True) if not is_positive(P))
        what = f"{bad.model} of {bad.robot} at {bad.time_ns}"
        raise OutputError(f"graph.g2o: the covariance of {what} is not positive") from error
    m = cov.shape[1]
    info = np.zeros((len(cov), size, size))
    info[:, range(size), range(size)] = NO_INFORMATION
    info[:, size - m :, size - m :] = half.mT @ half
    i, j = np.triu_indices(size)
    return np.asarray(info[:, i, j])


def _vertex(number: int, values: list[float]) -> str:
    """The line of a state."""
    return f"{VERTICES[len(values)]} {number} {' '.join(map(repr, values))}"


def _wrapped(z: Array) -> Array:
    """Measurements or states (n, k), of poses (k = 3) with the heading wrapped."""
    return np.column_stack([z[:, :2], wrap(z[:, 2])]) if z.shape[1] == 3 else z
