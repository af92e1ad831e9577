"""False loop closures among the verified ones: does the map stay what it is?

After verification, closures are added to those that matching found (`smooth`'s hook ``tamper``,
called for a few places at a time), so that 10, 30 or 50 % of all are false: half of them single
ones between submaps drawn at random, half in groups of three that agree with each other. Each is
off by one to five metres and up to half a radian. The final error over all relations must stay
within 10 % of the run without them.

Run: python benchmarks/false_closures.py [aces] [intel] [--seeds N] [--shares X ...]
Exit code 1 if it does not.
"""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import FREIBURG, FREIBURG_LOGS, import_freiburg, parser

from graphslam.core.config import Config
from graphslam.core.geometry import between, compose
from graphslam.core.records import Closure
from graphslam.evaluation.relation_metrics import read_relations, relation_errors
from graphslam.logs import open_logs
from graphslam.mapping.loop_closure import Tamper
from graphslam.mapping.submaps import SubmapPose
from graphslam.slam.smooth import smooth

SHARES, WITHIN, GROUP = (0.1, 0.3, 0.5), 1.1, 3
COV = np.diag([0.03, 0.03, 0.005]) ** 2


class FalseClosures:
    """Adds false closures to those that are found, whenever some are: a share of all so far."""

    def __init__(self, share: float, seed: int) -> None:
        self._share, self._rng = share, np.random.default_rng(seed)
        self.true = self.false = self._grouped = 0

    def __call__(self, found: list[Closure], places: Sequence[SubmapPose]) -> list[Closure]:
        """The closures, and the false ones behind them."""
        self.true += len(found)
        wanted = round(self.true * self._share / (1 - self._share))
        made: list[Closure] = []
        while self.false < wanted and len(places) > 2 * GROUP:
            # half of them in groups
            size = GROUP if 2 * self._grouped <= self.false else 1
            made += self._group(size, places)
            self.false += size
            self._grouped += size if size > 1 else 0
        return [*found, *made]

    def _group(self, size: int, places: Sequence[SubmapPose]) -> list[Closure]:
        """Closures from neighbouring places to one other, all wrong by the same motion."""
        first = int(self._rng.integers(size, len(places) - size))
        other = places[int(self._rng.integers(0, first))]
        way = self._rng.uniform(-np.pi, np.pi)
        far = self._rng.uniform(1.0, 5.0)
        off = np.array([far * np.cos(way), far * np.sin(way), self._rng.uniform(-0.5, 0.5)])
        return [
            Closure(
                *later.state,
                *other.state,
                compose(off, between(other.pose, later.pose)),
                COV,
            )
            for later in places[first : first + size]
        ]


def run(log: Path, relations: Path, tamper: Tamper | None) -> tuple[float, float]:
    """Mean error over all relations and over loops, m, final."""
    config = Config()
    result = smooth(open_logs([log], config), config, tamper=tamper)
    known = read_relations(relations)
    (robot,) = result.robots.values()
    assert robot.scan_final is not None
    errors = relation_errors(known, robot.scan_final)[:, 0]
    return float(np.nanmean(errors)), float(np.nanmean(errors[~known.local]))


def main() -> int:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("logs", nargs="*", default=list(FREIBURG_LOGS))
    options.add_argument("--seeds", type=int, default=2)
    options.add_argument("--shares", type=float, nargs="*", default=list(SHARES))
    arguments = options.parse_args()
    bad = 0
    print("log    share  seed  true  false  all, m  loops, m  of clean")
    for name in arguments.logs:
        with tempfile.TemporaryDirectory() as folder:
            log = import_freiburg(name, Path(folder))
            relations = FREIBURG / f"{name}.relations"
            clean, loops = run(log, relations, None)
            print(f"{name:6} {0:5.0%}     -     -      -  {clean:.4f}    {loops:.4f}", flush=True)
            for share in arguments.shares:
                for seed in range(arguments.seeds):
                    tamper = FalseClosures(share, seed)
                    error, loops = run(log, relations, tamper)
                    bad += error > WITHIN * clean
                    print(
                        f"{name:6} {share:5.0%} {seed:5d} {tamper.true:5d} {tamper.false:6d}  "
                        f"{error:.4f}    {loops:.4f}  {error / clean:8.2f}",
                        flush=True,
                    )
    print("held" if not bad else f"{bad} runs are more than 10 % worse")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
