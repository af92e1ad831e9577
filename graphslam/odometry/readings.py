"""One robot's odometry readings, and the way that they describe by themselves.

Readings come one by one and are worked out when first asked for, many at once where that is rare.
Between two readings the robot is taken to move on a circle segment. Nothing here knows of
calibration: that is `dead_reckoning`.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np

from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import Array, between, compose, exp, log, wrap
from graphslam.core.motion_models import wheel_twist
from graphslam.core.records import OdometryIncrement, OdometryPose, WheelAngles

IntArray = np.ndarray[tuple[int, ...], np.dtype[np.int64]]
BoolArray = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
Odometry = OdometryPose | OdometryIncrement | WheelAngles

#: m/s and rad/s: no wheeled robot's odometry says more. An interval that implies it was stamped
#: in a burst (a logger that fell behind): its stamps do not tell when the motion took place, so a
#: time inside it belongs to the reading before, as the order of recording has it
MAX_SPEED_M_S, MAX_TURN_RAD_S = 20.0, 20.0
#: m/s over at least this many ns (and half a metre): the odometry jumped, see `Track.resets`
RESET_SPEED_M_S, SHORTEST_RESET_NS = 10.0, 10_000_000
#: share of readings in bursts above which the stamps are not good enough to learn a latency
MAX_BURST_SHARE = 0.01
#: ns: how long before the first reading or after the last a robot is taken to stand
EDGE_NS = 500_000_000
#: m per rad: how much path a turn counts for when a correction is spread over an interval
TURNING_EFFORT_M = 0.3

_ROW_SIZE = {"odometry": 3, "commands": 3, "given": 12, "wheels": 2}


class Readings:
    """Odometry readings of one robot, in time order.

    One small row per reading is kept: what its interval adds (a twist, wheel turns, or an increment
    with its covariance).
    """

    def __init__(self, config: OdometryConfig, robot: RobotConfig) -> None:
        """None yet."""
        self.source = ""
        self._config, self._robot = config, robot
        self._count, self._bursts, self._resets = 0, 0, 0
        self._settled = 0  # readings that are worked out; the others' values wait in `_fresh`
        self._fresh: list[Array] = []
        self._times = np.empty(1024, dtype=np.int64)  # time of the end of each row's interval
        self._rows = np.empty((1024, 0))
        self._sums = np.empty((1024, 0))  # of the rows
        self._poses = np.empty((1024, 3))  # by odometry alone, first reading = origin
        self._effort = np.empty(1024)  # accumulated, see `effort`
        self._path = np.empty(1024)  # accumulated, m
        self._burst = np.empty(1024, dtype=bool)  # interval too short for its motion
        self._last = np.zeros(0)  # the last reading that is worked out

    def __len__(self) -> int:
        return self._count

    @property
    def first_ns(self) -> int:
        """Time of the first reading."""
        return int(self._times[0])

    @property
    def last_ns(self) -> int:
        """Time of the latest reading."""
        return int(self._times[self._count - 1])

    @property
    def times(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """Times (n,) of the readings, ns."""
        return self._times[: self._count]

    @property
    def bursty(self) -> bool:
        """Whether many readings were stamped in bursts: then a shift of time means nothing."""
        self._settle()
        return self._bursts > MAX_BURST_SHARE * self._count

    @property
    def resets(self) -> int:
        """Times that the odometry jumped."""
        self._settle()
        return self._resets

    def add(self, message: Odometry) -> None:
        """Append a reading; readings come in time order."""
        if isinstance(message, OdometryIncrement):
            if not self._count:
                self._begin("given", message.start_ns)
            value = np.concatenate([log(message.delta), message.cov.ravel()])
        elif isinstance(message, OdometryPose):
            value = message.pose
        else:
            value = np.array([message.left_rad, message.right_rad])
        if not self._count:
            poses = "commands" if self._config.commanded_velocities else "odometry"
            self._begin("wheels" if isinstance(message, WheelAngles) else poses, message.time_ns)
            self._last = value
        elif message.time_ns > self.last_ns:
            if self._count == len(self._times):
                self._grow()
            self._times[self._count] = message.time_ns
            self._count += 1
            self._fresh.append(value)
        else:
            # a second reading of one time: its motion belongs to the interval that ends here
            self._settle()
            n = self._count - 1
            row = self._row(value, 0)
            if n:
                self._bursts -= int(self._burst[n])
                self._enter(n, self._rows[n] + row)

    def _begin(self, source: str, time_ns: int) -> None:
        """The first reading, from which all motion counts."""
        self.source, self._count, self._settled = source, 1, 1
        self._rows = np.zeros((len(self._times), _ROW_SIZE[source]))
        self._sums = np.zeros_like(self._rows)
        self._times[0] = time_ns
        self._poses[0], self._effort[0], self._path[0], self._burst[0] = 0.0, 0.0, 0.0, False

    def _grow(self) -> None:
        for name in ("_times", "_rows", "_sums", "_poses", "_effort", "_path", "_burst"):
            full = getattr(self, name)
            setattr(self, name, np.concatenate([full, np.empty_like(full)]))

    def _settle(self) -> None:
        """Work out the readings that came since it was last asked for any motion, all at once."""
        if self._settled < self._count:
            settle((self,))

    def _row(self, value: Array, apart_ns: int) -> Array:
        """Row (k,) of a reading (k,) that follows the last one after ``apart_ns``; see `_rows`."""
        if self.source == "given":
            return value
        before, self._last = self._last, value
        if self.source == "wheels":
            return np.asarray(value - before)
        row = log(between(before, value))
        if _jumped(row, apart_ns):
            self._resets += 1
            return np.asarray(self._rows[self._settled - 1])
        return row

    def _enter(self, n: int, row: Array) -> None:
        """The row of the n-th reading, n > 0, and what accumulates from it."""
        twist = wheel_twist(row[None], self._robot)[0] if self.source == "wheels" else row[:3]
        (x, y, turned), (east, north, heading) = exp(twist).tolist(), self._poses[n - 1].tolist()
        c, s, path, turn = math.cos(heading), math.sin(heading), math.hypot(x, y), abs(turned)
        self._rows[n], self._sums[n] = row, self._sums[n - 1] + row
        self._poses[n] = east + c * x - s * y, north + s * x + c * y, float(wrap(heading + turned))
        self._effort[n] = self._effort[n - 1] + path + TURNING_EFFORT_M * turn
        self._path[n] = self._path[n - 1] + path
        seconds = 1e-9 * int(self._times[n] - self._times[n - 1])
        burst = path > MAX_SPEED_M_S * seconds or turn > MAX_TURN_RAD_S * seconds
        self._burst[n] = burst
        self._bursts += burst

    def reaches(self, time_ns: int) -> bool:
        """Whether the motion up to ``time_ns`` is known without looking beyond a reading."""
        return self._count > 0 and self.last_ns >= time_ns

    def near(self, time_ns: int, gap_ns: int) -> bool:
        """Whether ``time_ns`` lies between readings at most ``gap_ns`` apart, or just outside."""
        if not self._count:
            return False
        i = int(self.times.searchsorted(time_ns))
        if 0 < i < self._count:
            return bool(self._times[i] - self._times[i - 1] <= gap_ns)
        end_ns = self.first_ns if i == 0 else self.last_ns
        return abs(time_ns - end_ns) <= EDGE_NS

    def pose(self, times_ns: IntArray | int) -> Array:
        """Poses (..., 3) by odometry alone, in the frame of the first reading.

        Before the first reading and after the last one the robot is taken to stand still.
        """
        self._settle()
        times = np.asarray(times_ns, dtype=np.int64)
        i = np.clip(self.times.searchsorted(times), 1, max(self._count - 1, 1))
        if self._count < 2:
            return np.zeros((*times.shape, 3))
        share = self._share(i, self._times[i - 1], times)
        twist = log(between(self._poses[i - 1], self._poses[i]))
        return compose(self._poses[i - 1], exp(share[..., None] * twist))

    def _share(self, i: IntArray, from_ns: IntArray | int, to_ns: IntArray | int) -> Array:
        """Share (..., ) of the interval that ends at reading i that lies in from_ns..to_ns."""
        around = self._times[i - 1], self._times[i], self._burst[i]
        return reached(*around, to_ns) - reached(*around, from_ns)

    def effort(self, times_ns: IntArray | int) -> Array:
        """Accumulated motion (...,), m: path plus turning. Odometry errors grow with it."""
        self._settle()
        return self._at(np.asarray(times_ns, dtype=np.int64), self._effort)

    def _at(self, times_ns: IntArray, accumulated: Array) -> Array:
        """An accumulated quantity at any times, by the same rule as `pose`; settle first."""
        if self._count < 2:
            return np.zeros((*times_ns.shape, *accumulated.shape[1:]))
        i = np.clip(self.times.searchsorted(times_ns), 1, self._count - 1)
        share = self._share(i, self._times[i - 1], times_ns)
        if accumulated.ndim > 1:
            share = share[..., None]
        return accumulated[i - 1] + share * (accumulated[i] - accumulated[i - 1])

    def moved(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Path (m) and net turning (rad, absolute) from ``start_ns`` to ``end_ns``; cheap."""
        self._settle()
        if self._count < 2:
            return 0.0, 0.0
        (path, heading), (last_path, last_heading) = map(self._way, (start_ns, end_ns))
        return last_path - path, abs(float(wrap(last_heading - heading)))

    def _way(self, time_ns: int) -> tuple[float, float]:
        """Path and heading at a time, by the same rule as `pose`; settle first."""
        i = min(max(int(self.times.searchsorted(time_ns)), 1), self._count - 1)
        begin, end = int(self._times[i - 1]), int(self._times[i])
        share = min(max((time_ns - begin) / max(end - begin, 1), 0.0), 1.0)
        if self._burst[i]:
            share = float(share >= 1.0)
        path, last_path = self._path[i - 1], self._path[i]
        heading, last_heading = self._poses[i - 1, 2], self._poses[i, 2]
        turned = float(wrap(last_heading - heading))
        return float(path + share * (last_path - path)), float(heading + share * turned)


