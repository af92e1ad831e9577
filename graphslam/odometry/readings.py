"""One robot's odometry readings, and the path that they describe by themselves.

Readings are added one by one and integrated when a motion is first needed, many at once where that
is rare. Between two readings the robot is taken to move on a circle segment. Calibration is the
matter of `graphslam.odometry.preintegration`.
"""

import math
from collections import defaultdict
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import OdometryConfig, RobotConfig
from graphslam.core.geometry import Array, between, compose, exp, log, wrap
from graphslam.core.motion_models import wheel_twist
from graphslam.core.records import OdometryIncrement, OdometryPose, WheelAngles
from graphslam.odometry.missing_increments import SAME_NS, MissingIncrements, bridge

Odometry = OdometryPose | OdometryIncrement | WheelAngles

#: the odometry was reset if it moves faster than this share of ``odometry.max_speed_m_s`` for this
#: long or longer, in ns, and by this much more, in m: stamps of single readings are not that exact
RESET_SPEED_RATIO, SHORTEST_RESET_NS, RESET_SLACK_M = 0.5, 10_000_000, 0.5
#: share of readings in bursts above which the stamps are not good enough to learn a latency
MAX_BURST_SHARE = 0.01
#: ns: how long before the first reading or after the last a robot is taken to stand; one in motion
#: for two periods (the mean of the last ones, so many) or, if longer, until it is so far away, m
EDGE_NS, STANDS_M, PERIODS = 500_000_000, 1e-3, 32
#: readings that wait for integration at most: each is an array until then
MOST_PENDING = 50_000
#: readings of one robot that are integrated one by one at most: arrays take as long as eight do
FEW = 4
#: m per rad: how much path a turn counts for when a correction is spread over an interval
TURNING_EFFORT_M = 0.3

#: numbers in a row: a twist or two wheel turns, and the seconds in motion; or twist and covariance
_ROW_SIZE = {"odometry": 4, "commands": 4, "given": 12, "wheels": 3}
#: fewer readings are not forgotten by themselves
FEWEST_FORGOTTEN = 512
#: attributes of `Readings` with a row for each
_ARRAYS = ("_times", "_rows", "_totals", "_poses", "_burst")
#: columns of `Readings._totals`: path m, heading rad (not wrapped), effort m; then those of a row
_PATH, _HEADING, _EFFORT, _ROW = 0, 1, 2, 3


@dataclass(frozen=True, slots=True, eq=False)
class RowSpan:
    """Rows of the readings around some times.

    ``whole`` (w, k): rows from the first interval that a time lies in up to the last one, which is
    left out. ``index`` (...,): how many of them lie before each time; ``part`` (..., k): what each
    time has reached of the row of its own interval.
    """

    whole: Array
    index: IntArray
    part: Array


