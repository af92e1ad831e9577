"""Decoding context of each topic, from a sample of its messages: mounts and no-return values."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphslam.core import records
from graphslam.core.config import Config
from graphslam.core.geometry import Array
from graphslam.logs import schemas
from graphslam.logs.cdr import HEADER, CdrError
from graphslam.logs.contradictions import contradictions
from graphslam.logs.decoders import TopicContext, frame_of
from graphslam.logs.findings import Finding
from graphslam.logs.laser_noise import find_range_noise
from graphslam.logs.mounts import (
    MAX_TILT_RAD,
    Mount,
    TransformTree,
    base_above,
    find_mount,
    is_level,
    is_projectable,
    is_same,
)
from graphslam.logs.no_return import find_no_return
from graphslam.logs.point_cloud import cloud_points, sweep_of
from graphslam.logs.recording import Recording, sample_messages
from graphslam.logs.tf_tree import (
    StaticTransform,
    TransformEdge,
    moving_link,
    sampled_edges,
    static_tree,
)
from graphslam.logs.topics import ODOMETRY_KINDS, Topic

# 16 x 16 messages over the whole log: enough to find a frequent value, quick to read
_SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK = 16, 16
#: records that may come without a stamp; increments have two, which must differ
_STAMPED = (records.Scan, records.Sighting, records.OdometryPose, records.WheelAngles)
_SENSING = (records.Scan, records.Sighting)
#: share of the poses in which a base leans that are too many to be bumps
SHARE_LEANING = 0.05
#: the last beam is elsewhere than stated by more than so many beams, and this share of the field
ODD_BEAMS, ODD_SHARE = 2.0, 0.01
#: bearings beyond the largest, how many at least and of all: they are no radians
LEAST_IN_DEGREES, SHARE_IN_DEGREES = 10, 0.25
#: rad: that is a turn, rounded as drivers do; the beams of a scan may begin up to a turn from ahead
#: and go all around
MAX_BEARING_RAD, MAX_SCAN_ANGLE_RAD = 2.02 * np.pi, 4.04 * np.pi

#: m: lasers see from nearer than that, and not so far
MAX_RANGE_MIN_M, MAX_RANGE_MAX_M = 2.0, 1000.0

_NONE: Mapping[str, str] = {}


@dataclass(frozen=True, slots=True)
class ScanShape:
    """Properties of a laser by its messages; a range limit that is not finite is None."""

    beams: int
    field_of_view_rad: float
    range_min_m: float | None
    range_max_m: float | None


def scan_shape(files: Sequence[Recording], topic: Topic) -> ScanShape | None:
    """Shape of the first scan of ``topic`` that can be decoded; None if there is none."""
    for message in sample_decoded(files, topic):
        if topic.schema == schemas.POINT_CLOUD:
            return _cloud_shape(message)
        beams = len(message.ranges)
        view = abs(float(message.angle_increment)) * max(beams - 1, 0)
        limits = (float(message.range_min), float(message.range_max))
        return ScanShape(beams, view, *(limit if np.isfinite(limit) else None for limit in limits))
    return None


def _cloud_shape(message: Any) -> ScanShape | None:
    try:
        bearings, ranges = sweep_of(cloud_points(message))
    except ValueError:
        return None
    return ScanShape(len(ranges), float(bearings[-1] - bearings[0]), None, None)


def topic_contexts(
    files: Sequence[Recording],
    topics: Sequence[Topic],
    config: Config,
    sensors: Mapping[str, str] = _NONE,
) -> tuple[dict[str, TopicContext], list[Finding]]:
    """Decoding context of each topic, and findings about assumptions that were made.

    ``sensors``: topic -> name of a robot's further laser. Its mount has to be known.
    """
    findings: list[Finding] = []
    odometry = [t for kind in ODOMETRY_KINDS[::-1] for t in topics if t.record is kind]
    bases = {t.robot: base_frame(files, t) for t in odometry}  # the preferred kind comes last
    by_wheels = {t.robot for t in odometry if t.record is records.WheelAngles}
    by_wheels -= {t.robot for t in odometry if t.record is not records.WheelAngles}
    contexts = {}
    robots = {t.robot for t in topics if t.count and t.record in (*ODOMETRY_KINDS, *_SENSING)}
    frames = _SensorFrames(files, config, bases, by_wheels, len(robots))
    for topic in topics:
        settings = config.robot(topic.robot)
        sensor = sensors.get(topic.name, "")
        told: dict[str, Any] = {}
        if topic.record in _SENSING:
            told, notes = frames.context(topic, sensor)
            findings += notes
        if topic.schema == schemas.ODOMETRY:
            findings += leaning(topic.name, _turns(files, topic))
        unstamped = topic.record in _STAMPED and _is_unstamped(files, topic)
        if unstamped:
            text = "all stamps are zero; the times of recording are used, which are less exact"
            remedy = "let its driver stamp the messages"
            findings.append(Finding("doubt", "stamps", topic.name, text, remedy))
        contexts[topic.name] = TopicContext(
            robot=topic.robot,
            at_once=not config.logs.undistort,
            left_joint=settings.left_joint,
            right_joint=settings.right_joint,
            by_log_time=unstamped,
            sensor=sensor,
            session=session_of(topic.robot) if config.logs.same_place else "",
            **told,
        )
    return contexts, findings


def session_of(robot: str) -> str:
    """The session of one of its several robots, empty for its only one; see `logs.sessions`."""
    session, _, own = robot.partition(".")
    return session if own else ""


class _SensorFrames:
    """What the frames of sensors are on their robots; transforms are read once for each robot."""

    def __init__(
        self,
        files: Sequence[Recording],
        config: Config,
        bases: Mapping[str, str],
        by_wheels: Collection[str],
        robots: int,
    ) -> None:
        """``bases``: robot -> frame that moves; ``by_wheels``: robots whose wheels tell how.

        ``robots``: how many there are.
        """
        self._files, self._config, self._bases = files, config, bases
        self._by_wheels = by_wheels
        self._robots = robots
        self._trees: dict[str, tuple[dict[str, TransformEdge], TransformTree]] = {}
        self._replaced: dict[str, dict[str, list[StaticTransform]]] = {}

    def _transforms(self, robot: str) -> tuple[dict[str, TransformEdge], TransformTree]:
        if robot not in self._trees:
            edges, replaced = (
                sampled_edges(self._files, robot),
                self._replaced.setdefault(robot, {}),
            )
            self._trees[robot] = edges, static_tree(self._files, robot, edges, replaced)
        return self._trees[robot]

    def context(self, topic: Topic, sensor: str) -> tuple[dict[str, Any], list[Finding]]:
        """Of a `TopicContext` what is about its frames and ranges, and findings.

        ``sensor``: name of a further laser, empty for the first.
        """
        settings = self._config.robot(topic.robot)
        laser = settings.lasers.get(sensor, ()) if sensor else settings.laser
        edges, tree = self._transforms(topic.robot)
        messages = list(sample_decoded(self._files, topic))
        is_scan = topic.record is records.Scan
        mounts: dict[str, Array] = {}
        inverted: set[str] = set()
        tilted: dict[str, Mount] = {}
        findings: list[Finding] = []
        counted = Counter(map(frame_of, messages))
        only = None
        if is_scan and len(counted) > 1:
            only, findings = _one_laser(topic, counted, tree, self._base(topic, min(counted), tree))
        if only is not None:
            messages = [message for message in messages if frame_of(message) == only]
        for frame in sorted(set(map(frame_of, messages))):
            base = self._base(topic, frame, tree)
            if sensor and base == frame:
                base = "the robot's base"  # nothing ties this laser to the others
            link = moving_link(edges, tree, base, frame) if is_scan else None
            mount, notes = _mount(topic, tree, base, (sensor, frame, link), laser)
            mounts[frame] = mount.pose
            if is_scan and not is_level(mount):
                tilted[frame] = mount
            elif mount.inverted:
                inverted.add(frame)
            findings += notes
            if not (is_scan and laser):
                where, setting = _names(topic, sensor, frame)
                replaced = self._replaced[topic.robot]
                told_by = (base, frame), tree, replaced, self._robots
                findings += contradictions(where, *told_by, setting if is_scan else "")
        told: dict[str, Any] = {
            "mounts": mounts, "inverted": frozenset(inverted), "tilted": tilted, "only_frame": only
        }  # fmt: skip
        if topic.schema == schemas.SIGHTING:
            bearings = [float(m.bearing) for m in messages]
            findings += in_degrees(topic.name, bearings, "their variance * (pi / 180)^2")
        if topic.schema == schemas.LASER_SCAN:
            first, step, stated = (
                np.array([getattr(m, name) for m in messages])
                for name in ("angle_min", "angle_increment", "angle_max")
            )
            last = first + step * [len(m.ranges) - 1 for m in messages]
            findings += odd_spacing(topic.name, first, last, stated, step)
            findings += in_degrees(
                topic.name, [*first, *last], "angle_increment too", MAX_SCAN_ANGLE_RAD
            )
            limits = np.array([(m.range_min, m.range_max) for m in messages])
            findings += odd_limits(topic.name, limits)
            no_return = find_no_return(message.ranges for message in messages)
            told["no_return_m"] = np.inf if no_return is None else no_return
        if is_scan:
            swept = (_swept(topic, m, told.get("no_return_m", np.inf)) for m in messages)
            told["range_noise"] = find_range_noise(scan for scan in swept if scan is not None)
        return told, findings

    def _base(self, topic: Topic, frame: str, tree: TransformTree) -> str:
        """The frame that moves with a robot, on which a sensor is."""
        above = base_above(tree, frame)
        if topic.robot in self._by_wheels and above.rpartition("/")[2].startswith("base"):
            return above  # no message of the wheels names it
        return self._bases.get(topic.robot, above)


def _swept(topic: Topic, message: Any, no_return_m: float) -> tuple[Array, Array] | None:
    """Ranges (n,) m, NaN without a return, and bearings (n,) rad of a message of a laser."""
    if topic.schema == schemas.POINT_CLOUD:
        try:
            points = cloud_points(message)
        except ValueError:
            return None
        return sweep_of(points)[::-1] if len(points) else None
    if topic.schema != schemas.LASER_SCAN:
        return None
    ranges = np.asarray(message.ranges, dtype=float)
    fine = (ranges >= message.range_min) & (ranges < min(message.range_max, no_return_m))
    return np.where(fine, ranges, np.nan), message.angle_increment * np.arange(len(ranges))


def _one_laser(
    topic: Topic, counted: Counter[str], tree: TransformTree, base: str
) -> tuple[str | None, list[Finding]]:
    """The frame of the laser that is used, where scans of several come on one topic.

    ``counted``: frame -> scans of a sample. None, and nothing to say, if tf has all at one mount:
    then they are names of one laser.
    """
    mounts = [find_mount(tree, base, frame) for frame in counted]
    first = mounts[0]
    if first is not None and all(one is not None and is_same(one, first) for one in mounts):
        return None, []
    used = max(sorted(counted), key=lambda frame: counted[frame])
    others = ", ".join(frame or "(none)" for frame in sorted(counted) if frame != used)
    text = f"scans of several lasers come on it: those in frame {used or '(none)'} are used, "
    text += f"those in frame {others} are left out"
    return used, [
        Finding("doubt", "frames", topic.name, text, "record each laser on a topic of its own")
    ]


def _turns(files: Sequence[Recording], topic: Topic) -> Array:
    """Quaternions (n, 4) x y z w of some of the poses of an odometry."""
    found = [np.zeros((0, 4))]
    for file in files:
        data = list(sample_messages(file, topic.name, _SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK))
        with suppress(CdrError):  # damaged ones are counted when the topic is read
            found += [schemas.odometry_table(data)["rotation"]] if data else []
    return np.concatenate(found)


def leaning(topic: str, turns: Array) -> list[Finding]:
    """That a base is not level, by quaternions (n, 4) x y z w of its poses, if that is so often."""
    with np.errstate(all="ignore"):  # of quaternions that are none
        off = np.hypot(turns[:, 0], turns[:, 1]) / np.linalg.norm(turns, axis=1)
        tilt = 2 * np.arcsin(np.minimum(off, 1.0))
    tilt = tilt[np.isfinite(tilt)]
    leans = tilt > MAX_TILT_RAD
    if not len(tilt) or np.mean(leans) < SHARE_LEANING:
        return []
    text = f"the base leans by up to {np.rad2deg(tilt.max()):.0f} deg, by more than "
    text += f"{np.rad2deg(MAX_TILT_RAD):.0f} in {100 * np.mean(leans):.0f} % of its poses; "
    text += "motions and scans are taken as level"
    remedy = "leave ramps and slopes out, or expect walls seen from there to be too far"
    return [Finding("doubt", "level", topic, text, remedy)]


def in_degrees(
    topic: str, bearings: Sequence[float], too: str, most_rad: float = MAX_BEARING_RAD
) -> list[Finding]:
    """That the bearings of a source are no angles in radians, if they are in degrees.

    ``too``: what else has to be written in radians then. ``most_rad``: how large they may be.

    One that is not wrapped is at most a turn away from one that is; of those in degrees few are.
    """
    sizes = np.abs(bearings)
    sizes = sizes[np.isfinite(sizes)]
    beyond = np.count_nonzero(sizes > most_rad)
    if beyond < LEAST_IN_DEGREES or beyond < SHARE_IN_DEGREES * len(sizes) or sizes.max() > 360:
        return []
    text = f"its bearings are in degrees: up to {sizes.max():.0f}, where a whole turn is 6.28 rad"
    remedy = f"write them in radians: bearing * pi / 180, and {too}"
    return [Finding("unusable", "units", topic, text, remedy)]


def odd_limits(topic: str, limits: Array) -> list[Finding]:
    """That limits of ranges (n, 2), from and to, are none of a laser's in metres."""
    if not len(limits):
        return []
    first, last = np.median(limits, axis=0).tolist()
    remedy = "write ranges and their limits in metres"
    if first > last:
        text = f"ranges are from {first:g} to {last:g} m, so that none is possible"
        remedy = "check range_min and range_max: are they exchanged?"
    elif first > MAX_RANGE_MIN_M or (np.isfinite(last) and last > MAX_RANGE_MAX_M):
        text = f"ranges are from {first:g} to {last:g} m: are they in mm or cm?"
    else:
        return []
    return [Finding("doubt", "units", topic, text, remedy)]


