"""Walls that are curved, by the pieces that a robot sees of them."""

import numpy as np
import pytest

from graphslam.core.records import Association
from graphslam.verdict.curved_walls import curved_share


def chain(turns, images=20):
    """Pieces of 1 m, the end of each where the next begins, counter-clockwise about the sensor."""
    pieces, at, heading = [], np.array([-3.0, -4.0]), -sum(turns) / 2
    for turn in (*turns, 0.0):
        along = np.array([np.cos(heading), np.sin(heading)])
        pieces.append(np.array([*(at + 0.5 * along), heading]))
        at, heading = at + along, heading + turn
    extent, cov = np.array([-0.5, 0.5]), np.diag([1.0, 1e-4, 2.5e-5])
    return [
        Association("r", k, n, "line", piece, cov, extent=extent)
        for k in range(images)
        for n, piece in enumerate(pieces)
    ]


@pytest.mark.parametrize(
    ("turns_deg", "share"),
    [
        ((8, 8, 8, 8, 8), 1.0),  # a round wall of radius 7 m
        ((-8, -8, -8, -8, -8), 1.0),  # from within and from without
        ((60, 8, 8, 60, 0), 0.5),  # a bay window of three pieces, three of straight walls
        ((45, 45, 45, 45, 45), 0.0),  # an eight-sided room has walls
        ((8, -8, 8, -8, 8), 0.0),  # a wall with buttresses is no curve
        ((0.5, 0.5, 0.5, 0.5, 0.5), 0.0),  # noise of directions
    ],
)
def test_three_pieces_in_a_row_that_turn_alike_are_a_curve(turns_deg, share):
    assert curved_share(chain(np.radians(turns_deg))) == pytest.approx(share)


def test_pieces_of_different_images_are_no_chain():
    """Nor are a few pieces enough to tell."""
    pieces = chain(np.radians([8, 8, 8, 8, 8]))
    apart = [
        Association(a.robot, k, a.target, a.model, a.z, a.cov, extent=a.extent)
        for k, a in enumerate(pieces)
    ]
    assert curved_share(apart) == 0.0
    assert curved_share(pieces[:48]) == 0.0
