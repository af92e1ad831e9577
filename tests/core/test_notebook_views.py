"""Data frames and the plot of a result."""

import numpy as np
import pytest
from synthetic_results import orchard, room

from graphslam.results.folder import load, save


def read_back(result, folder):
    save(result, folder, force=False)
    return load(folder)


@pytest.fixture(scope="module")
def two_robots(tmp_path_factory):
    result = orchard(keyframes=20, trees=6)[0]
    return read_back(result, tmp_path_factory.mktemp("views") / "out")


def test_data_frames_hold_every_pose_and_landmark(two_robots):
    pytest.importorskip("pandas", reason="needs pandas")
    frame = two_robots.to_dataframe()
    assert list(frame.index.get_level_values("robot").unique()) == ["robot1", "robot2"]
    final = two_robots.robots["robot2"].final
    own = frame.loc["robot2"]
    assert own.index.astype("int64").tolist() == final.stamps_ns.tolist()
    np.testing.assert_array_equal(own[["x_m", "y_m", "phi_rad"]], final.poses)
    np.testing.assert_allclose(own["y_sigma_m"] ** 2, final.covs[:, 1, 1])
    assert len(orchard(keyframes=20, trees=6)[0].to_dataframe()) == len(frame)
    marks = two_robots.landmarks_dataframe()
    assert marks.index.tolist() == [m.id for m in two_robots.landmarks]
    assert marks["sightings"].sum() == sum(m.sightings for m in two_robots.landmarks)


def test_a_plot_draws_every_path_and_landmark(two_robots, tmp_path):
    """With matplotlib, on axes that are given or new ones."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    axes = two_robots.plot()
    drawn = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    for name, robot in two_robots.robots.items():
        np.testing.assert_array_equal(drawn[name], robot.final.poses[:, :2])
    assert len(axes.get_lines()) == 3
    one_robot = read_back(room(keyframes=10, beams=9)[0], tmp_path / "room")
    assert one_robot.plot(axes) is axes
    assert len(axes.get_lines()) == 3 + len(one_robot.landmarks) + 1
    pyplot.close("all")
