"""Whether an error is Ctrl-C."""

from graphslam.cli.interrupts import is_interrupt


def raised_from(error, cause):
    error.__cause__ = cause
    return error


def test_an_error_is_an_interrupt_if_it_was_raised_from_one():
    assert is_interrupt(raised_from(ValueError(), raised_from(OSError(), KeyboardInterrupt())))
    assert not is_interrupt(raised_from(ValueError(), OSError()))


def test_errors_that_cause_each_other_are_looked_at_once():
    """The command went round for ever where an error was raised from itself."""
    one = ValueError()
    other = raised_from(OSError(), one)
    raised_from(one, other)
    assert not is_interrupt(one)
    assert not is_interrupt(raised_from(other, other))