def odd_spacing(topic: str, first: Array, last: Array, stated: Array, step: Array) -> list[Finding]:
    """That angle_max, ``stated`` (n,), is not where beams end, ``last``: one of them is wrong.

    Some drivers leave it zero, or a beam or two off; rad.
    """
    off = np.abs(stated - last)
    odd = (off > ODD_BEAMS * np.abs(step)) & (off > ODD_SHARE * np.abs(last - first))
    if not len(off) or np.mean(odd & (stated != 0.0)) <= 0.5:
        return []
    end, said = np.degrees([np.median(last), np.median(stated)])
    text = (
        f"beams end at {end:.1f}° by angle_increment and their number, at {said:.1f}° by angle_max"
    )
    return [Finding("doubt", "angles", topic, text, "check both: a wrong spacing bends the map")]


def _is_unstamped(files: Sequence[Recording], topic: Topic) -> bool:
    """Whether all stamps of a topic are zero, as drivers leave them."""
    count = 0
    for file in files:
        for data in sample_messages(file, topic.name, 1, _SAMPLE_PER_BLOCK):
            if any(data[HEADER : HEADER + 8]):
                return False
            count += 1
    return count > 1


def sample_decoded(files: Sequence[Recording], topic: Topic) -> Iterator[Any]:
    """Decoded messages of ``topic``, sampled evenly over the log."""
    for file in files:
        data = sample_messages(file, topic.name, _SAMPLE_BLOCKS, _SAMPLE_PER_BLOCK)
        # damaged messages are counted when the topic is read
        yield from schemas.decode_all(topic.schema, data)