def reached(
    begin_ns: IntArray, end_ns: IntArray, burst: BoolArray, time_ns: IntArray | int
) -> Array:
    """Share (...,) of intervals that times have reached; of one in a burst nothing but at its end.

    Args:
        begin_ns: (...,) times of the readings before.
        end_ns: (...,) times of the readings after.
        burst: (...,) whether these were stamped in bursts, see `MAX_SPEED_M_S`.
        time_ns: (...,) any times.
    """
    share = (time_ns - begin_ns) / np.maximum(end_ns - begin_ns, 1)
    share = np.minimum(np.maximum(share, 0.0), 1.0)
    return np.asarray(np.where(burst, share >= 1.0, share))


def settle(many: Iterable[Readings]) -> None:
    """Work out what readings of several robots say of motion, at once, as far as it is not known.

    Arrays of few numbers are dear, so this takes not much longer for five robots than for one.
    """
    alike: dict[str, list[Readings]] = defaultdict(list)
    for one in many:
        if one._settled < one._count:
            alike[one.source].append(one)
    for group in alike.values():
        if len(group) == 1 and len(group[0]._fresh) == 1:  # the rule where each scan asks
            (one,) = group
            n = one._settled
            row = one._row(one._fresh.pop(), int(one._times[n] - one._times[n - 1]))
            one._settled = one._count
            one._enter(n, row)
        else:
            _settle_alike(group)


