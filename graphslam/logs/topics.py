"""Selection of the topics of a log that are used, and their robots."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.errors import LogError
from graphslam.core.suggestions import did_you_mean
from graphslam.logs import schemas
from graphslam.logs.decoders import DECODERS, TopicContext, decode_messages
from graphslam.logs.findings import Finding, topics_setting
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.schemas import POINT_CLOUD
from graphslam.logs.tf_tree import namespace_of

# Sources of odometry in order of preference: an increment has its covariance, wheel angles need
# the wheel geometry from the configuration.
ODOMETRY_KINDS: tuple[type[records.Message], ...] = (
    records.OdometryIncrement,
    records.OdometryPose,
    records.WheelAngles,
)
# What tells how a robot moved: without odometry its scans, compared with each other.
MOTION_KINDS = (*ODOMETRY_KINDS, records.Scan)

#: blocks of a recording from which messages are taken, and how many from each
_SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK = 4, 4
#: last part of the name of a frame, in which poses jump by REP 105
_JUMPING_FRAMES = ("map", "world", "earth")


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of ``robot`` that can be decoded; ``count`` messages over all files."""

    name: str
    schema: str
    robot: str
    record: type[records.Message]
    count: int


def find_topics(files: Sequence[Recording], config: Config) -> list[Topic]:
    """All topics whose schema has a decoder, sorted by name.

    The robot is the namespace, a nested one where several of one namespace are robots; see
    `robots_and_topics` for whose it really is.
    ``config.logs.topics``, where not empty, restricts the topics and names the robots.

    Raises:
        LogError: no topic is usable, or a configured one is not in the logs.
    """
    found: dict[str, Topic] = {}
    others: set[str] = set()
    for file in files:
        for raw in file.topics:
            if raw.schema not in DECODERS or raw.encoding != "cdr":
                others.add(f"{raw.name} ({raw.schema}, {raw.encoding})")
                continue
            before = found[raw.name].count if raw.name in found else 0
            robot = config.logs.topics.get(raw.name, namespace_of(raw.name))
            record = DECODERS[raw.schema].record
            found[raw.name] = Topic(raw.name, raw.schema, robot, record, before + raw.count)
    names = ", ".join(str(file.path) for file in files)
    if not found:
        there = ", ".join(sorted(others)) or "nothing"
        raise LogError(
            f"{names}: no usable topic; the log has {there}; "
            f"usable are {', '.join(DECODERS)}, encoded as cdr"
        )
    wanted = config.logs.topics
    missing = sorted(set(wanted) - set(found))
    if missing:
        raise LogError(
            f"{names}: logs.topics names {missing[0]}, which is not a usable topic of the log; "
            f"there are {', '.join(sorted(found))}{did_you_mean(missing[0], found)}"
        )
    if not wanted:
        return _nested([found[name] for name in sorted(found)])
    return [found[name] for name in sorted(found) if name in wanted]


def _nested(topics: Sequence[Topic]) -> list[Topic]:
    """Topics, those of ``/fleet/a`` and ``/fleet/b`` of robots a and b instead of one, fleet.

    If at least two namespaces within one have each a sensor and odometry.
    """
    inner: dict[tuple[str, str], set[type]] = defaultdict(set)
    for topic in topics:
        if topic.count and len(parts := topic.name.strip("/").split("/")) > 2:
            inner[parts[0], parts[1]].add(topic.record)
    whole = [
        name
        for name, kinds in inner.items()
        if kinds & set(ODOMETRY_KINDS) and kinds & {records.Scan, records.Sighting}
    ]
    outer = Counter(first for first, _ in whole)
    taken = Counter(second for first, second in whole if outer[first] > 1)
    taken.update({topic.robot for topic in topics})
    robots = {
        (first, second): second if taken[second] == 1 else f"{first}_{second}"
        for first, second in whole
        if outer[first] > 1
    }
    made = []
    for topic in topics:
        first, _, rest = topic.name.strip("/").partition("/")
        robot = robots.get((first, rest.partition("/")[0]), topic.robot)
        made.append(replace(topic, robot=robot))
    return made


