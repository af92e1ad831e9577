"""What a viewer shows of a result, read from its folder and put into frames."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphslam.core.gaussian import chi2_quantile
from graphslam.core.geometry import Array, transform
from graphslam.core.records import Landmark, Trajectory
from graphslam.logs.schemas import DEFAULT_ROBOT
from graphslam.results.folder import load
from graphslam.results.map_files import in_world
from graphslam.results.occupancy_grid import GridMap, grid_map
from graphslam.results.scans_file import SCANS_FILE, PlacedScan, read_scans

Stamps = np.ndarray[tuple[int], np.dtype[np.int64]]

#: s between two ellipses of a robot
ELLIPSE_EVERY_S = 1.0
_CORNERS = 24
_SIGMAS_95 = float(np.sqrt(chi2_quantile(0.95, 2)))
_SIGMAS_95_1D = float(np.sqrt(chi2_quantile(0.95, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class SceneRobot:
    """A robot: poses of its base in the frame ``world``, and by odometry alone where known."""

    name: str
    world: str
    final: Trajectory
    odometry: Trajectory | None
    has_scans: bool

    def frame(self, name: str) -> str:
        """A frame of its own, as `graphslam.logs.LogWriter` names it."""
        return name if self.name == DEFAULT_ROBOT else f"{self.name}/{name}"

    def topic(self, name: str) -> str:
        """A topic of its own."""
        return f"/{self.frame(name)}"


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Robots, landmarks and scans of a result, and the grid map of what is in frame ``map``."""

    robots: tuple[SceneRobot, ...]
    landmarks: tuple[Landmark, ...]
    scans: tuple[PlacedScan, ...]
    grid: GridMap | None

    @property
    def begin_ns(self) -> int:
        """Stamp of the first pose."""
        return min(int(robot.final.stamps_ns[0]) for robot in self.robots)

    def frame_of(self, landmark: Landmark) -> str:
        """The frame that a landmark is in."""
        return "map" if landmark.frame is None else f"{landmark.frame}/map"


def read_scene(directory: Path) -> Scene:
    """The scene of a result folder.

    Raises:
        OutputError: it is no result folder, or a file of it is malformed.
    """
    saved = load(directory)
    scans = read_scans(directory / SCANS_FILE)
    worlds: Mapping[str, str] = {
        name: "map" if in_world(saved.summary, name) else f"{name}/map" for name in saved.robots
    }
    placed = [scan for scan in scans if worlds.get(scan.robot) == "map"]
    return Scene(
        tuple(
            SceneRobot(
                name, worlds[name], robot.final, robot.odometry, robot.scan_final is not None
            )
            for name, robot in sorted(saved.robots.items())
        ),
        saved.landmarks,
        scans,
        grid_map(placed) if placed else None,
    )


def scan_points(scan: PlacedScan) -> Array:
    """Points (n, 2) m of a scan in the world."""
    return transform(scan.pose, scan.points.astype(float))


def uncertainty_lines(landmark: Landmark) -> Array:
    """Pieces (k, 2, 2) m that show where a landmark may be, with 95 %.

    The ellipse of a point; of a wall a bar across each end, since its place along itself is known
    no better than its ends.
    """
    if landmark.line is None:
        ring = ellipse(landmark.position[:2], landmark.cov[:2, :2])
        return np.stack([ring[:-1], ring[1:]], axis=1)
    normal, _, cov = landmark.line
    n = np.array([np.cos(normal), np.sin(normal)])
    t = np.array([-n[1], n[0]])
    lever = np.column_stack([-landmark.extent @ t, np.ones(2)])  # of the normal and the offset
    sigmas = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", lever, cov, lever), 0.0))
    half = _SIGMAS_95_1D * sigmas[:, None] * n
    return np.stack([landmark.extent - half, landmark.extent + half], axis=1)


def ellipse(mean: Array, cov: Array) -> Array:
    """A closed line (n, 2) m around the 95 % of a Gaussian with mean (2,), covariance (2, 2)."""
    values, vectors = np.linalg.eigh(cov)
    turn = np.linspace(0, 2 * np.pi, _CORNERS + 1)
    axes = vectors * np.sqrt(np.maximum(values, 0)) * _SIGMAS_95
    return np.asarray(mean + np.column_stack([np.cos(turn), np.sin(turn)]) @ axes.T)


def every(stamps_ns: Stamps, seconds: float) -> list[int]:
    """Indices of the first of the sorted stamps (n,) in each interval of so many seconds."""
    intervals = stamps_ns // round(seconds * 1e9)
    return [int(k) for k in np.unique(intervals, return_index=True)[1]]


def by_frame(scene: Scene) -> Iterator[tuple[str, Sequence[Landmark]]]:
    """Landmarks by the frame they are in."""
    frames = sorted({scene.frame_of(m) for m in scene.landmarks})
    for frame in frames:
        yield frame, [m for m in scene.landmarks if scene.frame_of(m) == frame]
