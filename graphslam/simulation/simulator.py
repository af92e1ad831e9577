"""Simulation of a scenario with a seed: logs with ground truth."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from graphslam.core.errors import OutputError
from graphslam.core.output_folder import atomic_folder, check_nothing_else_in, identity
from graphslam.simulation.recording import SimulatedLog, record_visit
from graphslam.simulation.scenario import Scenario
from graphslam.simulation.scene import prepare_visits
from graphslam.simulation.true_changes import true_changes

#: of what changed between the visits
TRUTH = "truth.json"


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """What was written: a log, or a folder with the logs of two visits, at ``target``."""

    scenario: str
    seed: int
    target: Path
    recordings: tuple[SimulatedLog, ...]
    changed_cells: int

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages per topic over all logs."""
        return sum((Counter(recording.counts) for recording in self.recordings), Counter())


def simulate(
    scenario: Scenario, target: Path, seed: int = 0, *, materials_seed: int | None = None
) -> Simulation:
    """Write the log ``target``, or the folder ``target`` if the scenario has two visits.

    The folder has reference.mcap, later.mcap and truth.json; it appears whole or not at all. An
    existing target is replaced. Equal scenarios and seeds give equal bytes.

    ``materials_seed``: of the biases of ranges from materials, which belong to the building, so
    that they stay the same in logs of one building with different seeds; ``seed`` by default.

    Raises:
        ScenarioError: the scenario is infeasible, see `graphslam.simulation.scene.prepare_visits`.
        OutputError: nothing can be written there, or something else would be lost.
    """
    visits = prepare_visits(scenario)
    if len(visits) == 1:
        if target.is_dir():
            raise OutputError(f"{target}: is a folder; this scenario makes one log: -o LOG.mcap")
        recording = record_visit(scenario, visits[0], target, seed, materials_seed)
        return Simulation(scenario.name, seed, target, (recording,), 0)
    if target.is_file() or target.suffix == ".mcap":
        raise OutputError(f"{target}: this scenario makes two logs; name a folder: -o DIR")
    before = identity(target)
    if target.is_dir():
        check_nothing_else_in(target)
        if any(target.iterdir()) and not (target / TRUTH).is_file():
            raise OutputError(f"{target}: is no folder of two visits; choose another name")
    with atomic_folder(target, before) as part:
        first, second = (
            record_visit(scenario, visit, part / f"{visit.name}.mcap", seed, materials_seed)
            for visit in visits
        )
        truth = true_changes(scenario, (first, second), seed)
        text = json.dumps(truth, indent=1, allow_nan=False) + "\n"
        (part / TRUTH).write_text(text, encoding="utf-8")
    written = tuple(replace(r, path=target / r.path.name) for r in (first, second))
    return Simulation(scenario.name, seed, target, written, len(truth["cells"]))