def choose_topics(
    files: Sequence[Recording], topics: Sequence[Topic], config: Config
) -> tuple[list[Topic], list[Finding]]:
    """One odometry source and one laser per robot, all other topics, and findings.

    For further lasers see `graphslam.logs.lasers`.

    Raises:
        LogError: all topics are empty; a robot has sightings but neither odometry nor scans, or
            scans but no odometry, which another robot without sensors has.
    """
    names = ", ".join(str(file.path) for file in files)
    filled = [topic for topic in topics if topic.count]
    if not filled:
        raise LogError(
            f"{names}: all usable topics are empty: {', '.join(t.name for t in topics)}; "
            "record it again"
        )
    chosen: list[Topic] = []
    findings: list[Finding] = []
    spare: list[list[Topic]] = []
    for robot in sorted({topic.robot for topic in filled}):
        own = [topic for topic in filled if topic.robot == robot]
        own.sort(key=lambda t: (t.schema == POINT_CLOUD, -t.count, t.name))
        odometry = _odometry_of(files, own)
        lasers = lasers_of(filled, robot)
        if lasers:  # scans tell how it moved too
            odometry, unusable = _with_usable_first(files, odometry, config)
            findings += unusable
        sensors = lasers + [t for t in own if t.record is records.Sighting]
        if sensors and not odometry:
            if not lasers or _odometry_alone(filled):
                raise LogError(
                    f"{names}: a {'scan' if lasers else 'sighting'} without odometry: robot "
                    f"{robot} has {sensors[0].name} but no odometry; record nav_msgs/Odometry, "
                    "or odom to base on /tf, or assign topics to robots in logs.topics"
                )
            findings.append(
                Finding(
                    "doubt",
                    "odometry",
                    f"robot {robot}",
                    f"no odometry: scan matching of {lasers[0].name} is used",
                    "record nav_msgs/Odometry, or odom to base on /tf, too",
                )
            )
        # true associations are read by `logs.truth` only
        others = (*ODOMETRY_KINDS, records.Scan, records.TrueAssociations)
        rest = [t for t in filled if t.robot == robot and t.record not in others]
        chosen += odometry[:1] + lasers[:1] + rest
        spare.append(odometry)
    if not any(topic.record in MOTION_KINDS for topic in chosen):
        raise LogError(
            f"{names}: no odometry; the log has only {', '.join(t.name for t in filled)}; "
            "smoothing needs LaserScan, nav_msgs/Odometry, odom to base on /tf, JointState or "
            "OdometryIncrement"
        )
    findings += [unused("odometry", own, chosen) for own in spare if len(own) > 1]
    return chosen, findings


def _odometry_of(files: Sequence[Recording], topics: Sequence[Topic]) -> list[Topic]:
    """The sources of odometry among a robot's ``topics``, the one first that is used.

    Of poses those in a frame that does not jump (REP 105) come first, else the order is kept.
    """
    poses = [topic for topic in topics if topic.record is records.OdometryPose]
    if len(poses) > 1:
        poses.sort(key=lambda topic: _jumps(files, topic))
    of_kind = {kind: [t for t in topics if t.record is kind] for kind in ODOMETRY_KINDS}
    of_kind[records.OdometryPose] = poses
    return [topic for own in of_kind.values() for topic in own]


def _with_usable_first(
    files: Sequence[Recording], topics: Sequence[Topic], config: Config
) -> tuple[list[Topic], list[Finding]]:
    """Sources of odometry of which a message can be used before the others; none if there is none.

    Joints may be those of an arm, and a rotation of a pose may be none. What is left out is said.
    """
    usable = [topic for topic in topics if _is_usable(files, topic, config)]
    if usable or not topics:
        return usable + [topic for topic in topics if topic not in usable], []
    text = "is no odometry: none of a sample of its messages can be used"
    remedy = "check what publishes it"
    if any(topic.record is records.WheelAngles for topic in topics):
        remedy = "`graphslam info` lists its joints, and how to name a wheel of each side"
    return [], [Finding("doubt", "odometry", topic.name, text, remedy) for topic in topics]


def _is_usable(files: Sequence[Recording], topic: Topic, config: Config) -> bool:
    """Whether some message of a sample can be used."""
    own = config.robot(topic.robot)
    context = TopicContext(topic.robot, left_joint=own.left_joint, right_joint=own.right_joint)
    for file in files:
        data = list(sample_messages(file, topic.name, _SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK))
        found = decode_messages(topic.schema, data, context, Counter()) if data else []
        if any(message is not None for message in found):
            return True
    return False


def _jumps(files: Sequence[Recording], topic: Topic) -> bool:
    """Whether poses are in a frame that jumps where a robot finds out where it is."""
    for file in files:
        first = sample_messages(file, topic.name, 1, 1)
        for message in schemas.decode_all(topic.schema, first):
            frame = message.header.frame_id.rstrip("/").rpartition("/")[2]
            return frame.lower() in _JUMPING_FRAMES
    return False


def lasers_of(topics: Sequence[Topic], robot: str) -> list[Topic]:
    """Topics with scans of a robot, the one first that is used if only one is."""
    own = [t for t in topics if t.robot == robot and t.record is records.Scan and t.count]
    return sorted(own, key=lambda t: (t.schema == POINT_CLOUD, -t.count, t.name))


def _odometry_alone(topics: Sequence[Topic]) -> bool:
    """Whether some robot has odometry and no sensor: it may be that of a robot with scans only."""
    sensing = {t.robot for t in topics if t.record in (records.Scan, records.Sighting)}
    return any(t.record in ODOMETRY_KINDS and t.robot not in sensing for t in topics)


def unused(what: str, topics: Sequence[Topic], chosen: Sequence[Topic]) -> Finding:
    """That only the first of several ``topics`` of a robot is used, and how to use the second."""
    used, other = topics[0], topics[1]
    others = ", ".join(topic.name for topic in topics[1:])
    wanted = [t for t in chosen if t != used and t.record is not records.TrueLandmark]
    # what is made of transforms has no name of its own
    setting = {t.name: t.robot for t in [*wanted, other] if " " not in t.name}
    return Finding(
        "note",
        "unused",
        f"robot {used.robot}",
        f"{what} is taken from {used.name}; not used: {others}",
        f"to use {other.name} instead: {topics_setting(setting)}",
    )
