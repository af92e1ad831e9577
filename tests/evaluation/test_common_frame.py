"""Results and truths in different world frames, and words on what NEES says."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_results import orchard, room

from graphslam.core.config import KnownMapConfig, StartConfig
from graphslam.core.geometry import compose, transform
from graphslam.core.records import Trajectory, TrueLandmark
from graphslam.evaluation.common_frame import places
from graphslam.evaluation.error_statistics import effective_number, nees_series, nees_statistics
from graphslam.evaluation.metrics import evaluate
from graphslam.results.metric_tables import evaluation_notes, evaluation_tables

ELSEWHERE = np.array([30.0, -12.0, 2.0])


def point(identity, xy):
    return TrueLandmark("", 0, 0, identity, "point", np.array([*xy, np.nan]), None)


def wall(number, start, end):
    pose = np.array([*start, np.arctan2(*(np.array(end) - start)[::-1])])
    return TrueLandmark("", 0, 0, f"wall {number}", "segment", pose, np.array([start, end], float))


def moved(truths, world=ELSEWHERE):
    return {
        name: Trajectory(t.stamps_ns, compose(world, t.poses), t.covs) for name, t in truths.items()
    }


def tables(found):
    return {title: heads for title, heads, _ in evaluation_tables(found)}


@pytest.fixture(scope="module")
def garden():
    result, truths, xy = orchard(keyframes=120, trees=20)
    return result, truths, xy


def test_truth_in_another_frame_leaves_aligned_errors_only_and_says_so(garden):
    """Nothing but the frame differs: what is left must be what was there before."""
    result, truths, xy = garden
    true = [point(str(k), p) for k, p in enumerate(xy)]
    same = evaluate(result, truths, true)
    away = evaluate(
        result, moved(truths), [point(t.identity, transform(ELSEWHERE, t.pose[:2])) for t in true]
    )
    assert same["common_frame"] and not away["common_frame"]
    for kind in ("final", "causal"):
        before, after = same["joint"][kind], away["joint"][kind]
        for key in ("ate_aligned_rmse_m", "max_aligned_m", "heading_aligned_rmse_rad"):
            assert after[key] == pytest.approx(before[key], rel=1e-6)
        for key in ("ate_rmse_m", "max_m", "heading_rmse_rad", "nees_per_dof", "nees_bounds",
                    "nees_verdict", "coverage"):  # fmt: skip
            assert before[key] is not None and after[key] is None
    landmarks = away["landmarks"]
    assert (landmarks["matched"], landmarks["missed"], landmarks["aligned_by"]) == (20, 0, "poses")
    assert landmarks["nees_per_dof"] is None
    assert landmarks["rmse_m"] == pytest.approx(same["landmarks"]["rmse_m"], rel=0.3)
    (note,) = [text for text in evaluation_notes(away) if "no world frame in common" in text]
    assert "alignment of the poses" in note
    heads = tables(away)["Against true poses"]
    assert "aligned, m" in heads and "ATE, m" not in heads and "NEES/dof" not in heads
    assert "ATE, m" in tables(same)["Against true poses"]


def test_a_start_that_was_given_is_believed(garden):
    """Then an estimate that is elsewhere is wrong, not in another frame."""
    result, truths, _ = garden
    for start in (StartConfig(from_truth=True), StartConfig(poses={"a": (0.0, 0.0, 0.0)})):
        given = replace(result, config=replace(result.config, start=start))
        found = evaluate(given, moved(truths))
        assert found["common_frame"]
        assert found["joint"]["final"]["ate_rmse_m"] > 10
        assert found["joint"]["final"]["nees_verdict"] == "too confident"


def test_a_start_in_a_known_map_says_nothing_about_the_truth(garden):
    """It is in the frame of the map: that is the truth's only if the map was begun by a start."""
    result, truths, _ = garden
    start = StartConfig(poses={"a": (0.0, 0.0, 0.0)})
    in_map = replace(result.config, start=start, known_map=KnownMapConfig("monday"))
    for given in (False, True):
        summary = {**result.summary, "known_map": {"world_given": given}}
        found = evaluate(replace(result, config=in_map, summary=summary), moved(truths))
        assert found["common_frame"] == given
        assert (found["joint"]["final"]["ate_rmse_m"] is None) != given
    sampled = replace(in_map, start=StartConfig(from_truth=True))
    assert evaluate(replace(result, config=sampled), moved(truths))["common_frame"]