class Readings:
    """Odometry readings of one robot, in time order, each as one small row of what it adds.

    That is a twist or wheel turns with the seconds in motion, or an increment with its covariance.
    """

    def __init__(self, config: OdometryConfig, robot: RobotConfig) -> None:
        """No readings yet."""
        self.source = ""
        #: readings that were made of scans where there were none, see `gap_bridging`
        self.bridged, self.bridged_sigma_m = 0, 0.0
        #: what increments leave out
        self.missing = MissingIncrements()
        self.config, self.robot = config, robot
        # values of readings that are not integrated yet wait in `_pending`
        self._count = self._bursts = self._resets = self._forgotten = self._integrated = 0
        self._pending: list[Array] = []
        self._times = np.empty(1024, dtype=np.int64)  # time of the end of each row's interval
        self._rows = np.empty((1024, 0))
        self._totals = np.empty((1024, 0))  # accumulated, see `_PATH` and its like
        self._poses = np.empty((1024, 3))  # by odometry alone, first reading = origin
        self._burst = np.empty(1024, dtype=bool)  # interval too short for its motion
        self._last = np.zeros(0)  # the last reading that is integrated

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
    def has_burst_stamps(self) -> bool:
        """Whether many readings were stamped in bursts: then latency cannot be estimated."""
        self._integrate_pending()
        return self._bursts > MAX_BURST_SHARE * (self._forgotten + self._count)

    @property
    def resets(self) -> int:
        """How often the odometry was reset."""
        self._integrate_pending()
        return self._resets

    def add(self, message: Odometry) -> None:
        """Append a reading; readings come in time order."""
        if isinstance(message, OdometryIncrement):
            if not self._count:
                self._begin("given", message.start_ns)
            value = self._new_part(message)
        elif isinstance(message, OdometryPose):
            value = message.pose
        else:
            value = np.array([message.left_rad, message.right_rad])
        if not self._count:
            poses = "commands" if self.config.commanded_velocities else "odometry"
            self._begin("wheels" if isinstance(message, WheelAngles) else poses, message.time_ns)
            self._last = value
        elif message.time_ns > self.last_ns:
            self._append(message.time_ns, value)
        else:
            # a second reading of one time: its motion belongs to the interval that ends here
            self._integrate_pending()
            row, n = self._row(value, 0), self._count - 1
            if n:
                self._bursts -= int(self._burst[n])
                self._enter(n, self._rows[n] + row)

    def _append(self, time_ns: int, value: Array) -> None:
        if self._count == len(self._times):
            self._grow()
        self._times[self._count] = time_ns
        self._count += 1
        self._pending.append(value)
        if len(self._pending) == MOST_PENDING:
            self._integrate_pending()

    def _new_part(self, message: OdometryIncrement) -> Array:
        """The row of an increment after the readings so far; a gap before it is bridged."""
        twist, cov = log(message.delta), message.cov
        begin_ns, end_ns, last_ns = message.start_ns, message.time_ns, self.last_ns
        if begin_ns > last_ns + SAME_NS:
            self._integrate_pending()
            n = self._count - 1
            took = 1e-9 * int(self._times[n] - self._times[n - 1]) if n else 0.0
            before = self._rows[n, :3] / took if n else None
            after = twist / (1e-9 * (end_ns - begin_ns))
            found, spread = bridge(before, after, 1e-9 * (begin_ns - last_ns))
            self.missing.note_gap(last_ns, begin_ns)
            self._append(begin_ns, np.concatenate([found, spread.ravel()]))
        elif begin_ns < last_ns - SAME_NS and end_ns > last_ns:
            share = (end_ns - last_ns) / (end_ns - begin_ns)
            twist, cov = share * twist, share * cov
            self.missing.overlaps += 1
        return np.concatenate([twist, cov.ravel()])

    def _begin(self, source: str, time_ns: int) -> None:
        """Start at the first reading, the origin of `pose`."""
        self.source, self._count, self._integrated = source, 1, 1
        self._rows = np.zeros((len(self._times), _ROW_SIZE[source]))
        self._totals = np.zeros((len(self._times), _ROW + _ROW_SIZE[source]))
        self._times[0] = time_ns
        self._poses[0], self._burst[0] = 0.0, False

    def forget_before(self, time_ns: int) -> None:
        """Drop the readings that only motions before a time need.

        Half of them at least, or none, so that each is moved once on average.
        """
        self._integrate_pending()
        n = int(self.times.searchsorted(time_ns, side="right")) - 1
        if n < max(FEWEST_FORGOTTEN, self._count // 2):
            return
        for name in _ARRAYS:
            setattr(self, name, getattr(self, name)[n : self._count].copy())
        self._count, self._integrated = self._count - n, self._integrated - n
        self._forgotten += n

    def _grow(self) -> None:
        for name in _ARRAYS:
            full = getattr(self, name)
            # what is not written yet takes no memory, so nothing is put there
            grown = np.empty((2 * len(full), *full.shape[1:]), dtype=full.dtype)
            grown[: len(full)] = full
            setattr(self, name, grown)

    def _integrate_pending(self) -> None:
        """Integrate the readings that came since a motion was last needed, all at once."""
        if self._integrated < self._count:
            integrate_pending((self,))

    def _row(self, value: Array, apart_ns: int) -> Array:
        """`_rows` of one reading, which follows the last one after ``apart_ns``."""
        if self.source == "given":
            return value
        before, self._last = self._last, value
        row = value - before if self.source == "wheels" else log(between(before, value))
        if self.source != "wheels" and _is_reset(row, apart_ns, self.config.max_speed_m_s):
            self._resets += 1
            return np.asarray(self._rows[self._integrated - 1])
        return np.append(row, 1e-9 * apart_ns if row.any() else 0.0)

    def _enter(self, n: int, row: Array) -> None:
        """`_integrate` of one row, that of the n-th reading, n > 0.

        Arrays of one number take six times as long, and where every scan asks for its pose this
        would add up to 15 % to the time of a run.
        """
        twist = wheel_twist(row[None], self.robot)[0] if self.source == "wheels" else row[:3]
        (x, y, turned), (east, north, heading) = exp(twist).tolist(), self._poses[n - 1].tolist()
        c, s, path, turn = math.cos(heading), math.sin(heading), math.hypot(x, y), abs(turned)
        self._rows[n] = row
        self._poses[n] = east + c * x - s * y, north + s * x + c * y, float(wrap(heading + turned))
        step = path, turned, path + TURNING_EFFORT_M * turn, *row.tolist()
        self._totals[n] = self._totals[n - 1] + step
        seconds = 1e-9 * int(self._times[n] - self._times[n - 1])
        limits = self.config.max_speed_m_s * seconds, self.config.max_turn_rad_s * seconds
        burst = path > limits[0] or turn > limits[1]
        self._burst[n] = burst
        self._bursts += burst

    def reaches(self, time_ns: int) -> bool:
        """Whether the motion up to ``time_ns`` is known without looking beyond a reading."""
        return self._count > 0 and self.last_ns >= time_ns

    def covers(self, time_ns: int, gap_ns: int) -> bool:
        """Whether ``time_ns`` lies between readings at most ``gap_ns`` apart, or just after them.

        Not before them: a robot begins where its odometry does, which is where its start is told.
        """
        if not self._count:
            return False
        i = int(self.times.searchsorted(time_ns))
        if 0 < i < self._count:
            return bool(self._times[i] - self._times[i - 1] <= gap_ns)
        return self.first_ns <= time_ns <= self._end_ns()

    def covers_each(self, times_ns: IntArray, gap_ns: int) -> BoolArray:
        """`covers` of many times (n,)."""
        if not self._count:
            return np.zeros(len(times_ns), dtype=np.bool_)
        i = self.times.searchsorted(times_ns)
        before, after = (self.times[k.clip(0, self._count - 1)] for k in (i - 1, i))
        near = (self.first_ns <= times_ns) & (times_ns <= self._end_ns())
        return np.asarray(np.where((i > 0) & (i < self._count), after - before <= gap_ns, near))

    def _end_ns(self) -> int:
        """Until when the robot is where the last reading says, see `EDGE_NS`."""
        recent = self.times[-PERIODS - 1 :]
        period_ns = int(recent[-1] - recent[0]) // max(len(recent) - 1, 1)
        moved = max(float(np.diff(self.effort(self.last_ns - np.array([period_ns, 0])))[0]), 1e-9)
        return self.last_ns + min(EDGE_NS, round(max(period_ns, 1000) * max(2.0, STANDS_M / moved)))

    def pose(self, times_ns: IntArray | int) -> Array:
        """Poses (..., 3) by odometry alone, in the frame of the first reading.

        Before the first reading and after the last one the robot is taken to stand still.
        """
        i, share = self._interval(np.asarray(times_ns, dtype=np.int64))
        if self._count < 2:
            return np.zeros((*share.shape, 3))
        twist = log(between(self._poses[i - 1], self._poses[i]))
        return compose(self._poses[i - 1], exp(share[..., None] * twist))

    def effort(self, times_ns: IntArray | int) -> Array:
        """Accumulated motion (...,), m: path plus turning. Odometry errors grow with it."""
        return self._total(np.asarray(times_ns, dtype=np.int64))[..., _EFFORT]

    def times_of_effort(self, effort_m: Array) -> IntArray:
        """Times (n,), ns, at which accumulated `effort` reaches values (n,), m."""
        self._integrate_pending()
        known = self._totals[: self._count, _EFFORT]
        return np.interp(effort_m, known, self.times).astype(np.int64)

    def moved(self, start_ns: int, end_ns: int) -> tuple[float, float]:
        """Path (m) and net turning (rad, absolute) from ``start_ns`` to ``end_ns``; cheap."""
        start, end = self.driven(np.array([start_ns, end_ns]))
        return float(end[0] - start[0]), abs(float(wrap(end[1] - start[1])))

    def driven(self, times_ns: IntArray) -> Array:
        """Accumulated path (m) and heading (rad, not wrapped) at times (n,): (n, 2)."""
        return self._total(times_ns)[:, [_PATH, _HEADING]]

    def added_rows(self, start_ns: IntArray, end_ns: IntArray) -> Array:
        """Sums (n, k) of the rows between times (n,) and (n,), a share of those cut by a time."""
        start, end = self._total(np.stack([start_ns, end_ns]))
        return np.asarray((end - start)[:, _ROW:])

    def rows_between(self, start_ns: int, end_ns: int) -> Array:
        """Rows (m, k) of the readings between two times, a share of those cut by a time."""
        self._integrate_pending()
        first = max(int(np.searchsorted(self.times, start_ns, side="right")), 1)
        last = min(int(np.searchsorted(self.times, end_ns, side="left")), self._count - 1)
        if end_ns <= start_ns or last < first:
            return self._rows[:0]
        i = np.arange(first, last + 1)
        return self._rows[i] * (self._share(i, end_ns) - self._share(i, start_ns))[:, None]

    def span(self, times_ns: IntArray) -> RowSpan:
        """The rows around times (...,); there are two readings at least."""
        i, share = self._interval(times_ns)
        first = int(i.min(initial=self._count - 1))
        last = int(i.max(initial=first))
        return RowSpan(self._rows[first:last], i - first, self._rows[i] * share[..., None])

    def _total(self, times_ns: IntArray) -> Array:
        """What accumulated (..., 3 + k) up to any times, by the same rule as `pose`."""
        i, share = self._interval(times_ns)
        if self._count < 2:
            return np.zeros((*times_ns.shape, self._totals.shape[1]))
        before = self._totals[i - 1]
        return np.asarray(before + share[..., None] * (self._totals[i] - before))

    def _interval(self, times_ns: IntArray) -> tuple[IntArray, Array]:
        """The reading (...,) that ends the interval of a time, and the share of it reached."""
        self._integrate_pending()
        if self._count < 2:
            return np.ones_like(times_ns), np.zeros(times_ns.shape)
        i = np.minimum(np.maximum(self.times.searchsorted(times_ns), 1), self._count - 1)
        return i, self._share(i, times_ns)

    def _share(self, i: IntArray, time_ns: IntArray | int) -> Array:
        """Share (...,) of the intervals that end at readings i that times have reached.

        An interval is in a burst if its motion is faster than ``odometry.max_speed_m_s`` or
        ``max_turn_rad_s``: a logger that fell behind stamped it. A time inside such an interval
        belongs to the reading before, which is the order of recording.
        """
        begin, end = self._times[i - 1], self._times[i]
        share = (time_ns - begin) / np.maximum(end - begin, 1)
        share = np.minimum(np.maximum(share, 0.0), 1.0)
        return np.asarray(np.where(self._burst[i], share >= 1.0, share))


def integrate_pending(many: Iterable[Readings]) -> None:
    """Integrate the readings of several robots that are not integrated yet, at once.

    NumPy's cost per call outweighs that of few numbers, so five robots take little more time than
    one.
    """
    alike: dict[Hashable, list[Readings]] = defaultdict(list)
    for one in many:
        if one._integrated < one._count:
            limits = one.config.max_speed_m_s, one.config.max_turn_rad_s
            alike[one.source, *limits].append(one)
    for group in alike.values():
        if len(group) == 1 and len(group[0]._pending) <= FEW:  # the rule where each scan asks
            (one,) = group
            for value in one._pending:
                n = one._integrated
                row = one._row(value, int(one._times[n] - one._times[n - 1]))
                one._enter(n, row)
                one._integrated = n + 1
            one._pending.clear()
        else:
            _integrate(group)


def _integrate(group: Sequence[Readings]) -> None:
    """`settle` of readings from one kind of source: arrays (n, ...) robot after robot."""
    counts = [len(one._pending) for one in group]
    firsts = np.cumsum([0, *counts[:-1]])
    times = [one._times[one._integrated - 1 : one._count] for one in group]
    apart_ns = np.concatenate([t[1:] - t[:-1] for t in times])
    rows = _rows(group, firsts, apart_ns)
    twists = rows[:, :3]
    if group[0].source == "wheels":
        parts = np.split(rows, firsts[1:])
        robots = [one.robot for one in group]
        twists = np.concatenate(list(map(wheel_twist, parts, robots)))
    x, y, turned = exp(twists).T
    path, turn = np.hypot(x, y), np.abs(turned)
    of = np.repeat(np.arange(len(group)), counts)

    def summed(each: Array, before: Array) -> Array:
        """Sums (n, ...) of each robot's own, from what it had ``before`` (m, ...)."""
        sums = np.cumsum(each, axis=0)
        others = np.concatenate([np.zeros((1, *each.shape[1:])), sums[firsts[1:] - 1]])
        # the difference first: the sums of a robot at rest stay exactly the same
        return np.asarray((sums - others[of]) + before[of])

    last = [one._integrated - 1 for one in group]
    poses = np.array([one._poses[n] for one, n in zip(group, last, strict=True)])
    totals = np.array([one._totals[n] for one, n in zip(group, last, strict=True)])
    heading = summed(turned, poses[:, 2])
    c, s = np.cos(heading - turned), np.sin(heading - turned)
    effort = path + TURNING_EFFORT_M * turn
    step = np.column_stack([c * x - s * y, s * x + c * y, path, turned, effort, rows])
    sums = summed(step, np.column_stack([poses[:, :2], totals]))
    poses = np.column_stack([sums[:, :2], wrap(heading)])
    seconds = 1e-9 * apart_ns
    config = group[0].config
    burst = (path > config.max_speed_m_s * seconds) | (turn > config.max_turn_rad_s * seconds)
    for one, first, count in zip(group, firsts.tolist(), counts, strict=True):
        new, own = slice(one._integrated, one._count), slice(first, first + count)
        one._rows[new], one._totals[new], one._poses[new] = rows[own], sums[own, 2:], poses[own]
        one._burst[new] = burst[own]
        one._bursts += int(np.count_nonzero(burst[own]))
        one._integrated = one._count
        one._pending.clear()


def _rows(group: Sequence[Readings], firsts: IntArray, apart_ns: IntArray) -> Array:
    """Rows (n, k) of the pending readings of robots with one kind of source.

    A jump of the odometry pose, see `_is_reset`, is not a motion: the odometry was reset. The
    motion in that interval is unknown; the previous interval's is taken for it.

    Args:
        group: the robots' readings.
        firsts: (m,) where in n those of each begin.
        apart_ns: (n,) since the reading before.
    """
    values = np.array([value for one in group for value in one._pending])
    if group[0].source == "given":
        return values
    earlier = np.roll(values, 1, axis=0)
    earlier[firsts] = [one._last for one in group]
    for one in group:
        one._last = one._pending[-1]
    wheels = group[0].source == "wheels"
    rows = values - earlier if wheels else log(between(earlier, values))
    rows = np.column_stack([rows, 1e-9 * apart_ns * rows.any(axis=1)])
    if wheels:
        return rows
    resets = _is_reset(rows, apart_ns, group[0].config.max_speed_m_s)
    for k in np.flatnonzero(resets).tolist():
        g = int(np.searchsorted(firsts, k, side="right")) - 1
        group[g]._resets += 1
        rows[k] = rows[k - 1] if k > firsts[g] else group[g]._rows[group[g]._integrated - 1]
    return rows


def _is_reset(rows: Array, apart_ns: IntArray | int, max_speed_m_s: float) -> BoolArray:
    """Whether rows (..., 3) over intervals (...,) are resets, see `RESET_SPEED_RATIO`."""
    limit_m = RESET_SPEED_RATIO * max_speed_m_s * 1e-9 * np.asarray(apart_ns) + RESET_SLACK_M
    long = np.asarray(apart_ns) >= SHORTEST_RESET_NS
    return np.asarray(long & (np.hypot(rows[..., 0], rows[..., 1]) > limit_m))
