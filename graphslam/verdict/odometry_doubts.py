"""Doubts about odometry: frozen, jumping, scaled, reversed, with gaps, or faster than robots drive.

Its own readings tell what no robot does; the result, which landmarks and scans made, tells where
odometry is alone with what it says.
"""

from collections.abc import Iterator
from itertools import chain

import numpy as np

from graphslam.core.arrays import IntArray, stretches
from graphslam.core.geometry import Array, between, wrap
from graphslam.pipeline.path_evidence import FACTORS as PATH_FACTORS
from graphslam.pipeline.path_evidence import better_fit
from graphslam.pipeline.scan_evidence import Parked
from graphslam.verdict.doubts import MOVED_M, MOVED_RAD, Reason, seconds
from graphslam.verdict.evidence import Evidence, RobotEvidence

#: share of a scan's beams that change while a robot stands, by people and doors, at most
SCAN_CHANGE = 0.6
#: m: half of the beams change by more than that only where a robot moved
RANGE_CHANGE_M = 0.04
#: share of readings, far from each other in time: the fastest that a robot drives is exceeded by
#: those only that are wrong
FAST_SHARE = 0.98
#: m/s, rad/s: no robot of the kind is faster
TOP_SPEED_M_S, TOP_TURN_RAD_S = 30.0, 12.0
#: m/s: no robot that drives is slower all the time; share of the time in which it drives, of that
#: in which it does not turn by more than rad/s; least share of that
CREEP_M_S, CREEPING, STRAIGHT_RAD_S, STRAIGHT = 0.01, 0.5, 0.02, 0.2
#: m, rad: a motion within one period that is more than the robot can do by so much is a jump
JUMP_M, JUMP_RAD = 0.22, 0.4
#: m, m/s²: a deviation from the speed around it by more is no motion of wheels: 2 cm within 20 ms
#: and 10 cm within 100 ms; share of motions that may be so: else it is how the odometry counts;
#: share of motions that take about as long as usual, without which nothing is told
SUDDEN_M, SUDDEN_M_S2, SUDDEN, EVEN = 0.02, 10.0, 0.02, 0.9
#: s: odometry without a reading for longer is a guess; periods of the topic
GAP_S, GAP_PERIODS = 3.0, 8.0
#: share of the time, or of increments, that may be missing, or overlap
MISSING = 0.1
#: s: readings that are farther apart do not tell how a robot moved
SLOW_S = 1.2
#: s: motions over so long are compared with those of the result
SPAN_S = 2.0
#: factors of odometry on turning and on paths that calibration explains
FACTORS = 0.6, 1.6
#: share of turning or path that must be in a part of the log to compare it; rad, m
TURNED_RAD, DRIVEN_M = 2.0, 2.0
#: s: stamps of scans that are later or earlier by so much; what is tried; in steps of
LATE_S, LATEST_S, LATE_STEP_S = 0.3, 2.0, 0.1
#: correlation of turning that is as good as it gets: even turning fits at any time
FITS = 0.99
LEAST_POSES = 50
#: rad: turned by so much the other way, in a row of spans that each turn by more than noise and
#: less than half a turn, which is one in either direction
OPPOSITE_RAD, SPAN_RAD = 1.0, (0.1, 2.5)
#: pairs of scans in which the path along walls is looked at together
PATH_PAIRS = 8
#: m: sigma of the position after a time without odometry from which it is doubtful
BRIDGED_SIGMA_M = 0.15
#: seconds of a log from which its speed is judged
LEAST_SPEEDS = 10
#: the log is compared in so many parts
PARTS = 6


def odometry_doubts(evidence: Evidence) -> Iterator[Reason]:
    """What is wrong with the odometry of each robot."""
    for robot in evidence.robots:
        if robot.name in evidence.without_odometry or len(robot.readings_ns) < 3:
            continue
        jumps = list(_jumps(robot)) or _corrections(robot)
        found = list(chain(_gaps(robot), _speed(robot), jumps, _frozen(robot)))
        yield from found
        if not found:
            found = [*_factors(robot), *_opposite(robot), *_along_walls(robot)]
            yield from found
            yield from _late(robot)


def _steps(robot: RobotEvidence) -> tuple[Array, Array]:
    """Motions (n-1, 3) between readings, and the time that each took, s."""
    apart = np.diff(robot.readings_ns) * 1e-9
    return between(robot.readings[:-1], robot.readings[1:]), apart


