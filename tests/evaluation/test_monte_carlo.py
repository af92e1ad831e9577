"""Experiments: the bench says what it draws, the bound is one, rows are kept, EKF and smoother do
what theory says of them."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from finite_differences import jacobian
from scipy.stats import chi2
from small_experiment import SMALL

from graphslam.campaigns import experiment as campaign
from graphslam.campaigns.experiment import run_campaign
from graphslam.campaigns.tasks import Outcome, Workers
from graphslam.core.config_io import load_config
from graphslam.core.errors import ConfigError, LogError, OutputError
from graphslam.core.geometry import between, compose, exp, rotation3
from graphslam.core.observation_models import MODELS
from graphslam.estimation.backend import JointMarginal
from graphslam.evaluation import cramer_rao_bound as bound
from graphslam.evaluation import monte_carlo_campaign
from graphslam.evaluation.monte_carlo_bench import Noise, draw_run, planned_path, run_seed
from graphslam.evaluation.monte_carlo_campaign import Job, run_job
from graphslam.evaluation.monte_carlo_consistency import joint_errors, joint_nees
from graphslam.evaluation.monte_carlo_definition import (
    EXPERIMENTS,
    Definition,
    Logs,
    load_definition,
)
from graphslam.evaluation.monte_carlo_log_run import (
    NOISE,
    drawn_starts,
    scale_noise,
    scratch_folder,
)
from graphslam.evaluation.monte_carlo_summary import bootstrap_interval, summarise
from graphslam.logs import open_logs
from graphslam.pipeline.start_priors import start_poses
from graphslam.results.report_experiment import experiment_figures, experiment_page
from graphslam.simulation import SCENARIOS, load_scenario, simulate

WHOLE = load_definition("ekf-versus-smoothing")


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return load_definition(path)


# ------------------------------------------------------------ definitions


def test_a_variant_may_be_a_preset():
    """Under all its settings, whatever their order."""
    made = load_definition("three-filters")
    assert made.config("thesis") == load_config(preset="thesis")
    assert made.config("thesis", "ekf.past_states=4").ekf.past_states == 4
    assert made.config("batch") == load_config()


@pytest.mark.parametrize("name", sorted(EXPERIMENTS))
def test_every_experiment_that_comes_along_can_be_read(name):
    definition = load_definition(name)
    assert definition.description
    assert definition.name == name


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("runs = 2", "runs = 0", "runs: must be at least 1"),
        ("runs = 2", "rnus = 2", "rnus: unknown key; did you mean runs"),
        ("name=batch", "name=bach", "variants.batch: "),
        ("[0.1]", "[0.1, 0.1]", "noise_scales: give at least one, each once"),
        ("[0.1]", "[-1.0]", r"noise_scales\[0\]: must be above 0"),
        ("steps = 3, forward_m = 0.6", "steps = 4, forward_m = 0.6", "same number of steps"),
        ("[bench]", "[logs]\nscenarios = ['lab']\n[bench]", "exactly one of the tables"),
        ("start_m = 0.1", "start_m = 0.0", "bench.sigma.start_m: must be above 0"),
    ],
)
def test_a_wrong_definition_is_one_line_with_file_and_key(tmp_path, old, new, said):
    path = tmp_path / "wrong.toml"
    assert old in SMALL
    path.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(ConfigError, match=rf"^wrong\.toml: .*{said}") as error:
        load_definition(path)
    assert "\n" not in str(error.value)


def test_an_unknown_name_says_which_there_are():
    with pytest.raises(ConfigError, match=r"neither a file nor one of ekf-versus-smoothing"):
        load_definition("ekf-vs-smoothing")


# ------------------------------------------------------------ the bench


def test_a_run_without_noise_says_the_truth():
    """Motions compose to the truth, every sighting predicts itself."""
    run = draw_run(WHOLE.bench, 1.0, None)
    for name, robot in WHOLE.bench.robots.items():
        np.testing.assert_array_equal(run.truth[name], planned_path(robot))
    for k, step in enumerate(run.steps):
        for name, motion in step.motions.items():
            moved = compose(run.truth[name][k - 1], motion.delta)
            np.testing.assert_allclose(between(moved, run.truth[name][k]), 0.0, atol=1e-12)
        for seen in step.associations:
            known = isinstance(seen.target, int)
            t = run.landmarks[seen.target] if known else run.truth[seen.target][k]
            residual = MODELS[seen.model].residual(seen.z, run.truth[seen.robot][k], t)
            np.testing.assert_allclose(residual, 0.0, atol=1e-12)


def test_what_is_drawn_has_the_covariance_that_is_stated():
    """Normalised squares of starts, motions and sightings, at a noise so small that the models are
    linear: their means are the degrees of freedom, within the 1e-4 quantiles for so many."""
    scale, squares = 1e-3, {"start": [], "motion": [], "point": [], "line": [], "robot-pose": []}
    for r in range(30):
        run = draw_run(WHOLE.bench, scale, np.random.default_rng(run_seed(1, scale, r)))
        for k, step in enumerate(run.steps):
            for name, start in step.starts.items():
                e = run.truth[name][0] - start.pose
                squares["start"].append(e @ np.linalg.solve(start.cov, e))
            for name, motion in step.motions.items():
                e = between(run.truth[name][k - 1], run.truth[name][k]) - motion.delta
                squares["motion"].append(e @ np.linalg.solve(motion.cov, e))
            for seen in step.associations:
                known = isinstance(seen.target, int)
                t = run.landmarks[seen.target] if known else run.truth[seen.target][k]
                x, model = run.truth[seen.robot][k], MODELS[seen.model]
                e = model.residual(seen.z, x, t)
                V = model.noise(seen.z, seen.cov, x, t)
                squares[seen.model].append(e @ np.linalg.solve(V, e))
    dofs = {"start": 3, "motion": 3, "point": 2, "line": 2, "robot-pose": 3}
    for name, dof in dofs.items():
        n = dof * len(squares[name])
        low, high = chi2.ppf([5e-5, 1 - 5e-5], n) / n
        assert low < np.mean(squares[name]) / dof < high, name


def test_motions_slip_in_the_share_given_and_state_it_only_where_told():
    """100 runs of 40 motions: errors of slipping ones are ten times as large, a tenth of them slip,
    and what is told has NEES of one. The draws are the same whether it is told or not."""
    bench, share, squares, stated = load_definition("slip").bench, [], [], []
    for run in range(100):
        drawn, known = (
            draw_run(bench, 1.0, np.random.default_rng(run_seed(1, 1.0, run)), told=told)
            for told in (False, True)
        )
        cov = Noise.of(bench, 1.0).motion
        for k, (step, twin) in enumerate(zip(drawn.steps[1:], known.steps[1:], strict=True), 1):
            for name, motion in twin.motions.items():
                e = motion.delta - between(drawn.truth[name][k - 1], drawn.truth[name][k])
                np.testing.assert_array_equal(motion.delta, step.motions[name].delta)
                np.testing.assert_array_equal(step.motions[name].cov, cov)
                share.append(motion.cov[0, 0] / cov[0, 0])
                squares.append(e @ np.linalg.solve(motion.cov, e))
                stated.append(e @ np.linalg.solve(cov, e))
    assert set(np.round(share, 9)) == {1.0, 100.0}
    assert np.mean(np.array(share) > 1) == pytest.approx(0.1, abs=0.02)
    assert np.mean(squares) / 3 == pytest.approx(1.0, abs=0.05)
    assert np.mean(stated) / 3 == pytest.approx(0.9 + 10, rel=0.2)


def test_a_seed_is_of_run_and_scale_alone():
    """And differs between them: else runs would repeat each other."""
    states = {
        tuple(run_seed(seed, scale, run).generate_state(4))
        for seed in (0, 1) for scale in (1.0, 0.3) for run in (0, 1)
    }  # fmt: skip
    assert len(states) == 8
    a, b = (
        draw_run(WHOLE.bench, 1.0, np.random.default_rng(run_seed(5, 1.0, 3))) for _ in range(2)
    )
    np.testing.assert_array_equal(a.truth["a"][0], b.truth["a"][0])


# ------------------------------------------------------------ errors in their own frame


@pytest.mark.parametrize("frame", ["world", "body"])
def test_nees_of_errors_drawn_from_the_covariance(frame):
    """400 draws of a pose, a line, a point and another pose around an estimate: the mean NEES is 10
    (3 + 2 + 2 + 3) within its 1e-4 quantiles. Errors are large, 0.6 rad: in the other frame the
    mean is far off, and so it would be with a line's gauge among the errors."""
    rng = np.random.default_rng(4)
    pose, line = np.array([1.0, 2.0, 2.5]), np.array([4.0, 0.0, -1.0])
    point, other = np.array([3.0, 3.0]), np.array([-1.0, 1.0, -2.9])
    A = np.diag([0.3, 0.05, 0.6, 0.4, 0.02, 1e-3, 0.2, 0.1, 0.1, 0.3, 0.6])
    A += 0.02 * rng.standard_normal(A.shape) * np.diag(A)[:, None]
    own = A @ A.T  # in the frame of the test; the line's always in its own
    turn = np.eye(11)
    turn[3:6, 3:6] = rotation3(line[2])
    if frame == "body":
        turn[:3, :3], turn[8:, 8:] = rotation3(pose[2]), rotation3(other[2])
    cov = turn @ own @ turn.T
    slices = (slice(3, 6), slice(6, 8), slice(8, 11))
    joint = JointMarginal(pose, (line, point), cov, slices, (other,))
    found, wrong = [], []
    for _ in range(400):
        e = A @ rng.standard_normal(11)
        add = compose if frame == "body" else np.add
        as_pose = exp if frame == "body" else np.asarray
        # anywhere on the true line
        along = np.array([rng.normal(), 0.0, 0.0])
        true_line = compose(compose(line, np.array([0.0, *e[4:6]])), along)
        marks = [true_line, point + e[6:8]]
        truth = add(pose, as_pose(e[:3])), marks, [add(other, as_pose(e[8:]))]
        for frame_asked, values in (
            (frame, found),
            ("world" if frame == "body" else "body", wrong),
        ):
            errors, own_cov = joint_errors(joint, *truth, frame_asked)
            assert errors.shape == (10,)
            values.append(joint_nees(errors, own_cov))
    low, high = chi2.ppf([5e-5, 1 - 5e-5], 4000) / 400
    assert low < np.mean(found) < high
    assert not low < np.mean(wrong) < high


