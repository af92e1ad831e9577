"""What increments of odometry leave out, and what two of them have in common.

An increment says from when to when it goes. Where the next one begins later than the last one ends
(a message was lost), the robot moved on: its velocity is that at both ends, and in between a random
walk that is tied to these. Where it begins earlier, both contain the same motion.
"""

from dataclasses import dataclass

import numpy as np

from graphslam.core.geometry import Array

#: ns: stamps that are as near as that are the same
SAME_NS = 1_000_000
#: m²/s³, rad²/s³: how fast the variance of a velocity grows that nobody measures
VELOCITY_GROWTH, TURN_GROWTH = 0.25, 0.25
#: rad: a heading is not less certain than that
MOST_SIGMA_RAD = 2.0


@dataclass(slots=True)
class MissingIncrements:
    """Counts of a robot's odometry: ``gaps`` and how long they are in all, ns, and the longest.

    ``longest_at_ns``: when that began; ``overlaps``: increments that begin before the last one's
    end.
    """

    gaps: int = 0
    total_ns: int = 0
    longest_ns: int = 0
    longest_at_ns: int = 0
    overlaps: int = 0

    def note_gap(self, begin_ns: int, end_ns: int) -> None:
        """Count a stretch without an increment."""
        self.gaps += 1
        self.total_ns += end_ns - begin_ns
        if end_ns - begin_ns > self.longest_ns:
            self.longest_ns, self.longest_at_ns = end_ns - begin_ns, begin_ns

    def to_text(self, origin_ns: int) -> str:
        """What was found, in words after "its odometry"; empty if there is nothing.

        ``origin_ns``: from which seconds count.
        """
        parts = []
        if self.gaps:
            at = 1e-9 * (self.longest_at_ns - origin_ns)
            stretches = "1 stretch" if self.gaps == 1 else f"{self.gaps} stretches"
            parts.append(
                f"leaves out {stretches}, {1e-9 * self.total_ns:.1f} s in all, the "
                f"longest {1e-9 * self.longest_ns:.1f} s from {at:.1f} s on; the velocity before "
                "and after each was used"
            )
        if self.overlaps:
            parts.append(
                f"has {self.overlaps} increments that begin before the last one's end; of each the "
                "part after it was used"
            )
        return ", and ".join(parts)


def bridge(before: Array | None, after: Array, seconds: float) -> tuple[Array, Array]:
    """Twist (3,) and covariance (3, 3) of a motion that no increment has.

    A random walk of the velocity that is tied at both ends has the mean of the two, and its
    integral the variance q T³ / 12.

    Args:
        before: velocity (3,) before it, m/s and rad/s; None if there was no motion yet.
        after: velocity (3,) after it.
        seconds: how long it takes.
    """
    twist = seconds * (after if before is None else 0.5 * (before + after))
    growth = seconds**3 / 12.0
    along = VELOCITY_GROWTH * growth
    turning = min(TURN_GROWTH * growth, MOST_SIGMA_RAD**2)
    # across: the path, in a direction that is not known
    across = 0.25 * turning * (along + float(twist[:2] @ twist[:2]))
    return twist, np.diag([along, across, turning])
