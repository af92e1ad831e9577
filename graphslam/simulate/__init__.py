"""Simulated recordings with their truth: worlds, ray casting, encoders, clocks. docs/simulator.md.

`load_scenario` reads a scenario, `simulate` writes its log.
"""

from graphslam.simulate.errors import ScenarioError
from graphslam.simulate.files import SCENARIOS, load_scenario
from graphslam.simulate.run import Simulation, simulate
from graphslam.simulate.spec import Scenario

__all__ = ["SCENARIOS", "Scenario", "ScenarioError", "Simulation", "load_scenario", "simulate"]