def test_a_covariance_that_is_none_has_no_nees():
    assert np.isnan(joint_nees(np.ones(2), np.diag([1.0, -1.0])))


# ------------------------------------------------------------ the bound


def test_bound_is_the_inverse_information_of_residuals_by_differences(small, monkeypatch):
    """The whole problem stacked into one residual of all errors, differentiated numerically."""
    monkeypatch.setattr(bound, "_DRAWS", 1)
    tiny = 1e-6  # the start's draw is 1e-7 off the plan
    run, noise = draw_run(small.bench, tiny, None), Noise.of(small.bench, tiny)
    names, K = list(run.truth), len(run.steps) - 1
    lines = [i for i, t in run.landmarks.items() if len(t) == 3]

    def residuals(e):
        parts, place = [], 0

        def take(n):
            nonlocal place
            place += n
            return e[place - n : place]

        poses = {name: run.truth[name] + take(3 * (K + 1)).reshape(-1, 3) for name in names}
        marks = {}
        for i, t in run.landmarks.items():
            marks[i] = t + take(2) if i not in lines else t + np.array(
                [[-np.sin(t[2]), 0], [np.cos(t[2]), 0], [0, 1]]) @ take(2)  # fmt: skip

        def white(r, V):
            parts.append(np.linalg.solve(np.linalg.cholesky(V), r))

        for name in names:
            white(poses[name][0] - run.truth[name][0], noise.start)
        for k, step in enumerate(run.steps):
            for name, motion in step.motions.items():
                moved = between(poses[name][k - 1], poses[name][k])
                white(moved - motion.delta, motion.cov)
            for seen in step.associations:
                known = isinstance(seen.target, int)
                t = marks[seen.target] if known else poses[seen.target][k]
                true = run.landmarks[seen.target] if known else run.truth[seen.target][k]
                model, x = MODELS[seen.model], run.truth[seen.robot][k]
                V = model.noise(seen.z, seen.cov, x, true)
                white(model.residual(seen.z, poses[seen.robot][k], t), V)
        return np.concatenate(parts)

    size = 3 * len(names) * (K + 1) + sum(2 for _ in run.landmarks)
    H = jacobian(residuals, np.zeros(size))
    P = np.linalg.inv(H.T @ H)
    poses = np.diag(P)[: 3 * len(names) * (K + 1)].reshape(len(names), K + 1, 3)
    found = bound.cramer_rao_bound(small.bench, tiny, np.random.default_rng(0))
    # 1e-4: the residual of lines is differentiated with its along part, which is second order
    np.testing.assert_allclose(
        found.final.position_m2, poses[..., :2].sum(axis=2).mean(axis=0), rtol=1e-4
    )
    np.testing.assert_allclose(found.final.heading_rad2, poses[..., 2].mean(axis=0), rtol=1e-4)
    tail = np.diag(P)[3 * len(names) * (K + 1) :].reshape(-1, 2)
    is_line = np.array([i in lines for i in run.landmarks])
    expected = [tail[~is_line].sum(axis=1).mean(), *tail[is_line].mean(axis=0)]
    np.testing.assert_allclose(list(found.landmarks.values()), expected, rtol=1e-4)


