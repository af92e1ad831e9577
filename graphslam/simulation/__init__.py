"""Simulated recordings with their truth: worlds, ray casting, encoders, clocks. docs/simulator.md.

`load_scenario` reads a scenario, `simulate` writes its log.
"""

from typing import TYPE_CHECKING

from graphslam.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from graphslam.simulation.scenario import Scenario, ScenarioError
    from graphslam.simulation.scenario_files import load_scenario
    from graphslam.simulation.scenario_names import SCENARIOS
    from graphslam.simulation.simulator import Simulation, simulate

#: module -> the names that it defines
_NAMES = {
    "scenario": ("Scenario", "ScenarioError"),
    "scenario_files": ("load_scenario",),
    "scenario_names": ("SCENARIOS",),
    "simulator": ("Simulation", "simulate"),
}

__all__ = ["SCENARIOS", "Scenario", "ScenarioError", "Simulation", "load_scenario", "simulate"]

if not TYPE_CHECKING:  # a type checker would take every name for defined
    __getattr__ = lazy_exports(__name__, _NAMES)
