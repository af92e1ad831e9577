"""Maps of a result: scans, trajectories with uncertainty, landmarks with their numbers."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, interpolate, path_length, unit_vectors
from graphslam.core.records import Landmark, Result, Trajectory
from graphslam.results.drawing import Axes
from graphslam.results.drawing_elements import ACCENT, INK, Style, robot_color, robot_dashes
from graphslam.results.report_figure import WIDTH_IN, Drawing, density, map_axes, svg

MAX_LABELS = 40
SIGMAS_95_2D = float(np.sqrt(chi2_quantile(0.95, 2)))
_SIGMAS_95_1D = float(np.sqrt(chi2_quantile(0.95, 1)))


def poses_at(trajectory: Trajectory, stamps_ns: Sequence[int]) -> Array:
    """Poses (n, 3) of a sorted trajectory at stamps, on the twist between neighbours.

    Before its start and after its end the first and the last pose stand.
    """
    known = trajectory.stamps_ns
    wanted = np.clip(np.array(stamps_ns, dtype=np.int64), known[0], known[-1])
    after = np.searchsorted(known, wanted)
    before = np.maximum(after - 1, 0)
    share = (wanted - known[before]) / np.maximum(known[after] - known[before], 1)
    return interpolate(trajectory.poses[before], trajectory.poses[after], share)


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """What a map of all shows: ``paths`` and ``clouds`` (n, 2) of robots, ``landmarks``, limits.

    ``limits``: [[x_min, x_max], [y_min, y_max]] of paths and scans, or of paths and landmarks, m.
    """

    paths: Mapping[str, Trajectory]
    clouds: Mapping[str, Array]
    landmarks: Sequence[Landmark]
    limits: Array

    @property
    def height_in(self) -> float:
        """Height of the maps, inches: in proportion to the extent, within limits."""
        (x0, x1), (y0, y1) = self.limits
        return WIDTH_IN * float(np.clip((y1 - y0) / (x1 - x0), 0.6, 1.15))


def overview_of(result: Result, *, dead_reckoning: bool = False) -> Overview:
    """All scans and paths on the final trajectory, or on odometry alone.

    Without scans the final trajectory is shown with the landmarks.
    """
    paths = {
        name: robot.dead_reckoning if dead_reckoning else robot.final
        for name, robot in sorted(result.robots.items())
    }
    clouds = {name: _cloud(result, name, path, dead_reckoning) for name, path in paths.items()}
    landmarks = () if result.keyframe_scans or dead_reckoning else result.landmarks
    extents = [landmark.extent for landmark in landmarks]
    whole = [*(path.poses[:, :2] for path in paths.values()), *extents]
    return Overview(paths, clouds, landmarks, _limits(whole, clouds.values()))


def overview_map(shown: Overview, height_in: float, of: str) -> str:
    """The map of an overview ``of`` this trajectory."""
    paths, limits = shown.paths, shown.limits

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        for i, cloud in enumerate(shown.clouds.values()):
            if len(cloud):
                axes.image(density(cloud, limits, robot_color(i)), limits)
        several = len(paths) > 1
        for i, (name, path) in enumerate(paths.items()):
            style = Style(robot_color(i) if several else ACCENT, 0.9, dashes=robot_dashes(i))
            axes.path(path.poses[:, :2], style, name if several else None)
        _draw_landmarks(axes, shown.landmarks, 1.0)

    return svg(f"Scans and paths on {of}", height_in, draw)


def landmark_map(result: Result, height_in: float) -> tuple[str, int]:
    """Landmarks with their ids and 95 % bounds, and the enlargement of the bounds.

    A point has an ellipse, a line a bar across each end. Ids and bounds are of the landmarks with
    the most sightings, as many as can be told apart: bars of all walls would bury them.
    """
    landmarks = result.landmarks
    paths = [robot.final.poses[:, :2] for robot in result.robots.values()]
    limits = _limits([*paths, *(landmark.extent for landmark in landmarks)])
    by_sightings = sorted(landmarks, key=lambda m: (-m.sightings, m.id))
    labels = _label_positions(by_sightings, limits)
    shown = [m for m, _ in labels]
    factor = _enlargement([_size(m) for m in shown], limits)
    bounds = [b for m in shown for b in _bounds(m, factor)]
    limits = _including(limits, bounds)

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        for path in paths:
            axes.path(path, Style(INK, 0.5, 0.35))
        _draw_landmarks(axes, landmarks, 1.2)
        axes.lines(bounds, Style(ACCENT, 0.8))
        for landmark, (x, y) in labels:
            axes.text(float(x), float(y), str(landmark.id), 7.5, (3, 3))

    return svg("Landmarks with numbers and 95 % bounds", height_in, draw), factor


def trajectory_map(result: Result, height_in: float) -> tuple[str, int]:
    """Final and causal paths with 95 % ellipses along the final one, and their enlargement."""
    robots = sorted(result.robots.items())
    # the causal path may leave these limits and is cut off there
    limits = _limits([robot.final.poses[:, :2] for _, robot in robots])
    samples = {name: _sample(robot.final, max(40 // len(robots), 12)) for name, robot in robots}
    factor = _enlargement([float(s) for _, c in samples.values() for s in _semi_axes(c)], limits)
    ellipses = [_ellipse(m, c, factor) for s in samples.values() for m, c in zip(*s, strict=True)]
    limits = _including(limits, ellipses)

    def draw(drawing: Drawing) -> None:
        axes = map_axes(drawing, limits)
        one = len(robots) == 1
        for i, (name, robot) in enumerate(robots):
            color, dashes = robot_color(i), robot_dashes(i)
            if robot.causal is not None:
                causal = Style(INK if one else color, 0.5, 0.4)
                axes.path(robot.causal.poses[:, :2], causal, "causal" if one else None)
            final = Style(color, 1.1, dashes=dashes)
            axes.path(robot.final.poses[:, :2], final, "final" if one else name)
            axes.symbols(robot.final.poses[:1, :2], color, 5.5)
        axes.lines(ellipses, Style(ACCENT, 0.7))

    return svg("Trajectory with 95 % ellipses", height_in, draw), factor


def worst_sigma(covs: Array) -> Array:
    """Standard deviations (n,) m of positions in their worst directions, of covariances (n, 3, 3).

    The square root of the larger eigenvalue of the 2 x 2 block, in closed form.
    """
    a, b, c = covs[:, 0, 0], covs[:, 0, 1], covs[:, 1, 1]
    return np.asarray(np.sqrt(np.maximum((a + c) / 2 + np.hypot((a - c) / 2, b), 0.0)))


def _cloud(result: Result, robot: str, path: Trajectory, dead_reckoning: bool) -> Array:
    """All points (n, 2) of a robot's scans in the world frame."""
    scans = [p for p in result.keyframe_scans if p.robot == robot and len(p.points)]
    if not scans:
        return np.empty((0, 2))
    source = path if dead_reckoning else result.estimate.states.get(robot, path)
    poses = poses_at(source, [p.time_ns for p in scans])
    poses = np.repeat(poses, [len(p.points) for p in scans], axis=0)
    points = np.concatenate([p.points for p in scans])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return np.column_stack(
        [
            poses[:, 0] + c * points[:, 0] - s * points[:, 1],
            poses[:, 1] + s * points[:, 0] + c * points[:, 1],
        ]
    )


