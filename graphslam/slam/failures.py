"""What a log's odometry has to do with it when nothing can be estimated."""

from collections.abc import Iterator

from graphslam.core.config import Config
from graphslam.core.errors import EstimationError
from graphslam.logs import LogSet
from graphslam.pipeline.robot_settings import make_tracks
from graphslam.pipeline.synchronisation import ODOMETRY
from graphslam.verdict.odometry_doubts import impossible_speed


def explained(error: EstimationError, log: LogSet, config: Config) -> EstimationError:
    """The error, with what no robot does in the log's odometry, which is read for this."""
    found = [*_impossible_odometry(log, config)]
    return EstimationError(f"{error}; {'; '.join(found)}") if found else error


def _impossible_odometry(log: LogSet, config: Config) -> Iterator[str]:
    tracks = make_tracks(log, config)
    others = {topic.record for topic in log.topics} - set(ODOMETRY)
    for message in log.messages(tuple(others)):
        if isinstance(message, ODOMETRY):
            tracks[message.robot].add(message)
    for name, track in tracks.items():
        if len(track):
            times = track.times
            for text in impossible_speed(times, track.pose(times), track.resets):
                yield f"{name}: its odometry {text}"
