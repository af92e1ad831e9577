"""Laser scans: exact ranges, then noise and errors of a real laser."""

from collections.abc import Callable, Mapping

import numpy as np

from graphslam.core.geometry import Array, compose
from graphslam.simulation.raycast import NO_SURFACE, BeamFan, Hits, cast_beams, nearest_hits
from graphslam.simulation.robot_shapes import outline_shapes
from graphslam.simulation.scenario import Body, Laser
from graphslam.simulation.world import World

# Surfaces are searched this far beyond the range limit: a mixed pixel at a range discontinuity may
# return a range inside the limit although the far surface is outside.
_MARGIN_M = 5.0


def beam_fan(laser: Laser) -> BeamFan:
    """The beams of a laser in its own frame, symmetric about its x axis."""
    step = np.radians(laser.step_deg)
    return BeamFan(-step * (laser.beams - 1) / 2, step, laser.beams)


def laser_mount(laser: Laser) -> Array:
    """Pose (3,) of the laser in the base frame."""
    return np.array([*laser.mount_m, np.radians(laser.mount_deg)])


def told_mount(laser: Laser) -> Array:
    """Pose (3,) of the laser in the base frame according to the log."""
    error = np.array([*laser.mount_error_m, np.radians(laser.mount_error_deg)])
    return np.asarray(laser_mount(laser) + error)


def noise_free_scans(
    poses: Array,
    laser: Laser,
    world: World,
    others: Mapping[str, tuple[Body, Array]],
    fan: BeamFan | None = None,
) -> Hits:
    """Ranges and surfaces of noise-free beams for bases at ``poses`` (n, 3).

    ``others``: the other robots with their poses (n, 3) at the same times. Surfaces are numbered as
    in ``world``; the whole outline of robot i is surface ``len(world.names) + i``. ``fan``: some of
    the beams instead of all.
    """
    at, fan = compose(poses, laser_mount(laser)), fan or beam_fan(laser)
    reach = laser.range_max_m + _MARGIN_M
    hits = cast_beams(at, fan, world.shapes, reach)
    for number, (body, where) in enumerate(others.values()):
        seen = cast_beams(at, fan, outline_shapes(body, where), reach)
        robot = np.where(seen.surfaces == NO_SURFACE, NO_SURFACE, 0)
        hits = nearest_hits(hits, Hits(seen.ranges, robot), len(world.names) + number)
    return hits


def swept_scans(
    times: Array,
    laser: Laser,
    world: World,
    poses_at: Callable[[Array], Array],
    others_at: Callable[[Array], Mapping[str, tuple[Body, Array]]],
) -> Hits:
    """`noise_free_scans` whose beams are measured one after the other, the first at times (n,) s.

    ``poses_at`` and ``others_at`` give the base and the other robots at times.
    """
    fan = beam_fan(laser)
    columns = []
    for beam, angle in enumerate(fan.angles.tolist()):
        now = times + beam * laser.beam_period_s
        one = BeamFan(angle, fan.step_rad, 1)
        columns.append(noise_free_scans(poses_at(now), laser, world, others_at(now), one))
    ranges, surfaces = ([getattr(c, name) for c in columns] for name in ("ranges", "surfaces"))
    return Hits(np.concatenate(ranges, axis=1), np.concatenate(surfaces, axis=1))


def noisy_ranges(hits: Hits, biases: Array, laser: Laser, rng: np.random.Generator) -> Array:
    """Ranges (n, beams) m as the laser reports them; inf without a return.

    ``biases`` (surfaces,) m are added to ranges on the surface. Random numbers are drawn in the
    same order for all settings, so that one kind of error does not change the others.
    """
    clean, shape = hits.ranges, hits.ranges.shape
    bias = np.where(hits.surfaces == NO_SURFACE, 0.0, np.append(biases, 0.0)[hits.surfaces])
    far = np.where(np.isfinite(clean), clean, 0.0)
    sigma = np.hypot(laser.range_sigma_m, laser.range_sigma_ratio * far)
    ranges = clean + bias + sigma * rng.normal(size=shape)
    ranges = _mixed_pixels(ranges, hits, laser, rng)
    spurious = rng.random(shape) < laser.spurious_share
    farthest = np.minimum(np.where(np.isfinite(clean), clean, np.inf), laser.range_max_m)
    somewhere = laser.range_min_m + (farthest - laser.range_min_m) * rng.random(shape)
    ranges = np.where(spurious, somewhere, ranges)
    ranges[rng.random(shape) < laser.dropout_share] = np.inf
    if laser.resolution_m:
        ranges = np.round(ranges / laser.resolution_m) * laser.resolution_m
    reported = (ranges >= laser.range_min_m) & (ranges <= laser.range_max_m)
    return np.where(reported, ranges, np.inf)


def _mixed_pixels(ranges: Array, hits: Hits, laser: Laser, rng: np.random.Generator) -> Array:
    """Ranges with mixed pixels: some beams at a range discontinuity return a range in between.

    A beam has a width: at an edge it hits the near and the far surface, and a time-of-flight laser
    reports a range between them. It is as wide to either side: of the two beams at an edge each is
    mixed in half of the cases. A beam along a wall hits the wall alone, however far its neighbours
    hit it.
    """
    share, chosen = rng.random(hits.ranges.shape), rng.random(hits.ranges.shape)
    mixed = ranges
    for step in (1, -1):
        with np.errstate(invalid="ignore"):  # two beams without a hit
            jump = np.roll(hits.ranges, -step, axis=1) - hits.ranges
        edge = (np.abs(jump) > laser.mixed_gap_m) & np.isfinite(jump)
        edge &= np.roll(hits.surfaces, -step, axis=1) != hits.surfaces
        edge[:, -1 if step == 1 else 0] = False  # has no neighbour there
        least = 0.0 if step == 1 else laser.mixed_share / 2
        this = edge & (chosen >= least) & (chosen < least + laser.mixed_share / 2)
        mixed = np.where(this, ranges + share * np.where(this, jump, 0.0), mixed)
    return mixed
