"""Logs of the simulated lab, in which furniture is pushed."""

from dataclasses import replace

import numpy as np

from graphslam.simulation import load_scenario, simulate


def lab(path, push_m, seed, materials_seed=None):
    """The log of the simulated lab, all boxes and boards pushed by (2,) m."""
    scenario = load_scenario("lab")

    def pushed(things):
        return tuple(
            replace(one, center_m=tuple((np.array(one.center_m) + push_m).tolist()), may_cross=True)
            for one in things
        )

    world = scenario.world
    world = replace(world, boxes=pushed(world.boxes), boards=pushed(world.boards))
    simulate(replace(scenario, world=world), path, seed, materials_seed=materials_seed)
    return path
