"""Robots whose start is unknown, found in another's scans by the way they move.

After every robot has been estimated by itself, for each observer and each robot of known outline:

1. `supposing` has places where the robot may have begun. Each says where the robot is in every
   scan; there its outline is fitted, as `watching` does. Where it should show and does not, because
   beams went through or something else stands there, the place is contradicted.
2. Where the robot began, and how far its clock is ahead, follow from all its sightings
   (`registering`).
3. It is believed if its sightings are many, hardly contradicted, of a motion that is its own (not
   straight at one speed, as anybody's), if no other place explains half as much, and if they are
   not as well those of another robot.

Odds of chance: in ten minutes of a real building with people in it, searched for robots of three
outlines that were never there, the best place had 7 sightings; `FEWEST_SEEN` are asked for. What is
left to be afraid of moves like the robot: for that are the outline, contradictions, rivals and the
shape of the motion itself.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.config import FrontEndConfig
from graphslam.core.consistency import poses_differ
from graphslam.core.geometry import Array, between, compose, path_length, wrap
from graphslam.core.records import Scan, Sighting
from graphslam.multi_robot.detection_hypotheses import (
    SURE_M,
    Path,
    ScanSequence,
    StartHypothesis,
    candidate_detections,
    scans_by_robot,
    scans_with_robot_away,
    start_hypotheses,
)
from graphslam.multi_robot.relative_frames import (
    MAX_TURN_SIGMA_RAD,
    RIVAL,
    RelativeFrame,
    RobotEstimate,
)
from graphslam.multi_robot.robot_detection import ExpectedPose, detect_robots
from graphslam.multi_robot.track_registration import fit_start
from graphslam.odometry.preintegration import Track
from graphslam.odometry.readings import IntArray
from graphslam.perception.ordered_scan import Sweep
from graphslam.perception.robot_outlines import MIN_RETURNS, expected_ranges, outline_radius

#: m: a scan is kept once a robot drove so far since the last one
APART_M = 0.1
#: sightings at least, and share of the scans where the robot should show that have one
FEWEST_SEEN, SHARE_SEEN = 12, 0.6
#: m: what drives straight at one speed is nowhere as far from the robot's path, root mean square
OWN_M = 0.25
#: places that are looked at closely; scans searched for those where a robot should show; scans in
#: which its outline is fitted
LOOKED, SEARCHED, FITTED = 8, 1000, 100
#: scans after which a place is given up that has the robot in less than half of `SHARE_SEEN`
SOME = 12
#: of the angle that an outline takes, where its beams must meet it; m: what is so much nearer hides
#: it; of these beams, hidden at most
WITHIN, HIDDEN_M, HIDDEN = 0.8, 0.3, 0.2
#: rad: sigma of a heading by a place, beyond what its turn has
HEADING_RAD = 0.1


class ScanBuffer:
    """Scans in which robots are to be looked for when a pass is over.

    One for every `APART_M` that another robot of known outline drove: a robot that stands tells
    nothing new.
    """

    def __init__(self, tracks: Mapping[str, Track], outlines: Mapping[str, Array]) -> None:
        """Nothing kept yet; ``outlines``: robot -> corners (k, 2), m."""
        self.scans: list[Scan] = []
        self._tracks, self._outlines = tracks, outlines
        self._last: dict[str, dict[str, int]] = defaultdict(dict)

    def add(self, scan: Scan) -> None:
        """Take in the next scan of a log."""
        last = self._last[scan.robot]
        others = [name for name in self._outlines if name != scan.robot and self._tracks[name]]
        if any(
            name not in last or self._tracks[name].moved(last[name], scan.time_ns)[0] >= APART_M
            for name in others
        ):
            last.update(dict.fromkeys(others, scan.time_ns))
            self.scans.append(scan)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionCandidate:
    """A place after a close look.

    ``relation`` of the robot to its observer, weighed by the number of sightings; ``seen`` share of
    scans with a sighting among those where the robot should show; ``support`` those with one less
    those without, if all of these scans had been looked at; ``own_m`` how far its path is from one
    that goes straight at one speed. ``at``: scan's time -> where it was seen (2,), in the
    observer's frame; ``sightings`` in order of time; ``late_s``, ``turn_sigma``: see
    `registering.Began`.
    """

    relation: RelativeFrame
    support: float
    seen: float
    own_m: float
    at: Mapping[int, Array]
    sightings: Sequence[Sighting]
    late_s: float
    turn_sigma: float

    @property
    def is_accepted(self) -> bool:
        """Whether it is the robot as far as its own sightings tell."""
        return (
            self.relation.weight >= FEWEST_SEEN
            and self.seen >= SHARE_SEEN
            and self.own_m >= OWN_M
            and self.turn_sigma <= MAX_TURN_SIGMA_RAD
        )

    def differs(self, other: "DetectionCandidate") -> bool:
        """Whether two places are not one."""
        one, two = self.relation, other.relation
        return poses_differ(one.pose, one.cov, two.pose, two.cov)


@dataclass(frozen=True, slots=True, eq=False)
class MutualDetections:
    """What looking for robots in scans told: relations, and robot -> why it is not related."""

    relations: tuple[RelativeFrame, ...]
    undecided: Mapping[str, str]


def find_robots_in_scans(
    views: Mapping[str, RobotEstimate],
    scans: Sequence[Scan],
    outlines: Mapping[str, Array],
    placed: Sequence[str],
    doubt_s: float,
    config: FrontEndConfig,
) -> MutualDetections:
    """Find robots in scans of others, wherever they began.

    Args:
        views: what each robot knows by itself.
        scans: of any robots, in which others may show.
        outlines: robot -> corners (k, 2), m, base frame.
        placed: robots whose start is known. They are looked for as well, for they may be taken for
            another one.
        doubt_s: sigma of the difference of two robots' clocks.
        config: of the front end.
    """
    relations: list[RelativeFrame] = []
    undecided: dict[str, str] = {}
    for observer, own in scans_by_robot(scans).items():
        others = [name for name in outlines if name in views and name != observer]
        if observer not in views or {observer, *others} <= set(placed):
            continue
        watch = ScanSequence.of(views[observer], own, config.max_range_m)
        found: dict[str, DetectionCandidate] = {}
        for name in others:
            look = _RobotSearch(observer, name, watch, views[name], outlines[name], doubt_s, config)
            one = look.found()
            if isinstance(one, DetectionCandidate):
                found[name] = one
            elif one:
                undecided[name] = one
        for name, one in found.items():
            rivals = [
                n
                for n in found
                if n != name and _is_same_object(one, found[n], outline_radius(outlines[name]))
            ]
            if rivals:
                undecided[name] = f"what {observer} saw may be {' or '.join([name, *rivals])}"
            elif not {name, observer} <= set(placed):
                relations.append(one.relation)
    return MutualDetections(tuple(relations), undecided)


def _is_same_object(one: DetectionCandidate, other: DetectionCandidate, near_m: float) -> bool:
    """Whether sightings of a robot are as well those of another, seen as often or nearly so."""
    shared = sum(
        bool(np.hypot(*(at - other.at[time_ns])) < near_m)
        for time_ns, at in one.at.items()
        if time_ns in other.at
    )
    alike = shared > RIVAL * min(len(one.at), len(other.at))
    return alike and other.support > RIVAL * one.support


class _RobotSearch:
    """One observer looks for one robot."""

    def __init__(
        self,
        observer: str,
        name: str,
        watch: ScanSequence,
        view: RobotEstimate,
        outline: Array,
        doubt_s: float,
        config: FrontEndConfig,
    ) -> None:
        self.observer, self.name, self.view = observer, name, view
        self.outline, self.doubt_s, self.config = outline, doubt_s, config
        there, _ = view.at(watch.times_ns)
        way = path_length(there)
        edge_ns = round(1e9 * doubt_s)
        known = (watch.times_ns > view.track.first_ns - edge_ns) & (
            watch.times_ns < view.track.last_ns + edge_ns
        )
        # the robot has moved since the scan before
        _, first = np.unique(np.floor(way / APART_M), return_index=True)
        self.watch = watch.some(np.intersect1d(first, np.flatnonzero(known)))

    def found(self) -> DetectionCandidate | str:
        """Where it began, or why that is not known ("" if nothing like it was seen)."""
        if len(self.watch.scans) < FEWEST_SEEN:
            return ""
        path = Path.of(self.view, self.watch.times_ns, self.doubt_s)
        seen = candidate_detections(self.watch, path, self.outline)
        looked: list[DetectionCandidate] = []
        most = 0.0
        for place in start_hypotheses(self.watch, path, self.outline, seen)[:LOOKED]:
            # what has not half as much to confirm it is no rival
            if place.score >= RIVAL * most:
                looked += [found for found in [self._close(place)] if found]
                if looked and looked[-1].is_accepted:
                    most = max(most, place.score)
        seen_well = [f for f in looked if f.seen >= SHARE_SEEN and len(f.sightings) >= FEWEST_SEEN]
        if not seen_well:
            return ""
        what = f"what {self.observer} saw in its scans"
        accepted = [f for f in seen_well if f.is_accepted]
        if not accepted:
            return f"{what} moved too simply to be known as {self.name}"
        enough = RIVAL * max(f.support for f in accepted)
        # of equals the one to which both drifted least says best where the robot began
        best = min(
            (f for f in accepted if f.support >= enough), key=lambda f: float(f.relation.cov[2, 2])
        )
        best = self._united(best, [f for f in accepted if f is not best and not best.differs(f)])
        if any(f.support > RIVAL * best.support and best.differs(f) for f in looked):
            return f"{what} may be {self.name} in two ways"
        return best

    def _united(
        self, best: DetectionCandidate, same: Sequence[DetectionCandidate]
    ) -> DetectionCandidate:
        """One place that was followed from several stretches: from all their sightings."""
        if not same:
            return best
        every = {s.time_ns: s for found in (*same, best) for s in found.sightings}
        sightings = [every[time_ns] for time_ns in sorted(every)]
        pose, late_s = best.relation.pose, best.late_s
        began = fit_start(pose, late_s, sightings, self.watch.view, self.view, self.doubt_s)
        if began is None or len(began.used) < best.relation.weight:
            return best
        weight = float(len(began.used))
        relation = RelativeFrame(self.name, self.observer, began.pose, began.cov, weight)
        at = {time_ns: at for found in (*same, best) for time_ns, at in found.at.items()}
        return replace(best, relation=relation, support=max(best.support, weight), at=at)

    def _close(self, place: StartHypothesis) -> DetectionCandidate | None:
        """The outline fitted in every scan where a place has it, and what follows from that."""
        watch = self.watch
        there, _ = self.view.at(watch.times_ns + round(1e9 * place.shift_s))
        poses = between(watch.poses, compose(place.pose, there))
        known = np.flatnonzero(place.spread < SURE_M**2)
        shown = np.array(
            [
                k
                for k in _evenly(known, SEARCHED)
                if is_visible(
                    watch.sweeps[k], self.outline, between(watch.scans[k].mount, poses[k])
                )
            ],
            dtype=np.int64,
        )
        fitted = _evenly(shown, FITTED)
        sightings: list[Sighting] = []
        numbers: list[int] = []
        turned = place.turn_sigma**2 + HEADING_RAD**2
        for n, k in enumerate(_first_some(fitted)):
            if n == SOME and len(sightings) < SHARE_SEEN / 2 * SOME:
                return None
            cov = np.diag([place.spread[k] + SURE_M**2 / 9] * 2 + [turned])
            before = [
                (watch.sweeps[j], between(watch.lasers[j], watch.lasers[k]))
                for j in scans_with_robot_away(there, k, 2 * outline_radius(self.outline))
            ]
            found = detect_robots(
                watch.scans[k],
                {self.name: ExpectedPose(poses[k], cov)},
                {self.name: self.outline},
                self.config,
                {self.name: before},
            )
            sightings += found.sightings
            numbers += [k] * len(found.sightings)
        order = np.argsort(numbers, kind="stable")
        numbers, sightings = [numbers[k] for k in order], [sightings[k] for k in order]
        began = fit_start(place.pose, place.shift_s, sightings, watch.view, self.view, self.doubt_s)
        if began is None:
            return None
        used = np.array(numbers)[began.used]
        share = len(sightings) / len(fitted)
        q, t = there[used], watch.times_ns[used]
        at = compose(began.pose, q)[:, :2]
        return DetectionCandidate(
            RelativeFrame(self.name, self.observer, began.pose, began.cov, float(len(used))),
            (len(used) + len(sightings) - len(fitted)) * len(shown) / len(fitted),
            share,
            _straight_line_residual(q[:, :2], t),
            dict(zip(t.tolist(), at, strict=True)),
            [sightings[k] for k in began.used],
            began.late_s,
            began.turn_sigma,
        )


def is_visible(sweep: Sweep, outline: Array, pose: Array) -> bool:
    """Whether a robot at ``pose`` (3,), laser frame, would be seen: nothing nearer hides it.

    Beams without a return do not tell.
    """
    if not len(sweep.angles):
        return False
    h, edges = expected_ranges(outline, pose[None], sweep.angles)
    right, left = edges[0]
    off = np.abs(wrap(sweep.angles - (right + left) / 2))
    beams = np.flatnonzero(off < WITHIN * (left - right) / 2)
    if len(beams) < MIN_RETURNS:
        return False
    with np.errstate(invalid="ignore"):
        free = sweep.ranges[beams] > h[0, beams] - HIDDEN_M
    return bool(np.mean(free) >= 1 - HIDDEN)


def _first_some(numbers: IntArray) -> IntArray:
    """``numbers``, first `SOME` of them that are spread over all."""
    if len(numbers) <= SOME:
        return numbers
    first = np.linspace(0, len(numbers) - 1, SOME).round().astype(np.int64)
    return np.concatenate([numbers[first], np.delete(numbers, first)])


def _evenly(numbers: IntArray, most: int) -> IntArray:
    """So many of ``numbers`` at most, evenly."""
    if len(numbers) <= most:
        return numbers
    return numbers[np.linspace(0, len(numbers) - 1, most).round().astype(np.int64)]


def _straight_line_residual(q: Array, times_ns: IntArray) -> float:
    """How far points (n, 2) are from going straight at one speed, root mean square, m."""
    t = 1e-9 * (times_ns - times_ns[0])
    A = np.column_stack([np.ones_like(t), t])
    off = q - A @ np.linalg.lstsq(A, q, rcond=None)[0]
    return float(np.sqrt(np.mean((off**2).sum(axis=1))))
