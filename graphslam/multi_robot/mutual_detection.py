"""Robots of unknown start, found in another one's scans by the way they move.

After every robot has been estimated by itself, for each observer and each robot of known outline:

1. `detection_hypotheses` proposes where the robot began. Each hypothesis predicts where the robot
   is in every scan; there its outline is fitted, as `robot_detection` does. Scans in which it
   should be visible and is not, because beams passed through or something else stands there,
   contradict the hypothesis.
2. The start and the offset of the robot's clock follow from all its detections
   (`track_registration`).
3. It is accepted if it has many detections and hardly any contradictions, if its motion is
   distinctive (not straight at constant speed), if no other hypothesis has half as much support,
   and if its detections do not fit another robot as well.

False detections: in ten minutes of a real building with people in it, searched for robots of three
outlines that were never there, the best hypothesis had 7 detections; `multi_robot.min_detections`
is 12. What may still deceive moves like the robot: against that are the outline, contradictions,
rivals and the shape of the motion itself.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.config import Config
from graphslam.core.consistency import RIVAL_SHARE, has_rival, poses_differ
from graphslam.core.geometry import Array, between, compose, path_length, wrap
from graphslam.core.records import Scan, Sighting
from graphslam.multi_robot.detection_hypotheses import (
    PredictedPath,
    ScanSequence,
    StartHypothesis,
    candidate_detections,
    scans_by_robot,
    scans_with_robot_away,
    start_hypotheses,
)
from graphslam.multi_robot.relative_frames import (
    MAX_HEADING_SIGMA_RAD,
    RelativeFrame,
    RobotEstimate,
    evenly_spaced,
)
from graphslam.multi_robot.robot_detection import (
    MAX_POSITION_SIGMA_M,
    ExpectedPose,
    detect_robots,
)
from graphslam.multi_robot.track_registration import FittedStart, fit_start
from graphslam.odometry.preintegration import Track
from graphslam.perception.ordered_scan import Sweep
from graphslam.perception.robot_outlines import MIN_RETURNS, expected_ranges, outline_radius

#: share of the scans in which the robot should be visible that must have a detection
MIN_DETECTION_RATE = 0.6
#: hypotheses that are evaluated; scans searched for those in which a robot should be visible; scans
#: in which its outline is fitted: bound the run time
MAX_EVALUATED, MAX_SEARCHED, MAX_FITTED = 8, 1000, 100
#: scans after which a hypothesis is given up that has the robot in less than half as many as it
#: should
FIRST_SCANS = 12
#: share of the angle that an outline takes in which its beams must meet it
VISIBLE_SHARE = 0.8
#: m: what is so much nearer hides it; share of these beams that may be hidden
HIDDEN_M, MAX_HIDDEN_SHARE = 0.3, 0.2
#: rad: sigma of a predicted heading, beyond that of the hypothesis
HEADING_SIGMA_RAD = 0.1


class ScanBuffer:
    """Scans in which robots are searched for after a pass over the log.

    One for every ``sampling_m`` that another robot of known outline drove: a robot that stands adds
    nothing.
    """

    def __init__(
        self, tracks: Mapping[str, Track], outlines: Mapping[str, Array], sampling_m: float
    ) -> None:
        """An empty buffer; ``outlines``: robot -> corners (k, 2), m."""
        self.scans: list[Scan] = []
        self._tracks, self._outlines, self._sampling_m = tracks, outlines, sampling_m
        self._last: dict[str, dict[str, int]] = defaultdict(dict)

    def add(self, scan: Scan) -> None:
        """Keep the next scan of a log if it is needed."""
        last = self._last[scan.robot]
        others = [name for name in self._outlines if name != scan.robot and self._tracks[name]]
        if any(
            name not in last
            or self._tracks[name].moved(last[name], scan.time_ns)[0] >= self._sampling_m
            for name in others
        ):
            last.update(dict.fromkeys(others, scan.time_ns))
            self.scans.append(scan)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionCandidate:
    """A start hypothesis after its outline was fitted in the scans.

    ``relation`` of the robot to its observer, its weight the number of detections; ``rate``: share
    of the scans in which the robot should be visible that have one; ``support``: scans with a
    detection less those without, scaled to all scans in which it should be visible;
    ``path_residual_m``: root mean square distance of its path from a straight one at constant
    speed. ``positions``: scan's time -> (2,) in the observer's frame; ``sightings`` in order of
    time; ``clock_offset_s``, ``heading_sigma``: see `FittedStart`.
    """

    relation: RelativeFrame
    support: float
    rate: float
    path_residual_m: float
    positions: Mapping[int, Array]
    sightings: Sequence[Sighting]
    clock_offset_s: float
    heading_sigma: float

    def is_accepted(self, config: Config) -> bool:
        """Whether it is the robot as far as its own detections show."""
        return (
            self.relation.weight >= config.multi_robot.min_detections
            and self.rate >= MIN_DETECTION_RATE
            and self.path_residual_m >= config.multi_robot.min_path_residual_m
            and self.heading_sigma <= MAX_HEADING_SIGMA_RAD
        )

    def differs(self, other: "DetectionCandidate") -> bool:
        """Whether the starts of two hypotheses are not the same."""
        one, two = self.relation, other.relation
        return poses_differ(one.pose, one.cov, two.pose, two.cov)


@dataclass(frozen=True, slots=True, eq=False)
class MutualDetections:
    """Relations found by robots in scans, and robot -> why it is not related."""

    relations: tuple[RelativeFrame, ...]
    undecided: Mapping[str, str]


def find_robots_in_scans(
    estimates: Mapping[str, RobotEstimate],
    scans: Sequence[Scan],
    outlines: Mapping[str, Array],
    placed: Sequence[str],
    clock_sigma_s: float,
    config: Config,
) -> MutualDetections:
    """Find robots in scans of others, wherever they began.

    Args:
        estimates: of each robot by itself.
        scans: of any robots, in which others may be visible.
        outlines: robot -> corners (k, 2), m, base frame.
        placed: robots whose start is known. They are looked for as well, for they may be mistaken
            for another one.
        clock_sigma_s: sigma of the offset of two robots' clocks.
        config: settings.
    """
    relations: list[RelativeFrame] = []
    undecided: dict[str, str] = {}
    for observer, own in scans_by_robot(scans).items():
        others = [name for name in outlines if name in estimates and name != observer]
        if observer not in estimates or {observer, *others} <= set(placed):
            continue
        watch = ScanSequence.of(estimates[observer], own, config.front_end.max_range_m)
        found: dict[str, DetectionCandidate] = {}
        for name in others:
            search = _RobotSearch(
                observer, name, watch, estimates[name], outlines[name], clock_sigma_s, config
            )
            result = search.find()
            if isinstance(result, DetectionCandidate):
                found[name] = result
            elif result:
                undecided[name] = result
        for name, one in found.items():
            near_m = outline_radius(outlines[name])
            rivals = [n for n in found if n != name and _is_same_object(one, found[n], near_m)]
            if rivals:
                undecided[name] = f"what {observer} saw may be {' or '.join([name, *rivals])}"
            elif not {name, observer} <= set(placed):
                relations.append(one.relation)
    return MutualDetections(tuple(relations), undecided)


def _is_same_object(one: DetectionCandidate, other: DetectionCandidate, near_m: float) -> bool:
    """Whether detections of a robot are as well those of another, which has about as many."""
    shared = sum(
        bool(np.hypot(*(position - other.positions[time_ns])) < near_m)
        for time_ns, position in one.positions.items()
        if time_ns in other.positions
    )
    alike = has_rival(min(len(one.positions), len(other.positions)), [shared])
    return alike and has_rival(one.support, [other.support])


class _RobotSearch:
    """The search of one observer for one robot."""

    def __init__(
        self,
        observer: str,
        name: str,
        watch: ScanSequence,
        estimate: RobotEstimate,
        outline: Array,
        clock_sigma_s: float,
        config: Config,
    ) -> None:
        self.observer, self.name, self.estimate = observer, name, estimate
        self.outline, self.clock_sigma_s, self.config = outline, clock_sigma_s, config
        poses, _ = estimate.at(watch.times_ns)
        edge_ns = round(1e9 * clock_sigma_s)
        covered = (watch.times_ns > estimate.track.first_ns - edge_ns) & (
            watch.times_ns < estimate.track.last_ns + edge_ns
        )
        # the robot has moved since the scan before
        samples = np.floor(path_length(poses) / config.multi_robot.sampling_m)
        _, first = np.unique(samples, return_index=True)
        self.watch = watch.subset(np.intersect1d(first, np.flatnonzero(covered)))

    def find(self) -> DetectionCandidate | str:
        """Where it began, or why that is unknown ("" if nothing like it was seen)."""
        fewest = self.config.multi_robot.min_detections
        if len(self.watch.scans) < fewest:
            return ""
        path = PredictedPath.of(self.estimate, self.watch.times_ns, self.clock_sigma_s)
        seen = candidate_detections(self.watch, path, self.outline)
        evaluated: list[DetectionCandidate] = []
        best_score = 0.0
        for hypothesis in start_hypotheses(self.watch, path, self.outline, seen)[:MAX_EVALUATED]:
            if hypothesis.score < RIVAL_SHARE * best_score:
                continue  # too little support for a rival
            candidate = self._evaluate(hypothesis)
            if candidate is not None:
                evaluated.append(candidate)
            if evaluated and evaluated[-1].is_accepted(self.config):
                best_score = max(best_score, hypothesis.score)
        frequent = [
            c for c in evaluated if c.rate >= MIN_DETECTION_RATE and len(c.sightings) >= fewest
        ]
        if not frequent:
            return ""
        accepted = [c for c in frequent if c.is_accepted(self.config)]
        if not accepted:
            return (
                f"what {self.observer} saw in its scans moved too simply to be recognised as "
                f"{self.name}"
            )
        enough = RIVAL_SHARE * max(c.support for c in accepted)
        # of about equals, the one with least drift of both robots determines the start best
        best = min(
            (c for c in accepted if c.support >= enough), key=lambda c: float(c.relation.cov[2, 2])
        )
        best = self._merge(best, [c for c in accepted if c is not best and not best.differs(c)])
        if has_rival(best.support, [c.support for c in evaluated if best.differs(c)]):
            return f"what {self.observer} saw in its scans may be {self.name} in two ways"
        return best

    def _fit_start(
        self, pose: Array, clock_offset_s: float, sightings: Sequence[Sighting]
    ) -> FittedStart | None:
        observer = self.watch.estimate
        return fit_start(
            pose, clock_offset_s, sightings, observer, self.estimate, self.clock_sigma_s
        )

    def _merge(
        self, best: DetectionCandidate, same: Sequence[DetectionCandidate]
    ) -> DetectionCandidate:
        """One hypothesis from the detections of all that agree, extended from other stretches."""
        if not same:
            return best
        by_time = {s.time_ns: s for candidate in (*same, best) for s in candidate.sightings}
        sightings = [by_time[time_ns] for time_ns in sorted(by_time)]
        start = self._fit_start(best.relation.pose, best.clock_offset_s, sightings)
        if start is None or len(start.used) < best.relation.weight:
            return best
        weight = float(len(start.used))
        relation = RelativeFrame(self.name, self.observer, start.pose, start.cov, weight)
        positions = {t: at for candidate in (*same, best) for t, at in candidate.positions.items()}
        support = max(best.support, weight)
        return replace(best, relation=relation, support=support, positions=positions)

    def _evaluate(self, hypothesis: StartHypothesis) -> DetectionCandidate | None:
        """The outline fitted in every scan where a hypothesis predicts it, and the start by that.

        None if too few scans have it.
        """
        watch = self.watch
        own, _ = self.estimate.at(watch.times_ns + round(1e9 * hypothesis.clock_offset_s))
        poses = between(watch.poses, compose(hypothesis.pose, own))
        known = np.flatnonzero(hypothesis.spread < MAX_POSITION_SIGMA_M**2)
        visible = np.array(
            [
                k
                for k in evenly_spaced(known, MAX_SEARCHED)
                if is_visible(
                    watch.sweeps[k], self.outline, between(watch.scans[k].mount, poses[k])
                )
            ],
            dtype=np.int64,
        )
        fitted = evenly_spaced(visible, MAX_FITTED)
        sightings: list[Sighting] = []
        numbers: list[int] = []
        heading_var = hypothesis.heading_sigma**2 + HEADING_SIGMA_RAD**2
        for n, k in enumerate(_some_first(fitted)):
            if n == FIRST_SCANS and len(sightings) < MIN_DETECTION_RATE / 2 * FIRST_SCANS:
                return None
            variance = hypothesis.spread[k] + MAX_POSITION_SIGMA_M**2 / 9
            earlier = [
                (watch.sweeps[j], between(watch.lasers[j], watch.lasers[k]))
                for j in scans_with_robot_away(own, k, 2 * outline_radius(self.outline))
            ]
            found = detect_robots(
                watch.scans[k],
                {self.name: ExpectedPose(poses[k], np.diag([variance, variance, heading_var]))},
                {self.name: self.outline},
                self.config.front_end,
                {self.name: earlier},
            )
            sightings += found.sightings
            numbers += [k] * len(found.sightings)
        order = np.argsort(numbers, kind="stable")
        numbers, sightings = [numbers[k] for k in order], [sightings[k] for k in order]
        start = self._fit_start(hypothesis.pose, hypothesis.clock_offset_s, sightings)
        if start is None:
            return None
        used = np.array(numbers)[start.used]
        q, times = own[used], watch.times_ns[used]
        positions = compose(start.pose, q)[:, :2]
        return DetectionCandidate(
            RelativeFrame(self.name, self.observer, start.pose, start.cov, float(len(used))),
            (len(used) + len(sightings) - len(fitted)) * len(visible) / len(fitted),
            len(sightings) / len(fitted),
            _straight_line_residual(q[:, :2], times),
            dict(zip(times.tolist(), positions, strict=True)),
            [sightings[k] for k in start.used],
            start.clock_offset_s,
            start.heading_sigma,
        )


def is_visible(sweep: Sweep, outline: Array, pose: Array) -> bool:
    """Whether a robot at ``pose`` (3,), laser frame, would be seen: nothing nearer hides it.

    Beams of unknown range count as hidden.
    """
    if not len(sweep.angles):
        return False
    h, edges = expected_ranges(outline, pose[None], sweep.angles)
    right, left = edges[0]
    off = np.abs(wrap(sweep.angles - (right + left) / 2))
    beams = np.flatnonzero(off < VISIBLE_SHARE * (left - right) / 2)
    if len(beams) < MIN_RETURNS:
        return False
    with np.errstate(invalid="ignore"):
        free = sweep.ranges[beams] > h[0, beams] - HIDDEN_M
    return bool(np.mean(free) >= 1 - MAX_HIDDEN_SHARE)


def _some_first(numbers: IntArray) -> IntArray:
    """``numbers``, those of `FIRST_SCANS` first that are evenly spread over all."""
    if len(numbers) <= FIRST_SCANS:
        return numbers
    first = np.linspace(0, len(numbers) - 1, FIRST_SCANS).round().astype(np.int64)
    return np.concatenate([numbers[first], np.delete(numbers, first)])


def _straight_line_residual(q: Array, times_ns: IntArray) -> float:
    """Root mean square distance of points (n, 2) from a straight path at constant speed, m."""
    t = 1e-9 * (times_ns - times_ns[0])
    A = np.column_stack([np.ones_like(t), t])
    off = q - A @ np.linalg.lstsq(A, q, rcond=None)[0]
    return float(np.sqrt(np.mean((off**2).sum(axis=1))))
