"""The public Python interface: every name, what it costs to import, settings, the examples."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command_line import call
from paths import ROOT
from room_log import drive

import graphslam
from graphslam.core import config, errors, records
from graphslam.results.file_formats import read_trajectory

TRUTH_START = {"start": {"from_truth": True}}


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A log with its truth, what `smooth` returns of it, and the folder that it writes."""
    folder = tmp_path_factory.mktemp("room")
    log = drive(folder / "room.mcap", seconds=10)
    result = graphslam.smooth(log, output=folder / "out", **TRUTH_START)
    return SimpleNamespace(log=log, result=result, out=folder / "out", folder=folder)


def same_poses(a, b):
    return all(np.array_equal(a.robots[n].final.poses, b.robots[n].final.poses) for n in a.robots)


# ---------------------------------------------------------------- names


def test_every_public_name_is_there_and_no_other():
    assert set(graphslam.__all__) <= set(dir(graphslam))
    for name in graphslam.__all__:
        assert getattr(graphslam, name) is not None
    assert graphslam.Result is records.Result
    assert graphslam.Config is config.Config
    assert issubclass(graphslam.ScenarioError, errors.GraphSlamError)
    with pytest.raises(AttributeError, match="no attribute 'smoth'"):
        graphslam.smoth  # noqa: B018