def test_bounds_fall_with_data_and_scale_with_noise():
    rng = np.random.default_rng
    at = {s: bound.cramer_rao_bound(WHOLE.bench, s, rng(0)) for s in (0.02, 0.01)}
    b = at[0.01]
    assert np.all(b.final.position_m2 <= b.causal.position_m2 * (1 + 1e-9))
    # at the last step both have seen everything
    assert b.final.position_m2[-1] == pytest.approx(b.causal.position_m2[-1], rel=1e-9)
    # 1e-2: the first motion is longer or shorter by where the robot starts
    np.testing.assert_allclose(at[0.02].final.position_m2 / b.final.position_m2, 4.0, rtol=1e-2)


# ------------------------------------------------------------ filters and smoothers

SEEDS, SCALES = 50, (1.0, 0.03)


@pytest.fixture(scope="module")
def consistency():
    """Mean joint NEES per degree of freedom of 50 seeds, and the distance of the last poses. Two
    sides of the room and the way round both corners are enough for a filter to show it."""
    robots = {name: replace(one, path=one.path[:4]) for name, one in WHOLE.bench.robots.items()}
    short = replace(WHOLE, bench=replace(WHOLE.bench, robots=robots))
    found, ends = {}, {}
    for scale in SCALES:
        for variant in ("ekf-body", "batch"):
            rows = [run_job(short, Job("", "", scale, variant, r)) for r in range(SEEDS)]
            found[variant, scale] = np.mean([row["nees"] for row in rows]) / rows[0]["dof"]
            ends[variant, scale] = np.array([row["end"] for row in rows])
            dof = rows[0]["dof"]
    n = dof * SEEDS
    # two scales, two-sided, 99.9 % together
    return found, ends, chi2.ppf([0.00025, 1 - 0.00025], n) / n


