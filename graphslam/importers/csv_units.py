"""Whether the poses of a table look as if they were in other units than s and rad.

What is said is a question: a table that is as it should be must not raise it.
"""

import numpy as np

from graphslam.core.geometry import Array

#: rows of poses whose median distance is more, s, would be of no use; in ms it is 50 Hz
_LONGEST_STEP_S = 20.0
#: so many rows tell
_FEWEST_ROWS = 10
#: share of headings beyond a whole turn from which on they are looked at
_BEYOND_A_TURN = 0.1
#: How well headings agree with the motion, 0 to 1: at least in degrees, at most in radians. Those
#: in degrees must differ, as where the robot drives in one direction anything constant agrees.
_AGREE, _DISAGREE, _ONE_DIRECTION = 0.9, 0.8, 0.9


def milliseconds(stamps_s: Array) -> str:
    """A question, if stamps (n), s, are so far apart that they may be ms; else empty."""
    step = float(np.median(np.diff(np.sort(stamps_s)))) if len(stamps_s) > _FEWEST_ROWS else 0.0
    if step <= _LONGEST_STEP_S:
        return ""
    return (
        f"are its stamps in milliseconds? They are read as seconds, and rows are {step:g} s apart"
    )


def degrees(poses: Array) -> str:
    """A question, if headings of poses (n, 3), m and rad, may be degrees; else empty.

    A robot mostly drives where it looks, or backwards. Headings in radians that were added up over
    many turns are large, too, and agree with the path.
    """
    headings = poses[:-1, 2]
    if len(poses) <= _FEWEST_ROWS or np.mean(np.abs(headings) > 2 * np.pi) < _BEYOND_A_TURN:
        return ""
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that no robot has
        motions = np.diff(poses[:, :2], axis=0) @ np.array([1, 1j])
        # twice the angles are those of axes: who drives backwards agrees, too
        axes = motions * np.exp(1j * np.angle(motions))
        in_degrees, in_radians = np.exp(2j * np.deg2rad(headings)), np.exp(2j * headings)
        lengths = np.abs(motions)
        shares = np.abs([axes @ in_degrees.conj(), axes @ in_radians.conj(), lengths @ in_degrees])
        agree, disagree, same = shares / max(lengths.sum(), np.finfo(float).tiny)
    # not so of numbers that are not finite
    if agree > _AGREE and disagree < _DISAGREE and same < _ONE_DIRECTION:
        return "are its headings in degrees? They are read as radians, and disagree with the path"
    return ""
