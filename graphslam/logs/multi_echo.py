"""sensor_msgs/MultiEchoLaserScan as LaserScan: of each beam its first echo.

The first echo is that of the nearest thing: rain, dust and glass have it too, but a later one may
be missing, so that another would be taken from beam to beam.
"""

import numpy as np

from graphslam.logs.cdr import Decoder
from graphslam.logs.cdr_writing import scan_bytes
from graphslam.logs.schemas import stamp_ns

MULTI_ECHO = "sensor_msgs/msg/MultiEchoLaserScan"

_DECODER = Decoder(
    {
        MULTI_ECHO: """\
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
sensor_msgs/LaserEcho[] ranges
sensor_msgs/LaserEcho[] intensities
""",
        "sensor_msgs/LaserEcho": "float32[] echoes",
        "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
        "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    }
)


def first_echoes(data: bytes) -> bytes:
    """The LaserScan, in CDR, of the MultiEchoLaserScan in ``data``; ranges in m, inf without echo.

    Raises:
        CdrError: the bytes are cut short or are not such a message.
    """
    message = _DECODER.decode(MULTI_ECHO, data)
    ranges = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in message.ranges]
    return scan_bytes(
        stamp_ns(message.header.stamp),
        message.header.frame_id,
        message.angle_min,
        message.angle_increment,
        np.array(ranges, dtype=np.float32),
        (message.range_min, message.range_max),
        (message.time_increment, message.scan_time),
    )