@pytest.mark.parametrize("names", [True, False])
def test_landmarks_alone_are_aligned_by_names_or_by_their_constellation(garden, names):
    """Three that are out of place, as with wrong names, do not drag the others along."""
    result, _, xy = garden
    there = transform(ELSEWHERE, xy)
    there[:3] += [[40.0, 3.0], [-9.0, 25.0], [7.0, -30.0]]
    landmarks = tuple(
        replace(landmark, identity=str(k) if names else None)
        for k, landmark in enumerate(sorted(result.landmarks, key=lambda one: one.id))
    )
    true = [point(str(k) if names else "", p) for k, p in enumerate(there)]
    found = evaluate(replace(result, landmarks=landmarks), None, true)
    assert not found["common_frame"]
    assert found["landmarks"]["aligned_by"] == ("identities" if names else "constellation")
    near = 20 if names else 17
    assert found["landmarks"]["matched"] == near
    assert np.median([found["landmarks"]["rmse_m"]]) < (100 if names else 0.2)
    at_home = evaluate(
        replace(result, landmarks=landmarks),
        None,
        [point(str(k) if names else "", p) for k, p in enumerate(xy)],
    )
    assert at_home["common_frame"] and at_home["landmarks"]["matched"] == 20


def test_walls_alone_are_aligned_by_their_corners():
    result, _ = room(keyframes=80, beams=5)
    true = [wall(k, *transform(ELSEWHERE, one.extent)) for k, one in enumerate(result.landmarks)]
    assert len(places(true)) >= 6
    found = evaluate(result, None, true)
    assert not found["common_frame"]
    assert found["landmarks"]["matched"] == len(result.landmarks)
    assert found["landmarks"]["rmse_m"] < 0.05


def test_a_map_that_fits_nowhere_is_not_matched(garden):
    """Not as all missed: the truth may be of somewhere else, or too little."""
    result, _, _ = garden
    rng = np.random.default_rng(3)
    landmarks = tuple(replace(landmark, identity=None) for landmark in result.landmarks)
    true = [point("", p) for p in rng.uniform(0, 500, (20, 2))]
    found = evaluate(replace(result, landmarks=landmarks), None, true)
    assert found["landmarks"]["matched"] is found["landmarks"]["missed"] is None
    assert any("cannot be matched" in text for text in evaluation_notes(found))


# ---------------------------------------------------------------- effective number, words


def correlated(n, share, rng):
    """White noise of unit covariance, of which ``share`` is carried on to the next one."""
    out = np.empty((n, 3))
    out[0] = rng.normal(size=3)
    for k in range(1, n):
        out[k] = share * out[k - 1] + np.sqrt(1 - share**2) * rng.normal(size=3)
    return out


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, 0.97])
def test_correlated_errors_count_as_fewer(share):
    """The NEES of errors with correlation s^k has s^2k: n (1 - s²) / (1 + s²) of them count."""
    rng = np.random.default_rng(8)
    found = np.mean([effective_number(correlated(4000, share, rng)) for _ in range(20)])
    assert found == pytest.approx(4000 * (1 - share**2) / (1 + share**2), rel=0.3)


def test_one_error_throughout_counts_once():
    """An offset of the start: a mean taken from the series itself would leave nothing of it."""
    assert effective_number(np.tile([1.0, -2.0, 0.5], (500, 1))) < 2
    assert effective_number(np.ones((1, 3))) == 1.0


def test_words_come_for_wrong_covariances_and_seldom_for_right_ones():
    """Bounds for independent poses would call half of the right ones wrong."""
    rng = np.random.default_rng(11)
    verdicts = {1.0: [], 0.25: [], 4.0: []}
    for _ in range(200):
        z = correlated(1000, 0.95, rng)
        for scale, found in verdicts.items():
            cov = np.tile(scale * np.eye(3), (len(z), 1, 1))
            found.append(nees_statistics([nees_series(z, cov)])["nees_verdict"])
    assert np.mean([v == "consistent" for v in verdicts[1.0]]) >= 0.9
    assert np.mean([v == "too confident" for v in verdicts[0.25]]) > 0.99
    assert np.mean([v == "too cautious" for v in verdicts[4.0]]) > 0.99


def test_the_words_say_which_way_and_by_how_much():
    rng = np.random.default_rng(2)
    z = rng.normal(size=(400, 3))
    for scale, way, size in (
        (0.25, "too confident", "2 times as large"),
        (4.0, "too cautious", "2 times as small"),
    ):
        found = nees_statistics([nees_series(z, np.tile(scale * np.eye(3), (400, 1, 1)))])
        (text,) = evaluation_notes({"robots": {"r": {"final": found}}})
        assert text.startswith(f"r, final poses: covariances are {way}") and size in text
    honest = nees_statistics([nees_series(z, np.tile(np.eye(3), (400, 1, 1)))])
    assert evaluation_notes({"robots": {"r": {"final": honest}}}) == []
