"""A second process that answers questions: the same as without, whatever happens to it."""

import sys

import pytest
from test_worker import printed, pytestmark

__all__ = ["pytestmark"]

BEGIN = """
from graphslam.core.companion import Companion
known = {}
def answer(question):
    known[question] = known.get(question, 0) + 1
    return question * 2, known[question], os.getpid()
"""


def test_both_answer_and_each_remembers():
    """Breaks if the second process begins anew with each question, or answers are exchanged."""
    lines = printed(
        BEGIN
        + """
with Companion(answer) as second:
    for _ in range(3):
        mine, other = second.both(1, 2)
        print(mine[:2], mine[2] == here, other[:2], other[2] == here)
print(second.forked, len(known))
"""
    )
    assert lines == [f"(2, {k}) True (4, {k}) False" for k in (1, 2, 3)] + ["False 1"]


def test_without_a_second_process_both_are_answered_here():
    lines = printed(
        BEGIN
        + """
worker.allow_fork(second=False)
with Companion(answer) as second:
    print(second.forked, [a[0] for a in second.both(1, 2)], len(known))
"""
    )
    assert lines == ["False [2, 4] 2"]


@pytest.mark.parametrize("end", ["os._exit(0)", "os.kill(os.getpid(), 9)"])
def test_when_the_second_process_dies_this_one_answers(end):
    """Amid a question, and again after that. Breaks with an answer that is lost or waited for."""
    lines = printed(
        BEGIN
        + f"""
def dying(question):
    if question == 3 and os.getpid() != here:
        {end}
    return answer(question)
with Companion(dying) as second:
    for k in range(6):
        print([a[0] for a in second.both(10, k)], second.forked)
"""
    )
    assert lines == [f"[20, {2 * k}] {k < 3}" for k in range(6)]


def test_an_error_is_raised_here():
    lines = printed(
        BEGIN
        + """
def failing(question):
    if question == 2:
        raise LookupError("the second")
    return answer(question)
with Companion(failing) as second:
    try:
        second.both(1, 2)
    except LookupError as error:
        print(error)
"""
    )
    assert lines == ["the second"]


# ------------------------------------------------------------ a generator that works ahead

SUMS = """
from graphslam.core.companion import Exchange
def sums(end=""):
    total, k = 0, 0
    while k < 6:
        if end and k == 4 and os.getpid() != here:
            exec(end)
        value = yield k, total, os.getpid()
        total += value or 0
        k += 1
def taken(end=""):
    found = []
    with Exchange(lambda: sums(end)) as ahead:
        forked = ahead.forked
        while (item := ahead.receive()) is not None:
            if item[0] != 2:
                ahead.send(10 ** item[0])
            found.append(item[:2])
            last = item[2]
        assert ahead.receive() is None
    return found, forked, last == here
"""
#: item k has the sum of what was sent for the items before it; nothing is sent for the third
EXPECTED = [(k, sum(10**j for j in range(k) if j != 2)) for k in range(6)]


@pytest.mark.parametrize("second", [True, False])
def test_values_reach_the_generator_before_its_next_item(second):
    """Breaks if values come late, or if one that was not sent is waited for."""
    lines = printed(SUMS + f"worker.allow_fork(second={second})\nprint(*taken())")
    assert lines == [f"{EXPECTED} {second} {not second}"]


@pytest.mark.parametrize("second", [True, False])
def test_with_a_first_value_the_generator_is_an_item_ahead(second):
    """Each value comes an item later, and the last one too late: it is not waited for, nor missed.
    Breaks if the first value is lost, or if the second process ends before it is told to."""
    lines = printed(
        SUMS
        + f"""
worker.allow_fork(second={second})
found = []
with Exchange(sums, (0.5,)) as ahead:
    while (item := ahead.receive()) is not None:
        time.sleep(0.01)
        ahead.send(10 ** item[0])
        found.append(item[:2])
    print(found, ahead.receive())
"""
    )
    later = [(k, sum(10**j for j in range(k - 1)) + (0.5 if k else 0)) for k in range(6)]
    assert lines == [f"{later} None"]


@pytest.mark.parametrize("end", ["os._exit(0)", "os.kill(os.getpid(), 9)", "raise LookupError"])
def test_a_generator_that_dies_is_repeated_here_with_the_same_values(end):
    """Breaks with an item that is lost, that comes twice, or that was made with other values."""
    lines = printed(SUMS + f"print(*taken({end!r}))")
    assert lines == [f"{EXPECTED} True True"]


def test_an_exchange_that_is_left_early_leaves_no_process_behind():
    lines = printed(
        SUMS
        + """
with Exchange(sums) as ahead:
    ahead.receive()
try:
    os.waitpid(-1, os.WNOHANG)
except ChildProcessError:
    print("none")
"""
    )
    assert lines == ["none"]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets a pipe have more room")
def test_what_is_made_ahead_does_not_wait_for_who_is_busy():
    """Breaks with a common pipe, which has room for a quarter of these items."""
    lines = printed(
        """
import tempfile, time
from pathlib import Path
from graphslam.core.companion import Exchange
made = Path(tempfile.mkdtemp()) / "made"
def items():
    for number in range(3):
        yield bytes(80_000)
    made.touch()
with Exchange(items, (None, None, None)) as ahead:
    until = time.monotonic() + 30.0
    while not made.exists() and time.monotonic() < until:
        time.sleep(0.01)
    print(made.exists(), ahead.forked)
"""
    )
    assert lines == ["True True"]
