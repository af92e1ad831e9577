"""Sorting of messages by time, and what is left out of it."""

import numpy as np

from graphslam.core.records import Sighting
from graphslam.logs.time_order import REPEATED_SIGHTING, MessageSorter


def test_a_sighting_that_is_recorded_twice_counts_once():
    """As of recordings that were put together. Two that differ in anything are both kept."""

    def seen(range_m, identity="a"):
        z, cov = np.array([0.1, range_m]), np.eye(2)
        return Sighting("r", 5, 5, z, cov, identity, None, np.zeros(3))

    order = MessageSorter(10)
    given = [seen(1.0), seen(1.0), seen(2.0), seen(1.0, "b"), seen(1.0)]
    kept = [out for one in given for out in order.push("t", one)] + list(order.finish())
    assert [(one.z[1], one.identity) for one in kept] == [(1.0, "a"), (2.0, "a"), (1.0, "b")]
    assert order.counts["t"][REPEATED_SIGHTING] == 2
