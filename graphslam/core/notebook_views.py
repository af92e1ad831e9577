"""What a notebook asks of a result: data frames and a plot.

pandas and matplotlib are imported when they are asked for; graphslam itself needs neither.
"""

from importlib import import_module
from typing import Any

import numpy as np


def poses_dataframe(trajectory: Any) -> Any:
    """Poses of a trajectory as a pandas.DataFrame (n, 6) by their time: m, rad, with sigmas."""
    pandas = import_module("pandas")
    variances = np.diagonal(trajectory.covs, axis1=1, axis2=2)
    with np.errstate(invalid="ignore"):
        table = np.column_stack([trajectory.poses, np.sqrt(variances)])
    return pandas.DataFrame(
        table,
        index=pandas.DatetimeIndex(trajectory.stamps_ns.astype("datetime64[ns]"), name="time"),
        columns=["x_m", "y_m", "phi_rad", "x_sigma_m", "y_sigma_m", "phi_sigma_rad"],
    )


class ResultViews:
    """What a result looks like in pandas and matplotlib."""

    __slots__ = ()

    def to_dataframe(self) -> Any:
        """Final poses of all robots as a pandas.DataFrame by robot and time, m and rad."""
        own: Any = self
        pandas = import_module("pandas")
        frames = {name: poses_dataframe(robot.final) for name, robot in sorted(own.robots.items())}
        return pandas.concat(frames, names=["robot"])

    def landmarks_dataframe(self) -> Any:
        """Landmarks as a pandas.DataFrame by id: place and ends in m, phi in rad, sightings."""
        own: Any = self
        pandas = import_module("pandas")
        columns = ["kind", "x_m", "y_m", "phi_rad", "x1_m", "y1_m", "x2_m", "y2_m"]
        rows = [(m.kind, *m.position, *m.extent.ravel(), m.sightings) for m in own.landmarks]
        index = pandas.Index([m.id for m in own.landmarks], name="id")
        return pandas.DataFrame(rows, index=index, columns=[*columns, "sightings"])

    def plot(self, axes: Any = None) -> Any:
        """Draw paths and landmarks, in m, into ``axes`` of matplotlib or new ones; return them."""
        own: Any = self
        if axes is None:
            _, axes = import_module("matplotlib.pyplot").subplots(layout="constrained")
        for wall in (m.extent for m in own.landmarks if m.kind != "point"):
            axes.plot(*wall.T, color="0.2", linewidth=1)
        points = np.array([m.position[:2] for m in own.landmarks if m.kind == "point"])
        if len(points):
            axes.plot(*points.T, "^", color="0.2", markersize=4)
        for name, robot in sorted(own.robots.items()):
            axes.plot(*robot.final.poses[:, :2].T, linewidth=1.2, label=name)
        axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
        axes.legend()
        return axes