def _limits(whole: Iterable[Array], clouds: Iterable[Array] = ()) -> Array:
    """[[x_min, x_max], [y_min, y_max]] around paths and walls, and scans but for a few returns.

    Outliers are those of each cloud of returns; what is ``whole`` stays so.
    """
    boxes = [np.stack([points.min(axis=0), points.max(axis=0)]) for points in whole if len(points)]
    for points in clouds:
        if len(points):
            least = 0.002 if len(points) > 1000 else 0.0
            boxes.append(np.quantile(points, [least, 1.0 - least], axis=0))
    low = np.min([box[0] for box in boxes], axis=0)
    high = np.max([box[1] for box in boxes], axis=0)
    margin = 0.03 * max(float((high - low).max()), 1.0)
    return np.column_stack([low - margin, high + margin])


def _including(limits: Array, lines: Sequence[Array]) -> Array:
    """Limits [[x_min, x_max], [y_min, y_max]] widened to hold polylines (k, 2)."""
    if not lines:
        return limits
    points = np.concatenate(lines)
    low, high = points.min(axis=0), points.max(axis=0)
    return np.column_stack([np.minimum(limits[:, 0], low), np.maximum(limits[:, 1], high)])


def _draw_landmarks(axes: Axes, landmarks: Sequence[Landmark], width: float) -> None:
    """Points as triangles, lines over the extent seen."""
    points = np.array([m.position[:2] for m in landmarks if m.kind == "point"]).reshape(-1, 2)
    axes.symbols(points, INK, 2.5, triangles=True)
    axes.lines([m.extent for m in landmarks if m.kind != "point"], Style(INK, width))


