# ruff: noqa: RUF001 -- σ is meant: people read it
"""The map of a result that can be zoomed, hovered, played and swiped to odometry alone."""

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Result, Trajectory
from graphslam.core.thinning import rows_along, rows_to_the_last
from graphslam.results import report_maps as maps
from graphslam.results.drawing_elements import ACCENT, INK, robot_color, robot_dashes
from graphslam.results.live_figure import (
    COLORS,
    LiveFigure,
    Series,
    encoded,
    joined,
    quantised,
    tip_text,
)
from graphslam.results.report_html import MINUTES_FROM_S
from graphslam.results.report_tables import landmark_sigma

#: of all scans, poses and ellipses together: more would make the page large or slow
_MAX_POINTS, _MAX_POSES, _MAX_ELLIPSES = 250_000, 4000, 60
#: poses at even intervals of one robot at least, at which the replay has it
_LEAST_POSES = 250
#: m: how far what is drawn is from a path; and most poses of all robots that this may need
_WITHIN_M, _MOST_POSES = 0.01, 20_000
_SCANS, _LANDMARKS, _ELLIPSES = "scans", "landmarks", "95 % ellipses"
_CLOSURES, _CAUSAL = "loop closures", "causal"


def live_map(result: Result, limits: Array) -> LiveFigure:
    """The figure; robots in their colours, everything at the time at which it was seen.

    ``limits``: [[x_min, x_max], [y_min, y_max]], m, see `report_maps.Overview`.
    """
    robots = sorted(result.robots)
    stamps = [result.robots[name].final.stamps_ns for name in robots]
    start_ns, end_ns = int(min(s[0] for s in stamps)), int(max(s[-1] for s in stamps))
    clock = _Clock(start_ns, end_ns)
    series = [*_landmarks(result, clock), *_closures(result, clock)]
    for i, name in enumerate(robots):
        series += _paths(result, name, i, clock)
    series += _ellipses(result, clock)
    layers = {_SCANS: True} if result.keyframe_scans else {}
    # robots side by side, what is of all of them after these
    for one in sorted(series, key=lambda one: one.layer in (_CAUSAL, _ELLIPSES)):
        layers.setdefault(one.layer, one.layer not in (_CAUSAL, _CLOSURES))
    what = "scans, paths and landmarks" if result.keyframe_scans else "paths and landmarks"
    return LiveFigure(
        "map", "Interactive map.",
        f"Drag to move; click, then turn the wheel to zoom; point at {what} for their numbers. "
        "Swipe from the result to odometry alone; replay the drive. Ellipses are to scale.",
        "map", limits, series, layers,
        duration_s=(end_ns - start_ns) / 1e9, in_minutes=clock.in_minutes,
        sides=("odometry alone", "result"),
        scans=_scans(result, robots, clock) if result.keyframe_scans else None,
    )  # fmt: skip


Stamps = np.ndarray[tuple[int], np.dtype[np.int64]]


class _Clock:
    """Seconds since the first pose, and how tips show them."""

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start_ns = start_ns
        self.in_minutes = end_ns - start_ns > 1e9 * MINUTES_FROM_S

    def seconds(self, stamps_ns: Stamps) -> Array:
        return np.asarray((stamps_ns - self._start_ns) / 1e9)

    def of(self, stamps_ns: list[int]) -> Array:
        return self.seconds(np.array(stamps_ns, dtype=np.int64))

    def shown(self, seconds: Array) -> Array:
        """What the column ``clock`` of a tip holds."""
        return seconds / 60.0 if self.in_minutes else seconds

    @property
    def text(self) -> str:
        """The time in a tip."""
        return "@clock{0.00} min" if self.in_minutes else "@clock{0.0} s"


