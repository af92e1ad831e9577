"""The error of reference relations, by three of them among three scans."""

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.geometry import between, compose, exp
from graphslam.core.records import Trajectory
from graphslam.evaluation.relation_metrics import (
    MIN_TRIANGLES,
    REFERENCE_SIGMA_M,
    Relations,
    _relation_group,
    closing_errors,
    closing_sigmas,
    match_relations,
    relation_metrics,
)

SIGMA_M, SIGMA_RAD = 0.05, 0.008


def path_and_relations(sigmas, n=400):
    """A path of n scans, and noisy relations of each to the next two, some told backwards."""
    rng = np.random.default_rng(3)
    poses = [np.zeros(3)]
    for _ in range(n - 1):
        poses.append(compose(poses[-1], exp(np.array([0.4, 0.0, rng.normal(0.0, 0.2)]))))
    path = np.array(poses)
    pairs = [(k, k + d) for k in range(n) for d in (1, 2) if k + d < n]
    pairs = [pair[::-1] if rng.random() < 0.3 else pair for pair in pairs]
    first, second = np.array(pairs).T
    noise = rng.normal(size=(len(pairs), 3)) * sigmas
    told = compose(between(path[first], path[second]), noise)
    stamps = 1_000_000_000 * np.arange(n, dtype=np.int64)
    scans = Trajectory(stamps, path, np.tile(np.eye(3) * 1e-8, (n, 1, 1)))
    return scans, Relations(stamps[first], stamps[second], told)


def test_the_error_of_the_reference_is_found_from_its_triangles():
    """Within three of its own sigmas: of 398 triangles a twentieth each."""
    _, relations = path_and_relations([SIGMA_M, SIGMA_M, SIGMA_RAD])
    errors = closing_errors(relations)
    found = closing_sigmas(errors)
    assert len(errors) == 398
    # a heading that is off moves the far end of the next relation, 0.4 m away: less than a tenth
    assert found == pytest.approx((SIGMA_M, SIGMA_RAD), rel=0.15)


def test_exact_relations_close_whichever_way_they_are_told():
    _, relations = path_and_relations([0.0, 0.0, 0.0])
    assert np.abs(closing_errors(relations)).max() < 1e-12


def test_few_triangles_tell_nothing():
    _, relations = path_and_relations([SIGMA_M] * 3, n=MIN_TRIANGLES + 1)
    errors = closing_errors(relations)
    assert len(errors) == MIN_TRIANGLES - 1
    assert closing_sigmas(errors) is None


def test_shares_are_those_of_the_error_that_was_found():
    """Exact poses against a reference that is off by 5 cm: 95 % inside by its triangles (798
    relations: 1 % is 1.3 sigmas), far fewer by the 2 cm that are allowed otherwise."""
    scans, relations = path_and_relations([SIGMA_M, SIGMA_M, SIGMA_RAD])
    found = match_relations(relations, scans)
    known = replace(found, covs=np.tile(np.eye(3) * 1e-8, (len(found.errors), 1, 1)))
    shares = _relation_group(known, known.matched, closing_sigmas(closing_errors(relations)))
    assert shares["trans_inside_closing"] == pytest.approx(0.95, abs=0.04)
    assert shares["rot_inside_closing"] == pytest.approx(0.95, abs=0.04)
    assert shares["trans_inside"] < 0.6


def test_the_metrics_say_what_was_found_and_are_null_without_covariances():
    """Shares inside 95 % need covariances of the scans; the error of the reference does not."""
    scans, relations = path_and_relations([SIGMA_M, SIGMA_M, SIGMA_RAD])
    found = relation_metrics(relations, scans)
    assert found["reference"]["triangles"] == 398
    assert found["reference"]["sigma_m"] > 2 * REFERENCE_SIGMA_M
    assert found["reference"]["sigma_deg"] == pytest.approx(np.degrees(SIGMA_RAD), rel=0.15)
    assert found["all"]["trans_inside"] is None and found["all"]["trans_inside_closing"] is None
