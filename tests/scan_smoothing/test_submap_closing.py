"""What is decided about loop closures from round to round."""

import numpy as np

from graphslam.core.records import Closure
from graphslam.scan_smoothing.submap_closing import ClosureLedger, State


def closure(number):
    """A closure of its own pair of states."""
    return Closure("r", 10 * number, "r", 1, np.zeros(3), np.eye(3))


def test_what_was_inconsistent_is_proposed_again_and_may_be_used_later():
    """Breaks if a round forgets what the one before refused, or uses it out of turn."""
    a, b, sure = closure(1), closure(2), closure(3)
    ledger = ClosureLedger()
    assert ledger.decide(ledger.proposed([a, b]), [sure], [a, sure])
    assert ledger.used == [a, sure]
    assert ledger.having(State.REFUSED) == [b]
    again = ledger.proposed([])
    assert again == [b]
    assert ledger.decide(again, [], [b])
    assert ledger.used == [a, sure, b]
    assert not ledger.having(State.REFUSED)


def test_closures_that_only_confirm_end_the_rounds():
    """Breaks if a round without a correction makes one more solution, or is counted as one."""
    sure = closure(3)
    ledger = ClosureLedger()
    assert not ledger.decide(ledger.proposed([]), [sure], [sure])
    assert ledger.used == []


def test_what_the_solution_contradicts_is_taken_back_and_counted_if_it_moved_the_estimate():
    """Breaks if a confirming closure that is taken back counts as refused."""
    a, b, sure = closure(1), closure(2), closure(3)
    ledger = ClosureLedger()
    ledger.decide(ledger.proposed([a, b]), [sure], [a, b, sure])
    ledger.take_back([True, False, True])
    assert ledger.used == [b]
    assert ledger.taken_back == 1


def test_a_correction_stays_one_when_its_pair_is_confirmed():
    """Breaks if a later match of the same submaps makes a used correction a mere confirmation."""
    a, b = closure(1), closure(2)
    ledger = ClosureLedger()
    ledger.decide(ledger.proposed([a]), [], [a])
    again = closure(1)
    ledger.decide(ledger.proposed([b]), [again], [again, b])
    assert ledger.having(State.CORRECTING) == [again, b]


def test_a_used_closure_stays_if_a_newer_match_of_its_pair_is_inconsistent():
    """Breaks if the newer match replaces it, or takes it out."""
    a = closure(1)
    ledger = ClosureLedger()
    ledger.decide(ledger.proposed([a]), [], [a])
    assert not ledger.decide(ledger.proposed([closure(1)]), [], [])
    assert ledger.used == [a]
