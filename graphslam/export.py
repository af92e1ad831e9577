"""The factor graph as text that other tools open: g2o, and the table that names its vertices.

g2o knows no robots and no stamps, and readers differ in what they make of comments, so vertices
are numbered here and `graph_ids` says which is which. Robust kernels have no place in the format:
the file holds the plain Gaussian weights.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.errors import OutputError
from graphslam.geometry import Array, between, rotate_cov, rotation, wrap
from graphslam.models.observation import LineModel
from graphslam.records import Association, Estimate, Step

_EdgeParts = tuple[str, Array, Array]  # tag, measurement, information

# "No information" in a direction is written as this, not as zero: GTSAM refuses a zero on the
# diagonal of an information matrix ("looks like this is not G2O matrix order"), and it as well as
# Ceres take a Cholesky factor, which needs a positive matrix. One sigma is then 1000 km.
NO_INFORMATION = 1e-12


@dataclass(frozen=True, slots=True)
class GraphIds:
    """Vertex numbers: ``states[robot, stamp_ns]`` and ``landmarks[landmark id]``.

    States come first, robots in alphabetical order, each in order of time; then landmarks.
    """

    states: Mapping[tuple[str, int], int]
    landmarks: Mapping[int, int]


def number_vertices(estimate: Estimate) -> GraphIds:
    """Running numbers for every state and landmark of the estimate, the same for equal input."""
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
    lines: list[str] = []
    for robot in sorted(estimate.states):
        for pose in estimate.states[robot].poses:
            lines.append(_record("VERTEX_SE2", [len(lines)], pose))
    for landmark in ids.landmarks:
        state = estimate.landmarks[landmark][0]
        tag = "VERTEX_XY" if len(state) == 2 else "VERTEX_SE2"
        lines.append(_record(tag, [ids.landmarks[landmark]], state))
    poses = {
        (robot, stamp): pose
        for robot, trajectory in estimate.states.items()
        for stamp, pose in zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    }
    for step in steps:
        lines += _structure_edges(step, ids)
        for association in step.associations:
            lines += _association_edge(association, ids, poses, estimate.landmarks)
    return "\n".join(lines) + "\n"


def _structure_edges(step: Step, ids: GraphIds) -> Iterable[str]:
    """Priors, motions and closures of one step."""
    for robot, start in sorted(step.starts.items()):
        if (robot, step.time_ns) in ids.states:
            i = ids.states[robot, step.time_ns]
            # world axes -> the frame of the prior itself, like every other edge
            cov = rotate_cov(start.cov, -start.pose[2])
            yield _record("EDGE_PRIOR_SE2", [i], start.pose, _information(cov, f"start of {robot}"))
    for robot, motion in sorted(step.motions.items()):
        ends = (robot, motion.start_ns), (robot, motion.end_ns)
        if all(end in ids.states for end in ends):
            what = f"motion of {robot} to {motion.end_ns}"
            info = _information(rotate_cov(motion.cov, -motion.delta[2]), what)
            yield _record("EDGE_SE2", [ids.states[end] for end in ends], motion.delta, info)
    for closure in step.closures:
        ends = (closure.other, closure.other_time_ns), (closure.robot, closure.time_ns)
        if all(end in ids.states for end in ends):
            what = f"closure of {closure.robot} at {closure.time_ns}"
            info = _information(rotate_cov(closure.cov, -closure.delta[2]), what)
            yield _record("EDGE_SE2", [ids.states[end] for end in ends], closure.delta, info)


def _association_edge(
    association: Association,
    ids: GraphIds,
    poses: Mapping[tuple[str, int], Array],
    landmarks: Mapping[int, tuple[Array, Array]],
) -> Iterable[str]:
    """The edge of one association, or nothing where an end of it is not in the estimate."""
    source = (association.robot, association.time_ns)
    if isinstance(association.target, str):
        seen = (association.target, association.time_ns)
        target, state = ids.states.get(seen), poses.get(seen)
    else:
        target = ids.landmarks.get(association.target)
        state = landmarks[association.target][0] if target is not None else None
    if source not in ids.states or target is None or state is None:
        return
    what = f"{association.model} seen by {association.robot} at {association.time_ns}"
    tag, z, info = EDGES[association.model](association, poses[source], state, what)
    yield _record(tag, [ids.states[source], target], z, info)


def _point_edge(seen: Association, pose: Array, state: Array, what: str) -> _EdgeParts:
    """Bearing and range as Cartesian."""
    xy, cov = _cartesian(seen)
    return "EDGE_SE2_XY", xy, _information(cov, what)


def _robot_point_edge(seen: Association, pose: Array, state: Array, what: str) -> _EdgeParts:
    """A robot's position as a pose edge: no information on its heading.

    The residual of EDGE_SE2 is turned by the measured heading; there is none, so the estimate
    stands in for it, which is exact at the estimate and first order beside it.
    """
    xy, cov = _cartesian(seen)
    phi = float(between(pose, state)[2])
    turned = rotation(-phi) @ cov @ rotation(-phi).T
    info = np.diag([0.0, 0.0, NO_INFORMATION])
    info[:2, :2] = _information(turned, what)
    return "EDGE_SE2", np.array([*xy, phi]), info


def _pose_edge(seen: Association, pose: Array, state: Array, what: str) -> _EdgeParts:
    """A relative pose: segments, robots with direction."""
    return "EDGE_SE2", seen.z, _information(rotate_cov(seen.cov, -float(seen.z[2])), what)


def _line_edge(seen: Association, pose: Array, state: Array, what: str) -> _EdgeParts:
    """A line, moved along itself to face the landmark's origin; no information along it."""
    model = LineModel()
    info = np.diag([NO_INFORMATION, 0.0, 0.0])
    info[1:, 1:] = _information(model.noise(seen.z, seen.cov, pose, state), what)
    return "EDGE_SE2", model.facing(seen.z, pose, state), info


def _cartesian(seen: Association) -> tuple[Array, Array]:
    """Bearing and range as x and y (2,) in the base frame, with covariance (2, 2)."""
    bearing, distance = seen.z
    c, s = np.cos(bearing), np.sin(bearing)
    J = np.array([[-distance * s, c], [distance * c, s]])
    return distance * np.array([c, s]), J @ seen.cov @ J.T


#: model of an association -> its edge; the rows are those of `graphslam.models`
EDGES: Mapping[str, Callable[[Association, Array, Array, str], _EdgeParts]] = {
    "point": _point_edge,
    "line": _line_edge,
    "segment": _pose_edge,
    "robot-pose": _pose_edge,
    "robot-point": _robot_point_edge,
}


def _information(cov: Array, what: str) -> Array:
    """Inverse of a covariance, exactly symmetric."""
    try:
        half = np.linalg.inv(np.linalg.cholesky(cov))
    except np.linalg.LinAlgError as error:
        raise OutputError(f"graph.g2o: the covariance of {what} is not positive") from error
    return np.asarray(half.T @ half)


def _record(tag: str, ids: Sequence[int], values: Array, info: Array | None = None) -> str:
    """One line: tag, vertex numbers, values (heading wrapped), upper triangle of ``info``."""
    numbers = values.tolist()
    if len(numbers) == 3:
        numbers[2] = float(wrap(numbers[2]))
    if info is not None:
        numbers += [x for k, row in enumerate(info.tolist()) for x in row[k:]]
    return " ".join([tag, *map(str, ids), *map(repr, numbers)])
