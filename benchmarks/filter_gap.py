"""What separates a filter from the smoother on a simulated log, one difference at a time.

Each seed's log is associated once, by the default smoother; its steps are replayed in every row,
with or without late evidence (from before a landmark's promotion). Base poses over all
robots, position; mean and standard deviation over seeds.

Run: python benchmarks/filter_gap.py [SCENARIO [SEEDS [key=value ...]]]
"""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
from common import START_FROM_TRUTH, parser, simulated_log

from graphslam.core.config_io import load_config
from graphslam.core.records import Step
from graphslam.estimation.backends import BACKENDS
from graphslam.estimation.replay import replay
from graphslam.evaluation.compare_variants import parse_variants
from graphslam.evaluation.ground_truth import truth_of_logs
from graphslam.evaluation.metrics import evaluate
from graphslam.evaluation.recorded_steps import RecordedSteps, record_steps
from graphslam.logs import GroundTruth, open_logs

#: label -> spec, whether late evidence is left out, and the gauge of filters' lines, m
ROWS: dict[str, tuple[str, bool, float | None]] = {
    "EKF": ("ekf", False, None),
    "EKF, two past states": ("ekf+ekf.past_states=2", False, None),
    "EKF, no past states": ("ekf+ekf.past_states=0", False, None),
    "isam2": ("isam2", False, None),
    "isam2, nothing late": ("isam2", True, None),
    "isam2, horizon 20 s": ("isam2:20", False, None),
    "isam2, horizon 20 s, nothing late": ("isam2:20", True, None),
    "EKF, body errors": ("ekf+ekf.error=body", False, None),
    "isam2, horizon 0": ("isam2:0", False, None),
    "invariant EKF": ("invariant-ekf", False, None),
    "EKF, iterated 5 times": ("ekf+ekf.iterations=5", False, None),
    "EKF, lines' gauge 1 m": ("ekf", False, 1.0),
    "EKF, lines of the thesis": ("ekf+ekf.lines=thesis", False, None),
    "EKF, no kernel": ("ekf+robust.kernel=none", False, None),
    "isam2, no kernel": ("isam2+robust.kernel=none", False, None),
    "dead reckoning": ("dead-reckoning", False, None),
}


def in_time(steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """The steps without late evidence."""
    return tuple(
        replace(s, associations=tuple(a for a in s.associations if not a.late)) for s in steps
    )


def judge(
    recording: RecordedSteps, truth: GroundTruth, label: str, settings: list[str]
) -> list[float]:
    """Causal and final position error, m; causal NEES per degree of freedom; landmarks, m."""
    spec, strip, gauge_m = ROWS[label]
    (variant,) = parse_variants([spec], load_config(overrides=settings))
    gauge: AbstractContextManager[object] = nullcontext()
    if gauge_m is not None:
        gauge = patch("graphslam.estimation.factors.FILTER_GAUGE_SIGMA_M", gauge_m)
    with gauge:
        backend = BACKENDS[variant.config.backend.name](variant.config)
        done = replay(in_time(recording.steps) if strip else recording.steps, backend)
    result = recording.result(done, variant.config)
    found = evaluate(result, truth.trajectories, truth.landmarks)
    causal, final = found["joint"]["causal"], found["joint"]["final"]
    errors = causal["ate_rmse_m"], final["ate_rmse_m"], causal["nees_per_dof"]
    return [*errors, found["landmarks"]["rmse_m"]]


def main() -> None:
    options = parser(__doc__)
    options.add_argument("scenario", nargs="?", default="lab")
    options.add_argument("seeds", nargs="?", type=int, default=10)
    options.add_argument("overrides", nargs="*", metavar="key=value")
    given = options.parse_args()
    settings = [START_FROM_TRUTH, *given.overrides]
    config = load_config(None, settings)
    numbers: dict[str, list[list[float]]] = {label: [] for label in ROWS}
    with TemporaryDirectory() as folder:
        for seed in range(given.seeds):
            log = open_logs([simulated_log(given.scenario, seed, Path(folder))], config)
            truth, recording = truth_of_logs(log), record_steps(log, config)
            for label, rows in numbers.items():
                rows.append(judge(recording, truth, label, settings))
    print("                                     causal, mm     final, mm   NEES/dof  landmarks, mm")
    for label, rows in numbers.items():
        (c, f, nees, m), (c_, f_, _, m_) = np.mean(rows, axis=0), np.std(rows, axis=0)
        print(
            f"{label:34s} {1e3 * c:5.1f} ± {1e3 * c_:4.1f}  {1e3 * f:5.1f} ± {1e3 * f_:4.1f}"
            f"  {nees:9.2f}  {1e3 * m:5.1f} ± {1e3 * m_:4.1f}"
        )


if __name__ == "__main__":
    main()