def test_the_smoother_is_consistent_at_any_noise(consistency):
    """True associations, start drawn from the prior, 34 degrees of freedom, both bounds. Breaks
    with a covariance in a wrong frame, a noise counted twice, a gauge among the information."""
    found, _, (low, high) = consistency
    for scale in SCALES:
        assert low < found["batch", scale] < high, scale


def test_the_filter_is_consistent_at_small_noise_and_overconfident_at_full(consistency):
    """The known result (S. Huang, G. Dissanayake, IEEE T-RO 23(5), 2007,
    DOI 10.1109/TRO.2007.903811): a filter linearises each observation once, at different
    estimates of the same state, and gains information that is not there."""
    found, _, (low, high) = consistency
    assert low < found["ekf-body", 0.03] < high
    assert found["ekf-body", 1.0] > high


def test_filter_and_smoother_agree_in_proportion_to_the_square_of_the_noise(consistency):
    """At 3 % of the noise the ends differ by less than a tenth of what proportion would leave."""
    _, ends, _ = consistency
    gap = {s: np.sqrt(np.mean((ends["ekf-body", s] - ends["batch", s])[..., :2] ** 2))
           for s in SCALES}  # fmt: skip
    assert gap[0.03] < 0.1 * 0.03 * gap[1.0]


# ------------------------------------------------------------ the campaign


