"""What a log's odometry has to do with it when nothing can be estimated."""

from graphslam.core.config import Config
from graphslam.logs import LogSet
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.pipeline.synchronisation import ODOMETRY
from graphslam.verdict.odometry_doubts import impossible_speed


def impossible_odometry(log: LogSet, config: Config) -> list[str]:
    """What no robot does in the log's odometry, which is read for this: a line for each."""
    tracks = make_tracks(log, config)
    others = {topic.record for topic in log.topics} - set(ODOMETRY)
    for message in log.messages(tuple(others)):
        if isinstance(message, ODOMETRY):
            tracks[message.robot].add(message)
    return [
        f"{name}: its odometry {text}"
        for name, track in tracks.items()
        if len(track)
        for text in impossible_speed(track.times, track.pose(track.times), track.resets)
    ]