def _reason(robot: RobotEvidence, level: str, text: str) -> Reason:
    return Reason(level, "odometry", robot.name, f"{robot.name}: its odometry {text}")


def _gaps(robot: RobotEvidence) -> Iterator[Reason]:
    moved, apart = _steps(robot)
    usual = float(np.median(apart))
    origin = int(robot.readings_ns[0])
    if usual > SLOW_S and robot.source != "given":
        yield _reason(robot, "doubtful", f"has a reading every {usual:.1f} s only")
        return
    if robot.source == "given":
        yield from _left_out(robot)
        return
    if robot.bridged_sigma_m > BRIDGED_SIGMA_M:
        text = (
            "is silent for a while, in which nothing but its speed before tells how far it went "
            f"(sigma {robot.bridged_sigma_m:.2f} m): its scans are of walls that look the same"
        )
        yield _reason(robot, "doubtful", text)
    wide = np.flatnonzero(apart > max(GAP_S, GAP_PERIODS * usual))
    far = np.hypot(moved[wide, 0], moved[wide, 1]) > MOVED_M
    wide = wide[far | (np.abs(moved[wide, 2]) > MOVED_RAD)]
    if len(wide):
        k = int(wide[np.argmax(apart[wide])])
        text = (
            f"has no reading for {apart[k]:.1f} s from {seconds(robot.readings_ns[k], origin)} on, "
            "in which the robot moved"
        )
        yield _reason(robot, "doubtful", text)


def _left_out(robot: RobotEvidence) -> Iterator[Reason]:
    """Increments that are missing while the robot moved, or that overlap."""
    missing, origin = robot.missing, int(robot.readings_ns[0])
    whole_ns = int(robot.readings_ns[-1]) - origin
    gap_s = 1e-9 * missing.longest_ns
    ends = missing.longest_at_ns + np.array([0, missing.longest_ns])
    near = robot.readings_ns.searchsorted(ends).clip(0, len(robot.readings) - 1)
    moved = between(robot.readings[near[0]], robot.readings[near[1]])
    is_long = gap_s > GAP_S and (np.hypot(*moved[:2]) > MOVED_M or abs(moved[2]) > MOVED_RAD)
    if (
        is_long
        or missing.total_ns > MISSING * whole_ns
        or missing.overlaps > MISSING * len(robot.readings)
    ):
        yield _reason(robot, "doubtful", missing.to_text(origin))


def _speed(robot: RobotEvidence) -> Iterator[Reason]:
    impossible = impossible_speed(robot.readings_ns, robot.readings, robot.resets)
    yield from (_reason(robot, "bad", text) for text in impossible)
    if robot.resets <= _most_resets(len(robot.readings)):
        path, _ = _moved_in_seconds(robot.readings_ns, robot.readings)
        yield from _creep(robot, path)


def impossible_speed(readings_ns: IntArray, readings: Array, resets: int) -> Iterator[str]:
    """What odometry does that no robot can, as of a wrong unit, to be read after "its odometry".

    Args:
        readings_ns: (n,) times.
        readings: (n, 3) poses by odometry alone, its resets bridged.
        resets: how many there are.
    """
    if resets > _most_resets(len(readings)):
        yield f"jumps {resets} times, or is not in metres: it is faster than robots drive"
        return
    path, turn = _moved_in_seconds(readings_ns, readings)
    for rates, most, unit, hint in (
        (path, TOP_SPEED_M_S, "m/s", "metres"),
        (turn, TOP_TURN_RAD_S, "rad/s", "radians"),
    ):
        if len(rates) and np.quantile(rates, FAST_SHARE) > most:
            fast = float(np.quantile(rates, FAST_SHARE))
            yield f"moves at {fast:.3g} {unit}, which no robot does: is it in {hint}?"


def _most_resets(readings: int) -> float:
    return max(3, 0.02 * (readings - 1))


def _moved_in_seconds(readings_ns: IntArray, readings: Array) -> tuple[Array, Array]:
    """Path (n,), m, and turning (n,), rad, in every second: stamps may come in bursts."""
    moved = between(readings[:-1], readings[1:])
    times = (readings_ns - readings_ns[0]) * 1e-9
    grid = np.arange(0.0, times[-1], 1.0)

    def rates(step: Array) -> Array:
        return np.diff(np.interp(grid, times, np.concatenate([[0.0], np.cumsum(step)])))

    return rates(np.hypot(moved[:, 0], moved[:, 1])), rates(np.abs(moved[:, 2]))