def _paths(result: Result, name: str, index: int, clock: _Clock) -> list[Series]:
    """Final path with its poses, causal path, and odometry alone, of one robot."""
    robot, color = result.robots[name], robot_color(index)
    layer = "paths" if len(result.robots) == 1 else name
    count = len(result.robots)
    final = _followed(robot.final, count)
    named = "" if len(result.robots) == 1 else f"<b>{tip_text(name)}</b> "
    worst = 100 * maps.worst_sigma(final.covs)
    turn = np.degrees(np.sqrt(np.maximum(final.covs[:, 2, 2], 0.0)))
    found, dash = [], [2.0 * length for length in robot_dashes(index)] or "solid"
    if robot.dead_reckoning is not None:
        path = _path(_followed(robot.dead_reckoning, count), clock)
        look = 1.5, 0.9, dash
        found.append(
            Series("path", layer, color, path, *look, side="before", timed=True, robot=True)
        )
    if robot.causal is not None:
        path = _path(_followed(robot.causal, count), clock)
        found.append(Series("path", _CAUSAL, color, path, 1.0, 0.6, dash, side="after", timed=True))
    path = _path(final, clock)
    path |= {"clock": clock.shown(path["time"]), "sigma": worst, "turn": turn}
    tip = f"{named}at {clock.text}<br>position σ @sigma{{0.0}} cm<br>heading σ @turn{{0.00}}°"
    look = 2.0, 0.9, dash
    found.append(Series("path", layer, color, path, *look, side="after", timed=True, robot=True))
    # discs that are not seen, only pointed at
    poses = {name: column for name, column in path.items() if name != "heading"}
    found.append(Series("points", layer, color, poses, 7.0, 0.0, tip=tip, side="after", timed=True))
    return found


def _path(path: Trajectory, clock: _Clock) -> dict[str, Array]:
    x, y, heading = path.poses.T
    return {"x": x, "y": y, "heading": heading, "time": clock.seconds(path.stamps_ns)}


