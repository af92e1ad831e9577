"""Dormant variables against the joint Gaussian of all, solved whole."""

import numpy as np
import pytest

from graphslam.estimation import dormant_variables
from graphslam.estimation.dormant_variables import DormantVariables, covariance
from graphslam.estimation.factors import landmark_key, state_key
from graphslam.estimation.square_root import Rows, column_slices, eliminate, stacked, triangular

STATES = [state_key(0, n) for n in range(3)]
LANDMARKS = [landmark_key(n) for n in range(8)]
DIMS = {**dict.fromkeys(STATES, 3), **{key: 2 + key % 2 for key in LANDMARKS}}


def measured(rng, keys, rows=4):
    """Random rows between some variables."""
    dims = {key: DIMS[key] for key in keys}
    return Rows(dims, rng.normal(size=(rows, sum(dims.values()))), rng.normal(size=rows))


def everything(parts):
    """Means and joint covariance of all variables, from all rows at once."""
    whole = stacked(parts, DIMS)
    cov = np.linalg.inv(whole.A.T @ whole.A)
    return cov @ whole.A.T @ whole.b, cov


def solved(rows):
    """Means by key, square root information and columns of variables in use."""
    R, d, _ = triangular(rows.A, rows.b)
    z = np.linalg.solve(R, d)
    slices = column_slices(rows.dims)
    return {key: z[at] for key, at in slices.items()}, R, slices


def assert_equal_to_everything(dormant, prior, parts):
    """Every mean and the whole covariance, in a shuffled order, as if nothing were dormant."""
    means, cov = everything(parts)
    in_use, root, slices = solved(prior)
    found = in_use | dormant.solve(in_use.__getitem__)
    for key, at in column_slices(DIMS).items():
        np.testing.assert_allclose(found[key], means[at], rtol=0, atol=1e-10)
    keys = [*LANDMARKS[::-1], *STATES[::-1]]
    order = np.concatenate([np.r_[column_slices(DIMS)[key]] for key in keys])
    joint = covariance(root, slices, dormant, keys)
    np.testing.assert_allclose(joint, cov[np.ix_(order, order)], rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_lost_while_variables_sleep_and_wake(seed):
    """Blocks given states and landmarks that become dormant later, measurements in between, and
    landmarks of the first and the second block woken together. Correlations left out would be off
    by their whole size."""
    rng = np.random.default_rng(seed)
    dormant = DormantVariables()
    parts = [measured(rng, DIMS, 40)]
    prior = stacked(parts, DIMS)

    def add(keys):
        nonlocal prior
        parts.append(measured(rng, keys))
        prior = stacked([prior, parts[-1]], prior.dims)
        assert_equal_to_everything(dormant, prior, parts)

    prior = dormant.add(prior, LANDMARKS[:3])
    assert dormant.anchors == set(STATES)
    add([STATES[1], LANDMARKS[4]])
    prior = dormant.add(prior, [STATES[0], LANDMARKS[3], LANDMARKS[5]])
    assert dormant.anchors == set(STATES[1:])
    add([STATES[2], LANDMARKS[7]])
    woken = dormant.wake([LANDMARKS[1], LANDMARKS[3]])
    dims = {**prior.dims, **{key: DIMS[key] for key in (LANDMARKS[1], LANDMARKS[3])}}
    prior = stacked([prior, *woken], dims)
    assert LANDMARKS[1] not in dormant and LANDMARKS[0] in dormant
    add([STATES[2], LANDMARKS[1], LANDMARKS[3]])
    prior = dormant.add(prior, [LANDMARKS[1], LANDMARKS[6]])
    add([STATES[1], LANDMARKS[7]])


def test_changes_of_dormant_variables_follow_those_in_use():
    rng = np.random.default_rng(1)
    dormant = DormantVariables()
    prior = dormant.add(measured(rng, DIMS, 40), LANDMARKS[:3])
    start, _, _ = solved(prior)
    moved = {key: z + rng.normal(size=(2, len(z))).T.sum(axis=1) for key, z in start.items()}
    before, after = (dormant.solve(z.__getitem__) for z in (start, moved))
    change = dormant.solve(lambda key: (moved[key] - start[key])[:, None], changes=1)
    for key in LANDMARKS[:3]:
        np.testing.assert_allclose(after[key] - before[key], change[key][:, 0], atol=1e-12)


def test_few_landmarks_stay_in_use(monkeypatch):
    monkeypatch.setattr(dormant_variables, "AT_ONCE", 3)
    dormant = DormantVariables()
    dormant.anchors = {STATES[0]}
    assert dormant.due(LANDMARKS[:2], STATES) == []
    assert dormant.due(LANDMARKS[:3], STATES) == [*LANDMARKS[:3], STATES[0]]


def test_what_no_estimate_makes_smaller_is_kept():
    """The squared residual of all rows at their solution, however they are eliminated."""
    rows = measured(np.random.default_rng(2), DIMS, 60)
    z, residual = np.linalg.lstsq(rows.A, rows.b)[:2]
    for count in (3, 7, len(DIMS)):
        rest = eliminate(rows, count)
        left = rest.b - rest.A @ z[len(z) - rest.A.shape[1] :]
        assert left @ left == pytest.approx(residual[0])
