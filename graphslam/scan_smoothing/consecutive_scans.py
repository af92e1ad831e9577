"""Each scan of a robot's first laser compared with the one before, where odometry puts it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from graphslam.core.config import ScanMatchingConfig
from graphslam.core.geometry import Array
from graphslam.core.record import replace
from graphslam.core.records import Motion, Scan
from graphslam.odometry.preintegration import Track
from graphslam.odometry.scan_odometry import MIN_POINTS, match_motions, suspect_motions
from graphslam.perception.scan_matching import make_submap
from graphslam.scan_smoothing.motion_checks import ScanPair

#: share of points on each other below which two consecutive scans have little in common
LITTLE_OVERLAP = 0.3

Span = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class ComparedScans:
    """What was found of the scans of a block.

    ``pairs``: those that can be compared. ``lost``: times, ns, of the scans of pairs that have
    little in common where odometry puts them, and that match nowhere else. ``shares``: times,
    ns, of the scans of each pair -> the share of points of the later one on the earlier one.
    """

    pairs: Sequence[ScanPair] = ()
    lost: Sequence[Span] = ()
    shares: Mapping[Span, float] = field(default_factory=dict)


class ConsecutiveScans:
    """Compares the scans of a block with those before, whatever states are between them."""

    def __init__(self, track: Track, config: ScanMatchingConfig) -> None:
        """No scan yet; ``track`` is the odometry."""
        self._track, self._config = track, config
        self._last: tuple[int, Array] = -1, np.zeros((0, 2))
        #: of the present block: whether a motion is suspect, and the overlap, by its times
        self._known: dict[Span, tuple[bool, float]] = {}

    def compare(
        self,
        scans: Sequence[Scan],
        motions: Sequence[Motion | None],
        points: Sequence[Array],
        resumed_ns: Collection[int] = (),
    ) -> ComparedScans:
        """The pairs of a block; may be asked for again, with scans added.

        Args:
            scans: of all lasers that have a state.
            motions: by odometry, of each since the state before; None if that has the same time.
            points: (k, 2) returns of each, in the order of the beams.
            resumed_ns: times of scans that came after a pause of the laser.
        """
        last_ns, last_points = self._last
        times, clouds, pairs = [last_ns], [last_points], []
        before = -1
        for n, scan in enumerate(scans):
            if scan.sensor:
                continue
            motion, part, begin = motions[n], None, times[-1]
            if motion is not None and begin >= 0 and begin != motion.start_ns:
                part = self._track.motion(begin, motion.start_ns)
                motion = self._track.motion(begin, motion.end_ns)
            times.append(scan.time_ns)
            clouds.append(points[n])
            enough = min(len(clouds[-2]), len(clouds[-1])) >= MIN_POINTS
            if motion is not None and begin == motion.start_ns and enough:
                has_paused = scan.time_ns in resumed_ns
                pair = ScanPair(before, n, motion, part, suspect=False, has_paused=has_paused)
                pairs.append((len(times) - 1, pair))
            before = n
        found = self._found([pair.motion for _, pair in pairs], clouds, [k for k, _ in pairs])
        return ComparedScans(
            [replace(pair, suspect=one) for (_, pair), (one, _) in zip(pairs, found, strict=True)],
            self._lost(pairs, [overlap for _, overlap in found], clouds),
            {
                (pair.motion.start_ns, pair.motion.end_ns): share
                for (_, pair), (_, share) in zip(pairs, found, strict=True)
            },
        )

    @property
    def last(self) -> tuple[int, Array]:
        """Time, ns (-1: none), and returns (k, 2) of the last scan of the blocks before."""
        return self._last

    def end_block(self, scans: Sequence[Scan], points: Sequence[Array]) -> None:
        """The next block begins after the last of the scans; ``points`` (k, 2) as in `compare`."""
        own = [n for n, scan in enumerate(scans) if not scan.sensor]
        if own:
            self._last = scans[own[-1]].time_ns, points[own[-1]]
        self._known = {}

    def _found(
        self, motions: Sequence[Motion], clouds: Sequence[Array], ends: Sequence[int]
    ) -> list[tuple[bool, float]]:
        """Whether each motion is suspect, and the overlap; ``ends`` are numbers of later scans."""
        spans = [(motion.start_ns, motion.end_ns) for motion in motions]
        new = [k for k, span in enumerate(spans) if span not in self._known]
        at = np.array([ends[k] for k in new], dtype=np.int64)
        used = np.unique(np.concatenate([at - 1, at]))
        before, now = np.searchsorted(used, at - 1), np.searchsorted(used, at)
        suspect, overlap = suspect_motions(
            [motions[k] for k in new], [clouds[k] for k in used], before, now, self._config
        )
        values = zip(suspect.tolist(), overlap.tolist(), strict=True)
        self._known |= {spans[k]: value for k, value in zip(new, values, strict=True)}
        return [self._known[span] for span in spans]

    def _lost(
        self, pairs: Sequence[tuple[int, ScanPair]], overlap: Sequence[float], clouds: list[Array]
    ) -> list[Span]:
        """See `ComparedScans`; pairs are given with the number of the later scan's points."""
        little = [k for k, share in enumerate(overlap) if share < LITTLE_OVERLAP]
        motions, ends = [pairs[k][1].motion for k in little], [pairs[k][0] for k in little]
        before, now = (
            [make_submap(np.zeros((1, 3)), [clouds[k]], self._config) for k in numbers]
            for numbers in ([end - 1 for end in ends], ends)
        )
        matches = match_motions(motions, before, now, np.array([overlap[k] for k in little]))
        pairs_of = zip(motions, matches, strict=True)
        return [(m.start_ns, m.end_ns) for m, match in pairs_of if match is None]
