"""A scenario and a seed in; a log with its truth out."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from graphslam.core.errors import OutputError
from graphslam.core.output_folder import atomic_folder
from graphslam.simulation.recording import Recording, record_visit
from graphslam.simulation.scenario import Scenario
from graphslam.simulation.scene import SimulatedVisit, prepare_visits
from graphslam.simulation.true_changes import true_changes


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """What was written where: a log, or a folder with the logs of two visits."""

    scenario: str
    seed: int
    target: Path
    recordings: tuple[Recording, ...]
    changed_cells: int = 0

    @property
    def counts(self) -> Mapping[str, int]:
        """Messages per topic over all logs."""
        total: dict[str, int] = {}
        for recording in self.recordings:
            for topic, count in recording.counts.items():
                total[topic] = total.get(topic, 0) + count
        return total


def simulate(scenario: Scenario, target: Path, seed: int = 0) -> Simulation:
    """Write the log ``target``; of a scenario with two visits, the folder ``target``.

    The folder holds reference.mcap, later.mcap and truth.json; it appears when it is whole. What
    is there already is replaced. Equal scenarios and seeds give equal bytes.

    Raises:
        ScenarioError: the scenario cannot take place, see `graphslam.simulation.scene.visits`.
        OutputError: nothing can be written there.
    """
    ready = prepare_visits(scenario)
    if len(ready) == 1:
        if target.is_dir():
            raise OutputError(f"{target}: is a folder; this scenario makes one log: -o LOG.mcap")
        recording = record_visit(scenario, ready[0], target, seed)
        return Simulation(scenario.name, seed, target, (recording,))
    return _two_visits(scenario, (ready[0], ready[1]), target, seed)


def _two_visits(
    scenario: Scenario, ready: tuple[SimulatedVisit, SimulatedVisit], target: Path, seed: int
) -> Simulation:
    if target.is_file() or target.suffix == ".mcap":
        raise OutputError(f"{target}: this scenario makes two logs; name a folder: -o DIR")
    with atomic_folder(target) as part:
        first, second = (
            record_visit(scenario, visit, part / f"{visit.name}.mcap", seed) for visit in ready
        )
        assert scenario.later is not None  # that is what makes two visits
        truth = true_changes(scenario, scenario.later, ready, (first, second), seed)
        text = json.dumps(truth, indent=1, allow_nan=False) + "\n"
        (part / "truth.json").write_text(text, encoding="utf-8")
    written = tuple(replace(r, path=target / r.path.name) for r in (first, second))
    return Simulation(scenario.name, seed, target, written, len(truth["cells"]))
