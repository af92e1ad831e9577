"""Sightings of robots associated again, once all data are known.

While a log is read, a sighting is judged by what came before it. In the solution of the whole log
each is compared with all others: one that was rejected may fit, and one that was used may turn out
to be false, or to be of another robot.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.config import AssociationConfig, Config, RobustConfig
from graphslam.core.record import replace
from graphslam.core.records import Association, Estimate, Sighting, Step
from graphslam.estimation.robot_distances import robot_distances
from graphslam.mapping.gating import assign, gate_distance, gate_floor

#: a sighting and the robot that it may be of
Key = tuple[int | None, int | str]


@dataclass(frozen=True)
class RobotOffers:
    """What the sightings of robots in a log could be.

    ``by_step``: number of a step -> associations with every robot that a sighting of it may be of;
    ``sightings``: those that `Association.source` numbers.
    """

    by_step: Mapping[int, Sequence[Association]]
    sightings: Sequence[Sighting] = field(repr=False)

    @classmethod
    def of(cls, steps: Sequence[Step], sightings: Sequence[Sighting]) -> "RobotOffers":
        """The sightings of robots in steps, each of the robot that it is associated with."""
        seen = [[a for a in step.associations if isinstance(a.target, str)] for step in steps]
        return cls({n: own for n, own in enumerate(seen) if own}, sightings)

    def associated_again(
        self, steps: Sequence[Step], estimate: Estimate, kernel: RobustConfig, config: Config
    ) -> tuple[Step, ...]:
        """Steps in which sightings of robots are used as the estimate says.

        Args:
            steps: in their recorded order, with their recorded numbers.
            estimate: their solution.
            kernel: that it was solved with.
            config: settings.

        Raises:
            EstimationError: the steps make the estimate indeterminate.
        """
        landmarks = {
            a.source for step in steps for a in step.associations if isinstance(a.target, int)
        }
        offers = [
            (n, a) for n, own in self.by_step.items() for a in own if a.source not in landmarks
        ]
        used = {_key(a) for step in steps for a in step.associations if isinstance(a.target, str)}
        if not offers:
            return tuple(steps)
        d2 = robot_distances(
            steps,
            [(steps[n].time_ns, a) for n, a in offers],
            [_key(a) in used for _, a in offers],
            estimate,
            kernel,
            gate_floor(config.association),
        )
        chosen = self._chosen([a for _, a in offers], d2, config.association)
        if chosen == used:
            return tuple(steps)
        made = list(steps)
        for n, own in self.by_step.items():
            kept = [
                a
                for a in steps[n].associations
                if not isinstance(a.target, str) or _key(a) in chosen
            ]
            missing = chosen & set(map(_key, own)) - set(map(_key, kept))
            kept += [a for a in own if _key(a) in missing]
            made[n] = replace(steps[n], associations=tuple(kept))
        return tuple(made)

    def _chosen(
        self, offers: Sequence[Association], d2: np.ndarray, config: AssociationConfig
    ) -> set[Key]:
        """The pairs that are used: of one image each sighting and each robot once."""
        images: dict[tuple[str, int], list[int]] = defaultdict(list)
        for k, a in enumerate(offers):
            assert a.source is not None  # all sightings of robots have a number
            images[a.robot, self.sightings[a.source].time_ns].append(k)
        chosen: set[Key] = set()
        for own in images.values():
            if len(own) == 1:
                (k,) = own
                if d2[k] < gate_distance(config.gate_probability, len(offers[k].z)):
                    chosen.add(_key(offers[k]))
                continue
            rows = list(dict.fromkeys(offers[k].source for k in own))
            columns = list(dict.fromkeys(offers[k].target for k in own))
            cost = np.full((len(rows), len(columns)), np.inf)
            gate = np.zeros_like(cost)
            for k in own:
                cell = rows.index(offers[k].source), columns.index(offers[k].target)
                cost[cell] = d2[k]
                gate[cell] = gate_distance(config.gate_probability, len(offers[k].z))
            chosen |= {(rows[i], columns[j]) for i, j in assign(cost, gate, config.method)}
        return chosen

    @property
    def count(self) -> int:
        """Number of sightings of robots."""
        return len({a.source for own in self.by_step.values() for a in own})

    def unused(self, steps: Sequence[Step]) -> int:
        """Number of sightings of robots, told from landmarks, that are in none of the steps."""
        used = {a.source for step in steps for a in step.associations}
        offered = {a.source for own in self.by_step.values() for a in own}
        left = [k for k in offered - used if k is not None]
        return sum(self.sightings[k].may_be != "either" for k in left)


def _key(a: Association) -> Key:
    return a.source, a.target
