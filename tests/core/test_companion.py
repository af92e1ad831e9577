"""A second process that answers questions: the same as without, whatever happens to it."""

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
