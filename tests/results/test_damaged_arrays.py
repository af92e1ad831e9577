"""Files of arrays that are damaged are an error of one kind, which names the file."""

from io import BytesIO

import numpy as np
import pytest

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.errors import OutputError
from graphslam.results.joint_file import read_joint
from graphslam.results.known_map_file import _read
from graphslam.results.scans_file import read_scans

READERS = (read_joint, read_scans, lambda path: _read(path, "", ScanMatchingConfig()))


def packed():
    """A file of arrays, compressed."""
    made = BytesIO()
    np.savez_compressed(made, format=np.arange(2000) % 7)
    return made.getvalue()


def wrong_bytes(data):
    """The same with some bytes of the compressed array changed."""
    middle = len(data) // 3
    return data[:middle] + bytes(255 - b for b in data[middle : middle + 20]) + data[middle + 20 :]


DAMAGED = {
    "empty": b"",
    "cut": packed()[:60],
    "wrong bytes": wrong_bytes(packed()),
    "no archive": b"not an archive of arrays",
}


@pytest.mark.parametrize("read", READERS, ids=("joint", "scans", "known map"))
@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_file_of_arrays_is_an_error_that_names_it(read, data, tmp_path):
    """An empty one, as a full disk leaves it, ended as a defect of the program."""
    path = tmp_path / "arrays.npz"
    path.write_bytes(data)
    with pytest.raises(OutputError, match=r"arrays\.npz"):
        read(path)
