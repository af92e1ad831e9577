"""Every script in benchmarks/ runs, on the smallest input that it takes.

What they measure takes minutes to hours and is printed on the pages of the documentation; here only
that a script that a page names still comes to its end. A bar may be missed on so small an input
(exit code 1); an exception may not be raised. `make slow-test` runs these.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from doc_pages import PAGES, command_lines
from paths import DATA, ROOT, real_data

#: script -> its arguments for a run of seconds; FOLDER is an empty folder
SMALL: dict[str, list[str]] = {
    "changes.py": ["false-alarms", "--seeds", "1"],
    "content_faults.py": ["FOLDER", "--only", "lab ranges of scans doubled"],
    "decentralised.py": ["two-robots", "10"],
    "ekf_speed.py": [],
    "false_closures.py": ["aces", "--seeds", "1", "--shares", "0.1"],
    "filter_gap.py": ["lab", "1"],
    "fleet_campaign.py": ["FOLDER", "--robots", "2"],
    "frontend_speed.py": ["--scans", "20"],
    "frontend_table.py": ["--seeds", "1", "--no-runs"],
    "full_information.py": ["given", "--seeds", "1", "--seconds", "20"],
    "gross_errors.py": ["named", "--seeds", "1", "--seconds", "30", "--only", "outliers 2 %"],
    "growth.py": ["--landmarks", "100", "200", "--rounds"],
    "healthy_logs.py": ["FOLDER", "--seeds", "1", "--only", "lab"],
    "horizon.py": ["lab"],
    "horizon_zero.py": ["lab", "--seconds", "30"],
    "interrupted_campaign.py": ["--seeds", "6", "--times", "1"],
    "joined_by_maps.py": ["parts", "aces"],
    "kills.py": ["--kills", "1", "--signals", "1", "--pairs", "1", "--log", "lab"],
    "live.py": ["soak", "--minutes", "1"],
    "long_run.py": ["--minutes", "1"],
    "maps.py": ["lab"],
    "mrclam.py": ["alone"],
    "mutated_files.py": ["FOLDER", "--files", "60"],
    "outlier_closures.py": [],
    "perturbed_logs.py": ["aces:half"],
    "prior_map.py": ["repeated", "--seeds", "1"],
    "moved_posts.py": ["--seeds", "1", "--moves", "2"],
    "pushed_furniture.py": ["--seeds", "1", "--push", "0.05"],
    "reading_speed.py": ["--folder", "FOLDER"],
    "real_logs.py": ["aces"],
    "reference_error.py": ["aces"],
    "robot_names.py": ["passing", "--seeds", "1", "--rows", "named"],
    "robots_in_scans.py": ["--seeds", "1", "--unknown", "0"],
    "sessions.py": ["office", "--seeds", "1"],
    "simulate_speed.py": [],
    "speed.py": ["--only", "help"],
    "speed_in_turn.py": ["HEAD", "--jobs", "lab", "--repeats", "1"],
    "sweep_motion.py": ["--seeds", "1"],
    "three_filters.py": ["lab", "--seeds", "1"],
    "two_lasers.py": ["--seeds", "1"],
    "wide_information.py": ["--poses", "60", "--seeds", "1"],
    "without_odometry.py": ["lab", "--seeds", "1"],
    "workers.py": ["--only", "throughput", "--logs", "2"],
    "slipping_wheels.py": ["rounds", "--seeds", "1", "--slip", "0.02"],
    "usual_cameras.py": [
        "tags",
        "--odometry",
        "1,2",
        "--noise",
        "none",
        "--seeds",
        "1",
        "--seconds",
        "40",
    ],
    "noisy_lasers.py": ["lab", "--noise", "0.05:0", "--seeds", "1"],
    "usual_robots.py": ["lab", "--lasers", "LDS-01", "--axle", "0.5", "--seeds", "1"],
    "wrong_odometry.py": ["--seeds", "1"],
    "yardstick.py": [],
}
#: script -> what runs it instead
ELSEWHERE = {
    "fuzz.py": "needs an extra; the readers that it calls: logs/test_hostile_bytes.py",
    "mutation.py": "runs the tests themselves",
    "report_screenshots.py": "writes the pictures of docs/figures; the reports: browser/",
    "thesis_experiments.py": "writes a page; its runs: evaluation/test_thesis_experiments.py",
    "victoria_park.py": "is given the result of `make demo`, which calls it",
}
#: that read real logs -> a folder of the data that they read
REAL = {
    "false_closures.py": "freiburg",
    "joined_by_maps.py": "freiburg",
    "mrclam.py": "mrclam",
    "outlier_closures.py": "graphs",
    "perturbed_logs.py": "freiburg",
    "real_logs.py": "freiburg",
    "reference_error.py": "freiburg",
}


def scripts_on_pages():
    """Names of the scripts that a page tells to run."""
    lines = [words for page in PAGES for words in command_lines(page)]
    return {Path(words[1]).name for words in lines if words[:1] == ["python"] and words[1] != "-m"}


def test_every_script_on_a_page_is_run():
    """Breaks when a page names a script that nothing runs."""
    assert scripts_on_pages() <= {*SMALL, *ELSEWHERE}
    assert not {name for name in [*SMALL, *ELSEWHERE] if not (ROOT / "benchmarks" / name).exists()}


@pytest.mark.slow
@pytest.mark.parametrize("script", SMALL)
def test_a_script_comes_to_its_end(script, tmp_path):
    """Breaks when what a script calls has other names or arguments than it thinks."""
    if script in REAL:
        real_data(REAL[script])
    words = [str(tmp_path / "out") if word == "FOLDER" else word for word in SMALL[script]]
    done = subprocess.run(
        [sys.executable, str(ROOT / "benchmarks" / script), *words],
        cwd=tmp_path,
        env={**os.environ, "GRAPHSLAM_DATA": str(DATA)},
        capture_output=True,
        text=True,
        timeout=900,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    assert done.stdout.strip()
