"""What the walls of a known map are after one more log.

On each day a wall looks nearer or farther by an error of its own: it is seen from elsewhere, in
other parts. A log gets the map with that error, and tells where the walls were with the day's. What
it tells of the map itself is one step back of a smoother (H. E. Rauch, F. Tung and C. T. Striebel,
Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3, 1965, DOI 10.2514/3.3166):
so walls are averaged over days, and with them the direction of the whole, where the latest day
would win if its error were added to what it left.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, between, compose, exp, log, rotate_cov
from graphslam.core.known_landmarks import KnownLandmarks
from graphslam.core.record import replace
from graphslam.core.records import Landmark
from graphslam.mapping.landmark_records import line_parameters


def with_surface_biases(landmarks: Sequence[Landmark], cov: Array, bias_m: float) -> Array:
    """A covariance (D, D), errors of walls along each one's own axes, with that of a day's biases.

    Within a log it does not matter: whoever compares poses sees each wall with its bias. On another
    day without it many sightings of a wall make the map so stiff that differences of a few
    millimetres bend or turn all of it.
    """
    out = cov.copy()
    across = _across(landmarks)
    out[across, across] += bias_m**2
    return out


def without_days_biases(
    known: KnownLandmarks,
    itself: KnownLandmarks | None,
    bias_m: float,
    landmarks: Sequence[Landmark],
    cov: Array,
) -> tuple[tuple[Landmark, ...], Array]:
    """Landmarks after a log, and their joint covariance (D, D), without the errors of its day.

    Args:
        known: what the log was given, with an error of ``bias_m`` across each wall.
        itself: the same without this error; None: what ``known`` is without it.
        bias_m: sigma, m.
        landmarks: as the log saw them, those of the map that are still there and new ones.
        cov: (D, D) of them, errors of walls along each one's own axes.

    A wall that is new has the error of the day that saw it: later ones weigh as much as it does.
    The time grows with the cube of their number.
    """
    kept = [mark for mark in landmarks if mark.id in known.means]
    if not kept:
        return tuple(landmarks), with_surface_biases(landmarks, cov, bias_m)
    rows = np.concatenate([
        np.arange(first, first + _dim(mark))
        for first, mark in zip(_first(landmarks), landmarks, strict=True)
        if mark.id in known.means
    ])  # fmt: skip
    numbers = [mark.id for mark in kept]
    K = known.covariance(numbers)
    if itself is None:
        P, across = K.copy(), _across(kept)
        P[across, across] -= bias_m**2
    else:
        P = itself.covariance(numbers)
    gain = np.linalg.solve(K, P).T
    shift = gain @ np.concatenate([_off(known.means[mark.id], mark) for mark in kept])
    moved = {
        mark.id: _moved(mark, known.means[mark.id], shift[first : first + _dim(mark)])
        for first, mark in zip(_first(kept), kept, strict=True)
    }
    back = np.eye(len(cov))
    back[np.ix_(rows, rows)] = gain
    out = back @ cov @ back.T
    out[np.ix_(rows, rows)] += P - gain @ P
    # new walls are where this day saw them
    fresh = np.setdiff1d(_across(landmarks), rows)
    out[fresh, fresh] += bias_m**2
    return tuple(moved.get(mark.id, mark) for mark in landmarks), 0.5 * (out + out.T)


def with_covariances(landmarks: Sequence[Landmark], cov: Array) -> tuple[Landmark, ...]:
    """Landmarks with their blocks of a joint covariance (D, D), see `without_days_biases`."""
    return tuple(
        _with_covariance(mark, cov[first : first + _dim(mark), first : first + _dim(mark)])
        for first, mark in zip(_first(landmarks), landmarks, strict=True)
    )


def _with_covariance(mark: Landmark, own: Array) -> Landmark:
    if mark.kind == "point":
        return replace(mark, cov=own)
    cov = rotate_cov(own, float(mark.position[2]))
    return replace(mark, cov=cov, line=line_parameters(mark.position, cov))


def _dim(mark: Landmark) -> int:
    return 2 if mark.kind == "point" else 3


def _first(landmarks: Sequence[Landmark]) -> list[int]:
    """The first row of each."""
    rows: list[int] = np.cumsum([0, *map(_dim, landmarks)])[:-1].tolist()
    return rows


def _across(landmarks: Sequence[Landmark]) -> IntArray:
    """Rows (n,) of errors across walls."""
    rows = [
        first + 1
        for first, mark in zip(_first(landmarks), landmarks, strict=True)
        if mark.kind != "point"
    ]
    return np.array(rows, dtype=np.int64)


def _off(mean: Array, mark: Landmark) -> Array:
    """How far a landmark is from a mean (d,), in the tangent space there."""
    at = mark.position[: len(mean)]
    return at - mean if len(mean) == 2 else log(between(mean, at))


def _moved(mark: Landmark, mean: Array, off: Array) -> Landmark:
    """A landmark put ``off`` (d,) from a mean (d,)."""
    if len(mean) == 2:
        at = mean + off
        return replace(mark, position=np.array([*at, np.nan]), extent=np.array([at, at]))
    pose = compose(mean, exp(off))
    ends = np.column_stack([mark.extent, np.zeros(len(mark.extent))])
    extent = compose(pose, between(mark.position, ends))[:, :2]
    return replace(mark, position=pose, extent=extent)
