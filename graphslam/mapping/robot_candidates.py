"""Other robots as candidates of data association, beside landmarks.

A robot has a state like a landmark, which is compared with what was seen by the same distance and
the same gates. Unlike a landmark it has moved since its state, and a sighting that is of no robot
makes no new one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.gaussian import move_block
from graphslam.core.geometry import Array, compose, compose_jacobians, transform
from graphslam.core.records import Association, Motion, Observation
from graphslam.estimation.backend import JointMarginal
from graphslam.mapping.gating import PairDistances, Pairs, compare

#: why a sighting that may be of robots only was not used
NOT_THERE = "robot: not where it was seen"


@dataclass(frozen=True, slots=True, eq=False)
class RobotTarget:
    """Another robot that may be seen in an image.

    ``motion`` leads from its latest state in the back end to the image; None if that is its time.
    ``clock_shift`` (2,) m: one sigma of its displacement along its path, as its clock may be wrong,
    in its own frame.
    """

    name: str
    motion: Motion | None
    clock_shift: Array


def predicted_joint(
    joint: JointMarginal, motion: Motion | None, others: Sequence[RobotTarget] = ()
) -> JointMarginal:
    """The joint after robots moved on: system update of the blocks of poses, thesis 4.4-4.7.

    ``motion`` is that of the robot itself; ``others`` are those of the joint.
    """
    if motion is None and not others:
        return joint
    P, poses = joint.cov.copy(), [joint.pose, *joint.others]
    blocks = (slice(0, 3), *joint.slices[len(joint.slices) - len(others) :])
    for n, (block, own) in enumerate(
        zip(blocks, (motion, *(r.motion for r in others)), strict=True)
    ):
        if own is not None:
            F, W = compose_jacobians(poses[n], own.delta)
            move_block(P, block, F, W @ own.cov @ W.T)
            poses[n] = compose(poses[n], own.delta)
    for pose, block, robot in zip(poses[1:], blocks[1:], others, strict=True):
        shift = transform(pose, robot.clock_shift) - pose[:2]
        P[block.start : block.start + 2, block.start : block.start + 2] += np.outer(shift, shift)
    return replace(joint, pose=poses[0], others=tuple(poses[1:]), cov=P)


def robot_model(o: Observation) -> str:
    """The row of `MODELS` that compares a sighting with a robot."""
    return "robot-point" if o.kind == "point" else "robot-pose"


def robots_in(seen: Sequence[Observation]) -> list[str]:
    """Names of the robots that anything seen may be of, sorted."""
    return sorted({name for o in seen for name in o.robots})


def robot_associations(
    robot: str, time_ns: int, seen: Sequence[Observation]
) -> tuple[Association, ...]:
    """What a robot has seen at a state, as associations with every robot that it may be of."""
    return tuple(
        Association(robot, time_ns, name, robot_model(o), o.z, o.cov, source=o.source)
        for o in seen
        for name in o.robots
    )


def as_observation(a: Association) -> Observation:
    """An association with a robot as what was seen of that robot alone."""
    kind = "point" if a.model == "robot-point" else "segment"
    return Observation(kind, a.z, a.cov, None, None, a.source, (str(a.target),), False)


def robot_distances(
    seen: Sequence[Observation],
    robots: Sequence[RobotTarget],
    joint: JointMarginal,
    floor: Mapping[str, Array],
) -> tuple[Pairs, PairDistances]:
    """All pairs of sightings with robots that they may be of, and their distances.

    `Pairs.landmark` is -1 - k for robot k, so that it is no number of a landmark.

    Args:
        seen: observations in the observer's base frame.
        robots: those that may be seen.
        joint: of the observer and of all ``robots``, at the image.
        floor: see `compare`.
    """
    both = [(n, k) for n, o in enumerate(seen) for k, r in enumerate(robots) if r.name in o.robots]
    row, column = np.array(both, dtype=np.int64).reshape(-1, 2).T
    pairs = Pairs(
        row,
        -1 - column,
        tuple(robot_model(seen[n]) for n in row.tolist()),
        np.zeros(len(row), dtype=bool),
        np.zeros(len(row)),
    )
    blocks = joint.slices[len(joint.slices) - len(joint.others) :]
    P = joint.cov
    states = np.array([joint.others[k] for k in column.tolist()]).reshape(-1, 3)
    P_xx = np.broadcast_to(P[:3, :3], (len(row), 3, 3))
    P_xt = np.array([P[:3, blocks[k]] for k in column.tolist()]).reshape(-1, 3, 3)
    P_tt = np.array([P[blocks[k], blocks[k]] for k in column.tolist()]).reshape(-1, 3, 3)
    return pairs, compare(seen, pairs, joint.pose, states, P_xx, P_xt, P_tt, floor)