def _label_positions(landmarks: Sequence[Landmark], limits: Array) -> list[tuple[Landmark, Array]]:
    """The first landmarks whose ids do not overlap, each with the position of its id."""
    room = np.array([0.05, 0.035]) * (limits[:, 1] - limits[:, 0]).max()
    placed: list[tuple[Landmark, Array]] = []
    for landmark in landmarks:
        spot = landmark.extent.mean(axis=0)
        if len(placed) < MAX_LABELS and all((np.abs(spot - p) > room).any() for _, p in placed):
            placed.append((landmark, spot))
    return placed


def _enlargement(sizes: Sequence[float], limits: Array) -> int:
    """Enlargement that makes the median of the 95 % bounds visible: 1, 2, 5, 10, 20, ..."""
    sizes = [s for s in sizes if np.isfinite(s) and s > 0]
    if not sizes:
        return 1
    wanted = 0.008 * float((limits[:, 1] - limits[:, 0]).max()) / float(np.median(sizes))
    steps: list[int] = [m * int(10**e) for e in range(4) for m in (1, 2, 5)]
    return next((step for step in steps if step >= wanted), steps[-1])


def _sample(trajectory: Trajectory, count: int) -> tuple[Array, Array]:
    """Positions (k, 2) and covariances (k, 2, 2) at even intervals of path."""
    xy = trajectory.poses[:, :2]
    path = path_length(xy)
    index = np.unique(np.searchsorted(path, np.linspace(0, path[-1], count)))
    index = index[np.isfinite(trajectory.covs[index]).all(axis=(1, 2))]
    return xy[index], trajectory.covs[index, :2, :2]


def _semi_axes(covs: Array) -> Array:
    """Longer semi-axes (k,) of the 95 % ellipses of covariances (k, 2, 2), m."""
    values = np.linalg.eigvalsh(covs)[:, -1] if len(covs) else np.empty(0)
    return np.asarray(SIGMAS_95_2D * np.sqrt(np.maximum(values, 0.0)))


def _ellipse(mean: Array, cov: Array, factor: float) -> Array:
    """The 95 % ellipse, enlarged, as a closed line (25, 2)."""
    values, vectors = np.linalg.eigh(cov)
    t = np.linspace(0, 2 * np.pi, 25)
    circle = np.stack([np.cos(t), np.sin(t)])
    axes = factor * SIGMAS_95_2D * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(mean + (vectors @ (axes[:, None] * circle)).T)


def _half_widths(landmark: Landmark) -> Array:
    """95 % half widths (2,) of the bounds across a line at its two ends, m.

    The normal offset of a point at ``t`` along the line varies as offset error - t * direction
    error: [-t, 1] C [-t, 1]^T.
    """
    assert landmark.line is not None  # only called for lines
    normal, _, cov = landmark.line
    t = landmark.extent @ np.array([-np.sin(normal), np.cos(normal)])
    a = np.column_stack([-t, np.ones(2)])
    variances = np.einsum("ni,ij,nj->n", a, cov, a)
    return np.asarray(_SIGMAS_95_1D * np.sqrt(np.maximum(variances, 0.0)))


def _size(landmark: Landmark) -> float:
    if landmark.line is not None:
        return float(_half_widths(landmark).mean())
    return float(_semi_axes(landmark.cov[None, :2, :2])[0])


def _bounds(landmark: Landmark, factor: float) -> list[Array]:
    """Polylines of the 95 % bounds of a landmark."""
    if landmark.line is None:
        return [_ellipse(landmark.position[:2], landmark.cov[:2, :2], factor)]
    normal = landmark.line[0]
    n = unit_vectors(normal)
    half = factor * _half_widths(landmark)[:, None] * n
    return [np.stack([e - h, e + h]) for e, h in zip(landmark.extent, half, strict=True)]
