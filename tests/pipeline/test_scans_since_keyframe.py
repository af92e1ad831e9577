"""Scans that have no state, when they come: where they are by what the last keyframe saw."""

import numpy as np
import pytest
from paths import LOGS
from room_log import BEAMS, ROOM, S
from walls import cast

from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, rotation3, wrap
from graphslam.core.records import Scan
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs, read_truth
from graphslam.perception.front_ends import FRONT_ENDS
from graphslam.pipeline.scans_since_keyframe import MEMORY, ScansSinceKeyframe
from graphslam.slam.smooth import smooth

CONFIG = load_config()
#: what odometry states, and how much larger its errors are
STATED, FACTORS = np.array([0.005, 0.005, 0.01]), np.array([1.0, 1.0, 5.0])


class Odometry:
    """Says of each time what it was told, with a stated noise that is too small."""

    used_calibration = None

    def __init__(self):
        self.told = {}

    def coarse_motions(self, _begin, ends, _calibrations, _which):
        delta = np.array([self.told[t] for t in ends.tolist()])
        return delta, np.tile(np.diag(STATED**2), (len(delta), 1, 1))

    def moved(self, _begin, _end):
        return 0.1, 0.1


def scan(time_ns, pose, rng, room=ROOM):
    ranges = cast(room, BEAMS, pose, 30.0) + rng.normal(0, 0.01, len(BEAMS))
    step = float(BEAMS[1] - BEAMS[0])
    return Scan("r", time_ns, time_ns, ranges, float(BEAMS[0]), step, mount=np.zeros(3))


@pytest.fixture(scope="module")
def matched():
    """Of scans after keyframes round a room: their errors by odometry and by matching, its covs."""
    rng, odometry = np.random.default_rng(4), Odometry()
    since, rows, t = ScansSinceKeyframe(CONFIG.front_end, None), [], 0
    for _ in range(60):
        place = rng.uniform([1, 1], [9, 2.5])
        at = np.array([*place, rng.uniform(-np.pi, np.pi)])
        seen = FRONT_ENDS["segments"](scan(t, at, rng), CONFIG.front_end)
        since.begin(t, None, seen, odometry)
        state_ns, true = t, {}
        for _ in range(5):
            t += S // 5
            true[t] = rng.uniform([-0.1, -0.1, -0.2], [0.1, 0.1, 0.2])
            odometry.told[t] = compose(true[t], rng.normal(0, STATED * FACTORS))
            since.add(scan(t, compose(at, true[t]), rng), odometry)
        since.match(odometry)
        times = np.array(list(true), dtype=np.int64)
        found, poses, covs = since.at(times, np.full(len(times), state_ns))
        for k, pose, cov in zip(found, poses, covs, strict=True):
            own = true[int(times[k])]
            turned = rotation3(own[2])
            rows.append(
                (
                    between(own, odometry.told[int(times[k])]),
                    between(own, pose),
                    turned.T @ cov @ turned,
                )
            )
        t += S
    return since, [np.array(part) for part in zip(*rows, strict=True)]


def test_walls_of_the_keyframe_tell_better_than_odometry_where_a_scan_looks(matched):
    _, (by_odometry, found, _) = matched
    assert len(found) > 270  # of 300
    later = slice(100, None)  # when the noise of odometry is known
    rms = [np.sqrt(np.mean(off[later] ** 2, axis=0)) for off in (found, by_odometry)]
    assert rms[0][2] < 0.2 * rms[1][2]
    assert np.all(rms[0][:2] < 1.05 * rms[1][:2])


def test_noise_of_odometry_that_is_larger_than_stated_is_found(matched):
    """And errors are as stated then: what no wall told would be five times too sure."""
    since, (_, found, covs) = matched
    assert 2.5 < np.sqrt(since.variances[2]) < 8.0, since.variances
    assert np.all(np.sqrt(since.variances[:2]) < 1.5)
    d2 = np.einsum("ni,nij,nj->n", found[100:], np.linalg.inv(covs[100:]), found[100:]) / 3
    assert 0.2 < d2.mean() < 1.5, d2.mean()


def test_a_scan_of_which_little_is_on_the_walls_stays_where_odometry_has_it(matched):
    since, _ = matched
    rng, odometry = np.random.default_rng(8), Odometry()
    t, at = 10_000 * S, np.array([2.0, 1.5, 0.4])
    since.begin(t, None, FRONT_ENDS["segments"](scan(t, at, rng), CONFIG.front_end), odometry)
    odometry.told = {t + 1: np.array([0.1, 0, 0]), t + 2: np.array([0.1, 0, 0])}
    since.add(scan(t + 1, compose(at, odometry.told[t + 1]), rng), odometry)
    other = scan(t + 2, np.array([5.0, 6.5, 2.0]), rng)
    since.add(other, odometry)
    since.match(odometry)
    rows, _, _ = since.at(np.array([t + 1, t + 2]), np.array([t, t]))
    assert rows.tolist() == [0]
    # nor is one given that was seen from another state
    assert not len(since.at(np.array([t + 1]), np.array([t - 1]))[0])


def test_what_is_kept_does_not_grow(matched):
    """While a robot stands, odometry may say for hours that it moves a little."""
    since, _ = matched
    rng, odometry = np.random.default_rng(9), Odometry()
    t, at = 20_000 * S, np.array([2.0, 1.5, 0.4])
    since.begin(t, None, FRONT_ENDS["segments"](scan(t, at, rng), CONFIG.front_end), odometry)
    for k in range(1, 500):
        odometry.told[t + k] = np.zeros(3)
        since.add(scan(t + k, at, rng), odometry)
        since.match(odometry)
        since.forget()
    assert len(since.unused) <= MEMORY and not since.times and not since.poses


def test_filters_say_what_odometry_says():
    track = Odometry()
    for name, matches in (("batch", True), ("isam2", True), ("ekf", False)):
        config = load_config(overrides=(f"backend.name={name}",))
        assert (ScansSinceKeyframe.of_smoother(config, track) is not None) == matches
    config = load_config(overrides=("backend.name=isam2", "backend.horizon_s=0"))
    assert ScansSinceKeyframe.of_smoother(config, track) is None


def test_causal_headings_between_keyframes_are_half_as_wrong():
    """In the lab, final ones of which a third is left: causal ones know one scan, not the map."""
    errors = {}
    (truth,) = read_truth([LOGS / "lab.mcap"], load_config()).trajectories.values()
    for way in ("map", "odometry"):
        config = load_config(
            overrides=(
                f"keyframe.scans_between={way}", "start.from_truth=true", "backend.causal=true"
            )
        )  # fmt: skip
        result = smooth(open_logs([LOGS / "lab.mcap"], config), config)
        ((name, robot),) = result.robots.items()
        stamps = robot.causal.stamps_ns
        between_states = ~np.isin(stamps, result.estimate.states[name].stamps_ns)
        true = np.interp(stamps, truth.stamps_ns, np.unwrap(truth.poses[:, 2]))
        off = wrap(robot.causal.poses[:, 2] - true)[between_states]
        errors[way] = np.sqrt(np.mean(off**2))
        (found,) = evaluate(result, {name: truth})["robots"].values()
        assert found["causal"]["nees_per_dof"] < found["causal"]["nees_bounds"][1]
    assert errors["map"] < 0.6 * errors["odometry"], errors
