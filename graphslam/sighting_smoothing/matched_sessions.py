"""Points sighted on several visits: which of them stand where they stood before.

Between two sessions of one place posts are moved, and since a known map was made. A point that all
sessions share has one place, and one that was moved drags the later paths, or its sightings pass
for noise. So each session is solved by itself, with points of its own. Distances between these tell
which points did not move (`multi_robot.common_points`); only those are one in the map.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, compose, transform
from graphslam.core.records import Association, Estimate, Start, Step, Trajectory
from graphslam.mapping.landmark_map import mean_landmarks
from graphslam.mapping.point_reassociation import is_point, retargeted
from graphslam.multi_robot.common_points import FLOOR_M, GATE, CommonPoints, common_points
from graphslam.multi_robot.frames import logged_identity
from graphslam.pipeline.log_pass import LogPass
from graphslam.sighting_smoothing.joint_landmarks import joint_covariance
from graphslam.sighting_smoothing.sensor_calibration import PassSettings
from graphslam.sighting_smoothing.sighting_noise import noise_of_pass
from graphslam.sighting_smoothing.sighting_states import at_states
from graphslam.sighting_smoothing.state_at_every_sighting import FineSolution, SightingProblem
from graphslam.sighting_smoothing.state_per_step import SteppedProblem, sighting_problem

#: m: points without names that are farther apart are not compared
REACH_M = 1.0
#: m, rad: sigmas of where a session starts, as long as it is solved by itself
HELD_M, HELD_RAD = 1e-3, 1e-4
#: points that are compared with each other; of more, these tell where the session is, and each of
#: the others is compared with where it was by itself
MOST_COMPARED = 200
#: doubt about a session
TWO_PLACES = (
    "nearly as many of the points that it shares with earlier sessions agree on another place"
)
#: associates the sightings of each session again: problem, steps, their estimate, points by session
Associate = Callable[
    [SightingProblem | SteppedProblem, tuple[Step, ...], Estimate, Sequence[set[int]]],
    tuple[tuple[Step, ...], Estimate],
]


def with_sessions_matched(
    one: LogPass, estimate: Estimate, associate: Associate | None = None
) -> Estimate | None:
    """An estimate in which sessions share the points that stand where they stood, and no others.

    Args:
        one: the pass; the steps, landmarks and counts follow, and moved points are noted.
        estimate: of its steps, all points shared.
        associate: associates sightings without names.

    Returns:
        None if there is but one session, and no known map, or they share no points, or all of
        those that have names are where they were.

    Raises:
        EstimationError: a session by itself is indeterminate.
    """
    sessions, before = _sessions(one), one.steps
    calibrations = {name: run.track.calibration for name, run in one.started.items()}
    split = _Split.of(one, estimate, sessions)
    if split is None:
        return None
    starts = {robot: s for step in one.steps for robot, s in step.starts.items()}
    apart, solved = _solved_apart(one, split, sessions, associate)
    found = _matched(one, apart, solved, sessions, split.former)
    if associate is None and all(found.into.get(n) == old for n, old in split.former.items()):
        one.steps = before  # all are what they were taken for
        for number in split.former:
            del one.landmarks.entries[number]
        for name, calibration in calibrations.items():
            one.runs[name].track.calibration = calibration
        _note_doubts(one, found.doubts)
        return None
    one.steps = [
        replace(step, starts={robot: starts[robot] for robot in step.starts})
        for step in _merged(one.steps, found.into)
    ]
    _update_map(one, split, found)
    landmarks = {**split.estimate.landmarks, **mean_landmarks(one.steps, found.states)}
    left = one.landmarks.entries.keys()
    return replace(
        estimate, states=found.states, landmarks={n: m for n, m in landmarks.items() if n in left}
    )


def _sessions(one: LogPass) -> list[set[str]]:
    """The robots of each session that is in the world, in the order of their times.

    A known map is the first session, which no robot is in any more.
    """
    before: list[set[str]] = [] if one.known.known_map is None else [set()]
    if not one.given_config.logs.same_place:
        return [*before, {*one.started}] if before else []
    robots: dict[str, set[str]] = {}
    first: dict[str, int] = {}
    for name, run in one.started.items():
        if one.frames.of[name] != one.frames.world:
            continue
        recording = str(one.log.recordings_of(name)[0].path)
        robots.setdefault(recording, set()).add(name)
        first[recording] = min(first.get(recording, run.track.first_ns), run.track.first_ns)
    return before + [robots[name] for name in sorted(robots, key=lambda name: first[name])]


@dataclass(frozen=True, slots=True, eq=False)
class _Split:
    """Steps in which no point is seen in two sessions, their estimate, and former numbers."""

    steps: tuple[Step, ...]
    estimate: Estimate
    former: dict[int, int]

    @classmethod
    def of(cls, one: LogPass, estimate: Estimate, sessions: Sequence[set[str]]) -> "_Split | None":
        """The steps of a pass; its map gets the new numbers. None if nothing is to be split."""
        session = {robot: k for k, robots in enumerate(sessions) for robot in robots}
        marks = estimate.landmarks
        seen: dict[int, dict[int, list[Association]]] = {}
        for a in (a for step in one.steps for a in step.associations):
            if is_point(a, marks) and a.robot in session:
                seen.setdefault(int(a.target), {}).setdefault(session[a.robot], []).append(a)
        targets: dict[int | None, int | str] = {}
        former: dict[int, int] = {}
        for number, by_session in seen.items():
            first = 0 if number in one.landmarks.known else 1  # the map has it already
            for k in sorted(by_session)[first:]:
                new = one.landmarks.next_number
                one.landmarks.split(number, new)
                if (name := logged_identity(one.landmarks.entries[number].identity)) is not None:
                    one.landmarks.entries[new].identity = _later_name(one, name, sessions[k])
                former[new] = number
                targets |= {a.source: new for a in by_session[k]}
        if not former:
            return None
        steps = retargeted(one.steps, targets)
        placed = mean_landmarks(steps, estimate.states)
        shared = {*former, *former.values()} & placed.keys()  # what only a map saw is there
        landmarks = {**marks, **{n: placed[n] for n in shared}}
        return cls(steps, replace(estimate, landmarks=landmarks), former)


def _later_name(one: LogPass, name: str, session: set[str]) -> str:
    """What a point is called that was moved before a session; in a map that goes on as it was."""
    if one.known.known_map is not None and one.given_config.known_map.update:
        return name
    return f"{min(session)}.{name}"


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """Sessions laid on each other: their states in the world.

    ``into``: point -> that of an earlier session that it is; ``moved``: point -> where it was.
    ``doubts``: robot -> why its session may lie elsewhere.
    """

    states: Mapping[str, Trajectory]
    into: Mapping[int, int]
    moved: Mapping[int, int]
    doubts: Mapping[str, str]


def _solved_apart(
    one: LogPass, split: _Split, sessions: Sequence[set[str]], associate: Associate | None
) -> tuple[Estimate, FineSolution]:
    """The estimate of each session by itself, where it starts; the steps of the pass follow.

    Also what was solved, with a state at every sighting perhaps.
    """
    held = np.diag([HELD_M**2, HELD_M**2, HELD_RAD**2])
    leaders = {min(robots) for robots in sessions if robots}

    def at_start(robot: str, start: Start) -> Start:
        if robot not in leaders:
            return start
        return Start(split.estimate.states[robot].poses[0], held)

    one.steps = [
        replace(step, starts={r: at_start(r, s) for r, s in step.starts.items()})
        for step in split.steps
    ]
    before, sources = PassSettings.of(one), one.sources
    problem, start = sighting_problem(one, split.estimate, noise_of_pass(one, split.estimate))
    steps = problem.steps
    if associate is not None:
        steps, start = associate(problem, steps, start, _points_of(steps, sessions))
    found = problem.solved_finely(steps, start)
    targets = {a.source: a.target for step in steps for a in step.associations}
    one.steps = list(retargeted(one.steps, targets))
    before.restore(one)
    one.sources = sources
    tracks = {name: run.track for name, run in one.started.items()}
    return at_states(found.estimate, one.steps, tracks), found


def _points_of(steps: Sequence[Step], sessions: Sequence[set[str]]) -> list[set[int]]:
    """The points that each session sees."""
    return [
        {
            int(a.target)
            for step in steps
            for a in step.associations
            if a.model == "point" and a.robot in robots
        }
        for robots in sessions
    ]


@dataclass(slots=True, eq=False)
class _Points:
    """Points ``at`` (2,) m by number, and what was ``solved``.

    ``origin``: the point that each was taken for; ``named``: those with a name.
    """

    at: dict[int, Array]
    origin: Mapping[int, int]
    named: frozenset[int]
    solved: FineSolution

    @classmethod
    def of(cls, one: LogPass, solved: FineSolution, former: Mapping[int, int]) -> "_Points":
        """Those of a pass whose sessions were solved by themselves."""
        entries, marks = one.landmarks.entries, solved.estimate.landmarks
        at = {n: mean for n, (mean, _) in marks.items() if entries[n].kind == "point"}
        named = frozenset(n for n in at if entries[n].identity is not None)
        return cls(at, {n: former.get(n, n) for n in at}, named, solved)

    def stacked(self, numbers: Sequence[int]) -> Array:
        """Points (n, 2)."""
        return np.array([self.at[n] for n in numbers]).reshape(-1, 2)

    def candidates(self, before: Sequence[int], now: Sequence[int]) -> list[tuple[int, int]]:
        """Points before and now that may be one: of one name, or near."""
        places = defaultdict[int, list[int]](list)
        for n in before:
            places[self.origin[n]].append(n)
        pairs = [(old, n) for n in now if n in self.named for old in places[self.origin[n]]]
        unnamed = [[n for n in some if n not in self.named] for some in (before, now)]
        near = _near(*map(self.stacked, unnamed))
        return pairs + [(unnamed[0][i], unnamed[1][j]) for i, j in near]

    def common(
        self, pairs: Sequence[tuple[int, int]]
    ) -> tuple[dict[int, int], CommonPoints | None]:
        """Point now -> point before, of those ``pairs`` that are where they were; how they lie.

        Where nothing tells, they are what they were taken for.
        """
        compared = pairs
        if len(pairs) > MOST_COMPARED:
            some = np.linspace(0, len(pairs) - 1, MOST_COMPARED).astype(np.int64)
            compared = [pairs[k] for k in some.tolist()]
        numbers = sorted({n for pair in compared for n in pair})
        place = {n: 2 * k for k, n in enumerate(numbers)}
        A = np.zeros((2 * len(compared), 2 * len(numbers)))
        for k, pair in enumerate(compared):
            for n, sign in zip(pair, (1.0, -1.0), strict=True):
                A[2 * k : 2 * k + 2, place[n] : place[n] + 2] = sign * np.eye(2)
        cov = A @ joint_covariance(self.solved, numbers) @ A.T if numbers else np.zeros((0, 0))
        before, now = (self.stacked([pair[k] for pair in compared]) for k in (0, 1))
        found = common_points(before, now, cov)
        if found is None:
            return {new: old for old, new in pairs if self.origin[old] == self.origin[new]}, None
        same = {compared[k][1]: compared[k][0] for k in found.which.tolist()}
        return same | self._rest(pairs, found.pose, compared, same), found

    def _rest(
        self,
        pairs: Sequence[tuple[int, int]],
        pose: Array,
        compared: Sequence[tuple[int, int]],
        same: Mapping[int, int],
    ) -> dict[int, int]:
        """`common` of the ``pairs`` that were not compared with each other."""
        done, taken = {n for _, n in compared}, {*same.values()}
        marks, found = self.solved.estimate.landmarks, dict[int, int]()
        for old, new in pairs:
            if new in done or new in found or old in taken:
                continue
            off = self.at[old] - transform(pose, self.at[new])
            cov = marks[old][1] + marks[new][1] + FLOOR_M**2 * np.eye(2)
            if mahalanobis_squared(off, cov) <= GATE:
                found[new] = old
                taken.add(old)
        return found


def _near(before: Array, now: Array) -> list[tuple[int, int]]:
    """Indices of points (n, 2) and (m, 2) that are within `REACH_M` of each other."""
    if not (len(before) and len(now)):
        return []
    found = cKDTree(now).query_ball_tree(cKDTree(before), REACH_M)
    return [(i, j) for j, own in enumerate(found) for i in own]


def _matched(
    one: LogPass,
    apart: Estimate,
    solved: FineSolution,
    sessions: Sequence[set[str]],
    former: Mapping[int, int],
) -> _Matched:
    """The sessions, one after another, laid on those before by the points that did not move."""
    points = _Points.of(one, solved, former)
    seen = [sorted(own & points.at.keys()) for own in _points_of(one.steps, sessions)]
    seen[0] = sorted({*seen[0], *(one.landmarks.known.keys() & points.at.keys())})
    states, known = dict(apart.states), list(seen[0])
    into, moved, doubts = dict[int, int](), dict[int, int](), dict[str, str]()
    for robots, now in zip(sessions[1:], seen[1:], strict=True):
        same, found = points.common(points.candidates(known, now))
        if found is not None:
            for name in robots:
                states[name] = replace(states[name], poses=compose(found.pose, states[name].poses))
            points.at |= {n: transform(found.pose, points.at[n]) for n in now}
            gone, new = {*known} - {*same.values()}, {*now} - {*same}
            moved |= _moved(points, sorted(gone), sorted(new))
            if found.is_open:
                doubts |= dict.fromkeys(robots, TWO_PLACES)
        into |= same
        known += [n for n in now if n not in same]
    return _Matched(states, into, moved, doubts)


def _moved(points: _Points, before: Sequence[int], now: Sequence[int]) -> dict[int, int]:
    """Points ``now`` -> those ``before`` that they probably were: the nearest, each once."""
    pairs = points.candidates(before, now)
    apart = [float(np.hypot(*(points.at[new] - points.at[old]))) for old, new in pairs]
    found, taken = dict[int, int](), set[int]()
    for k in np.argsort(apart, kind="stable").tolist():
        old, new = pairs[k]
        if new not in found and old not in taken:
            found[new] = old
            taken.add(old)
    return found


def _merged(steps: Sequence[Step], into: Mapping[int, int]) -> tuple[Step, ...]:
    """Steps in which points are those of earlier sessions; ``into``: see `_Matched`."""
    seen = (a for step in steps for a in step.associations)
    targets = {a.source: into.get(a.target, a.target) for a in seen if isinstance(a.target, int)}
    return retargeted(steps, targets)


def _update_map(one: LogPass, split: _Split, found: _Matched) -> None:
    """Have the map follow the steps: points that are one are, others count what they are seen."""
    entries = one.landmarks.entries
    seen: dict[int, list[Association]] = {}
    for a in (a for step in one.steps for a in step.associations):
        if isinstance(a.target, int) and a.model == "point":
            seen.setdefault(a.target, []).append(a)
    for number in [n for n in entries if n in split.estimate.landmarks and n not in seen]:
        if entries[number].kind == "point" and number not in one.landmarks.known:
            del entries[number]
    for number, own in seen.items():
        one.landmarks.recount(number, own)
        entry, robots = entries[number], {a.robot for a in own}
        entry.path_m = {r: far for r, far in entry.path_m.items() if r in robots}
    one.moved = {**one.moved, **found.moved}
    if found.moved:
        one.counts["landmarks_moved"] += len(found.moved)
    _note_doubts(one, found.doubts)


def _note_doubts(one: LogPass, doubts: Mapping[str, str]) -> None:
    """Have the verdict tell doubts, robot -> text, about where sessions lie."""
    if doubts and one.known.known_map is not None:
        one.map_doubt = "; ".join(filter(None, (one.map_doubt, *dict.fromkeys(doubts.values()))))
    elif doubts:
        frames = one.known.frame_assignment
        doubted = replace(frames, remarks={**frames.remarks, **doubts})
        one.known = replace(one.known, frame_assignment=doubted)
