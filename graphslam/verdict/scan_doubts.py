"""Doubts about laser scans: repeated, too far apart, or against what odometry says."""

from collections.abc import Iterator

import numpy as np

from graphslam.core.arrays import BoolArray
from graphslam.core.geometry import Array, between
from graphslam.verdict.doubts import MOVED_M, MOVED_RAD, Reason, seconds
from graphslam.verdict.evidence import Evidence, IntTable, RobotEvidence
from graphslam.verdict.scan_distortion import Distortion

#: times that one scan is repeated while odometry moves: not just sent twice
REPEATED = 5
#: m, rad: scans that are farther apart have little in common
HOP_M, HOP_RAD = 1.2, 1.0
#: share of the path in such hops
HOPS = 0.3
#: share of motions in which scans contradict odometry, and how many of so many in a row
CONTRADICTED, IN_A_ROW, ROW = 0.12, 8, 12
#: share of what was seen of walls that is of curves: of Intel and ACES up to 0.04
CURVED = 0.15
#: sigmas, share of the squared residuals, and rad: of walls turned within scans by a sweep, and by
#: the spacing of beams; of healthy logs up to 7, 0.03 and 0.004
DISTORTED = 10.0, 0.1, 0.005
#: share of what the scans before and after a time can tell of each other that they deny; share of
#: the points of either side that the other one saw through; and what they deny of any two of them.
#: All three are more where a robot is set down elsewhere. The first is up to 0.06 in Intel, and 0.3
#: and more where somebody stands in front of the laser for 3 s: then the last is up to 0.02, if the
#: map is right. Corridors that look alike have 0.12, 0.03 and 0.07
DENIED, SEEN_THROUGH, LEAST_DENIED = 0.12, 0.02, 0.05
#: ns without a scan, and usual times between two, in which a robot may be carried
UNSEEN_NS, UNSEEN_SCANS = 1_000_000_000, 3
#: ns without a scan in which a robot may stop and start again; m and rad that one which drives
#: comes in the second before and after; and the share of that speed at which it stands
STOP_NS, SECOND_NS, DRIVES, STOOD = 5_000_000_000, 1_000_000_000, 0.1, 0.1


def scan_doubts(evidence: Evidence) -> Iterator[Reason]:
    """What is wrong with the scans of each robot."""
    for robot in evidence.robots:
        if len(robot.scans_ns) > 2:
            yield from _repeated(robot)
            yield from _sparse(robot)
            yield from _contradictions(robot, evidence)
            yield from _moved_unseen(robot, evidence)
            yield from _stood_unseen(robot, evidence)
            yield from _set_down(robot, evidence)
            yield from _curved(robot)
            if evidence.summary["graph"]["dof"]:  # not of back ends that use no observations
                yield from _distorted(robot)


