"""Observations of one or many scans as arrays, for what works on all of them at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.arrays import IntArray
from graphslam.core.geometry import Array, compose, polar_points, rotate_cov
from graphslam.core.observation_models import MODELS, transport
from graphslam.core.record import Record
from graphslam.core.records import Observation

#: kinds of landmarks and the models that compare them, by their codes in arrays
KINDS = ("point", "line", "segment")
POINT, LINE, SEGMENT = range(3)
#: rows of their residuals
ROWS = np.array([MODELS[kind].rows for kind in KINDS])


@dataclass(frozen=True, slots=True, eq=False)
class ObservationArrays(Record):
    """Observations (m) in the frames of the states or sensors from which they were made.

    ``kind`` (m,) code in `KINDS`; ``z`` (m, 3) and ``cov`` (m, 3, 3), padded with zeros for points,
    which are bearing and range; ``extent`` (m, 2) m along a line, 0 for points.
    """

    kind: IntArray
    z: Array
    cov: Array
    extent: Array

    def __len__(self) -> int:
        return len(self.kind)

    @classmethod
    def of(cls, seen: Sequence[Observation]) -> "ObservationArrays":
        """From single observations."""
        m = len(seen)
        z, cov, extent = np.zeros((m, 3)), np.zeros((m, 3, 3)), np.zeros((m, 2))
        for k, o in enumerate(seen):
            d = len(o.z)
            z[k, :d], cov[k, :d, :d] = o.z, o.cov
            if o.extent is not None:
                extent[k] = o.extent
        kind = np.array([KINDS.index(o.kind) for o in seen], dtype=np.int64)
        return cls(kind, z, cov, extent)

    def part(self, first: int, last: int) -> "ObservationArrays":
        """Those from ``first`` up to ``last``, which is left out."""
        own = slice(first, last)
        return ObservationArrays(self.kind[own], self.z[own], self.cov[own], self.extent[own])

    def one(self, k: int) -> Observation:
        """A single one."""
        d = 2 if self.kind[k] == POINT else 3
        extent = None if d == 2 else self.extent[k]
        return Observation(KINDS[self.kind[k]], self.z[k, :d], self.cov[k, :d, :d], extent)

    def poses(self) -> Array:
        """Poses (m, 3) of what was seen; heading 0 for points."""
        at = self.z.copy()
        points = self.kind == POINT
        if points.any():
            at[points, :2] = polar_points(self.z[points, 1], self.z[points, 0])
            at[points, 2] = 0.0
        return at

    def from_mounts(self, mounts: Array) -> "ObservationArrays":
        """The same seen from the frame in which their own frames are at ``mounts`` (m, 3)."""
        if not mounts.any():
            return self
        z, cov = compose(mounts, self.z), rotate_cov(self.cov, mounts[:, 2])
        for k in np.flatnonzero(self.kind == POINT):
            seen = transport(self.z[k, :2], self.cov[k, :2, :2], mounts[k], np.zeros((3, 3)))
            z[k], cov[k] = 0.0, 0.0
            z[k, :2], cov[k, :2, :2] = seen
        return ObservationArrays(self.kind, z, cov, self.extent)