def _settle_alike(group: Sequence[Readings]) -> None:
    """`settle` of readings from one kind of source, those of one robot after those of the other."""
    counts = [len(one._fresh) for one in group]
    firsts = np.cumsum([0, *counts[:-1]])
    times = [one._times[one._settled - 1 : one._count] for one in group]
    apart_ns = np.concatenate([t[1:] - t[:-1] for t in times])
    rows = _rows(group, firsts, apart_ns)
    twists = rows[:, :3]
    if group[0].source == "wheels":
        parts = np.split(rows, firsts[1:])
        robots = [one._robot for one in group]
        twists = np.concatenate(list(map(wheel_twist, parts, robots)))
    x, y, turned = exp(twists).T
    path, turn = np.hypot(x, y), np.abs(turned)
    of = np.repeat(np.arange(len(group)), counts)

    def summed(each: Array, before: Array) -> Array:
        """Sums (n, ...) of each robot's own, from what it had ``before`` (m, ...)."""
        sums = np.cumsum(each, axis=0)
        others = np.concatenate([np.zeros((1, *each.shape[1:])), sums[firsts[1:] - 1]])
        # the difference first: who stands has exactly what it had
        return np.asarray((sums - others[of]) + before[of])

    last = [one._settled - 1 for one in group]
    poses = np.array([one._poses[n] for one, n in zip(group, last, strict=True)])
    heading = summed(turned, poses[:, 2])
    c, s = np.cos(heading - turned), np.sin(heading - turned)
    effort = path + TURNING_EFFORT_M * turn
    step = np.column_stack([c * x - s * y, s * x + c * y, effort, path, rows])
    known = [
        [*one._poses[n, :2], one._effort[n], one._path[n], *one._sums[n]]
        for one, n in zip(group, last, strict=True)
    ]
    sums = summed(step, np.array(known))
    heading = wrap(heading)
    seconds = 1e-9 * apart_ns
    burst = (path > MAX_SPEED_M_S * seconds) | (turn > MAX_TURN_RAD_S * seconds)
    for one, first, count in zip(group, firsts.tolist(), counts, strict=True):
        new, own = slice(one._settled, one._count), slice(first, first + count)
        one._rows[new], one._sums[new], one._burst[new] = rows[own], sums[own, 4:], burst[own]
        one._poses[new, :2], one._poses[new, 2] = sums[own, :2], heading[own]
        one._effort[new], one._path[new] = sums[own, 2], sums[own, 3]
        one._bursts += int(np.count_nonzero(burst[own]))
        one._settled = one._count
        one._fresh.clear()


