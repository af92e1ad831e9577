"""Logs of three robots on circles that see landmarks and each other."""

import numpy as np

from graphslam.core.geometry import between, compose, exp
from graphslam.logs import LogWriter

S, T0 = 1_000_000_000, 10_000_000_000
STARTS = {"a": (0.0, 0.0, 0.0), "b": (5.0, 0.0, 2.0), "c": (2.0, 5.0, -1.5)}
LANDMARKS = {"6": (3.0, 2.0), "7": (-1.0, 4.0), "8": (6.0, 5.0)}
TWISTS = {"a": (0.3, 0.0, 0.2), "b": (0.25, 0.0, -0.15), "c": (0.3, 0.0, 0.1)}
SIGMAS = np.array([0.01, 0.05])


def pose(robot, seconds):
    """The true pose of a robot."""
    return compose(np.array(STARTS[robot]), exp(np.array(TWISTS[robot]) * seconds))


def write(
    path,
    seed=1,
    marks=LANDMARKS,
    meets=lambda a, b: True,
    names=None,
    spoil=None,
    seconds=60.0,
    say=None,
):
    """Three robots on circles, their odometry 2 % off in turns, see landmarks and each other.

    ``meets(observer, seen)`` says who sees whom or what; ``names`` are exchanged; ``spoil(z, rng,
    observer, seen, seconds)`` may return something else than what was measured; ``say(observer,
    seen, seconds)`` what the log says that it is of, as keywords of `LogWriter.sighting`, or None
    if it is not in the log.
    """
    rng = np.random.default_rng(seed)
    names = names or {}
    with LogWriter(path) as log:
        for k in range(round(10 * seconds)):
            stamp = T0 + k * S // 10
            for robot in STARTS:
                turned = exp(np.array([1.0, 1.0, 1.02]) * TWISTS[robot] * k / 10)
                log.odometry(robot, stamp, turned)
            if k % 5:
                continue
            for robot in STARTS:
                x = pose(robot, k / 10)
                for name, at in {**marks, **{r: pose(r, k / 10)[:2] for r in STARTS}}.items():
                    called = names.get(name, name)
                    if robot in (name, called) or not meets(robot, name):
                        continue
                    seen = between(x, np.array([*at, 0.0]))
                    z = np.array([np.arctan2(seen[1], seen[0]), np.hypot(*seen[:2])])
                    z = z + SIGMAS * rng.normal(size=2)
                    z = spoil(z, rng, robot, name, k / 10) if spoil else z
                    subject = {"seen_robot" if called in STARTS else "identity": called}
                    subject = say(robot, name, k / 10) if say else subject
                    if subject is not None:
                        log.sighting(robot, stamp, z, np.diag(SIGMAS**2), **subject)
