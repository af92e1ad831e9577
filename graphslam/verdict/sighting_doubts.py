"""Doubts about sightings: signs, units, names, repeated images, what odometry says of them.

Two sightings of one landmark, shortly after each other, and the motion in between by odometry must
agree, whatever the map. (A robot that is seen may drive along: nobody can tell that from an image
that is repeated.) Where they do not, the same is tried with a bearing of the other sign, a path of
another unit and so on: what makes them agree is what is wrong.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import ComplexArray, IntArray
from graphslam.core.geometry import Array, between
from graphslam.verdict.doubts import Reason, seconds
from graphslam.verdict.evidence import Evidence, RobotEvidence, Seen

#: s: sightings of one landmark are compared over up to this
PAIR_S = 3.0
#: m, rad: between which the robot moved by at least so much, or something else did
MOVED_M, MOVED_RAD = 0.05, 0.05
#: the log is looked at in so many parts, of so many pairs at least
PARTS, LEAST = 8, 20
#: pairs of a part with which explanations are tried, evenly chosen: medians need no more
MOST = 2000
#: of the range: an error that is none
TOLERANCE = 0.02
#: rad: offsets of bearings that are tried
OFFSETS_RAD = np.concatenate([np.arange(-3.0, 0.0, 0.1), np.arange(0.1, 3.1, 0.1)])
#: an explanation has to be better by this factor
BETTER = 0.5
#: squared distance per degree of freedom of an outlier, and the share of them in a part of the log
OUTLIER, OUTLIERS = 25.0, 0.4
#: share of images in which one name is at two places
TWICE = 0.05

#: what could be wrong: factors on bearing and range, on the motion (x, y, turn), and what that is
EXPLANATIONS: dict[str, tuple[tuple[float, float], tuple[float, float, float]]] = {
    "the bearings of its sightings, or the turning of its odometry, have the wrong sign": (
        (-1, 1),
        (1, 1, 1),
    ),
    "its odometry drives backwards where the sightings say forwards": ((1, 1), (-1, -1, 1)),
    "its sightings repeat an image while its odometry moves": ((1, 1), (0, 0, 0)),
    "the ranges of its sightings are 2 times too large, or its odometry half as long": (
        (1, 0.5),
        (1, 1, 1),
    ),
    "the ranges of its sightings are half of what they are, or its odometry twice as long": (
        (1, 2),
        (1, 1, 1),
    ),
    "the ranges of its sightings are 100 or more times too large: are they in metres?": (
        (1, 0.001),
        (1, 1, 1),
    ),
    "the ranges of its sightings are 100 or more times too small: are they in metres?": (
        (1, 1000),
        (1, 1, 1),
    ),
    "the turning of its odometry is in degrees": ((1, 1), (1, 1, np.pi / 180)),
}


CONTRADICTION = "its sightings contradict its odometry; one of the two is wrong"


def _offset_text(offset_rad: float) -> str:
    return f"the bearings of its sightings are off by {-offset_rad:.1f} rad: is the mount right?"


def sighting_doubts(evidence: Evidence) -> Iterator[Reason]:
    """What is wrong with the sightings of each robot."""
    for robot in evidence.robots:
        if len(robot.seen.times_ns) < LEAST:
            continue
        found = [*_same_name(robot), *_pairs(robot)]
        yield from found
        if not found:
            yield from _outliers(robot)


def _reason(robot: RobotEvidence, level: str, text: str) -> Reason:
    return Reason(level, "sightings", robot.name, f"{robot.name}: {text}")


def _same_name(robot: RobotEvidence) -> Iterator[Reason]:
    """One name at two places of one image."""
    seen = robot.seen
    order = np.lexsort((seen.targets, seen.times_ns))
    times, targets, z = seen.times_ns[order], seen.targets[order], seen.z[order]
    same = (np.diff(times) == 0) & (np.diff(targets) == 0)
    sigma = np.maximum(seen.sigmas.mean(axis=0), (0.02, 0.1))
    apart = (np.abs(np.diff(z, axis=0)) > 10 * sigma).any(axis=1)
    images = len(np.unique(times))
    twice = len(np.unique(times[1:][same & apart]))
    if twice > TWICE * images and twice > 3:
        text = (
            f"in {twice} of {images} images of sightings one landmark is at two places: several "
            "landmarks have one name"
        )
        yield _reason(robot, "bad", text)


def _pairs_of(seen: Seen) -> tuple[IntArray, IntArray]:
    """Places of sightings of one landmark, each with the next one of it."""
    order = np.lexsort((seen.times_ns, seen.targets))
    order = order[seen.stands[order]]
    a, b = order[:-1], order[1:]
    apart = (seen.times_ns[b] - seen.times_ns[a]) * 1e-9
    use = (seen.targets[a] == seen.targets[b]) & (apart > 0) & (apart < PAIR_S)
    a, b = a[use], b[use]
    by_time = np.argsort(seen.times_ns[b], kind="stable")
    return a[by_time], b[by_time]


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """Sightings (..., n) of things, twice each, and the motion in between.

    ``first``, ``second``: where they were seen from the robot's earlier and later pose, x + iy, m;
    ``to``: where the robot went, seen from its earlier pose, m; ``turn``: exp(i heading) of its
    later pose, seen from there.
    """

    first: ComplexArray
    second: ComplexArray
    to: ComplexArray
    turn: ComplexArray

    @classmethod
    def of(cls, z1: Array, z2: Array, moved: Array) -> "_Pairs":
        """Of bearings, rad, and ranges, m, (..., n, 2) and the motions (..., n, 3) in between."""
        first, second = (z[..., 1] * np.exp(1j * z[..., 0]) for z in (z1, z2))
        to, turn = moved[..., 0] + 1j * moved[..., 1], np.exp(1j * moved[..., 2])
        return cls(first, second, to, turn)

    def disagreement(self, mounted: ComplexArray | complex = 1.0) -> Array:
        """Medians (...,) of how far things are from where they were seen before, over their ranges.

        ``mounted``: exp(i offset) of the sensor. Turned back by it, all that was seen stays, and
        where the robot went is turned.
        """
        off = self.first - self.turn * self.second - self.to * np.conj(mounted)
        return np.asarray(np.median(np.abs(off) / np.maximum(np.abs(self.second), 1e-9), axis=-1))


def _explained(z1: Array, z2: Array, moved: Array) -> dict[str, float]:
    """What could be wrong -> `_Pairs.disagreement` if it were; of offsets of bearings the best."""
    seeing, driving = (np.array(of)[:, None] for of in zip(*EXPLANATIONS.values(), strict=True))
    tried = _Pairs.of(z1 * seeing, z2 * seeing, moved * driving).disagreement()
    found = dict(zip(EXPLANATIONS, tried.tolist(), strict=True))
    offsets = _Pairs.of(z1, z2, moved).disagreement(np.exp(1j * OFFSETS_RAD)[:, None])
    nearest = int(np.argmin(offsets))
    return {**found, _offset_text(float(OFFSETS_RAD[nearest])): float(offsets[nearest])}


def _pairs(robot: RobotEvidence) -> Iterator[Reason]:
    seen = robot.seen
    a, b = _pairs_of(seen)
    moved = between(seen.odometry[a], seen.odometry[b])
    # ranges that are too long look like odometry whose path is too short, but angles are angles
    calibrated = moved.copy()
    calibrated[:, 2] = between(seen.calibrated[a], seen.calibrated[b])[:, 2]
    noise = np.hypot(*(seen.sigmas[b] / np.column_stack([np.ones(len(b)), seen.z[b, 1]])).T)
    size = np.hypot(moved[:, 0], moved[:, 1])
    moves = (size > MOVED_M) | (np.abs(moved[:, 2]) > MOVED_RAD)
    a, b, moved, noise = a[moves], b[moves], moved[moves], noise[moves]
    calibrated = calibrated[moves]
    if len(a) < LEAST or _is_half_measured(seen.z[a]):
        return
    found: dict[str, list[int]] = {}
    parts = np.arange(len(a)) * PARTS // len(a) if len(a) >= PARTS * LEAST else 0 * a
    for part in np.unique(parts).tolist():
        own = parts == part
        z1, z2, motion = seen.z[a[own]], seen.z[b[own]], moved[own]
        plain = float(_Pairs.of(z1, z2, motion).disagreement())
        if plain < TOLERANCE:
            continue
        some = slice(None, None, 1 + len(z1) // MOST)
        tried = _explained(z1[some], z2[some], motion[some])
        best = min(tried, key=lambda text: tried[text])
        what = best
        if tried[best] > BETTER * plain:
            limit = 3 * float(np.median(noise[own]))
            if plain < limit:
                continue  # it is noise
            if float(_Pairs.of(z1, z2, calibrated[own]).disagreement()) < max(limit, TOLERANCE):
                continue  # a calibration of turning explains it
            what = CONTRADICTION
        found.setdefault(what, []).append(int(seen.times_ns[a[own]][0]))
    for what, times in found.items():
        since = seconds(times[0], int(robot.readings_ns[0]))
        certain = what != CONTRADICTION and len(times) > 1
        yield _reason(robot, "bad" if certain else "doubtful", f"{what}, from {since} on")


def _is_half_measured(z: Array) -> bool:
    """Whether of bearings and ranges (n, 2) one never changes: a constant stands for it.

    Where both never change an image may be repeated.
    """
    return bool((np.ptp(z, axis=0) == 0).sum() == 1)


def _outliers(robot: RobotEvidence) -> Iterator[Reason]:
    """Parts of the log in which many sightings are nowhere near their landmarks."""
    seen = robot.seen
    parts = np.arange(len(seen.d2)) * PARTS // len(seen.d2)
    shares = np.array([np.mean(seen.d2[parts == part] > OUTLIER) for part in range(PARTS)])
    if shares.max() > OUTLIERS:
        first = int(np.flatnonzero(parts == int(shares.argmax()))[0])
        since = seconds(seen.times_ns[first], int(robot.readings_ns[0]))
        text = (
            f"{100 * shares.max():.0f} % of its sightings from {since} on are not where their "
            "landmarks are: were names exchanged?"
        )
        yield _reason(robot, "doubtful", text)
