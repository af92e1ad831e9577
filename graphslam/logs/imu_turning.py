"""Turning of a robot by its gyroscope in place of that of its wheels.

Wheels slip where a robot turns, a gyroscope does not, but it has a bias that wanders. The bias is
found by comparison with the wheels over seconds, in the whole log at once: the gyroscope turns by
the rate of the robot plus its bias, the wheels by the rate, an unknown share of it (slip, axle)
and an unknown turning per metre (unequal wheels). What is said of the wheels weighs most where the
robot stands or drives straight, so slip in turns does not get into the bias.

The two have their own delays. The gyroscope is shifted in time to where it goes best with the
wheels; the delay of the odometry against the laser is the matter of calibration.

The odometry then goes the way that the wheels say, and turns as the gyroscope says. A gyroscope
that contradicts the wheels altogether (another axis, degrees, no signal) is not used.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import RobotConfig
from graphslam.core.geometry import Array, between, compose, exp, log, wrap
from graphslam.core.motion_models import rows_of_twists, wheel_twist
from graphslam.core.record import replace
from graphslam.core.records import Message, OdometryPose, WheelAngles

#: ns: the gyroscope knows nothing of a longer time between two of its readings
GAP_NS = 200_000_000
#: s: turning is compared over so long; the bias is that of knots so far apart, linear in between
WINDOW_S, KNOTS_S, MOST_KNOTS = 1.0, 30.0, 200
#: sigmas a priori: rad/s of the bias; per root of a second, of its wandering; rad/m of unequal
#: wheels; share of a turn that wheels slip
BIAS_SIGMA, WANDER_SIGMA, DRIFT_SIGMA, SLIP_SIGMA = 0.05, 1e-4, 0.03, 0.3
#: sigma of the comparison over a window: rad/s, and per m/s and per rad/s of motion
FLOOR_SIGMA, PATH_SIGMA, TURN_SIGMA = 2e-3, 0.01, 0.1
#: rad: a window with so much turning tells whether the gyroscope is one; there must be so many
TURNED_RAD, ENOUGH_TURNS = 0.1, 5
#: a gyroscope turns so much of what the wheels say, and its spread, in windows with turning
RATIOS, SPREAD = (0.5, 1.6), 0.25
#: rad/s by which it may differ from the wheels, where they are good, before it is worse than they
MAX_NOISE = 0.05
_HUBER, _REWEIGHTED = 2.0, 4
#: s: how late a gyroscope may be against the odometry, and the steps in which that is searched
MOST_LATE_S, LATE_STEP_S = 0.4, 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Turning:
    """What a gyroscope says: the ``angle`` (n,) rad turned since ``times`` (n,)[0] ns, no bias.

    ``gaps`` (n,) counts the intervals up to each time that are longer than `GAP_NS`. ``topic`` is
    where it is from; ``bias`` rad/s its mean bias; ``late_s`` how late its stamps were, which is
    taken out of ``times``. ``wheels``: those of odometry by wheel angles.
    """

    topic: str
    times: IntArray
    angle: Array
    gaps: IntArray
    bias: float
    late_s: float
    wheels: RobotConfig = field(default_factory=RobotConfig)

    def turned(self, start_ns: int, end_ns: int) -> float | None:
        """How far the robot turned, rad; None where the gyroscope did not measure all the time."""
        i, j = self.times.searchsorted((start_ns, end_ns), side="right") - 1
        k = min(j + 1, len(self.times) - 1)
        if i < 0 or end_ns > self.times[-1] or self.gaps[k] > self.gaps[i]:
            return None
        start, end = np.interp((start_ns, end_ns), self.times[i : k + 1], self.angle[i : k + 1])
        return float(end - start)


def find_turning(
    topic: str, times: IntArray, rates: Array, odometry_ns: IntArray, poses: Array
) -> Turning | str:
    """The turning by a gyroscope, or why it is not used.

    Args:
        topic: where the gyroscope is from.
        times: (n,) ns, ascending, of its readings.
        rates: (n,) rad/s.
        odometry_ns: (m,) times of the odometry, in any order.
        poses: (m, 3) of the odometry.
    """
    if len(times) < 2:
        return "it has no readings"
    raw, gaps = _integrated(times, rates)
    order = np.argsort(odometry_ns, kind="stable")
    late_s = _latency_s(times, raw, odometry_ns[order], poses[order])
    times = times - round(1e9 * late_s)
    windows = _windows(times, raw, gaps, odometry_ns[order], poses[order])
    if not len(windows.seconds):
        return "no second of it is covered by the odometry too"
    bias_of, off = _bias(windows)
    turns = np.abs(windows.wheels) > TURNED_RAD
    if np.count_nonzero(turns) < ENOUGH_TURNS:
        return "the robot turns too little to compare it with the odometry"
    without = windows.gyro - bias_of(windows.middle_ns) * windows.seconds
    ratios = without[turns] / windows.wheels[turns]
    middle = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios - middle)))
    if not (RATIOS[0] <= middle <= RATIOS[1] and spread <= SPREAD):
        return f"it turns {middle:.2f} ± {spread:.2f} times as much as the odometry"
    if off > MAX_NOISE:
        return f"it differs from the odometry by {off:.2f} rad/s where that is good"
    steps = 1e-9 * np.diff(times)
    bias = bias_of((times[1:] + times[:-1]) / 2)
    angle = raw - np.concatenate([[0.0], np.cumsum(bias * steps)])
    return Turning(topic, times, angle, gaps, float(np.mean(bias)), late_s)


def _latency_s(times: IntArray, angle: Array, odometry_ns: IntArray, poses: Array) -> float:
    """How late a gyroscope is against the wheels: where the turning of both correlates best.

    0 where that is at the end of what is searched: they do not go together.
    """
    reach_ns = round(1e9 * (MOST_LATE_S + LATE_STEP_S))
    inside = (odometry_ns >= times[0] + reach_ns) & (odometry_ns <= times[-1] - reach_ns)
    at = odometry_ns[inside]
    wheels = wrap(np.diff(poses[inside, 2]))
    if not wheels.any():
        return 0.0
    lags = np.arange(-MOST_LATE_S, MOST_LATE_S + LATE_STEP_S / 2, LATE_STEP_S)
    alike = np.zeros(len(lags))
    for n, lag in enumerate(lags):
        turned = np.diff(np.interp(at + 1e9 * lag, times, angle))
        if turned.std() > 0:
            alike[n] = np.corrcoef(turned, wheels)[0, 1]
    best = int(np.argmax(alike))
    if not 0 < best < len(lags) - 1 or alike[best] <= 0:
        return 0.0
    before, peak, after = alike[best - 1 : best + 2]
    curvature = before - 2 * peak + after
    off = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float(lags[best] + off * LATE_STEP_S)


@dataclass(frozen=True, slots=True, eq=False)
class _Windows:
    """Turning by ``gyro`` and ``wheels`` (w,) rad and ``path`` m in spans of ``seconds`` (w,)."""

    middle_ns: Array
    seconds: Array
    gyro: Array
    wheels: Array
    path: Array


def _integrated(times: IntArray, rates: Array) -> tuple[Array, IntArray]:
    """The angle (n,) turned since the first reading, and the gaps (n,) up to each."""
    steps = np.diff(times)
    turned = (rates[1:] + rates[:-1]) / 2 * (1e-9 * steps)
    gaps = np.cumsum(np.concatenate([[0], (steps > GAP_NS).astype(np.int64)]))
    return np.concatenate([[0.0], np.cumsum(turned)]), gaps


def _windows(
    times: IntArray, angle: Array, gaps: IntArray, odometry_ns: IntArray, poses: Array
) -> _Windows:
    """Spans of `WINDOW_S` or a little more, from one reading of the odometry to another."""
    inside = (odometry_ns >= times[0]) & (odometry_ns <= times[-1])
    at, poses = odometry_ns[inside], poses[inside]
    if len(at) < 2:
        return _Windows(*(np.empty(0) for _ in range(5)))
    turned = np.concatenate([[0.0], np.cumsum(wrap(np.diff(poses[:, 2])))])
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    numbers = (at - at[0]) // round(1e9 * WINDOW_S)
    ends = np.flatnonzero(np.diff(numbers, prepend=-1))
    a, b = ends[:-1], ends[1:]
    seconds = 1e-9 * (at[b] - at[a])
    by_gyro = np.interp(at, times, angle)
    i = np.clip(times.searchsorted(at, side="right") - 1, 0, len(times) - 1)
    k = np.minimum(times.searchsorted(at), len(times) - 1)
    good = (seconds > WINDOW_S / 2) & (seconds < 2.5 * WINDOW_S) & (gaps[k[b]] == gaps[i[a]])
    a, b = a[good], b[good]
    return _Windows(
        (at[a] + at[b]) / 2,
        seconds[good],
        by_gyro[b] - by_gyro[a],
        turned[b] - turned[a],
        path[b] - path[a],
    )


class _Bias:
    """A bias (rad/s) that is linear between knots."""

    def __init__(self, knots_ns: Array, values: Array) -> None:
        self._knots_ns, self._values = knots_ns, values

    def __call__(self, times_ns: Array) -> Array:
        return np.asarray(np.interp(times_ns, self._knots_ns, self._values))


def _bias(windows: _Windows) -> tuple[_Bias, float]:
    """The bias by least squares, and by how much the rest differs where wheels are good, rad/s.

    Unknown are the bias at its knots, the share of turning that is slip, and the turning per metre.
    """
    t = windows.middle_ns
    count = min(max(2, int(np.ceil(1e-9 * (t[-1] - t[0]) / KNOTS_S)) + 1), MOST_KNOTS)
    knots = np.linspace(t[0], max(t[-1], t[0] + 1), count)
    apart_s = 1e-9 * (knots[1] - knots[0])
    place = np.clip((t - knots[0]) / (knots[1] - knots[0]), 0, count - 1 - 1e-9)
    left = place.astype(np.int64)
    A = np.zeros((len(t), count + 2))
    rows = np.arange(len(t))
    A[rows, left], A[rows, left + 1] = 1 - (place - left), place - left
    speed, rate = windows.path / windows.seconds, windows.wheels / windows.seconds
    A[:, count], A[:, count + 1] = -speed, -rate
    difference = windows.gyro / windows.seconds - rate
    sigma = np.hypot(np.hypot(FLOOR_SIGMA, PATH_SIGMA * speed), TURN_SIGMA * rate)
    # the bias is small and wanders slowly; wheels are about equal and slip little
    walk = (np.eye(count, count + 2, 1) - np.eye(count, count + 2))[:-1]
    walk /= WANDER_SIGMA * np.sqrt(apart_s)
    own = np.eye(count + 2)[[0, count, count + 1]]
    prior = np.vstack([walk, own / np.array([BIAS_SIGMA, DRIFT_SIGMA, SLIP_SIGMA])[:, None]])
    weight = np.ones(len(t))
    for _ in range(_REWEIGHTED):
        scale = np.sqrt(weight) / sigma
        H = (A * scale[:, None]).T @ (A * scale[:, None]) + prior.T @ prior
        found = np.linalg.solve(H, A.T @ (scale**2 * difference))
        off = difference - A @ found
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(off), 1e-12))
    best = sigma <= np.quantile(sigma, 0.5)
    return _Bias(knots, found[:count]), 1.4826 * float(np.median(np.abs(off[best])))


def with_turning(
    messages: Iterable[Message], gyroscopes: Mapping[str, Turning]
) -> Iterator[Message]:
    """Messages in time order; the odometry of robots with a gyroscope turns as that says.

    Where it says nothing, and where the wheels stand, the odometry stays as it is.
    """
    last: dict[str, tuple[OdometryPose, Array]] = {}
    angles: dict[str, tuple[WheelAngles, Array]] = {}
    for message in messages:
        if isinstance(message, WheelAngles) and message.robot in gyroscopes:
            yield _turned_wheels(message, gyroscopes[message.robot], angles)
            continue
        if not isinstance(message, OdometryPose) or message.robot not in gyroscopes:
            yield message
            continue
        pose = message.pose
        if message.robot in last:
            before, begin = last[message.robot]
            twist = log(between(before.pose, message.pose))
            if twist.any():
                turned = gyroscopes[message.robot].turned(before.time_ns, message.time_ns)
                twist[2] = twist[2] if turned is None else turned
            pose = compose(begin, exp(twist))
        last[message.robot] = message, pose
        yield replace(message, pose=pose)


def _turned_wheels(
    message: WheelAngles, gyroscope: Turning, last: dict[str, tuple[WheelAngles, Array]]
) -> WheelAngles:
    """Wheels that have gone as far as those of a message, and turned the robot as it turned.

    ``last``: robot -> its message before, and the angles (2,) that were made of it.
    """
    angles = np.array([message.left_rad, message.right_rad])
    if message.robot in last:
        before, begin = last[message.robot]
        moved = angles - [before.left_rad, before.right_rad]
        if moved.any():
            turned = gyroscope.turned(before.time_ns, message.time_ns)
            if turned is not None:
                twist = wheel_twist(moved[None], gyroscope.wheels)
                twist[0, 2] = turned
                moved = rows_of_twists("wheels", twist, gyroscope.wheels)[0, :2]
        angles = begin + moved
    last[message.robot] = message, angles
    return replace(message, left_rad=float(angles[0]), right_rad=float(angles[1]))
