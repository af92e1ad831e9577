"""Truth that is given with ``--truth``: read with the settings of the result."""

import shutil

import pytest
from room_log import drive

import graphslam
from graphslam.core.errors import LogError, OutputError
from graphslam.evaluation.ground_truth import truth_of_files

#: nothing but odometry: the estimate does not matter here
FAST = {"backend": "dead-reckoning", "front_end": "none"}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return drive(tmp_path_factory.mktemp("room") / "room.mcap", seconds=4)


def robots(found):
    return {name: both["final"]["ate_aligned_rmse_m"] for name, both in found["robots"].items()}


def test_recordings_of_sessions_are_read_as_sessions(tmp_path):
    """Breaks when each is read by itself, or without `logs.same_place`: both have one robot."""
    days = [drive(tmp_path / f"{day}.mcap", seconds=4, seed=n) for n, day in enumerate("ab")]
    result = graphslam.smooth(days, logs={"same_place": True}, **FAST)
    by_default = robots(graphslam.evaluate(result))
    assert set(by_default) == {"a", "b"}
    assert robots(graphslam.evaluate(result, truth=days)) == by_default
    # one recording is no session, but a TUM file may name one
    with pytest.raises(OutputError, match=r"the truth is of robot, the result of a, b; name the"):
        graphslam.evaluate(result, truth=days[0])


def test_topics_have_the_robots_that_the_result_has(room):
    """Also in a recording that lacks some of them, and where the truth's topic was not named."""
    topics = {topic.name: "anna" for topic in graphslam.open_logs(room).topics}
    result = graphslam.smooth(room, logs={"topics": topics}, **FAST)
    assert set(robots(graphslam.evaluate(result, truth=room))) == {"anna"}
    config = graphslam.load_config(logs={"topics": {"/elsewhere/scan": "anna"}})
    assert set(truth_of_files([str(room)], ["anna"], config).trajectories) == {"robot"}


def test_a_comparison_names_the_robots_of_its_truth_as_those_of_the_log(room):
    topics = {topic.name: "anna" for topic in graphslam.open_logs(room).topics}
    done = graphslam.compare(
        room, ["dead-reckoning"], truth=room, logs={"topics": topics}, front_end="none"
    )
    assert set(done.summary["rows"][0]["robots"]) == {"anna"}


def test_several_recordings_are_one_truth(room, tmp_path):
    """As one log in two files: what a robot has in the second goes on where the first ends."""
    other = tmp_path / "other.mcap"
    shutil.copy(room, other)
    config = graphslam.load_config()
    (once,) = truth_of_files([str(room)], ["robot"], config).trajectories.values()
    (both,) = truth_of_files([str(room), str(other)], ["robot"], config).trajectories.values()
    assert len(both) == 2 * len(once)


def test_a_given_file_without_truth_does_not_ask_for_the_option(tmp_path):
    log = drive(tmp_path / "log.mcap", seconds=2, truth=False)
    with pytest.raises(LogError, match=r"log\.mcap: holds no true poses") as raised:
        truth_of_files([str(log)], ["robot"], graphslam.load_config())
    assert "--truth" not in str(raised.value)