def content(rows):
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A small campaign by two processes: (definition, folder, rows)."""
    folder = tmp_path_factory.mktemp("campaign")
    path = folder / "small.toml"
    path.write_text(SMALL)
    definition = load_definition(path)
    return definition, folder / "out", run_campaign(definition, folder / "out", Workers(2))


def test_rows_do_not_depend_on_the_number_of_processes(done, tmp_path):
    definition, _, rows = done
    assert content(rows) == content(run_campaign(definition, tmp_path / "one", Workers(1)))
    assert [row["variant"] for row in rows] == 2 * list(definition.variants)
    assert all(row["error"] is None and row["nees"] > 0 for row in rows)
    assert rows[0]["seed"] == [0, 100000, 0]
    assert rows[1]["settings"] == ["robust.kernel=none", "backend.name=batch"]


def test_a_campaign_goes_on_where_it_stopped(done, tmp_path, monkeypatch):
    """Rows that are there are not run again; a line that was cut short is, and more runs may be
    asked for; another definition is refused unless forced."""
    definition, folder, whole = done
    shutil.copytree(folder, tmp_path / "a")
    file = tmp_path / "a" / "results.jsonl"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[:2]) + lines[2][:50])
    counts = []
    again = run_campaign(
        replace(definition, runs=3), tmp_path / "a", Workers(2), progress=counts.append
    )
    assert counts == [2, 3, 4, 5, 6]
    assert content(again)[:4] == content(whole)
    assert file.read_text().splitlines(keepends=True)[:2] == lines[:2]
    assert len([json.loads(line) for line in file.read_text().splitlines()]) == 6
    with monkeypatch.context() as patch:
        nothing = lambda _d, missing, *_others: pytest.fail("run again") if missing else iter(())  # noqa: E731
        patch.setattr(campaign, "_run", nothing)
        assert content(run_campaign(definition, tmp_path / "a")) == content(whole)
    other = replace(definition, seed=1)
    with pytest.raises(OutputError, match="another experiment or an earlier definition"):
        run_campaign(other, tmp_path / "a")
    fresh = run_campaign(other, tmp_path / "a", Workers(2), force=True)
    assert len(file.read_text().splitlines()) == 4
    assert content(fresh) != content(whole)


def test_a_folder_of_something_else_is_left_alone(small, tmp_path):
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(OutputError, match="not the folder of an experiment"):
        run_campaign(small, tmp_path, force=True)
    assert (tmp_path / "mine.txt").read_text() == "x"


def test_an_experiment_in_another_world_is_another_one(tmp_path, monkeypatch):
    """Also if only the file beside it says so, whose world it uses; comments say nothing."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        campaign, "run_tasks", lambda tasks, *_: (Outcome(task, value={}) for task in tasks)
    )
    lab = SCENARIOS["lab"].read_text(encoding="utf-8")
    wider = lab.replace("[10.0, 8.0]", "[10.5, 8.0]")
    assert wider != lab
    world, robots = tmp_path / "world.toml", tmp_path / "robots.toml"
    world.write_text(lab, encoding="utf-8")
    robots.write_text('world_of = "world.toml"\n' + lab[lab.index("[robots.") :], encoding="utf-8")
    logs = Logs(scenarios=("robots.toml", "lab"))
    definition = Definition(variants={"isam2": ()}, runs=1, logs=logs, name="own")
    run_campaign(definition, tmp_path / "a")
    world.write_text(lab + "# the same\n", encoding="utf-8")
    more = replace(definition, runs=2)
    assert len(run_campaign(more, tmp_path / "a")) == 4
    world.write_text(wider, encoding="utf-8")
    with pytest.raises(OutputError, match="an earlier definition of this one"):
        run_campaign(more, tmp_path / "a")


def test_a_limit_on_memory_holds_for_each_run(small, monkeypatch):
    # 4.3 GB; the limit leaves this process, and threads of who runs the tests, what they have
    monkeypatch.setattr(monte_carlo_campaign, "run_bench", lambda *_: bytearray(1 << 32))
    limited = replace(small, variants={"batch": ("limits.memory_mb=3000",)})
    with pytest.raises(LogError, match=r"more memory than limits\.memory_mb \(3000\)"):
        run_job(limited, Job("", "", 0.1, "batch", 0))


