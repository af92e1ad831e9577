"""Where the sessions of a place begin relative to each other.

Each session has been tracked by itself. Sessions whose relative starts are known are a group with
one map; at first each is alone. One group is put into the map of another like a log into a known
map (`localisation`): the relative pose of the two is a hypothesis that lays all drives of one into
the map of the other. Most of their places must confirm it, few contradict it, and it may have no
rival. What was moved between two sessions costs a few places; a corridor that is taken for another
one is contradicted all over the building. More may have been moved where nearly all places are
recognised and nothing else explains any: that all is of one place was said. Groups grow, and
what was refused with less in common is tried again (`next_pair`). A group that is refused in the
end has a frame of its own.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.core.frame_forest import PRIOR_INFLATION
from graphslam.core.geometry import (
    Array,
    between,
    compose,
    compose_cov,
    inverse,
    moved_by_world,
)
from graphslam.core.known_landmarks import KnownLandmarks, SparseRoot
from graphslam.core.records import Start
from graphslam.logs import LogSet
from graphslam.mapping.known_map import KnownMap, latest_places
from graphslam.mapping.submaps import SubmapPose, with_poses_from
from graphslam.multi_robot.better_starts import better_alignment
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.multi_robot.hypothesis_choice import (
    Refusal,
    Telling,
    best_explanation,
    contradiction,
    doubt,
)
from graphslam.multi_robot.map_localisation import Support, support
from graphslam.multi_robot.place_recognition import PlaceMap, seen_extent
from graphslam.multi_robot.place_search import DISTINCT_M, DISTINCT_RAD
from graphslam.multi_robot.relative_frames import RelativeFrame
from graphslam.pipeline.start_priors import origin, start_poses
from graphslam.scan_smoothing.localisation import (
    CELL_COV,
    close_path_in_map,
    in_world,
    own_places,
    possible_starts,
    start_of_closed_path,
)
from graphslam.scan_smoothing.scan_tracking import ScanLog

#: a map of sessions has places only
_NO_LANDMARKS = KnownLandmarks({}, (), SparseRoot((), (), 1.0))
#: two groups that were refused are tried again once both have so many times the places together
GROWN = 1.1
#: hypotheses about a group that are judged at most; one session has 5 and a few symmetric ones
MAX_LAID = 10


def join_sessions(log: LogSet, sessions: Mapping[str, ScanLog], config: Config) -> FrameAssignment:
    """The start of the first state of every session, and its frame.

    Args:
        log: of all sessions.
        sessions: by name, tracked; those without a state are left out.
        config: settings.

    Raises:
        EstimationError: a start that is told is malformed, or contradicts another one; or truth was
            asked for and is missing.
    """
    told = start_poses(log, config)
    world = min(told)
    by_time = sorted(sessions, key=lambda name: sessions[name].first_ns)
    tracked = {name: _Session.of(sessions[name], name) for name in by_time}
    given = {name: _of_first_state(sessions, name, world, told) for name in told}
    placed = {name: start for name, start in given.items() if name in sessions}
    doubted, elsewhere = _check_given(placed, tracked, config)
    better = {
        name: _of_base(pose, sessions[name], name, told[name], given[name])
        for name, pose in elsewhere.items()
    }
    groups = [_group(placed, tracked)]
    groups += [_group({n: origin(config)}, tracked) for n in by_time if n not in given]
    refused = merge(groups, tracked, config)
    starts, frames, found = dict(given), dict.fromkeys(given, world), {}
    remarks = dict(doubted)
    for group in groups:
        leader = world if group is groups[0] else next(iter(group.starts))
        starts |= _as_priors(group.starts, given)
        frames |= dict.fromkeys(group.starts, leader)
        remarks |= group.remarks
        for name in group.starts.keys() - {leader, *given}:
            start = group.starts[name]
            cov = start.cov / PRIOR_INFLATION**2
            pose = between(starts[leader].pose, start.pose)
            found[name] = RelativeFrame(name, leader, pose, cov, group.confirmed[name])
    undecided = {name: why for name, why in refused.items() if frames[name] == name != world}
    return FrameAssignment(starts, frames, world, found, undecided, remarks, better)


def _as_priors(starts: Mapping[str, Start], given: Collection[str]) -> dict[str, Start]:
    """Starts in a group, as priors in the world; those that were ``given`` are already."""
    if not starts:
        return {}
    first = next(iter(starts.values()))
    to_world = np.linalg.inv(moved_by_world(first.pose))
    cov = to_world @ first.cov @ to_world.T
    return {
        name: start if start is first or name in given else in_world(start, cov)
        for name, start in starts.items()
    }


def _check_given(
    given: Mapping[str, Start], sessions: Mapping[str, "_Session"], config: Config
) -> tuple[dict[str, str], dict[str, Array]]:
    """See that sessions whose starts are told agree with those before them.

    Returns:
        Doubts of some; and of those that fit clearly better elsewhere, the pose (3,) of their first
        state there.

    Raises:
        EstimationError: from there one sees something else than the others.
    """
    before: dict[str, Start] = {}
    doubted: dict[str, str] = {}
    better: dict[str, Array] = {}
    for name, start in given.items():
        group = _group(before, sessions)
        if group.map.places:
            session = sessions[name]
            laid = group.lay({name: start}, sessions)
            placed = laid.support
            why = contradiction(placed)
            if why:
                raise EstimationError(
                    f"session {name}: --start contradicts that of {', '.join(before)}: {why}; "
                    "give another start, or none"
                )
            if said := doubt(placed, session.own.places, session.log.config.loop_closure):
                doubted[name] = said
            places = group.map.places
            motion = better_alignment(places, laid.places, placed, config.multi_robot)
            if motion is not None:
                there = Start(compose(motion, laid.starts[name].pose), CELL_COV)
                better[name] = group.lay({name: there}, sessions).starts[name].pose
        before[name] = start
    return doubted, better


def _of_base(pose: Array, session: ScanLog, name: str, told: Start, given: Start) -> Array:
    """The base pose (3,) that is to be told for a session to begin at ``pose`` (3,), its sensor's.

    ``told`` is that of the base, for which it begins at ``given``.
    """
    mount = session.runs[name].track.mount
    to_told = compose(compose(told.pose, mount), inverse(given.pose))
    return compose(compose(to_told, pose), inverse(mount))


def _of_first_state(
    sessions: Mapping[str, ScanLog], name: str, world: str, told: Mapping[str, Start]
) -> Start:
    """The told start of a base, as that of its first state, which is the sensor's.

    The base of the first robot begins where it is told only in the end: until then its first state
    does, see `FrameTransforms`.
    """
    start = told[name]
    if name == world or name not in sessions:
        return Start(start.pose, start.cov, start.cov)
    own, first = (sessions[n].runs[n].track for n in (name, world))
    base = told[world].pose
    shift = compose(compose(base, first.mount), inverse(base))
    pose = compose(inverse(shift), compose(start.pose, own.mount))
    cov = compose_cov(start.pose, start.cov, own.mount, own.mount_cov + first.mount_cov)
    return Start(pose, cov, start.cov)


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """A session as tracked, and its places by itself, in the world of its tracked path."""

    name: str
    log: ScanLog
    own: PlaceMap

    @classmethod
    def of(cls, log: ScanLog, name: str) -> "_Session":
        return cls(name, log, own_places(log, name))

    @property
    def first(self) -> Array:
        """The pose (3,) at which its tracked path begins."""
        return self.log.steps[0].starts[self.name].pose

    def at(self, start: Start) -> list[SubmapPose]:
        """Its places, if it begins there."""
        moved = compose(start.pose, inverse(self.first))
        return [replace(place, pose=compose(moved, place.pose)) for place in self.own.places]


@dataclass(frozen=True, slots=True, eq=False)
class _Laid:
    """A group laid into a map as a hypothesis says: starts and places there, and their support."""

    starts: Mapping[str, Start]
    places: Sequence[SubmapPose]
    support: Support


@dataclass(frozen=True, eq=False)
class _Group:
    """Sessions whose relative starts are known.

    ``starts`` in the frame of the group, the leader's first; ``seen``: places that they saw, the
    latest session first; ``confirmed``: how many places confirmed the start of each; ``remarks``
    about it. What was found of other sessions in its map is kept: alone they are refused, and as a
    group tried again.
    """

    starts: Mapping[str, Start]
    seen: Sequence[SubmapPose]
    confirmed: Mapping[str, float]
    remarks: Mapping[str, str] = field(default_factory=dict)
    _found: dict[str, list[Start]] = field(default_factory=dict, repr=False)
    _laid: dict[tuple[str, bytes], tuple[Start, list[SubmapPose]]] = field(
        default_factory=dict, repr=False
    )

    @property
    def leader(self) -> str:
        """The session in whose frame it is."""
        return next(iter(self.starts))

    @cached_property
    def map(self) -> KnownMap:
        """Its places."""
        return KnownMap("", "", (), _NO_LANDMARKS, latest_places(self.seen))

    def possible_starts(self, session: _Session) -> list[Start]:
        """Where another session may begin in it, the best supported start first."""
        name = session.name
        if name not in self._found:
            self._found[name] = possible_starts(session.log, name, self.map, session.own)
        return self._found[name]

    def lay(self, starts: Mapping[str, Start], sessions: Mapping[str, _Session]) -> _Laid:
        """Every session closed with its places from its start in it."""
        found, places = {}, []
        for name, start in starts.items():
            key = name, np.concatenate([start.pose, start.cov.ravel()]).tobytes()
            if key not in self._laid:
                session = sessions[name]
                laid = close_path_in_map(session.log, name, start, self.map)
                own = with_poses_from(session.own.places, laid.states)
                self._laid[key] = start_of_closed_path(laid, name), own
            found[name], own = self._laid[key]
            places += own
        return _Laid(found, places, support(self.map.places, places))


def _group(starts: Mapping[str, Start], sessions: Mapping[str, _Session]) -> _Group:
    """Sessions whose starts are given."""
    seen = [place for name in reversed(list(starts)) for place in sessions[name].at(starts[name])]
    return _Group(starts, seen, {})


def merge(groups: list[_Group], sessions: Mapping[str, _Session], config: Config) -> dict[str, str]:
    """Join groups as long as two can be joined, the earlier ones first.

    Returns:
        Why the sessions of each group that was tried and not joined are not known: leader -> why,
        and in whose map.
    """
    tried: dict[tuple[str, str], int] = {}
    refused: dict[str, dict[str, Refusal]] = {group.leader: {} for group in groups}
    while pair := next_pair(groups, tried):
        one, other = pair
        joined = _joined(one, other, sessions, config)
        if isinstance(joined, _Group):
            groups[groups.index(one)] = joined
            groups.remove(other)
            for reasons in refused.values():
                reasons.pop(other.leader, None)
            continue
        text = f"in the map of {' and '.join(one.starts)}: {joined.text}"
        refused[other.leader][one.leader] = replace(joined, text=text)
    # of equally telling ones the first, which is of the group that was there before
    return {
        leader: max(reasons.values(), key=lambda why: why.telling).text
        for leader, reasons in refused.items()
        if reasons
    }


def next_pair(
    groups: Sequence[_Group], tried: dict[tuple[str, str], int]
) -> tuple[_Group, _Group] | None:
    """The next two groups to be tried; None if there are none.

    With each group first what was never tried with it, so that it has grown when the others, which
    were refused with less in common, are tried again. They are only if clearly more of the place is
    known: else n sessions would be compared n² times with what hardly changed.

    Args:
        groups: that there are now.
        tried: leaders of two groups -> places of both when they were tried; this pair is added.
    """
    for k, one in enumerate(groups):
        sizes = {
            other.leader: len(one.map.places) + len(other.map.places) for other in groups[k + 1 :]
        }
        last = {leader: tried.get((one.leader, leader)) for leader in sizes}
        fresh = [name for name, before in last.items() if before is None]
        grown = [n for n, before in last.items() if before and sizes[n] >= GROWN * before]
        for other in groups[k + 1 :]:
            if other.leader == next(iter([*fresh, *grown]), None):
                tried[one.leader, other.leader] = sizes[other.leader]
                return one, other
    return None


def _joined(
    one: _Group, other: _Group, sessions: Mapping[str, _Session], config: Config
) -> _Group | Refusal:
    """Both groups in the frame of the first one, or why their relative pose is not known."""
    laid = [one.lay(starts, sessions) for starts in _hypotheses(one, other, sessions)]
    if not laid:
        return Refusal("no place is recognised", Telling.NOTHING)
    places = [place for name in other.starts for place in sessions[name].own.places]
    own = [place for name, start in other.starts.items() for place in sessions[name].at(start)]
    seen_m = seen_extent(one.map.places, own)
    supports = [found.support for found in laid]
    index, why = best_explanation(supports, places, config.multi_robot, seen_m)
    best = laid[index]
    if why:
        return why
    remarks = {**one.remarks, **other.remarks}
    against = best.support.is_contradicted
    if said := doubt(best.support, best.places, config.loop_closure, stands_alone=against):
        remarks |= dict.fromkeys(best.starts, said)
    return _Group(
        {**one.starts, **best.starts},
        [*best.places, *one.seen],
        {**one.confirmed, **dict.fromkeys(best.starts, float(best.support.confirmed.sum()))},
        remarks,
    )


def _hypotheses(
    one: _Group, other: _Group, sessions: Mapping[str, _Session]
) -> list[dict[str, Start]]:
    """Where the sessions of a group may begin in the map of another, as one.

    Each session has hypotheses of its own, which put all into the map. Those that most sessions
    have come first, and the rest of many is left out: each costs as much as there are sessions.
    """
    found: list[tuple[int, int, dict[str, Start]]] = []
    for name, start in other.starts.items():
        for rank, at in enumerate(one.possible_starts(sessions[name])):
            moved = {n: _carried(at, start, s) for n, s in other.starts.items()}
            same = next((k for k, (*_, have) in enumerate(found) if _is_same(have, moved)), None)
            if same is None:
                found.append((-1, rank, moved))
            else:
                votes, best, have = found[same]
                found[same] = votes - 1, min(best, rank), have
    found.sort(key=lambda entry: entry[:2])
    return [moved for *_, moved in found[:MAX_LAID]]


def _carried(found: Start, before: Start, start: Start) -> Start:
    """Where ``start`` is once ``before``, of the same group, is ``found`` elsewhere."""
    offset = between(before.pose, start.pose)
    cov = compose_cov(found.pose, found.cov, offset, np.zeros((3, 3)))
    return Start(compose(found.pose, offset), cov)


def _is_same(one: Mapping[str, Start], other: Mapping[str, Start]) -> bool:
    """Whether two hypotheses about a group put all its sessions at about the same starts."""
    off = np.array([between(one[name].pose, other[name].pose) for name in one])
    near = np.hypot(off[:, 0], off[:, 1]) < DISTINCT_M
    return bool((near & (np.abs(off[:, 2]) < DISTINCT_RAD)).all())
