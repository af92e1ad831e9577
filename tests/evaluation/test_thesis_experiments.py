"""The thesis' experiments hold their bars; benchmarks/thesis_experiments.py takes 20 seeds."""

import numpy as np
import pytest
from thesis_experiments import FIGURES, PAGE, pooled
from thesis_figures import FIGURES as DRAWN
from thesis_runs import (
    EXPERIMENTS,
    TRUE,
    WITH,
    WITHOUT,
    change,
    corridor,
    distance_to_faces,
    lab,
    two_robots,
)

from graphslam.core.records import TrueLandmark


def test_lab_a_corner_is_sharp_with_landmarks_and_smeared_without(tmp_path):
    """Thesis 6.1.1: 5 cm and 20 cm. Breaks when poses and scans do not belong together."""
    found = lab(0, tmp_path)
    assert found[TRUE] < found[WITH] <= 0.025 < 0.08 < found[WITHOUT]


def test_corridor_dead_reckoning_is_lost_and_landmarks_come_home(tmp_path):
    """Thesis 6.1.2. The walls at the start overlay themselves to a few centimetres, and the wheel
    that is 2 % too large is found to 0.2 %."""
    found = corridor(0, tmp_path)
    assert found["wheel"] < 0.002
    assert found[f"end {WITHOUT}"] >= 80
    assert found[f"end {WITH}"] <= 0.25
    assert found[f"overlay {TRUE}"] < found[f"overlay {WITH}"] < 0.05


def test_two_robots_cooperation_cuts_error_and_deviation_by_a_third(tmp_path):
    """Thesis 6.1.3. The error of one seed is chance, so it is pooled; the deviation is not."""
    runs = []
    for seed in range(5):
        folder = tmp_path / str(seed)
        folder.mkdir()
        runs.append(two_robots(seed, folder))
    v = {key: np.array([run[key] for run in runs]) for key in runs[0]}
    assert pooled(v)[0] <= 2 / 3
    assert (v["sigma with"] <= 2 / 3 * v["sigma without"]).all()
    # both honest: no error beyond four of its deviations (1 in 3 000 for the worst of two axes)
    assert (v["error with"] < 4 * v["sigma with"]).all()


def test_change_both_visits_are_worth_comparing(tmp_path):
    """Thesis 6.2: the table moves by up to 60 cm, so poses must be good to a small part of that."""
    found = change(0, tmp_path)
    assert max(found.values()) < 0.01


def test_distance_is_to_the_wall_and_not_to_its_line():
    faces = {
        "wall": TrueLandmark("", 0, 0, "wall", "segment", np.zeros(3), np.array([[0.0, 0], [2, 0]]))
    }
    found = distance_to_faces(np.array([[1.0, 0.5], [5.0, 4.0], [-3.0, 0.0]]), faces)
    np.testing.assert_allclose(found, [0.5, 5.0, 3.0])


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_page_has_a_table_and_figures_of_every_experiment(name):
    page = PAGE.read_text(encoding="utf-8")
    table = page.partition(f"<!-- table {name} -->\n")[2].partition(f"<!-- end {name} -->")[0]
    assert "| 20 seeds | thesis | bar | median | worst |" in table
    assert name in DRAWN
    figures = list(FIGURES.glob(f"{name}-*.png"))
    assert figures and all(f"figures/{path.name}" in page for path in figures)