def test_a_run_that_fails_is_a_row_with_its_error_and_is_counted(tmp_path):
    """The scenario's file is gone by the time of the run."""
    logs = Logs(scenarios=("gone.toml",))
    definition = Definition(variants={"isam2": ()}, runs=2, logs=logs, name="broken")
    rows = run_campaign(definition, tmp_path / "a", Workers(1))
    assert [row["error"][:25] for row in rows] == 2 * ["ScenarioError: gone.toml:"]
    found = summarise(definition, rows)
    assert [(row["runs"], row["failed"]) for row in found["table"]] == [(2, 2)]
    assert sum(found["errors"].values()) == 2
    assert found["warnings"] == ["2 of 2 runs failed"]
    assert "gone.toml" in experiment_page(found)  # says so rather than stumble over it


def test_the_error_of_a_run_does_not_name_its_temporary_folder():
    """It has another name in every run: equal errors would not be counted together."""
    with pytest.raises(LogError, match=r"^log\.mcap: no such file"), scratch_folder() as folder:
        open_logs([folder / "log.mcap"], load_config())
    assert not folder.exists()


def test_ctrl_c_leaves_whole_lines_and_exit_code_130(tmp_path):
    """In a process of its own, interrupted once the first row is there."""
    path = tmp_path / "long.toml"
    path.write_text(SMALL.replace("runs = 2", "runs = 2000"))
    folder = tmp_path / "out"
    command = [sys.executable, "-m", "graphslam", "experiment", path, "-o", folder, "--jobs", "2"]
    # a shell's background jobs ignore it, and so would what they start
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    signal.signal(signal.SIGINT, before)
    rows = folder / "results.jsonl"
    until = time.monotonic() + 240
    while not (rows.exists() and rows.stat().st_size) and time.monotonic() < until:
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=240)
    assert process.returncode == 130
    assert said == b""
    lines = rows.read_text().splitlines(keepends=True)
    assert 0 < len(lines) < 4000
    assert all(line.endswith("\n") and json.loads(line) for line in lines)


# ------------------------------------------------------------ what comes of it


def made_up_row(variant, run, nees=34.0, error=None, position=1e-2):
    row = {"scenario": "", "front_end": "", "scale": 1.0, "variant": variant, "run": run,
           "error": error, "code": "c", "seconds": 1.0}  # fmt: skip
    if error:
        return row
    steps = {"position_m2": [position] * 4, "heading_rad2": [1e-4] * 4}
    marks = {"points_m2": 1e-2, "lines_m2": 1e-3, "lines_rad2": 1e-4}
    end = [[0.0, 0.0, 0.0], [1.0 + 0.1 * (variant != "batch"), 0.0, 0.0]]
    return {**row, "error_frame": "body", "dof": 34, "nees": nees, "final": steps,
            "causal": {**steps, "nees": [6.0] * 4}, "landmarks": marks, "end": end}  # fmt: skip


def test_summary_counts_and_judges(small):
    definition = replace(small, runs=20, noise_scales=(1.0,))
    rows = [made_up_row("batch", r) for r in range(20)]
    rows += [made_up_row("dead-reckoning", r, nees=51.0) for r in range(18)]
    rows += [made_up_row("dead-reckoning", 18, position=100.0)]
    rows += [made_up_row("dead-reckoning", 19, error="EstimationError: x")]
    found = summarise(definition, rows)
    reckoned, batch = found["table"]
    assert (batch["nees_per_dof"], batch["nees_verdict"], batch["diverged"]) == (1.0, "inside", 0)
    assert reckoned["nees_verdict"] == "above"
    assert (reckoned["failed"], reckoned["diverged"]) == (1, 1)
    low, high = reckoned["diverged_interval"]
    assert 0.0 < low < 1 / 19 < high < 0.3
    n = 34 * 20
    np.testing.assert_allclose(batch["nees_bounds"], chi2.ppf([5e-4, 1 - 5e-4], n) / n)
    # 0.1 m in one of two robots
    assert reckoned["from_reference_m"] == pytest.approx(0.1 / np.sqrt(2))
    assert batch["final"]["position_m2"]["rmse"] == pytest.approx(0.1)


