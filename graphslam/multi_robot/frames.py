"""Several frames in one estimate, for robots whose relative poses are unknown.

A frame is a set of robots whose starts are related. While they are estimated, frames lie so far
apart that no gate reaches from one to another, and each has a map of its own: landmarks of the same
identity in two frames are different landmarks. At the end all frames go back to their origins.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from graphslam.core.geometry import Array, compose
from graphslam.core.record import replace
from graphslam.core.records import Landmark, Message, RelativePose, Sighting, Start
from graphslam.mapping.landmark_map import Entry
from graphslam.multi_robot.frame_tree import FrameAssignment
from graphslam.odometry.interpolation import FrameTransforms, origin_shift
from graphslam.odometry.preintegration import Track

#: m: distance of neighbouring frames while they are estimated, farther than any building is long
FRAME_SPACING_M = 1e5
#: between frame and identity of landmarks outside the world frame; no identity contains it
IDENTITY_SEPARATOR = "\0"


class RobotFrames:
    """The frame of each robot (``of``), and where frames other than the world's lie.

    A frame is named after the robot that begins at its origin; ``away`` (m, along x) is where it
    lies while it is estimated.
    """

    def __init__(self, assignment: FrameAssignment) -> None:
        self.of, self.world = assignment.frames, assignment.world
        self._starts = assignment.starts
        others = sorted(set(self.of.values()) - {self.world})
        self.away = {frame: (k + 1) * FRAME_SPACING_M for k, frame in enumerate(others)}

    def crosses_frames(self, message: Message) -> bool:
        """Whether a message is about two robots in different frames."""
        other = None
        if isinstance(message, Sighting):
            other = message.seen_robot
        elif isinstance(message, RelativePose):
            other = message.other
        if other is None or other not in self.of:
            return False
        return self.of[message.robot] != self.of[other]

    def with_frame_identity(self, message: Message) -> Message:
        """The message; in a frame other than the world's, a landmark's identity has its prefix."""
        if not self.away or not isinstance(message, Sighting) or message.identity is None:
            return message
        frame = self.of[message.robot]
        if frame == self.world:
            return message
        return replace(message, identity=f"{frame}{IDENTITY_SEPARATOR}{message.identity}")

    def offset_start(self, robot: str, start: Start) -> Start:
        """The start of a robot where its frame lies while it is estimated."""
        away = np.array([self.away.get(self.of[robot], 0.0), 0.0, 0.0])
        return replace(start, pose=start.pose + away)

    def landmark_frames(self, entries: Iterable[Entry]) -> dict[int, str]:
        """Landmark -> its frame, that of any robot that saw it."""
        return {entry.id: self.of[min(entry.path_m)] for entry in entries}

    def transforms(self, tracks: Mapping[str, Track], entries: Iterable[Entry]) -> FrameTransforms:
        """Transforms of every robot and landmark from where it was estimated into its frame.

        A prior is on the base of the robot that begins at a frame's origin, states are its sensor.
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
        """The final map: identities as in the log, the frame of landmarks outside the world's."""
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
    """The identity that a landmark has in the log."""
    return identity and identity.rpartition(IDENTITY_SEPARATOR)[2]
