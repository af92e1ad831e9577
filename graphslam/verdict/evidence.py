"""What a run knows about whether its result can be true, gathered where it is at hand.

Three witnesses tell how a robot moved: its odometry, its scans and the landmarks that it saw. Where
two of them contradict each other, the third tells which one is more likely wrong. What they say is
put into arrays here; `graphslam.verdict.verdict` judges it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from graphslam.core.arrays import BoolArray, IntArray
from graphslam.core.config import RobustConfig
from graphslam.core.gaussian import mahalanobis_squared
from graphslam.core.geometry import Array, between, chained, wrap
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Association, Estimate, RobotResult, Step
from graphslam.mapping.doubled_walls import Displacement
from graphslam.odometry.missing_increments import MissingIncrements
from graphslam.odometry.preintegration import Track
from graphslam.pipeline.log_pass import LogPass
from graphslam.pipeline.path_evidence import NO_PATH, PathMisfits
from graphslam.pipeline.robot_state import RobotState
from graphslam.pipeline.scan_evidence import Parked, find_parked
from graphslam.verdict.curved_walls import curved_share
from graphslam.verdict.scan_distortion import (
    UNDISTORTED,
    ScanDistortion,
    by_robot,
    scan_distortion,
)
from graphslam.verdict.set_down import SceneChange, scene_changes
from graphslam.verdict.told_starts import ToldStart, told_starts

IntTable = np.ndarray[tuple[int, int], np.dtype[np.int64]]

#: poses of a trajectory that are compared, at most
MOST_POSES = 4000
#: m: a closure says nothing along a direction in which its sigma is larger
OPEN_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Sightings of landmarks or robots by one robot, sorted by time, (n,) each.

    ``targets`` numbers what is seen, ``stands`` says that it is a landmark; ``z`` (n, 2) is bearing
    rad and range m of ``sigmas`` (n, 2); ``odometry`` (n, 3) the poses that they were made from by
    odometry alone, as recorded, ``calibrated`` (n, 3) as it was calibrated, ``poses`` (n, 3) the
    same in the result; ``d2`` their squared distances from the result, per degree of freedom.
    ``names``: those of the targets, in the order of their numbers; "" for robots and for landmarks
    without.
    """

    times_ns: IntArray
    targets: IntArray
    stands: BoolArray
    z: Array
    sigmas: Array
    odometry: Array
    calibrated: Array
    poses: Array
    d2: Array
    names: tuple[str, ...] = ()

    def at_images(self) -> tuple[IntArray, Array, Array]:
        """Times (m,) at which something was seen, and there ``odometry`` and ``poses`` (m, 3)."""
        times_ns, first = np.unique(self.times_ns, return_index=True)
        return times_ns, self.odometry[first], self.poses[first]


@dataclass(frozen=True, slots=True, eq=False)
class ClosureMisfits:
    """Closures (n) against the result: by how far they miss it.

    ``times_ns`` (n, 2): when the robot was there, and when it, or another one, was there before.
    ``off_m`` (n,): between where they and where the result have the one place from the other, as
    far as they know that; ``d2`` (n,): squared distances, for three degrees of freedom.
    """

    times_ns: IntTable
    off_m: Array
    d2: Array