def test_bonferroni_widens_the_bounds_with_the_number_of_scales(small):
    rows = [made_up_row(v, r) for r in range(5) for v in small.variants]
    rows += [{**row, "scale": 0.1} for row in rows]
    definition = replace(small, runs=5, noise_scales=(1.0, 0.1))
    low, high = summarise(definition, rows)["table"][0]["nees_bounds"]
    np.testing.assert_allclose((low, high), chi2.ppf([2.5e-4, 1 - 2.5e-4], 170) / 170, rtol=1e-9)


def test_page_and_figures_of_a_real_campaign(done):
    """One self-contained page with every variant, and figures that are whole SVG files."""
    definition, _, rows = done
    found = summarise(definition, rows)
    page = experiment_page(found)
    shown = re.sub(r"<script[^>]*>.*?</script>", "", page, flags=re.DOTALL)
    assert shown.count("<svg") == 5
    assert "http://" not in shown.replace("http://www.w3.org", "")
    for name in definition.variants:
        assert name in page
    for text in experiment_figures(found).values():
        assert text.startswith("<svg ")
        assert "var(--" not in text
        assert "currentColor" not in text


def test_a_noise_scale_multiplies_every_error_of_the_sensors_and_nothing_else():
    before, after = load_scenario("two-robots"), scale_noise(load_scenario("two-robots"), 0.5)
    for name, robot in before.robots.items():
        for part in ("encoders", "laser"):
            a, b = getattr(robot, part), getattr(after.robots[name], part)
            for key in a.__dataclass_fields__ if a is not None else ():
                factor = 0.5 if key in NOISE else 1.0
                value = getattr(a, key)
                assert getattr(b, key) == (value if factor == 1.0 else factor * value), key
    assert after.world == before.world
    assert scale_noise(before, 1.0) == before


def test_a_run_over_a_log_is_evaluated(tmp_path):
    """The thesis' two robots with a tenth of the noise: found within 5 cm of the truth."""
    definition = replace(load_definition("rooms"), noise_scales=(0.1,))
    row = run_job(definition, Job("two-robots", "segments", 0.1, "isam2", 0))
    assert row["joint"]["final"]["ate_rmse_m"] < 0.05
    assert set(row["robots"]) == {"pioneer", "vehicle"}
    full = {"scenario": "two-robots", "front_end": "segments", "scale": 0.1, "variant": "isam2",
            "run": 0, "error": None, "code": "c"}  # fmt: skip
    found = summarise(definition, [{**full, **row}])
    assert found["table"][0]["final"]["ate_rmse_m"]["mean"] == row["joint"]["final"]["ate_rmse_m"]
    assert "two-robots" in experiment_page(found)


# ---------------------------------------------------------------- coverage over runs


def test_the_interval_of_a_mean_is_by_runs_and_covers_it():
    """Of 20 runs whose shares differ, as those of correlated poses do. Breaks with an interval by
    poses, which has a tenth of the width."""
    rng = np.random.default_rng(1)
    hits, widths = 0, []
    for _ in range(200):
        low, high = bootstrap_interval(rng.normal(0.9, 0.05, 20))
        hits += low <= 0.9 <= high
        widths.append(high - low)
    assert 0.88 <= hits / 200 <= 0.98
    assert np.mean(widths) == pytest.approx(2 * 1.96 * 0.05 / np.sqrt(20), rel=0.15)


def test_drawn_starts_are_off_by_what_the_prior_says(tmp_path):
    """Equal seeds give equal starts, and over seeds they scatter as stated."""
    path = tmp_path / "two.mcap"
    simulate(load_scenario("two-robots"), path, 0)
    config = load_config(None, ["start.from_truth=true"])
    log = open_logs([path], config)
    true = {robot: start.pose for robot, start in start_poses(log, config).items()}
    off = []
    for seed in range(60):
        drawn = drawn_starts(log, config.start, seed)
        assert not drawn.from_truth and set(drawn.poses) == set(true)
        assert drawn.given_sigma_m == config.start.truth_sigma_m
        off += [np.array(drawn.poses[robot]) - true[robot] for robot in true]
    assert drawn_starts(log, config.start, 3).poses == drawn_starts(log, config.start, 3).poses
    sigmas = [config.start.truth_sigma_m] * 2 + [config.start.truth_sigma_rad]
    np.testing.assert_allclose(np.std(off, axis=0), sigmas, rtol=0.25)
