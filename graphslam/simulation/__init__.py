"""Simulated recordings with their truth: worlds, ray casting, encoders, clocks. docs/simulator.md.

`load_scenario` reads a scenario, `simulate` writes its log.
"""

from graphslam.simulation.scenario import Scenario, ScenarioError
from graphslam.simulation.scenario_files import SCENARIOS, load_scenario
from graphslam.simulation.simulate import Simulation, simulate

__all__ = ["SCENARIOS", "Scenario", "ScenarioError", "Simulation", "load_scenario", "simulate"]
