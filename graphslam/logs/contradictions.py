"""Static transforms that contradict each other: of them only the last one can be used.

Several robots that call their frames alike and publish them on one /tf_static make such, as does a
launch file that states a mount beside the one of the robot's description.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from graphslam.logs.findings import Finding
from graphslam.logs.mounts import TransformTree, transform_between
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.logs.tf_tree import StaticTransform, differ, namespace_of


def contradictions(
    where: str,
    frames: tuple[str, str],
    tree: TransformTree,
    replaced: Mapping[str, Sequence[StaticTransform]],
    robots: int,
    setting: str,
) -> list[Finding]:
    """That a sensor would be elsewhere on its base by a transform that was replaced.

    Args:
        where: the sensor, as a finding names it.
        frames: base and sensor.
        tree: the transforms that are used.
        replaced: by their child those that are not, see `static_tree`.
        robots: how many the log has.
        setting: the option that states the mount, empty if there is none.
    """
    base, sensor = frames
    used = transform_between(tree, base, sensor)
    if used is None or base == sensor:
        return []
    worst: tuple[float, float, StaticTransform] | None = None
    for other in (one for ones in replaced.values() for one in ones):
        mount = transform_between({**tree, other.child: (other.parent, other.matrix)}, base, sensor)
        off = None if mount is None else differ(used, mount)
        if off is not None and (worst is None or off > worst[:2]):
            worst = (*off, other)
    if worst is None:
        return []
    apart_m, apart_rad, other = worst
    parent, matrix = tree[other.child]
    if parent == other.parent:
        apart_m, apart_rad = differ(matrix, other.matrix) or (apart_m, apart_rad)
        text = f"{other.topic} has two transforms from {parent} to {other.child}, "
    else:
        text = f"{other.topic} has {other.child} both in {other.parent} and in {parent}, "
    text += f"{apart_m:.2f} m and {np.rad2deg(apart_rad):.0f}° apart; the last one is used"
    remedy = "record the right one alone"
    if robots > 1 and namespace_of(other.topic) == DEFAULT_ROBOT:
        remedy = "frames of several robots need a /NAME/tf_static each, or names of their own "
        remedy += "(NAME/laser)"
    return [Finding("doubt", "mount", where, text, remedy + (f", or {setting}" if setting else ""))]
