"""Milliseconds per observation of the filter, on one core, by the size of its map.

A robot among landmarks, all in the filter and correlated, as are its past states; one observation
of a known landmark is one step. CPU time, median and 99th percentile of 300. Beside it the
textbook's update with dense matrices and the Joseph form, on the same state.

Run: python benchmarks/ekf_speed.py
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one core; read when NumPy is imported

import time
from dataclasses import replace

import numpy as np
from common import best_cpu_s, parser

from graphslam.core.config import Config, EkfConfig
from graphslam.core.geometry import Array
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Motion, Start, Step
from graphslam.estimation.ekf import EkfBackend

ROOM_M = 30.0
COVS = {"point": np.diag([1e-4, 1e-3]), "segment": np.diag([1e-3, 1e-3, 1e-4])}


def mapped(kind: str, count: int, error: str) -> tuple[EkfBackend, list[Association]]:
    """A filter that has seen ``count`` landmarks, and 300 observations to come."""
    rng = np.random.default_rng(1)
    backend = EkfBackend(Config(ekf=EkfConfig(error=error)))
    pose, model = np.zeros(3), MODELS[kind]
    places = rng.uniform(-ROOM_M, ROOM_M, (count, model.dim))

    def seen(landmark: int) -> Association:
        z, cov = model.predict(pose, places[landmark]), COVS[kind]
        return Association(
            "r", 0, landmark, kind, z + rng.multivariate_normal(0 * z, 0.1 * cov), cov
        )

    backend.add(Step(0, {"r": Start(pose, 1e-2 * np.eye(3))}))
    backend.add(Step(0, associations=tuple(seen(i) for i in range(count))))
    # as many past states as the filter keeps: the robot trembles
    for k in range(1, EkfConfig().past_states + 1):
        still = Motion(k - 1, k, np.zeros(3), 1e-6 * np.eye(3), np.zeros((3, 0)), 0.0)
        backend.add(Step(k, motions={"r": still}))
    later = [seen(int(i)) for i in rng.integers(0, count, 300)]
    return backend, [replace(one, time_ns=EkfConfig().past_states) for one in later]


def joseph_ms(n: int, rows: int) -> float:
    """The reference: (I - K H) P (I - K H)ᵀ + K R Kᵀ with H dense."""
    rng = np.random.default_rng(1)
    P, H, R = np.eye(n), rng.normal(size=(rows, n)), np.eye(rows)

    def update() -> Array:
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        A = np.eye(n) - K @ H
        return A @ P @ A.T + K @ R @ K.T

    return 1e3 * best_cpu_s(update)


def main() -> None:
    parser(__doc__).parse_args()
    print("landmarks              state  median, ms  p99, ms  dense Joseph, ms")
    for count, kind in ((20, "segment"), (100, "point"), (100, "segment"), (300, "segment")):
        for error in ("world", "body"):
            backend, to_come = mapped(kind, count, error)
            n = len(backend.joint("r", range(count)).cov) + 3 * EkfConfig().past_states
            took = []
            for association in to_come:
                step = Step(0, associations=(association,))
                began = time.process_time()
                backend.add(step)
                took.append(1e3 * (time.process_time() - began))
            median, p99 = np.percentile(took, [50, 99])
            dense = joseph_ms(n, MODELS[kind].rows)
            label = f"{count} {kind}s, {error}"
            print(f"{label:22s} {n:5d}  {median:10.3f}  {p99:7.3f}  {dense:16.1f}")


if __name__ == "__main__":
    main()