def base_frame(files: Sequence[Recording], topic: Topic) -> str:
    """Frame whose motion an odometry topic describes."""
    if topic.record is records.WheelAngles:
        return "base_link"  # JointState has no such frame; this is ROS' convention
    for message in sample_decoded(files, topic):
        name = message.child_frame_id if topic.record is records.OdometryPose else frame_of(message)
        return str(name).lstrip("/") or "base_link"
    return "base_link"


def _names(topic: Topic, sensor: str, frame: str) -> tuple[str, str]:
    """How findings name a sensor in ``frame``, and the option that states its mount."""
    key = f"lasers.{sensor}" if sensor else "laser"
    setting = f"--set 'robots.{topic.robot}.{key}=[X, Y, YAW]' (m, m, rad)"
    return f"{topic.name}: frame {frame or '(none)'}", setting


def _mount(
    topic: Topic,
    tree: TransformTree,
    base: str,
    of: tuple[str, str, TransformEdge | None],
    configured: Sequence[float],
) -> tuple[Mount, list[Finding]]:
    """The mount of a sensor on the robot, and findings; one that is configured is level.

    ``of``: its name, if it is a further laser, its frame, and what moves between it and the base.
    """
    sensor, frame, link = of
    where, setting = _names(topic, sensor, frame)
    found = find_mount(tree, base, frame)
    inverted = found is not None and found.inverted
    if len(configured) == 3 and topic.record is records.Scan:
        return Mount(np.array(configured, dtype=float), inverted, 0.0), []
    if found is None:
        if topic.record is records.Sighting and not frame:
            return Mount(np.zeros(3), False, 0.0), []  # no frame: measured from the base
        text = f"tf_static has no transform from {base}"
        remedy = f"record /tf_static, or {setting}"
        if link is not None:
            text = f"moves on the robot: {link.child} in {link.parent} on {link.topic}; "
            text += "mounts that move are not followed"
            remedy = f"record a laser that does not move; if it does not, {setting}"
        if sensor or link is not None:
            return Mount(np.zeros(3), False, 0.0), [
                Finding("unusable", "mount", where, text, remedy)
            ]
        text += "; assumed to be the base itself"
        return Mount(np.zeros(3), False, 0.0), [Finding("doubt", "mount", where, text, remedy)]
    if is_level(found):
        return found, []
    return found, [_tilt(topic, found, where, setting)]


def _tilt(topic: Topic, mount: Mount, where: str, setting: str) -> Finding:
    """What is done about a sensor that is not level."""
    text = f"is tilted by {np.rad2deg(mount.tilt_rad):.0f} deg by tf"
    remedy = f"if it is level, {setting}"
    if topic.record is records.Sighting:
        text += "; bearings and ranges are taken as level"
        return Finding("doubt", "mount", where, text, "state them in a level frame")
    if not is_projectable(mount):
        text += ": its scans are no section of walls"
        remedy += "; else record a level laser, or leave this one out with logs.topics"
        return Finding("unusable", "mount", where, text, remedy)
    text += ": its returns are projected on the plane, as of vertical walls; those of the floor "
    text += "are left out"
    return Finding("doubt", "mount", where, text, remedy)
