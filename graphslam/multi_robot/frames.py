"""Robots in frames that nothing relates, in one estimate.

A frame is a set of robots whose starts are related. While they are estimated, frames lie so far
apart that no association can reach from one to another, and each has a map of its own: what bears
the same name in two of them is not taken for the same. At the end all go back to their origins.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from graphslam.core.geometry import Array, compose
from graphslam.core.records import Landmark, Message, RelativePose, Sighting, Start
from graphslam.mapping.landmark_map import Entry
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.odometry.interpolation import FrameTransforms, origin_shift
from graphslam.odometry.preintegration import Track

#: m: how far apart frames lie while they are estimated
FRAME_SPACING_M = 1e5
#: between frame and identity of landmarks in other frames than the world's; in no name
IDENTITY_SEPARATOR = "\0"


class RobotFrames:
    """Which robot is in which frame (``of``), and where frames other than the world's lie.

    A frame bears the name of the robot at whose start it hangs; ``away`` (m, along x) is where it
    lies while it is estimated.
    """

    def __init__(self, joined: FrameAssignment) -> None:
        self.of, self.world, self._starts = joined.frames, joined.world, joined.starts
        others = sorted(set(self.of.values()) - {self.world})
        self.away = {frame: (k + 1) * FRAME_SPACING_M for k, frame in enumerate(others)}

    def crosses_frames(self, message: Message) -> bool:
        """Whether a message relates robots whose frames are not related."""
        other = None
        if isinstance(message, Sighting):
            other = message.seen_robot
        elif isinstance(message, RelativePose):
            other = message.other
        if other is None or other not in self.of:
            return False
        return self.of[message.robot] != self.of[other]

    def with_frame_identity(self, message: Message) -> Message:
        """A message in which a landmark bears the name that it has in the frame of the robot."""
        if not self.away or not isinstance(message, Sighting) or message.identity is None:
            return message
        frame = self.of[message.robot]
        own = (
            message.identity
            if frame == self.world
            else f"{frame}{IDENTITY_SEPARATOR}{message.identity}"
        )
        return replace(message, identity=own)

    def offset_start(self, robot: str, start: Start) -> Start:
        """A robot's start where its frame lies while it is estimated."""
        away = np.array([self.away.get(self.of[robot], 0.0), 0.0, 0.0])
        return replace(start, pose=start.pose + away)

    def landmark_frames(self, entries: Iterable[Entry]) -> dict[int, str]:
        """Landmark -> in whose frame it is: whoever saw it has the same one."""
        return {entry.id: self.of[min(entry.path_m)] for entry in entries}

    def transforms(self, tracks: Mapping[str, Track], entries: Iterable[Entry]) -> FrameTransforms:
        """What takes every robot and landmark from where it was estimated into its frame.

        A prior is on the base of the robot at which a frame hangs, states are on its sensor.
        """
        by_frame: dict[str, Array] = {}
        for frame in sorted(set(self.of.values())):
            shift = origin_shift(self._starts[frame].pose, tracks[frame].mount)
            away = np.array([-self.away.get(frame, 0.0), 0.0, 0.0])
            by_frame[frame] = compose(shift, away)
        return FrameTransforms(
            {robot: by_frame[frame] for robot, frame in self.of.items()},
            {number: by_frame[frame] for number, frame in self.landmark_frames(entries).items()},
        )

    def label_landmarks(
        self, landmarks: tuple[Landmark, ...], entries: Iterable[Entry]
    ) -> tuple[Landmark, ...]:
        """The final map, in which landmarks of other frames than the world's say whose it is."""
        if not self.away:
            return landmarks
        frames = self.landmark_frames(entries)
        return tuple(
            mark
            if frames[mark.id] == self.world
            else replace(mark, identity=logged_identity(mark.identity), frame=frames[mark.id])
            for mark in landmarks
        )


def logged_identity(identity: str | None) -> str | None:
    """The name that a landmark bears in the log."""
    return identity and identity.rpartition(IDENTITY_SEPARATOR)[2]