def _creep(robot: RobotEvidence, speeds: Array) -> Iterator[Reason]:
    """Odometry that goes on and on, and nowhere: it is in a larger unit than metres.

    That of a robot that stands or turns on the spot shakes to and fro; this one goes one way,
    and straight.

    Args:
        robot: with its readings.
        speeds: (n,) m/s in every second.
    """
    if robot.source == "given" or len(speeds) < LEAST_SPEEDS:
        return
    moved, apart = _steps(robot)
    straight = np.abs(moved[:, 2]) < STRAIGHT_RAD_S * apart
    ahead = moved[straight, 0]
    total = np.abs(ahead).sum()
    one_way = max(ahead[ahead > 0].sum(), -ahead[ahead < 0].sum()) > 0.9 * total > 0
    goes_on = np.count_nonzero(ahead) > CREEPING * len(ahead) > CREEPING * STRAIGHT * len(moved)
    if one_way and goes_on and np.quantile(speeds, FAST_SHARE) < CREEP_M_S:
        text = f"moves at {speeds.max():.2g} m/s at most, and never stops: is it in metres?"
        yield _reason(robot, "doubtful", text)


def _jumps(robot: RobotEvidence) -> Iterator[Reason]:
    """Single motions that neither the motions around them nor the result know of."""
    origin = int(robot.readings_ns[0])
    if robot.resets:
        yield _reason(
            robot, "doubtful", f"jumped {robot.resets} times; bridged at the previous speed"
        )
    if robot.source == "given":
        return
    moved, apart = _steps(robot)
    usual = np.median(apart)
    # stamps jitter, by a period at most
    late = min(usual, float(np.quantile(np.abs(apart - usual), FAST_SHARE)))
    size = np.column_stack([np.hypot(moved[:, 0], moved[:, 1]), np.abs(moved[:, 2])])
    at = []
    for k, least in enumerate((JUMP_M, JUMP_RAD)):
        rates = size[:, k] / np.maximum(apart, usual)
        # what the robot does at its fastest
        most = float(np.quantile(rates, FAST_SHARE)) * (apart + late)
        at += np.flatnonzero(size[:, k] > most + least).tolist()
    at = [k for k in sorted(set(at)) if apart[k] < GAP_S]
    if at and len(at) <= max(5, 0.002 * len(apart)):
        k = at[0]
        text = (
            f"jumps by {size[k, 0]:.2f} m and {size[k, 1]:.2f} rad at "
            f"{seconds(robot.readings_ns[k + 1], origin)}"
        )
        yield _reason(robot, "doubtful", text + (f", and {len(at) - 1} times more" * (len(at) > 1)))


def _corrections(robot: RobotEvidence) -> Iterator[Reason]:
    """Motions too sudden for wheels, again and again: a localisation corrects the odometry.

    They deviate from the speed both before and after. Where stamps are uneven, or motions come in
    bursts, nothing is told.
    """
    moved, apart = _steps(robot)
    usual = float(np.median(apart))
    if robot.source == "given" or len(apart) < LEAST_POSES or not usual > 0:
        return
    even = (apart > usual / 2) & (apart < 2 * usual)
    told = even[:-2] & even[1:-1] & even[2:]
    speed = moved[:, :2] / np.maximum(apart, usual / 2)[:, None]
    off = np.stack([speed[1:-1] - speed[:-2], speed[1:-1] - speed[2:]]) * apart[1:-1, None]
    size = np.hypot(off[..., 0], off[..., 1]).min(axis=0)
    is_sudden = told & (size > np.maximum(SUDDEN_M, SUDDEN_M_S2 * apart[1:-1] ** 2))
    if even.mean() < EVEN or is_sudden.mean() > SUDDEN or size[is_sudden].sum() < JUMP_M:
        return
    number = np.count_nonzero(is_sudden)
    text = (
        f"jumps {number} times within one period, by {np.median(size[is_sudden]):.2f} m in the "
        "median: if a localisation corrects it, record the wheels' own odometry"
    )
    yield _reason(robot, "doubtful", text)