def _rows(group: Sequence[Readings], firsts: IntArray, apart_ns: IntArray) -> Array:
    """Rows (n, k) of fresh readings of one kind that follow each robot's last one.

    A pose that is no continuation of the one before tells that the odometry was set anew: it is
    faster than any robot over an interval that is no burst. The motion in it is unknown; the
    robot is taken to have gone on as before.

    Args:
        group: the robots' readings.
        firsts: (m,) where in n those of each begin.
        apart_ns: (n,) since the reading before.
    """
    values = np.array([value for one in group for value in one._fresh])
    if group[0].source == "given":
        return values
    earlier = np.roll(values, 1, axis=0)
    earlier[firsts] = [one._last for one in group]
    for one in group:
        one._last = one._fresh[-1]
    if group[0].source == "wheels":
        return np.asarray(values - earlier)
    rows = log(between(earlier, values))
    for k in np.flatnonzero(_jumped(rows, apart_ns)).tolist():
        g = int(np.searchsorted(firsts, k, side="right")) - 1
        group[g]._resets += 1
        rows[k] = rows[k - 1] if k > firsts[g] else group[g]._rows[group[g]._settled - 1]
    return rows


def _jumped(rows: Array, apart_ns: IntArray | int) -> BoolArray:
    """Whether rows (..., 3) are faster than any robot, over intervals (...,) that are no bursts."""
    limit_m = RESET_SPEED_M_S * 1e-9 * np.asarray(apart_ns) + 0.5
    long = np.asarray(apart_ns) >= SHORTEST_RESET_NS
    return np.asarray(long & (np.hypot(rows[..., 0], rows[..., 1]) > limit_m))
