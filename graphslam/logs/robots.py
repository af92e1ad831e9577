"""Who is whose: the robots of a log, and which topics belong to each.

One robot is the normal case, and its topics may have any names: ``/front/scan`` and
``/diff_drive_controller/odom`` are one robot's. A namespace is a robot of its own if it has both a
sensor and odometry. What else belongs to it is told by frames, or by there being only one robot.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from urllib.parse import quote

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.geometry import Array
from graphslam.logs.cloud_topics import without_other_clouds
from graphslam.logs.decoders import frame_of
from graphslam.logs.findings import Finding, topics_setting
from graphslam.logs.recording import Recording
from graphslam.logs.schemas import DEFAULT_ROBOT, ODOMETRY
from graphslam.logs.tf_odometry import Chain, find_chain, with_odometry
from graphslam.logs.tf_tree import (
    TransformEdge,
    moving_topics,
    namespace_of,
    sampled_edges,
    static_tree,
)
from graphslam.logs.topic_context import sample_decoded
from graphslam.logs.topics import MOTION_KINDS, ODOMETRY_KINDS, Topic, find_topics
from graphslam.logs.twist_odometry import twist_topics, with_twist_odometry

_NOBODY = ""
#: bytes of a robot's name in the names of files, of which systems allow 255
_LONGEST_NAME = 200
_SENSORS = (records.Scan, records.Sighting)


@dataclass(slots=True)
class _Space:
    """A namespace: its topics, and the frames of what it senses and of its odometry."""

    name: str
    topics: list[Topic]
    sensed: set[str] = field(default_factory=set)
    moved: set[str] = field(default_factory=set)

    @property
    def senses(self) -> bool:
        return any(topic.record in _SENSORS for topic in self.topics)

    @property
    def moves(self) -> bool:
        return any(topic.record in ODOMETRY_KINDS for topic in self.topics)

    @property
    def has_joints_only(self) -> bool:
        """Whether all its odometry are joints."""
        kinds = {topic.record for topic in self.topics if topic.record in ODOMETRY_KINDS}
        return kinds == {records.WheelAngles}

    @property
    def prefixes(self) -> set[str]:
        """Names of robots in frames such as ``robot1/base_link``."""
        return {f.partition("/")[0] for f in self.sensed | self.moved if "/" in f}


@dataclass(slots=True)
class _Frames:
    """What tf says, read when it is asked for."""

    files: Sequence[Recording]
    _trees: dict[str, tuple[dict[str, TransformEdge], dict[str, tuple[str, Array]]]] = field(
        default_factory=dict
    )

    def tree(self, space: str) -> tuple[dict[str, TransformEdge], dict[str, tuple[str, Array]]]:
        """Edges on /tf, and static transforms, of a namespace."""
        if space not in self._trees:
            edges = sampled_edges(self.files, space)
            self._trees[space] = edges, static_tree(self.files, space, edges)
        return self._trees[space]

    def above(self, frame: str, space: str) -> list[str]:
        """``frame`` and those above it, up to the root."""
        edges, static = self.tree(space)
        found = [frame]
        while frame in edges or frame in static:
            frame = edges[frame].parent if frame in edges else static[frame][0]
            if frame in found:
                break
            found.append(frame)
        return found

    def chain(self, frame: str, space: str) -> Chain | None:
        """The odometry above ``frame`` in tf."""
        return find_chain(frame, *self.tree(space))

    def only_chain(self, space: str) -> Chain | None:
        """The odometry in tf, if there is one: what moves in a frame that is called odom."""
        edges, static = self.tree(space)
        bases = [
            child
            for child, edge in edges.items()
            if edge.moves and "odom" in edge.parent.rsplit("/", 1)[-1]
        ]
        return find_chain(bases[0], edges, static) if len(bases) == 1 else None


def _check_names(robots: Collection[str], files: Sequence[Recording], config: Config) -> None:
    """Check that there are not too many robots, and that their names can be those of files.

    Raises:
        LogError: it is not so.
    """
    names = ", ".join(str(file.path) for file in files)
    if len(robots) > config.limits.robots:
        raise LogError(
            f"{names}: has topics of {len(robots)} robots, more than limits.robots "
            f"({config.limits.robots}); raise it, or name topics in logs.topics"
        )
    for robot in robots:
        if len(quote(robot, safe="")) > _LONGEST_NAME:
            raise LogError(
                f"{names}: a robot's name is too long for a file: {robot[:40]}...; give it another "
                "one in logs.topics"
            )


def robots_and_topics(
    files: Sequence[Recording], config: Config
) -> tuple[list[Recording], list[Topic], list[Finding]]:
    """The usable topics with their robots, the files with topics that were derived, findings.

    Raises:
        LogError: see `find_topics`; or it cannot be told whose a sensor is.
    """
    topics, clouds = without_other_clouds(files, find_topics(files, config))
    if not topics:
        names = ", ".join(str(file.path) for file in files)
        raise LogError(f"{names}: no usable topic; {clouds[0].line}")
    frames = _Frames(files)
    robots: dict[str, str] = {}
    if not config.logs.topics:
        topics = by_frames(files, topics)
        # a session has robots of its own: what another one calls base or joints says nothing of it
        for together in [[file] for file in files] if config.logs.same_place else [files]:
            there = {raw.name for file in together for raw in file.topics}
            own = [topic for topic in topics if topic.name in there]
            robots |= assign_robots(together, own, _Frames(together))
    named: list[Topic] = []
    unused: list[Finding] = []
    for topic in topics:
        robot = robots.get(topic.robot, topic.robot)
        if robot == _NOBODY and topic.record in ODOMETRY_KINDS:
            setting = {t.name: robots.get(t.robot, t.robot) for t in topics} | {topic.name: "NAME"}
            unused.append(
                Finding(
                    "doubt",
                    "robots",
                    topic.name,
                    "is not used: whose it is cannot be told",
                    f"say it with {topics_setting({n: r for n, r in setting.items() if r})}",
                )
            )
        else:
            named.append(replace(topic, robot=robot or topic.robot))
    _check_names({topic.robot for topic in named}, files, config)
    opened, found, derived = _with_tf_odometry(files, named, frames)
    opened, found, commands = _with_twist_odometry(opened, found)
    return opened, found, clouds + unused + derived + commands


def by_frames(files: Sequence[Recording], topics: Sequence[Topic]) -> list[Topic]:
    """Topics, those of several robots in one namespace of the robots that their frames name.

    ``/scan_anna`` in the frame ``anna/laser`` and ``/odom_anna`` of ``anna/base_link`` are one
    robot's if another one has a sensor and odometry beside them.
    """
    kinds = (*_SENSORS, *ODOMETRY_KINDS)
    own = [topic for topic in topics if topic.count and topic.record in kinds]
    sensing = sum(topic.record in _SENSORS for topic in own)
    if sensing < 2 or len(own) - sensing < 2:
        return list(topics)
    of = {topic.name: _robot_named(_first_frames(files, topic)) for topic in own}
    named: dict[str, set[str]] = {}
    for topic in own:
        named.setdefault(topic.robot, set()).add(of[topic.name])
    shared = [topic for topic in own if len(named[topic.robot] - {""}) > 1]
    both = {of[t.name] for t in shared if t.record in _SENSORS} - {""}
    both &= {of[t.name] for t in shared if t.record not in _SENSORS}
    if len(both) < 2:
        return list(topics)
    robots = {t.name: of[t.name] for t in shared if of[t.name] in both}
    return [replace(topic, robot=robots.get(topic.name, topic.robot)) for topic in topics]


def _first_frames(files: Sequence[Recording], topic: Topic) -> set[str]:
    """The frames in the first message of a sensor or of odometry that can be decoded."""
    for message in sample_decoded(files, topic):
        found = {frame_of(message)}
        if topic.record is records.OdometryPose:
            found.add(str(message.child_frame_id).lstrip("/"))
        return found - {""}
    return set()


def _robot_named(frames: Collection[str]) -> str:
    """The robot that frames such as ``anna/base_link`` name; empty if none, or several."""
    names = {frame.rpartition("/")[0].rpartition("/")[2] for frame in frames} - {""}
    return names.pop() if len(names) == 1 else ""


def assign_robots(
    files: Sequence[Recording], topics: Sequence[Topic], frames: _Frames
) -> Mapping[str, str]:
    """Robot of each namespace that has a sensor or odometry, by its name; empty: of none.

    Raises:
        LogError: it cannot be told whose a sensor is.
    """
    spaces = [
        _Space(name, [t for t in topics if t.robot == name and t.count])
        for name in sorted({t.robot for t in topics if t.count})
    ]
    spaces = [space for space in spaces if space.senses or space.moves]
    # joints may be those of an arm: they say who moves only where nothing else does
    by_joints = not any(space.moves and not space.has_joints_only for space in spaces)
    movers = [s for s in spaces if s.moves and (by_joints or not s.has_joints_only)]
    whole = [space for space in movers if space.senses]
    if len(whole) == len(spaces):
        return {space.name: space.name for space in spaces}
    for space in spaces:
        _add_frames(space, files)
    owners = {space.name: space.name for space in spaces}
    on_tf: dict[Chain, str] = {}
    for space in spaces:
        if space.senses and space not in whole:
            owner, chain = _owner_of_sensor(space, movers, frames)
            # sensors above which the same frames move are on one robot
            owners[space.name] = on_tf.setdefault(chain, space.name) if chain else owner
    sensing = {owners[space.name] for space in spaces if space.senses}
    for space in spaces:
        # more odometry of a robot that has some, such as /odometry/filtered beside /odom
        if owners[space.name] == space.name and space.name not in sensing:
            others = [s for s in movers if s.name in sensing]
            same = [s for s in others if _same_base(space, s, frames)]
            owners[space.name] = same[0].name if same else space.name
            if sensing and space.has_joints_only and space.name == DEFAULT_ROBOT:
                # /joint_states of the only robot, or of one that cannot be told
                owners[space.name] = next(iter(sensing)) if len(sensing) == 1 else _NOBODY
    return _named(owners, {space.name for space in whole})


def _add_frames(space: _Space, files: Sequence[Recording]) -> None:
    for topic in space.topics:
        if topic.record in _SENSORS:
            space.sensed |= _first_frames(files, topic)
        elif topic.record in (records.OdometryPose, records.OdometryIncrement):
            space.moved |= _first_frames(files, topic)


def _owner_of_sensor(
    space: _Space, movers: Sequence[_Space], frames: _Frames
) -> tuple[str, Chain | None]:
    """The namespace with the odometry of a sensor; its own, if that is on /tf or nowhere.

    Raises:
        LogError: there are several that may be.
    """
    above = {frame for sensed in space.sensed for frame in frames.above(sensed, space.name)}
    by_frames = [mover for mover in movers if mover.moved & above]
    if len(by_frames) == 1:
        return by_frames[0].name, None
    for sensed in sorted(space.sensed):
        if chain := frames.chain(sensed, space.name):
            return space.name, chain
    possible = [mover for mover in by_frames or movers if not _contradict(space, mover)]
    if len(possible) > 1:
        sensor = next(topic for topic in space.topics if topic.record in _SENSORS)
        names = [mover.name for mover in possible]
        of_movers = [topic for mover in movers for topic in mover.topics]
        setting = {t.name: t.robot for t in of_movers} | {sensor.name: names[0]}
        raise LogError(
            f"{', '.join(str(file.path) for file in frames.files)}: whose is {sensor.name}? its "
            f"frame {', '.join(sorted(space.sensed)) or '(none)'} belongs to none of "
            f"{', '.join(names)}; say it with {topics_setting(setting)}"
        )
    return (possible[0].name if possible else space.name), None


def _contradict(space: _Space, other: _Space) -> bool:
    """Whether the names of robots in their frames differ."""
    return bool(space.prefixes and other.prefixes and not space.prefixes & other.prefixes)


def _same_base(space: _Space, other: _Space, frames: _Frames) -> bool:
    """Whether two odometries are of one body: the frames are tied, and no tf is of one only."""
    if any(
        topic.startswith(f"/{name}/")
        for file in frames.files
        for topic in moving_topics(file)
        for name in (space.name, other.name)
    ):
        return False  # frames of the same name in different trees
    above = {frame for moved in other.moved for frame in frames.above(moved, other.name)}
    mine = {frame for moved in space.moved for frame in frames.above(moved, space.name)}
    bases = {frame for frame in space.moved & other.moved if "odom" not in frame}
    tied = (space.moved & above) | (other.moved & mine)
    return bool(bases or {frame for frame in tied if frame not in ("map", "world")})


def _named(owners: Mapping[str, str], whole: Collection[str]) -> dict[str, str]:
    """Names of the robots: the namespace.

    One that has its topics in several, of which none has all kinds, is `DEFAULT_ROBOT` if it is the
    only one.
    """
    alone = len(set(owners.values())) == 1 < len(owners)
    return {
        space: DEFAULT_ROBOT if alone and owner not in whole else owner
        for space, owner in owners.items()
    }


# ---------------------------------------------------------------- odometry on /tf


def _with_tf_odometry(
    files: Sequence[Recording], topics: Sequence[Topic], frames: _Frames
) -> tuple[list[Recording], list[Topic], list[Finding]]:
    """The files and topics with the odometry on /tf of robots that have no better one."""
    opened, found = list(files), list(topics)
    findings: list[Finding] = []
    good = (records.OdometryIncrement, records.OdometryPose)
    moving = any(moving_topics(file) for file in files)
    robots = sorted({t.robot for t in topics if t.count and t.record in _SENSORS})
    for robot in robots:
        own = [t for t in topics if t.robot == robot and t.count]
        if not moving or any(t.record in good for t in own):
            continue
        sensor = next(t for t in own if t.record in _SENSORS)
        sensed = {frame_of(message) for message in sample_decoded(files, sensor)}
        chains = (frames.chain(frame, robot) for frame in sorted(sensed))
        chain = next(filter(None, chains), None)
        if chain is None and len(robots) == 1:  # no transform leads from its base to a sensor
            chain = frames.only_chain(robot)
        if chain is None:
            continue
        name, count = "", 0
        for k, file in enumerate(opened):
            opened[k], derived = with_odometry(file, chain)
            if derived:
                name, count = derived.name, count + derived.count
        found.append(Topic(name, ODOMETRY, robot, records.OdometryPose, count))
        said = f"has no topic with odometry; it is taken from {chain.topic}: "
        said += f"{chain.base} in {chain.odometry}"
        where = f"robot {robot}"
        if "odom" in chain.odometry:
            findings.append(Finding("note", "odometry", where, said))
        else:
            said += ", which is not called odom: if it is a map, the pose may jump"
            remedy = "record nav_msgs/Odometry, or odom to base on /tf"
            findings.append(Finding("doubt", "odometry", where, said, remedy))
    return opened, sorted(found, key=lambda topic: topic.name), findings


def _with_twist_odometry(
    files: Sequence[Recording], topics: Sequence[Topic]
) -> tuple[list[Recording], list[Topic], list[Finding]]:
    """The files and topics with the odometry by commands of robots that nothing else tells of.

    These have sightings only: how a robot with scans moved, its scans tell better.
    """
    opened, found, findings = list(files), list(topics), list[Finding]()
    robots = sorted({t.robot for t in topics if t.count and t.record in _SENSORS})
    for robot in robots:
        if any(t.robot == robot and t.count and t.record in MOTION_KINDS for t in topics):
            continue
        own = [
            name for name in twist_topics(files) if namespace_of(name) == robot or len(robots) == 1
        ]
        if not own:
            continue
        name, count = "", 0
        for k, file in enumerate(opened):
            opened[k], derived = with_twist_odometry(file, own[0], "base_link")
            if derived:
                name, count = derived.name, count + derived.count
        found.append(Topic(name, ODOMETRY, robot, records.OdometryPose, count))
        text = f"has no odometry; it is made of the velocities of {own[0]}"
        remedy = "record nav_msgs/Odometry; if they are commands, --set "
        remedy += "odometry.commanded_velocities=true"
        findings.append(Finding("doubt", "odometry", f"robot {robot}", text, remedy))
    return opened, sorted(found, key=lambda topic: topic.name), findings