def _frozen(robot: RobotEvidence) -> Iterator[Reason]:
    """Times in which odometry stands while scans or landmarks change."""
    origin = int(robot.readings_ns[0])
    for parked in robot.parked:
        witness = _who_moved(robot, parked)
        if witness:
            text = (
                f"is frozen, or far too small, from {seconds(parked.begin_ns, origin)} to "
                f"{seconds(parked.end_ns, origin)}: {witness} change meanwhile"
            )
            yield _reason(robot, "bad", text)
            return


def _who_moved(robot: RobotEvidence, parked: Parked) -> str:
    """Which sensor says that the robot moved while it stood by odometry; empty if none does."""
    if parked.scan_change > SCAN_CHANGE or parked.range_change > RANGE_CHANGE_M or parked.speed_m_s:
        return "its scans"
    seen = robot.seen
    within = (seen.times_ns > parked.begin_ns) & (seen.times_ns < parked.end_ns) & seen.stands
    changes = []
    for target in np.unique(seen.targets[within]).tolist():
        own = np.flatnonzero(within & (seen.targets == target))
        turned = np.abs(wrap(seen.z[own, 0] - seen.z[own[0], 0]))
        nearer = np.abs(seen.z[own, 1] - seen.z[own[0], 1])
        # noise that does not fit was widened: it is taken for true within limits only
        turn, path = np.clip(10 * seen.sigmas[own].mean(axis=0), (0.1, 0.3), (0.4, 1.5))
        changes.append(max(float(np.median(turned) / turn), float(np.median(nearer) / path)))
    return "the landmarks that it sees" if changes and np.median(changes) > 1 else ""


def _factors(robot: RobotEvidence) -> Iterator[Reason]:
    """Turning and path by odometry against those of the result, over parts of the log.

    A robot that skids, or whose axle is another one, turns by half as much again as its odometry
    says, all along. Odometry that is calibrated agrees with the result then. Of paths that is no
    excuse: ranges that are twice as long look like odometry that is half as long.
    """
    worst = _contradictions(robot, robot.by_odometry)
    if "turning" in worst and "turning" not in _contradictions(robot, robot.by_calibrated):
        del worst["turning"]
    other = robot.other_sensor
    for _, text in worst.values():
        yield Reason(
            "doubtful",
            "odometry",
            robot.name,
            f"{robot.name}: its odometry and its {other} contradict each other: {text}",
        )


def _contradictions(robot: RobotEvidence, by_odometry: Array) -> dict[str, tuple[float, str]]:
    """Turning, or forward motion -> how well poses (m, 3) by odometry agree with the result.

    Where they do not agree, over the parts of the log; the worst one, and how it is told.
    """
    times = (robot.stamps_ns - robot.stamps_ns[0]) * 1e-9
    if len(times) < 3 or not times[-1] > 0:
        return {}
    grid = np.unique(np.searchsorted(times, np.arange(0.0, times[-1], SPAN_S)))
    ours = between(robot.final[grid[:-1]], robot.final[grid[1:]])
    its = between(by_odometry[grid[:-1]], by_odometry[grid[1:]])
    known = np.isfinite(its).all(axis=1) & np.isfinite(ours).all(axis=1)
    parts = np.arange(len(ours)) * PARTS // max(len(ours), 1)
    worst: dict[str, tuple[float, str]] = {}
    for part in [*range(PARTS), None]:
        use = known & (parts == part) if part is not None else known
        if not use.any():
            continue
        where = "" if part is None else f" from {times[grid[:-1][use]][0]:.0f} s on"
        for name, a, b, least in (
            ("turning", its[use, 2], ours[use, 2], TURNED_RAD),
            ("forward motion", its[use, 0], ours[use, 0], DRIVEN_M),
        ):
            amount = np.maximum(np.abs(a), np.abs(b)).sum()
            if amount < least:
                continue
            # as much of one as of the other explains: between the two regressions
            up, down = float(a @ b), float(np.sqrt((a @ a) * (b @ b)))
            agreement = up / max(down, 1e-12)
            ratio = float(np.sqrt(float(b @ b) / max(float(a @ a), 1e-12)))
            if agreement < 0.3 or not FACTORS[0] < ratio < FACTORS[1]:
                score = min(agreement, FACTORS[0] / ratio, ratio / FACTORS[1])
                if name not in worst or score < worst[name][0]:
                    worst[name] = score, _how(name, agreement, ratio, where)
    return worst