@dataclass(frozen=True, slots=True, eq=False)
class RobotEvidence:
    """What one robot's sensors say.

    ``source`` of its odometry; ``readings_ns`` (n,) and ``readings`` (n, 3), poses by odometry
    alone, its resets bridged; ``resets``: how many. ``stamps_ns`` (m,), ``final`` (m, 3) and
    ``by_odometry`` (m, 3): some poses of the result, and the same by odometry, as recorded;
    ``by_calibrated`` (m, 3) as it was calibrated. ``scans_ns`` (k,):
    when it had scans; ``repeated_ns`` (j, 2): of scans that were left out, as they repeat an
    earlier one, their times and those of the first that is the same. ``motions_ns`` (q,) when
    motions ended, ``contradicted`` (q,) whether scans contradicted them. ``seen``: what it saw.
    ``parked``: when it stood, by odometry; ``along_walls``: how its scans fit if its path was
    another one there; ``bridged_sigma_m``: of its position where scans were all that told;
    ``missing``: what increments of its odometry leave out;
    ``lost_ns`` (l, 2): times of consecutive scans that have nothing in common, see `ComparedScans`;
    ``changes``: how what it sees changes where scans suddenly have less in common;
    ``curved``: share of what it saw of walls, see `curved_share`; ``skew``: how its walls are
    turned within scans.
    """

    name: str
    source: str
    readings_ns: IntArray
    readings: Array
    resets: int
    stamps_ns: IntArray
    final: Array
    by_odometry: Array
    by_calibrated: Array
    scans_ns: IntArray
    repeated_ns: IntTable
    motions_ns: IntArray
    contradicted: BoolArray
    seen: Seen
    parked: tuple[Parked, ...]
    along_walls: PathMisfits = NO_PATH
    bridged_sigma_m: float = 0.0
    missing: MissingIncrements = field(default_factory=MissingIncrements)
    lost_ns: IntTable = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    changes: tuple[SceneChange, ...] = ()
    curved: float = 0.0
    distortion: ScanDistortion = UNDISTORTED

    @property
    def other_sensor(self) -> str:
        """What can contradict the odometry, in the plural: scans, or sightings without any."""
        return "scans" if len(self.scans_ns) else "sightings"


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the whole run knows; ``summary`` has what it counted.

    ``without_odometry``: robots whose motion is that of their scans. ``observed``: whether an
    observation or a closure is in the estimate; ``unobserved``: robots of which none is, neither by
    them nor of them. ``closures``: how well these fit; None without.
    ``told``: the starts that the user gave. ``displacements`` of visits from
    where walls of the building were seen before. ``kernel`` of the last solution.
    """

    robots: tuple[RobotEvidence, ...]
    summary: Mapping[str, Any]
    innovations: Mapping[str, Array] = field(default_factory=dict)
    without_odometry: tuple[str, ...] = ()
    observed: bool = True
    unobserved: tuple[str, ...] = ()
    closures: ClosureMisfits | None = None
    told: tuple[ToldStart, ...] = ()
    displacements: Mapping[str, Displacement] = field(default_factory=dict)
    kernel: RobustConfig = field(default_factory=RobustConfig)

    @property
    def without_scans(self) -> tuple[RobotEvidence, ...]:
        """Robots with odometry of which sightings alone can tell how they moved."""
        return tuple(
            robot
            for robot in self.robots
            if not len(robot.scans_ns) and robot.name not in self.without_odometry
        )

    @property
    def begin_ns(self) -> int:
        """When the first odometry was read; 0 without any."""
        return min((int(r.readings_ns[0]) for r in self.robots if len(r.readings_ns)), default=0)


def gather(
    pipeline: LogPass,
    robots: Mapping[str, RobotResult],
    steps: Sequence[Step],
    estimate: Estimate,
    innovations: Mapping[str, Array],
    summary: Mapping[str, Any],
    along_walls: Mapping[str, PathMisfits],
) -> Evidence:
    """The evidence of a run: the last pass, and its result, see `graphslam.core.records.Result`.

    ``along_walls``: robot -> what `misfits_along_walls` found.
    """
    found = []
    entries = pipeline.landmarks.entries.items()
    identities: dict[int | str, str] = {i: one.identity or "" for i, one in entries}
    scans = by_robot(pipeline.keyframe_scans)
    parked = find_parked(pipeline) if pipeline.parked is None else pipeline.parked
    for name, run in pipeline.started.items():
        motions = [(s.time_ns, s.motions[name].from_scans) for s in steps if name in s.motions]
        own = [a for step in steps for a in step.associations if a.robot == name]
        seen = [a for a in own if len(a.z) == 2]
        result, kept = robots[name], scans.get(name, [])
        some = np.unique(np.linspace(0, len(result.final) - 1, MOST_POSES).astype(int))
        found.append(
            RobotEvidence(
                name=name,
                source=run.track.source,
                readings_ns=run.track.times,
                readings=run.track.pose(run.track.times),
                resets=run.track.resets,
                missing=run.track.missing,
                stamps_ns=result.final.stamps_ns[some],
                final=result.final.poses[some],
                by_odometry=result.dead_reckoning.poses[some],
                by_calibrated=_by_calibrated(run.track, result.final.stamps_ns[some]),
                scans_ns=np.array([time for _, time, _ in run.scans], dtype=np.int64),
                repeated_ns=np.array(run.repeats.left_out, dtype=np.int64).reshape(-1, 2),
                motions_ns=np.array([time for time, _ in motions], dtype=np.int64),
                contradicted=np.array([was for _, was in motions], dtype=bool),
                seen=_seen(seen, run, estimate, identities),
                parked=tuple(parked[name]),
                along_walls=along_walls[name],
                bridged_sigma_m=run.track.bridged_sigma_m,
                lost_ns=np.array(run.lost, dtype=np.int64).reshape(-1, 2),
                changes=scene_changes(
                    run.changes, kept, estimate.states[name], pipeline.config.scan_matching
                ),
                curved=curved_share(own),
                distortion=scan_distortion(own, kept, estimate, run.track),
            )
        )
    observed = _observed(steps)
    unobserved = tuple(sorted(robots.keys() - observed))
    by_scans_alone = tuple(pipeline.log.without_odometry)
    misfits = _closure_misfits(steps, estimate)
    told = told_starts(pipeline, steps, estimate)
    return Evidence(
        tuple(found), summary, innovations, by_scans_alone, bool(observed), unobserved,
        misfits, told, pipeline.displacements, pipeline.kernel,
    )  # fmt: skip


def _observed(steps: Sequence[Step]) -> set[str]:
    """Robots that see something, are seen, or are at an end of a closure."""
    found = set[str]()
    for step in steps:
        for a in step.associations:
            found.update((a.robot, a.target) if isinstance(a.target, str) else (a.robot,))
        for closure in step.closures:
            found.update((closure.robot, closure.other))
    return found


def _closure_misfits(steps: Sequence[Step], estimate: Estimate) -> ClosureMisfits | None:
    """Of all closures in ``steps``; None without any."""
    closures = [closure for step in steps for closure in step.closures]
    if not closures:
        return None
    here = np.array([estimate.states[c.robot].at(c.time_ns) for c in closures])
    there = np.array([estimate.states[c.other].at(c.other_time_ns) for c in closures])
    off = between(there, here) - np.array([c.delta for c in closures])
    off[:, 2] = wrap(off[:, 2])
    pull = np.linalg.solve(np.array([c.cov for c in closures]), off[:, :, None])[:, :, 0]
    # of a direction that is open nothing is known, however far off it is
    known = np.array([np.sqrt(np.diag(c.cov)[:2]) < OPEN_M for c in closures])
    return ClosureMisfits(
        np.array([[c.time_ns, c.other_time_ns] for c in closures], dtype=np.int64),
        np.hypot(*(off[:, :2] * known).T),
        np.sum(off * pull, axis=1),
    )


def _seen(
    seen: Sequence[Association],
    run: RobotState,
    estimate: Estimate,
    identities: Mapping[int | str, str],
) -> Seen:
    usable = [a for a in seen if _target(a, estimate) is not None]
    usable.sort(key=lambda a: a.time_ns)
    n = len(usable)
    times = np.array([a.time_ns for a in usable], dtype=np.int64)
    numbers: dict[int | str, int] = {}
    targets = np.array([numbers.setdefault(a.target, len(numbers)) for a in usable], dtype=np.int64)
    z = np.array([a.z for a in usable]).reshape(n, 2)
    covs = np.array([a.cov for a in usable]).reshape(n, 2, 2)
    d2 = np.zeros(n)
    for model in {a.model for a in usable}:
        of = np.array([k for k, a in enumerate(usable) if a.model == model])
        states = estimate.states[usable[0].robot].at(times[of])
        to = np.array([_target(usable[k], estimate) for k in of.tolist()])
        residual = np.asarray(MODELS[model].residual(z[of], states, to))
        d2[of] = mahalanobis_squared(residual, covs[of]) / residual.shape[1]
    return Seen(
        times,
        targets,
        np.array([isinstance(a.target, int) for a in usable], dtype=bool),
        z,
        np.sqrt(np.diagonal(covs, axis1=1, axis2=2)),
        run.track.mounted_pose(times) if n else np.zeros((0, 3)),
        _by_calibrated(run.track, times) if n else np.zeros((0, 3)),
        estimate.states[usable[0].robot].at(times) if n else np.zeros((0, 3)),
        d2,
        tuple(identities.get(target, "") for target in numbers),
    )


def _by_calibrated(track: Track, times_ns: IntArray) -> Array:
    """Poses (n, 3) at ascending times by odometry as it was calibrated, from where it begins."""
    unique, of = np.unique(times_ns, return_inverse=True)
    moved = track.motions(unique[:-1], unique[1:]).delta
    return chained(moved)[of]


def _target(a: Association, estimate: Estimate) -> Array | None:
    """The landmark, or the pose of the robot, that an association is with; None without."""
    if isinstance(a.target, int):
        known = estimate.landmarks.get(a.target)
        return None if known is None else known[0]
    states = estimate.states.get(a.target)
    if states is None:
        return None
    k = int(states.index(a.time_ns))
    same = k < len(states) and int(states.stamps_ns[k]) == a.time_ns
    return states.poses[k] if same else None