def _followed(path: Trajectory, robots: int) -> Trajectory:
    """Poses of a path, of one of so many robots, that follow it closely; some at even intervals."""
    even = max(_LEAST_POSES, _MAX_POSES // robots)
    most = max(even, _MOST_POSES // robots)
    return _rows(path, rows_along(path.poses[:, :2], _WITHIN_M, even, most))


def _thinned(path: Trajectory, most: int) -> Trajectory:
    """At most ``most`` poses at even intervals, with the last one."""
    return _rows(path, rows_to_the_last(len(path), most))


def _rows(path: Trajectory, chosen: Stamps) -> Trajectory:
    return Trajectory(path.stamps_ns[chosen], path.poses[chosen], path.covs[chosen])


def _landmarks(result: Result, clock: _Clock) -> list[Series]:
    """Points as triangles, lines over what was seen of them."""
    found = []
    for glyph in ("points", "lines"):
        chosen = [m for m in result.landmarks if (m.line is None) == (glyph == "points")]
        if not chosen:
            continue
        columns, starts = joined([m.extent for m in chosen])
        if glyph == "points":
            columns = {"x": columns["x"][starts], "y": columns["y"][starts]}
        seconds = clock.of([m.first_ns for m in chosen])
        columns |= {
            "number": np.array([m.id for m in chosen]),
            "sigma": np.array([100 * landmark_sigma(m) for m in chosen]),
            "seen": np.array([m.sightings for m in chosen]),
            "time": seconds,
            "clock": clock.shown(seconds),
        }
        tip = (
            "<b>landmark @number{0}</b> @name<br>σ @sigma{0.0} cm<br>@seen{0} sightings, "
            f"from {clock.text}"
        )
        found.append(
            Series(
                glyph, _LANDMARKS, INK, columns, 8.0 if glyph == "points" else 2.5, 0.85,
                marker="triangle", starts=starts if glyph == "lines" else None, tip=tip,
                texts={"name": [m.identity or "" for m in chosen]}, side="after", timed=True,
            )
        )  # fmt: skip
    return found


def _closures(result: Result, clock: _Clock) -> list[Series]:
    """Every loop closure as a line between the two poses that it ties."""
    ties = [closure for step in result.steps for closure in step.closures]
    states = result.estimate.states
    ties = [tie for tie in ties if tie.robot in states and tie.other in states]
    if not ties:
        return []
    ends = np.empty((len(ties), 2, 2))
    for end, pairs in enumerate(
        ([(t.robot, t.time_ns) for t in ties], [(t.other, t.other_time_ns) for t in ties])
    ):
        for robot in {name for name, _ in pairs}:
            rows = [i for i, (name, _) in enumerate(pairs) if name == robot]
            poses = maps.poses_at(states[robot], [pairs[i][1] for i in rows])
            ends[rows, end] = poses[:, :2]
    columns, starts = joined(list(ends))
    seconds = clock.of([max(t.time_ns, t.other_time_ns) for t in ties])
    earlier = clock.of([min(t.time_ns, t.other_time_ns) for t in ties])
    columns |= {"time": seconds, "clock": clock.shown(seconds), "earlier": clock.shown(earlier)}
    tip = f"<b>loop closure</b> at {clock.text}<br>with {clock.text.replace('clock', 'earlier')}"
    return [
        Series(
            "lines", _CLOSURES, ACCENT, columns, 1.5, 0.7, starts=starts, tip=tip, side="after",
            timed=True,
        )
    ]  # fmt: skip


def _ellipses(result: Result, clock: _Clock) -> list[Series]:
    """95 % ellipses along the paths and of point landmarks, to scale.

    Of the paths, and of the landmarks, only ones that are apart: more would bury the map.
    """
    most = max(2, _MAX_ELLIPSES // len(result.robots))
    paths = [_thinned(robot.final, most) for robot in result.robots.values()]
    points = [m for m in result.landmarks if m.line is None][:_MAX_POSES]
    along = (
        np.concatenate([path.poses[:, :2] for path in paths]),
        np.concatenate([path.covs[:, :2, :2] for path in paths]),
        clock.seconds(np.concatenate([path.stamps_ns for path in paths])),
    )
    of_points = (
        np.array([m.position[:2] for m in points]).reshape(-1, 2),
        np.array([m.cov[:2, :2] for m in points]).reshape(-1, 2, 2),
        clock.of([m.first_ns for m in points]),
    )
    chosen = [[column[_apart(*some)] for column in some] for some in (along, of_points)]
    centre, cov, time = (np.concatenate(columns) for columns in zip(*chosen, strict=True))
    if not len(centre):
        return []
    values, vectors = np.linalg.eigh(cov)
    axes = 2 * maps.SIGMAS_95_2D * np.sqrt(np.maximum(values, 0.0))
    columns = {
        "x": centre[:, 0], "y": centre[:, 1], "width": axes[:, 1], "height": axes[:, 0],
        "angle": np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]), "time": time,
    }  # fmt: skip
    return [Series("ellipses", _ELLIPSES, ACCENT, columns, 1.0, 0.8, side="after", timed=True)]


def _apart(centres: Array, covs: Array, time: Array) -> list[int]:
    """Indices of ellipses none of which has its centre within another's longer semi-axis.

    Centres (n, 2) m, covariances (n, 2, 2) m², unknown ones are left out; the earlier of two wins.
    """
    known = np.flatnonzero(np.isfinite(covs).all(axis=(1, 2)))
    reach = np.full(len(centres), np.inf)
    reach[known] = maps.SIGMAS_95_2D * np.sqrt(
        np.maximum(np.linalg.eigvalsh(covs[known])[:, -1], 0.0)
    )
    kept: list[int] = []
    for i in known[np.argsort(time[known], kind="stable")].tolist():
        off = np.hypot(*(centres[kept] - centres[i]).T)
        if (off > np.maximum(reach[kept], reach[i])).all():
            kept.append(i)
    return kept


def _scans(result: Result, robots: list[str], clock: _Clock) -> dict[str, object]:
    """Points of all keyframes in the robot's frame, and its poses by all data and by odometry."""
    scans = sorted(result.keyframe_scans, key=lambda scan: scan.time_ns)
    total = sum(len(scan.points) for scan in scans)
    every = max(1, -(-total // _MAX_POINTS))
    # another beam first in every scan, so that thinning leaves no gap in the walls
    clouds = [scan.points[k % every :: every] for k, scan in enumerate(scans)]
    after, before = np.empty((len(scans), 3)), np.empty((len(scans), 3))
    for name in robots:
        rows = [i for i, scan in enumerate(scans) if scan.robot == name]
        if rows:
            times = [scans[i].time_ns for i in rows]
            robot = result.robots[name]
            after[rows] = maps.poses_at(result.estimate.states.get(name, robot.final), times)
            before[rows] = maps.poses_at(robot.dead_reckoning, times)
    points, unit = quantised(np.concatenate(clouds))
    return {
        "layer": _SCANS,
        # of one robot grey, so that its path is seen on them
        "colors": [COLORS[robot_color(i)] for i in range(len(robots))] if robots[1:] else ["soft"],
        "unit": unit,
        "points": encoded(points),
        "count": encoded(np.array([len(c) for c in clouds], dtype="<i4")),
        "robot": encoded(np.array([robots.index(s.robot) for s in scans], dtype="<i4")),
        "time": encoded(clock.of([s.time_ns for s in scans])),
        "after": encoded(after.ravel()),
        "before": encoded(before.ravel()),
    }