def _opposite(robot: RobotEvidence) -> Iterator[Reason]:
    """Turns that the result makes the other way than odometry: scans or odometry are mirrored."""
    times = (robot.stamps_ns - robot.stamps_ns[0]) * 1e-9
    grid = np.unique(np.searchsorted(times, np.arange(0.0, times[-1], SPAN_S)))
    ours = between(robot.final[grid[:-1]], robot.final[grid[1:]])[:, 2]
    its = between(robot.by_odometry[grid[:-1]], robot.by_odometry[grid[1:]])[:, 2]
    size = np.minimum(np.abs(ours), np.abs(its))
    most = np.maximum(np.abs(ours), np.abs(its))
    turns = np.flatnonzero((size > SPAN_RAD[0]) & (most < SPAN_RAD[1]))
    for a, b in stretches(ours[turns] * its[turns] < 0):
        if size[turns[a:b]].sum() > OPPOSITE_RAD:
            other = robot.other_sensor
            since = seconds(int(robot.stamps_ns[grid[turns[a]]]), int(robot.stamps_ns[0]))
            text = (
                f"and its {other} contradict each other: turning has the other sign from {since} "
                "on; one of the two is mirrored"
            )
            yield _reason(robot, "doubtful", text)
            return


def _along_walls(robot: RobotEvidence) -> Iterator[Reason]:
    """Scans of corridors that fit each other if the path along the walls was another one."""
    times, fits = robot.along_walls
    parts = np.arange(len(times)) * max(len(times) // PATH_PAIRS, 1) // max(len(times), 1)
    for part in np.unique(parts).tolist():
        best = better_fit(fits[parts == part])
        if best is not None:
            since = seconds(int(times[parts == part][0]), int(robot.stamps_ns[0]))
            text = (
                "and its scans contradict each other: along the walls its scans fit "
                f"{PATH_FACTORS[best]:.2g} times the path from {since} on"
            )
            yield _reason(robot, "doubtful", text)
            return


def _late(robot: RobotEvidence) -> Iterator[Reason]:
    """Turning by odometry that fits that of the scans at another time only."""
    if not len(robot.scans_ns) or len(robot.stamps_ns) < LEAST_POSES:
        return
    times = (robot.stamps_ns - robot.stamps_ns[0]) * 1e-9
    grid = np.arange(0.0, times[-1], LATE_STEP_S)
    known = np.isfinite(robot.by_odometry[:, 2])
    ours, its = (
        np.interp(grid, times[known], np.unwrap(poses[known, 2]))
        for poses in (robot.final, robot.by_odometry)
    )
    width = round(0.5 / LATE_STEP_S)
    a, b = (turned[width:] - turned[:-width] for turned in (ours, its))
    if np.abs(a).sum() * LATE_STEP_S / 0.5 < 2 * TURNED_RAD:
        return
    most = round(LATEST_S / LATE_STEP_S)
    if len(a) < 4 * most:
        return
    middle = a[most:-most]
    shifts = np.arange(-most, most + 1)
    fits = np.array([_alike(middle, b[most + k : len(b) - most + k]) for k in shifts.tolist()])
    best, plain = int(shifts[fits.argmax()]), float(fits[most])
    better = plain < FITS and fits.max() > 0.7 and 1 - fits.max() < 0.5 * (1 - plain)
    if abs(best) * LATE_STEP_S >= LATE_S and better:
        when = "later" if best < 0 else "earlier"
        text = (
            f"{robot.name}: its scans are stamped {abs(best) * LATE_STEP_S:.1f} s {when} than its "
            "odometry: two clocks, or a delay"
        )
        yield Reason("doubtful", "stamps", robot.name, text)


def _alike(a: Array, b: Array) -> float:
    return float(a @ b) / max(float(np.sqrt((a @ a) * (b @ b))), 1e-12)


def _how(name: str, agreement: float, ratio: float, where: str) -> str:
    if agreement < -0.3:
        return f"{name} has the other sign{where}; one of the two is mirrored"
    if agreement < 0.3:
        return f"{name} has nothing in common{where}; one of the two is wrong"
    return f"{name} by odometry is {1 / ratio:.2g} times that of the result{where}"
