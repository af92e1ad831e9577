"""The command line called in this process."""

import contextlib
import io
import re
from types import SimpleNamespace

import pytest

from graphslam.cli import main


def call(*arguments):
    """Exit code, stdout and stderr of one command, in this process."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as leaving,
    ):
        main([str(argument) for argument in arguments])
    return SimpleNamespace(code=leaving.value.code or 0, out=out.getvalue(), err=err.getvalue())


def check_one_line(done):
    assert done.code == 1
    assert done.out == ""
    assert re.fullmatch(r"graphslam: error: [^\n]+\n", done.err), done.err
    return done.err
