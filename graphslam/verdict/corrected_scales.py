"""Facts about odometry that is much too long or too short by the other sensors of its robot.

The calibration makes up for it, so the path agrees with itself. But lengths are then those of the
other sensor, and whether that or the odometry is right the log does not tell.
"""

from collections.abc import Iterator

from graphslam.verdict.doubts import Fact
from graphslam.verdict.evidence import Evidence

#: relative error of lengths that is told, and how many of its sigmas it is then at least. Wheels
#: that nobody calibrated are off by 1 to 4 % (ACES, Intel)
TOLD, TOLD_SIGMAS = 0.03, 5.0


def scale_facts(evidence: Evidence) -> Iterator[Fact]:
    """Robots whose odometry was made much longer or shorter by the calibration."""
    calibration = evidence.summary.get("calibration", {})
    for robot in evidence.robots:
        found = calibration.get(f"{robot.name}.translation_scale")
        if found is None or abs(found["value"]) < max(TOLD, TOLD_SIGMAS * found["sigma"]):
            continue
        which = "farther" if found["value"] > 0 else "less far"
        text = (
            f"{robot.name}: by its {robot.other_sensor} it drove {100 * abs(found['value']):.1f} % "
            f"{which} than by its odometry, and lengths are those of its {robot.other_sensor}: "
            "check their ranges if the odometry is calibrated"
        )
        yield Fact("odometry_scale", robot.name, None, text)