def test_a_type_checker_sees_the_classes_that_are_imported_lazily():
    """Breaks when a class is added to one of the two lists only."""
    tree = ast.parse(Path(graphslam.__file__).read_text(encoding="utf-8"))
    (block,) = (
        node
        for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    seen = {
        (node.module.removeprefix("graphslam."), alias.name)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    lazy = {(module, name) for module, names in graphslam._CLASSES.items() for name in names}
    assert lazy <= seen
    assert {name for _, name in lazy} <= set(graphslam.__all__)
    assert (ROOT / "graphslam/py.typed").is_file()


def test_every_type_that_a_public_function_names_is_public():
    """Who annotates a program of their own finds it without looking into the package."""
    tree = ast.parse(Path(graphslam.__file__).read_text(encoding="utf-8"))
    named = {
        word
        for function in tree.body
        if isinstance(function, ast.FunctionDef) and function.name in graphslam.__all__
        for argument in [*function.args.args, *function.args.kwonlyargs]
        for word in re.findall(r"[A-Z]\w+", ast.unparse(argument.annotation))
    }
    private = {"Any", "Callable", "None", "PathLike", "Recording", "Sequence", "Truth"}
    assert named - private <= set(graphslam.__all__)


def modules_after(code):
    """Names of the modules that are loaded after ``code``, in a process of its own."""
    code += "\nimport sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_loads_nothing_of_it():
    """So it takes no time, whatever the machine: what is heavy comes with the first use."""
    loaded = modules_after("import graphslam; dir(graphslam); graphslam.smooth")
    assert {name for name in loaded if name.startswith("graphslam.")} == set()
    assert not loaded & {"numpy", "scipy", "gtsam", "cv2", "mcap", "matplotlib", "typer"}


def test_a_class_loads_its_own_module_only():
    assert "gtsam" not in modules_after("from graphslam import Config, LogError, Result, LogWriter")
    assert "numpy" not in modules_after("import graphslam; graphslam.load_config(backend='ekf')")


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize(
    "settings",
    [
        {"keyframe": {"mode": "all"}, "backend": {"name": "ekf"}},
        {"keyframe.mode": "all", "backend.name": "ekf"},
        {"keyframe": {"mode": "all"}, "backend": "ekf"},
    ],
)
def test_settings_are_tables_or_dotted_keys_over_a_file_or_a_configuration(settings, tmp_path):
    file = tmp_path / "c.toml"
    file.write_text("[keyframe]\nmode = 'motion'\ndistance_m = 0.5\n[robust]\nkernel = 'none'\n")
    from_file = graphslam.load_config(file, **settings)
    for found in (from_file, graphslam.load_config(graphslam.load_config(str(file)), **settings)):
        assert (found.keyframe.mode, found.keyframe.distance_m) == ("all", 0.5)
        assert (found.backend.name, found.robust.kernel) == ("ekf", "none")


def test_settings_name_robots_and_topics_as_they_are():
    """A key of a mapping is not split at its dots; arrays and tuples may stand for lists."""
    found = graphslam.load_config(
        start={"poses": {"a.b/c": np.array([1.0, 2.0, 0.5]), "d": (0, 0, 1)}},
        logs={"topics": {"/scan.front": "a.b/c"}},
    )
    assert dict(found.start.poses) == {"a.b/c": (1.0, 2.0, 0.5), "d": (0.0, 0.0, 1.0)}
    assert dict(found.logs.topics) == {"/scan.front": "a.b/c"}
    more = graphslam.load_config(found, **{"start.poses.e": [3, 0, 0]})
    assert set(more.start.poses) == {"a.b/c", "d", "e"}


def test_an_old_key_is_accepted_with_one_warning(room):
    found = graphslam.load_config(keyframe={"gather_s": 0.3})
    assert found.keyframe.sighting_window_s == 0.3
    assert found.warnings == ("keyframe.gather_s is now called keyframe.sighting_window_s",)
    for logs in (room.log, graphslam.open_logs(room.log)):
        result = graphslam.smooth(logs, config=found, backend="dead-reckoning")
        assert result.summary["warnings"].count(found.warnings[0]) == 1


BAD_SETTINGS = {
    "unknown table": ({"keyframes": {"mode": "all"}}, "keyframes: unknown key"),
    "unknown key": ({"keyframe": {"distanse_m": 1}}, "keyframe.distanse_m: .* distance_m"),
    "unknown dotted key": ({"keyframe.distanse_m": 1}, "keyframe.distanse_m: .* distance_m"),
    "wrong type": ({"keyframe": {"distance_m": "far"}}, "keyframe.distance_m: expected float"),
    "no value": ({"keyframe": {"distance_m": None}}, "keyframe.distance_m: expected float"),
    "out of range": ({"keyframe.distance_m": -1}, "keyframe.distance_m: must not be negative"),
    "no such back end": ({"backend": "ceres"}, "backend.name: 'ceres' is not one of"),
    "a table without a name": ({"keyframe": "all"}, "keyframe: is a table"),
    "both names": (
        {"keyframe": {"gather_s": 1.0, "sighting_window_s": 2.0}},
        "keyframe.gather_s: is the old name",
    ),
}


@pytest.mark.parametrize("case", BAD_SETTINGS)
def test_a_bad_setting_is_a_config_error_that_names_it(case, room, tmp_path):
    """Before any work, in every function that takes settings."""
    settings, message = BAD_SETTINGS[case]
    for function in (
        graphslam.load_config,
        lambda **given: graphslam.open_logs(room.log, **given),
        lambda **given: graphslam.smooth(room.log, output=tmp_path / "out", **given),
        lambda **given: graphslam.compare(room.log, **given),
        lambda **given: graphslam.changes_between(room.out, room.out, **given),
    ):
        with pytest.raises(graphslam.ConfigError, match=message):
            function(**settings)
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------- functions


def test_smooth_takes_a_path_paths_or_open_logs(room):
    logs = graphslam.open_logs([room.log], **TRUTH_START)
    assert logs.robots == ("robot",)
    for given in (str(room.log), [room.log]):
        assert same_poses(graphslam.smooth(given, **TRUTH_START), room.result)
    again = graphslam.smooth(logs)  # with the settings of the logs
    assert same_poses(again, room.result)
    assert again.config == room.result.config == logs.config


def test_progress_is_of_the_messages_that_are_read(tmp_path):
    logs = graphslam.open_logs(drive(tmp_path / "long.mcap", seconds=50))
    calls = []
    graphslam.smooth(
        logs, backend="dead-reckoning", front_end="none", progress=lambda *args: calls.append(args)
    )
    done, total = calls[-1]
    assert 0 < done <= total == logs.count((records.Truth, records.TrueLandmark))


def test_settings_of_reading_are_refused_where_it_is_done(room):
    logs = graphslam.open_logs(room.log)
    with pytest.raises(graphslam.ConfigError, match="must be passed to open_logs"):
        graphslam.smooth(logs, logs={"reorder_s": 5.0})
    assert graphslam.smooth(logs, backend="dead-reckoning").config.backend.name == "dead-reckoning"


def test_smooth_writes_what_the_command_writes(room, tmp_path):
    done = call("smooth", room.log, "-o", tmp_path / "out", "--start", "truth")
    assert done.code == 0, done.err
    names = {path.relative_to(tmp_path / "out") for path in (tmp_path / "out").rglob("*")}
    assert names == {path.relative_to(room.out) for path in room.out.rglob("*")}
    for name in ("config.toml", "landmarks.json", "trajectories/robot.tum"):
        assert (room.out / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
    assert "Against the truth" in (room.out / "report.html").read_text()


def test_an_existing_folder_is_kept_without_force_and_before_any_work(room):
    for function in (graphslam.smooth, graphslam.compare):
        with pytest.raises(graphslam.OutputError, match="already exists"):
            function("missing.mcap", output=room.out)
    with pytest.raises(graphslam.OutputError, match="already exists"):
        graphslam.changes_between("missing", "missing", output=room.out)
    with pytest.raises(graphslam.OutputError, match="already exists"):
        graphslam.simulate("lab", room.out)
    assert same_poses(graphslam.load_result(room.out), room.result) is False  # nine digits
    graphslam.smooth(room.log, output=room.out, force=True, **TRUTH_START)


def test_load_result_reads_the_folder_back(room):
    saved = graphslam.load_result(str(room.out))
    assert isinstance(saved, graphslam.SavedResult)
    assert saved.config == room.result.config
    np.testing.assert_allclose(
        saved.robots["robot"].final.poses, room.result.robots["robot"].final.poses, atol=1e-8
    )


def test_evaluate_takes_a_result_or_a_folder_and_truth_from_anywhere(room, tmp_path):
    found = graphslam.evaluate(room.result)
    assert found["robots"]["robot"]["final"]["ate_rmse_m"] < 0.1
    assert graphslam.evaluate(room.result, truth=room.log) == found
    assert graphslam.evaluate(room.result, truth=[str(room.log)]) == found
    from_folder = graphslam.evaluate(room.out)
    assert json.loads(call("evaluate", room.out, "--json").out) == from_folder
    own = graphslam.evaluate(room.out, truth=room.out / "trajectories/robot.tum")
    assert own["robots"]["robot"]["final"]["ate_rmse_m"] < 1e-9
    (stamps,) = [read_trajectory(room.out / "trajectories/robot.scan.tum").stamps_ns]
    seconds = [f"{t // 10**9}.{t % 10**9:09d}" for t in stamps[:2]]
    (tmp_path / "relations").write_text(f"{' '.join(seconds)} 0.1 0 0 0 0 0\n")
    relations = graphslam.evaluate(room.result, relations=tmp_path / "relations")
    assert relations["relations"]["all"]["n"] == 1
    assert set(relations) == {"relations"}


def test_compare_returns_a_row_for_each_back_end(room, tmp_path):
    lines = []
    found = graphslam.compare(
        room.log,
        ["dead-reckoning", "isam2"],
        output=tmp_path / "out",
        announce=lines.append,
        **TRUTH_START,
    )
    assert isinstance(found, graphslam.Comparison)
    assert [row["spec"] for row in found.summary["rows"]] == ["dead-reckoning", "isam2"]
    assert len(lines) == 3
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("compare.json", "config.toml", "report.html")
    }
    with pytest.raises(graphslam.ConfigError, match="ceres"):
        graphslam.compare("missing.mcap", "isam2,ceres")


def test_simulate_and_changes_between(tmp_path):
    done = graphslam.simulate("lab", tmp_path / "lab.mcap", seed=3)
    assert isinstance(done, graphslam.Simulation)
    with pytest.raises(graphslam.OutputError, match="already exists"):
        graphslam.simulate("lab", tmp_path / "lab.mcap")
    with pytest.raises(graphslam.ScenarioError, match="no-such"):
        graphslam.simulate("no-such", tmp_path / "other.mcap")
    graphslam.smooth(tmp_path / "lab.mcap", output=tmp_path / "run")
    found = graphslam.changes_between(
        tmp_path / "run",
        tmp_path / "run",
        reference_span_s=(0, 20),
        later_span_s=(20, 60),
        output=tmp_path / "changes",
        changes={"false_alarm_rate": 0.002},
    )
    assert isinstance(found, graphslam.ChangeResult)
    assert found.rate == 0.002
    assert json.loads((tmp_path / "changes/changes.json").read_text()) == found.to_dict()


# ---------------------------------------------------------------- examples


@pytest.mark.parametrize("page", ["README.md", "docs/change-detection.md"])
def test_the_examples_of_the_docs_run(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for k in range(2 if "change" in page else 1):
        name = ("before", "after")[k] if "change" in page else "drive"
        drive(tmp_path / f"{name}.mcap", seconds=20, seed=k)
        if "change" in page:
            graphslam.smooth(f"{name}.mcap", output=name)
    text = (ROOT / page).read_text(encoding="utf-8")
    exec(text.split("```python\n")[1].split("```")[0], {"__name__": "__main__"})
    if "change" in page:
        assert (tmp_path / "changes/changes.json").is_file()
    else:
        assert "ends at" in capsys.readouterr().out
        assert graphslam.load_result("result").config.keyframe.distance_m == 0.5
