"""Text files: marks of editors are no content, logs of lines that cannot be read are refused."""

import codecs
import gzip

import pytest

from graphslam.core.errors import LogError
from graphslam.importers import IMPORTERS

SCAN = "FLASER 3 1.25 2.5 81.83 0 0 0 0 0 0 {0} host 0.2\n"
ODOMETRY = "ODOM {0} 0 0 0 0 0 {0} host 0.1\n"
GRAPH = "EDGE_SE2 0 1 0.5 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 0.5 0 0 1 0 0 1 0 1\n"


@pytest.mark.parametrize(
    ("name", "text"),
    [("carmen", ODOMETRY.format(1) + SCAN.format(1.5)), ("g2o", GRAPH), ("isam", GRAPH)],
)
@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_a_byte_order_mark_is_no_part_of_the_first_line(name, text, pack, tmp_path):
    suffix = ".gz" if pack is gzip.compress else ""
    plain, marked = (tmp_path / f"{made}.{name}{suffix}" for made in ("plain", "marked"))
    plain.write_bytes(pack(text.encode()))
    marked.write_bytes(pack(codecs.BOM_UTF8 + text.encode()))
    counts, told = [], []
    for source in (plain, marked):
        summary = IMPORTERS[name](source, tmp_path / "log.mcap")
        counts.append(summary.counts)
        told.append([warning.removeprefix(str(source)) for warning in summary.warnings])
    assert counts[0] == counts[1] and told[0] == told[1]


def without_end(line):
    """The line without host and logger time, as some programs write it."""
    return " ".join(line.split()[:-2]) + "\n"


def test_a_log_none_of_whose_laser_lines_can_be_read_is_refused(tmp_path):
    """Its lines of odometry can be, with stamps from other fields."""
    source, target = tmp_path / "log.clf", tmp_path / "log.mcap"
    lines = [line.format(k) for k in range(1, 30) for line in (ODOMETRY, SCAN)]
    source.write_text("".join(map(without_end, lines)))
    with pytest.raises(LogError, match=r"none of its 29 lines of lasers .* host and logger time"):
        IMPORTERS["carmen"](source, target)
    assert not target.exists()
    source.write_text("".join([*map(without_end, lines), *lines[:2]]))
    assert IMPORTERS["carmen"](source, target).counts["/scan"] == 1