def _repeated(robot: RobotEvidence) -> Iterator[Reason]:
    first_ns, times = np.unique(robot.repeated_ns[:, 1], return_counts=True)
    frozen = times >= REPEATED
    if frozen.any():
        since = seconds(first_ns[frozen][0], int(robot.scans_ns[0]))
        text = (
            f"{robot.name}: its laser repeats one scan from {since} on while odometry moves: the "
            f"laser is frozen; {len(robot.repeated_ns)} scans were left out, and odometry alone "
            "tells how the robot moved"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _sparse(robot: RobotEvidence) -> Iterator[Reason]:
    near = np.searchsorted(robot.stamps_ns, robot.scans_ns)
    near = np.unique(np.clip(near, 0, len(robot.stamps_ns) - 1))
    if len(robot.scans_ns) > len(robot.stamps_ns):
        return  # more scans than poses that are compared: they are not sparse
    hops = np.abs(between(robot.by_odometry[near[:-1]], robot.by_odometry[near[1:]]))
    far = np.hypot(hops[:, 0], hops[:, 1])
    wide = (far > HOP_M) | (hops[:, 2] > HOP_RAD)
    if len(far) and far[wide].sum() > HOPS * far.sum():
        apart = float(np.median(np.diff(robot.scans_ns))) * 1e-9
        text = (
            f"{robot.name}: its scans are {apart:.1f} s and up to {far.max():.1f} m apart: they "
            "have too little in common to be matched"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _contradictions(robot: RobotEvidence, evidence: Evidence) -> Iterator[Reason]:
    motions, contradicted = len(robot.contradicted), int(robot.contradicted.sum())
    if robot.name in evidence.without_odometry or not motions:
        return
    most = int(np.convolve(robot.contradicted.astype(int), np.ones(ROW, dtype=int)).max())
    if contradicted > max(5, CONTRADICTED * motions) or most >= IN_A_ROW:
        text = (
            f"{robot.name}: its scans contradict its odometry in {contradicted} of {motions} "
            "motions; one of the two is wrong"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _moved_unseen(robot: RobotEvidence, evidence: Evidence) -> Iterator[Reason]:
    """Pauses of the laser after which scans have nothing in common with those before.

    Or they do where odometry does not say that the robot is, and it may be another place that looks
    the same.
    """
    if robot.name in evidence.without_odometry:
        return
    which = np.flatnonzero(robot.contradicted[1:])
    motions = np.column_stack([robot.motions_ns[which], robot.motions_ns[which + 1]])
    spans = np.concatenate([robot.lost_ns, motions[_is_elsewhere(robot, motions)]])
    pauses = np.array([_pause(robot, *span) for span in spans.tolist()]).reshape(-1, 2)
    least = max(UNSEEN_NS, UNSEEN_SCANS * float(np.median(np.diff(robot.scans_ns))))
    pauses = pauses[pauses[:, 1] - pauses[:, 0] >= least]
    moved = _by_odometry(robot, pauses)[:, 0]
    pauses = pauses[(np.hypot(moved[:, 0], moved[:, 1]) < HOP_M) & (moved[:, 2] < HOP_RAD)]
    if len(pauses):
        begin, end = min(pauses.tolist())
        text = (
            f"{robot.name}: its scans before and after a pause of {seconds(end, begin)}, "
            f"{seconds(begin, int(robot.scans_ns[0]))} after the first one, are not as its "
            "odometry says, which hardly moved: it was moved meanwhile, and where to is a guess"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _stood_unseen(robot: RobotEvidence, evidence: Evidence) -> Iterator[Reason]:
    """Pauses of the laser in which odometry stands, though it drove before and after them.

    It has not counted then, as where a recording was interrupted: no scan contradicts that along
    walls, where all places look the same.
    """
    if robot.name in evidence.without_odometry:
        return
    long = np.flatnonzero(np.diff(robot.scans_ns) >= STOP_NS)
    begin, end = robot.scans_ns[long], robot.scans_ns[long + 1]
    times = np.column_stack([begin - SECOND_NS, begin, end, end + SECOND_NS])
    moved = _by_odometry(robot, times)
    # m, or rad where it turns: both are of the order of what a robot does in a second
    far = np.hypot(moved[:, :, 0], moved[:, :, 1]) + moved[:, :, 2]
    drove = np.minimum(far[:, 0], far[:, 2])
    stood = far[:, 1] < STOOD * drove * (end - begin) / SECOND_NS
    for k in np.flatnonzero((drove > DRIVES) & stood)[:1].tolist():
        text = (
            f"{robot.name}: odometry stands for {seconds(end[k], int(begin[k]))} without a scan, "
            f"{seconds(begin[k], int(robot.scans_ns[0]))} after the first one, though it drove "
            "just before and after that: it may have moved meanwhile, and where to is a guess"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _set_down(robot: RobotEvidence, evidence: Evidence) -> Iterator[Reason]:
    """Times at which all that is seen becomes that of another place, though odometry goes on."""
    if robot.name in evidence.without_odometry:
        return
    for change in robot.changes:
        moved = _by_odometry(robot, np.array([[change.begin_ns, change.end_ns]]))[0, 0]
        if np.hypot(moved[0], moved[1]) > HOP_M or moved[2] > HOP_RAD:
            continue
        both = min(change.gone, change.new)
        limits = np.array([DENIED, SEEN_THROUGH, LEAST_DENIED])
        if (np.array([change.contradicted, both, change.least]) >= limits).all():
            text = (
                f"{robot.name}: {seconds(change.end_ns, int(robot.scans_ns[0]))} after its first "
                "scan it sees another place than just before, and what it saw does not come back, "
                "though its odometry hardly moved in between: it was set down elsewhere, or slid, "
                "and where to is a guess"
            )
            yield Reason("doubtful", "scans", robot.name, text)
            return


def _curved(robot: RobotEvidence) -> Iterator[Reason]:
    if robot.curved > CURVED:
        text = (
            f"{robot.name}: {100 * robot.curved:.0f} % of what it saw of walls is of curved ones; "
            "they are mapped as straight pieces, which move along with the robot: its path may be "
            "too short, or turned, by far more than is stated; front_end.name=none goes by "
            "odometry instead"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _distorted(robot: RobotEvidence) -> Iterator[Reason]:
    """Of the two causes of walls that are turned within scans, that which explains more."""
    sweep, spacing = robot.distortion
    doubtful = "the map may be wrong by far more than is stated"
    if _is_told(sweep) and sweep.share >= spacing.share:
        text = (
            f"{robot.name}: where it turns, the walls of a scan are turned against each other, as "
            f"by beams that are measured one after the other in {abs(sweep.value):.2f} s or more "
            f"and are taken as if otherwise: {doubtful}; set "
            "time_increment of the scans and leave logs.undistort on (or, if it is set though all "
            "beams are measured at once, --set logs.undistort=false); see docs/logs.md, Motion "
            "during a sweep"
        )
        yield Reason("doubtful", "scans", robot.name, text)
    elif _is_told(spacing):
        which = "farther apart" if spacing.value > 0 else "closer together"
        text = (
            f"{robot.name}: the walls on one side of its scans are turned against those on the "
            f"other, as by beams that are {100 * abs(spacing.value):.1f} % or more {which} than "
            f"angle_increment says: {doubtful}; are angle_min, angle_max and angle_increment those "
            "of this laser?"
        )
        yield Reason("doubtful", "scans", robot.name, text)


def _is_told(found: Distortion) -> bool:
    """Whether a distortion is beyond `DISTORTED`."""
    return all(np.array([found.sigmas, found.share, found.rms_rad]) > DISTORTED)


def _by_odometry(robot: RobotEvidence, times_ns: IntTable) -> Array:
    """How far, m and rad (n, k, 3), a robot moved between consecutive ones of times (n, k + 1)."""
    at = np.minimum(np.searchsorted(robot.readings_ns, times_ns), len(robot.readings_ns) - 1)
    return np.abs(between(robot.readings[at[:, :-1]], robot.readings[at[:, 1:]]))


def _is_elsewhere(robot: RobotEvidence, spans_ns: IntTable) -> BoolArray:
    """Whether the robot is not where odometry says after times (n, 2): by more than it slips."""
    begin = np.searchsorted(robot.stamps_ns, spans_ns[:, 0], side="right") - 1
    begin = np.maximum(begin, 0)
    end = np.minimum(np.searchsorted(robot.stamps_ns, spans_ns[:, 1]), len(robot.stamps_ns) - 1)
    moved = between(robot.final[begin], robot.final[end])
    off = np.abs(between(between(robot.by_odometry[begin], robot.by_odometry[end]), moved))
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) > MOVED_M) | (off[:, 2] > MOVED_RAD))


def _pause(robot: RobotEvidence, begin_ns: int, end_ns: int) -> tuple[int, int]:
    """The longest time without a scan between two times at which there is one, ns."""
    first, last = np.searchsorted(robot.scans_ns, [begin_ns, end_ns]).tolist()
    scans = robot.scans_ns[first : last + 1]
    if len(scans) < 2:
        return begin_ns, begin_ns
    k = int(np.argmax(np.diff(scans)))
    return int(scans[k]), int(scans[k + 1])
