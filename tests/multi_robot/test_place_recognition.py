"""Robots of unknown start that see nothing with an identity: related by their maps.

Walls are those of the simulated office, whose corridors and doors repeat themselves: what looks
alike elsewhere is in every one of these runs.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.config import AssociationConfig, Config, MultiRobotConfig
from graphslam.core.config_io import load_config
from graphslam.core.geometry import between, compose, inverse, transform, wrap
from graphslam.core.records import Start
from graphslam.evaluation.metrics import evaluate
from graphslam.logs import open_logs, read_truth
from graphslam.mapping.submaps import SubmapPose
from graphslam.multi_robot.frame_tree import build_frame_tree
from graphslam.multi_robot.landmark_constellations import relate_points
from graphslam.multi_robot.place_recognition import (
    PlaceMap,
    PlaceMatch,
    choose_alignment,
    relate_places,
    seen_extent,
)
from graphslam.multi_robot.place_search import alternative_alignments
from graphslam.multi_robot.relative_frames import RelativeFrame
from graphslam.perception.scan_matching import Match, make_submap
from graphslam.simulation import load_scenario, simulate
from graphslam.simulation.scenario import Box, Leg, StaticObjects, Wall
from graphslam.slam.smooth import smooth


def test_how_far_all_that_is_seen_extends_does_not_depend_on_the_axes():
    """A room is as large however it lies in the world of a result."""
    edge = np.linspace(-2.0, 2.0, 80)
    side = np.column_stack([edge, np.full(80, 2.0)])
    room = np.concatenate([transform(np.array([0, 0, k * np.pi / 2]), side) for k in range(4)])
    for turn in np.linspace(0.0, 1.5, 7):
        place = SimpleNamespace(
            pose=np.array([30.0, -5.0, turn]), submap=SimpleNamespace(points=room)
        )
        assert seen_extent([place]) == pytest.approx(4 * 2**0.5, rel=0.01)
        far = replace_pose(place, [50.0, -5.0, turn])
        assert seen_extent([place], [place, far]) > 20.0
    assert seen_extent([]) == 0.0


def replace_pose(place, pose):
    return SimpleNamespace(pose=np.array(pose), submap=place.submap)


def through(*points, wait_s=0.0):
    legs = (Leg(wait_s=wait_s),) if wait_s else ()
    return (*legs, Leg(through_m=points))


def two(scenario, path, seed, a, b, world=None):
    """A log of two robots like the scenario's one; ``a`` and ``b`` are what is different."""
    (robot,) = load_scenario(scenario).robots.values()
    if robot.laser is not None:
        robot = replace(robot, laser=replace(robot.laser, period_s=0.5))
    robots = {name: replace(robot, **more) for name, more in (("a", a), ("b", b))}
    made = replace(load_scenario(scenario), robots=robots)
    simulate(replace(made, world=world) if world else made, path, seed)
    return path


def office(path, seed, *, together=True):
    """Two robots among corridors; the second comes to where the first was, or does not."""
    a = {"start_m": (9.0, 6.1), "drive": through((20.0, 6.1), (20.0, 17.9), (17.0, 17.9))}
    b = {"start_m": (30.0, 6.1), "start_deg": 180.0,
         "drive": through((20.0, 6.1), (20.0, 16.0), wait_s=25.0)}  # fmt: skip
    away = {"start_m": (33.1, 8.1), "start_deg": 90.0, "drive": through((33.1, 17.9), (23.5, 17.9))}
    return two("office-loop", path, seed, a, b if together else away)


def halls(path, seed):
    """Two halls with the same things in them, of which each robot sees one and what is outside."""
    walls, boxes = [], []
    for n, x in (("1", 0.0), ("2", 24.0)):
        outline = ((13.0, 6.0), (0.0, 6.0), (0.0, 0.0), (16.0, 0.0), (16.0, 6.0), (14.5, 6.0))
        walls.append(Wall(f"hall {n}", tuple((x + u, v) for u, v in outline)))
        boxes += [
            Box(f"bed {n}", (x + 1.2, 1.0), (2.0, 1.2)),
            Box(f"table {n}", (x + 6.5, 4.7), (1.2, 0.8), angle_deg=20.0),
            Box(f"shelf {n}", (x + 15.7, 1.5), (0.4, 1.6)),
        ]
    walls += [
        Wall("between", ((16.0, 6.0), (24.0, 6.0))),
        Wall("rest", ((40.0, 6.0), (48.0, 6.0), (48.0, 9.0), (0.0, 9.0), (0.0, 6.0))),
    ]
    boxes += [
        Box("copier", (18.5, 8.6), (1.6, 0.8)),
        Box("locker", (21.0, 6.25), (1.8, 0.5)),
        Box("bench", (45.0, 8.7), (2.4, 0.6)),
        Box("cupboard", (9.0, 8.6), (1.8, 0.8)),
    ]
    drives = {
        x: {
            "start_m": (x + 2.0, 2.5),
            "corner_m": 0.8,
            "drive": through((x + 12, 2.5), (x + 13.75, 4), (x + 13.75, 7.5), (x + 19.75, 7.5)),
        }
        for x in (0.0, 24.0)
    }
    world = StaticObjects(walls=tuple(walls), boxes=tuple(boxes))
    return two("office-loop", path, seed, drives[0.0], drives[24.0], world)


def forest(path, seed, *, together=True):
    """Two robots that see trees without identity; they have a third of them in common, or none."""
    a = {"laser": None, "drive": through((9.0, -1.5), (16.0, 2.0), (17.0, 9.0), (9.0, 12.0))}
    b = {"laser": None, "start_m": (1.0, 9.5), "start_deg": 180.0,
         "drive": through((0.0, 0.0), (8.0, 4.5), (8.5, 9.0), (3.0, 9.0), wait_s=60.0)}  # fmt: skip
    if not together:
        a |= {"drive": through((4.0, -1.0))}
        b |= {"start_m": (18.0, 10.0), "start_deg": 90.0, "drive": through((16.0, 14.0))}
    return two("forest", path, seed, a, b)


def run(path, *overrides):
    config = load_config(overrides=overrides)
    return smooth(open_logs([path], config), config)


def error(path, result):
    """Of all robots together, after one alignment, m."""
    truth = read_truth([path], load_config()).trajectories
    return evaluate(result, truth)["joint"]["final"]["ate_aligned_rmse_m"]


def starts(path):
    """True start of b as seen from that of a."""
    truth = read_truth([path], load_config()).trajectories
    return between(truth["a"].poses[0], truth["b"].poses[0])


@pytest.mark.parametrize(
    ("make", "seeds"),
    [
        (office, (2,)),
        (forest, (1,)),
        pytest.param(office, (2, 3), marks=pytest.mark.slow),
        pytest.param(forest, (1, 2), marks=pytest.mark.slow),
    ],
)
def test_robots_are_related_by_anonymous_maps(tmp_path, make, seeds):
    """Within the sigmas that are stated, and then the map is as good as with the start given.

    With seed 1 the offices look alike in another relative pose too, and the robots stay apart.
    """
    off, known, found = [], [], []
    for seed in seeds:
        path = make(tmp_path / f"{seed}.mcap", seed)
        true = starts(path)
        result = run(path)
        assert result.summary["frames"] == {"a": "a", "b": "a"}
        told = result.summary["starts_found"]["b"]
        sigmas = np.array([told["sigma_m"], told["sigma_m"], told["sigma_rad"]])
        assert np.all(sigmas < [0.3, 0.3, 0.03])  # they mean something
        miss = np.array([told["x"], told["y"], told["phi"]]) - true
        miss[2] = wrap(miss[2])
        off.append(miss / sigmas)
        found.append(error(path, result))
        given = ("start.poses.a=[0, 0, 0]", f"start.poses.b={true.tolist()}")
        known.append(error(path, run(path, *given)))
    assert np.abs(off).max() < 4.0
    assert np.mean(np.square(off)) < 3.0  # of nine, correlated: 1 if all sigmas were right
    # a start given to 5 cm says something that nothing else does: a few millimetres
    assert np.mean(found) < 1.1 * np.mean(known) + 0.003


@pytest.mark.parametrize(
    ("make", "why"),
    [
        (lambda path: office(path, 1, together=False), ""),
        pytest.param(lambda path: office(path, 2, together=False), "", marks=pytest.mark.slow),
        (lambda path: forest(path, 1, together=False), ""),
        (lambda path: halls(path, 1), "contradict each other"),
    ],
    ids=["elsewhere in a building", "the same, another seed", "elsewhere in a wood", "like halls"],
)
def test_robots_that_were_in_different_places_stay_apart(tmp_path, make, why):
    """Corridors look alike, and so do two halls: that relates no robots."""
    result = run(make(tmp_path / "log.mcap"))
    assert result.summary["frames"] == {"a": "a", "b": "b"}
    said = [w for w in result.summary["warnings"] if "in a separate frame" in w]
    assert len(said) == 1
    assert why in said[0]


def test_starts_that_are_given_are_taken(tmp_path, monkeypatch):
    """Breaks if maps are compared where every start is known, which costs a pass over the log."""
    monkeypatch.setattr("graphslam.slam.initialisation.build_frame_tree", None)
    monkeypatch.setattr("graphslam.slam.initialisation.relate_anonymous_maps", None)
    path = forest(tmp_path / "log.mcap", 1)
    result = run(path, "start.poses.a=[0, 0, 0]", f"start.poses.b={starts(path).tolist()}")
    assert result.summary["frames"] == {"a": "a", "b": "a"}


# ---------------------------------------------------------------- choice between matches

TURNED = np.array([12.0, -5.0, 2.0])


def row(count, frame):
    """Places 3 m apart, on a line, as seen from a frame (3,); nothing is seen at them."""
    poses = between(frame, np.column_stack([3.0 * np.arange(count), np.zeros((count, 2))]))
    return [
        SimpleNamespace(pose=pose, path_m=3.0 * k, state=("robot", k))
        for k, pose in enumerate(poses)
    ]


def matches(here, there, start, pairs, same=0.8):
    """Matches by which the other robot began at ``start`` (3,)."""
    return [
        PlaceMatch(i, j, Match(pose, np.diag([0.02, 0.02, 0.005]) ** 2, same, 0.0))
        for i, j in pairs
        for pose in [between(here[i].pose, compose(start, there[j].pose))]
    ]


def chosen(monkeypatch, found, here, there):
    monkeypatch.setattr("graphslam.multi_robot.place_recognition.verify_places", lambda *_: ([], 0))
    P = np.kron(np.eye(len(here)), np.diag([0.02, 0.02, 0.005]) ** 2)
    return choose_alignment(
        "a", "b", found, PlaceMap(here, P), PlaceMap(there, P), MultiRobotConfig()
    )


def test_matches_that_agree_determine_the_start(monkeypatch):
    """Some that do not agree with each other change nothing."""
    here, there = row(8, np.zeros(3)), row(8, TURNED)
    found = matches(here, there, TURNED, [(k, k) for k in range(5)])
    found += matches(here, there, np.array([3.0, 1.0, -1.0]), [(2, 6)])
    found += matches(here, there, np.array([-3.0, 4.0, 1.0]), [(5, 0)])
    relation = chosen(monkeypatch, found, here, there)
    assert isinstance(relation, RelativeFrame)
    assert relation.weight == 5
    assert relation.pose == pytest.approx(TURNED, abs=1e-6)


def test_three_matches_are_not_enough(monkeypatch):
    """They may agree by chance; that is not worth a warning."""
    here, there = row(8, np.zeros(3)), row(8, TURNED)
    found = matches(here, there, TURNED, [(0, 0), (2, 2), (4, 4)])
    assert chosen(monkeypatch, found, here, there) == ""


def test_matches_within_a_room_are_not_enough(monkeypatch):
    """However often one robot was there."""
    here, there = row(8, np.zeros(3)), row(8, TURNED)
    for k, place in enumerate(there):
        place.pose = there[k % 2].pose
    found = matches(here, there, TURNED, [(k % 2, k) for k in range(8)])
    assert "m only, and rooms look alike" in chosen(monkeypatch, found, here, there)


def test_places_that_differ_contradict(monkeypatch):
    """Two of five where the other robot saw something else are too many."""
    here, there = row(8, np.zeros(3)), row(8, TURNED)
    found = matches(here, there, TURNED, [(k, k) for k in range(5)])
    monkeypatch.setattr("graphslam.multi_robot.place_recognition.verify_places", lambda *_: ([], 2))
    P = np.zeros((24, 24))
    assert "contradict each other" in str(
        choose_alignment("a", "b", found, PlaceMap(here, P), PlaceMap(there, P), MultiRobotConfig())
    )


@pytest.mark.parametrize(("alike", "joined"), [(0.8, False), (0.5, True)])
def test_two_alignments_leave_it_undecided(monkeypatch, alike, joined):
    """If both match equally well; corridors that look alike match half as well."""
    here, there = row(8, np.zeros(3)), row(8, TURNED)
    found = matches(here, there, TURNED, [(k, k) for k in range(5)])
    other = compose(TURNED, np.array([3.0, 0.0, 0.0]))
    found += matches(here, there, other, [(k + 1, k) for k in range(5)], same=alike)
    relation = chosen(monkeypatch, found, here, there)
    assert isinstance(relation, RelativeFrame) is joined
    assert joined or "imply one relative" in relation


# ---------------------------------------------------------------- points without identity


def cloud(points, rng, sigma=0.1):
    seen = points[rng.random(len(points)) < 0.9]
    covs = np.tile(sigma**2 * np.eye(2), (len(seen), 1, 1))
    return seen + sigma * rng.normal(size=seen.shape), covs


def related(p, q):
    return relate_points("a", "b", p, q, AssociationConfig().floor_m)


def test_points_in_common_determine_the_start():
    """Half of 60 points on 30 m square, a tenth of them missed by each: always found, correctly.

    Breaks with a turn of the wrong sense, pairs that are not one to one, a mirror image.
    """
    off = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        points = rng.uniform(0.0, 30.0, (60, 2))
        here, there = points[points[:, 0] < 22.0], points[points[:, 0] > 8.0]
        relation = related(cloud(here, rng), cloud(transform(inverse(TURNED), there), rng))
        assert isinstance(relation, RelativeFrame)
        miss = relation.pose - TURNED
        off.append(miss @ np.linalg.solve(relation.cov, miss) / 3)
    # 1 if the covariance is right; 30 degrees of freedom: 0.5 to 1.8 in 99 % of all cases
    assert 0.3 < np.mean(off) < 2.0


def test_points_with_nothing_in_common_relate_nothing():
    """However many transforms are tried, too few points match by chance: 10 pairs of maps."""
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        here, there = (rng.uniform(0.0, 30.0, (50, 2)) for _ in range(2))
        assert related(cloud(here, rng), cloud(there, rng)) == ""


def test_an_orchard_is_ambiguous():
    """Trees in rows match at many shifts."""
    rng = np.random.default_rng(5)
    trees = np.stack(np.meshgrid(np.arange(8) * 4.0, np.arange(6) * 4.0), axis=-1).reshape(-1, 2)
    relation = related(cloud(trees, rng), cloud(transform(inverse(TURNED), trees), rng))
    assert isinstance(relation, str)
    assert "match at another relative pose" in relation


def test_relations_that_contradict_place_no_robot():
    """Then the robot keeps a frame of its own, with a reason."""
    start = Start(np.zeros(3), np.diag([0.01, 0.01, 0.01]) ** 2)
    cov = np.diag([0.05, 0.05, 0.01]) ** 2
    relations = [RelativeFrame("b", "a", pose, cov, 5.0) for pose in (TURNED, -TURNED)]
    nothing = SimpleNamespace(landmarks={}, sees=True)
    joined = build_frame_tree(
        ("a", "b"), {"a": nothing, "b": nothing}, (), {"a": start}, Config(), start,
        relations,
    )  # fmt: skip
    assert joined.frames == {"a": "a", "b": "b"}
    assert "contradicts itself" in joined.undecided["b"]


def in_hall(niche_m, length_m, at, start=(0.0, 0.0, 0.0)):
    """Places at x = ``at`` in a hall 12 m wide, as a robot has them that began at ``start`` (3,).

    A niche in its right half is ``niche_m`` deep. Every place shows all of the hall.
    """
    half = length_m / 2
    x, y = np.arange(-half, half, 0.05), np.arange(-6.0, 6.0, 0.05)
    niche = -6.0 - niche_m * (x > 0.25 * half)
    sides = [(x, 6.0 + 0 * x), (x, niche), (-half + 0 * y, y), (half + 0 * y, y)]
    outline = np.concatenate([np.column_stack(side) for side in sides])
    found = []
    for k, place in enumerate(at):
        pose = np.array([place, 0.9, 0.3])
        submap = make_submap(np.zeros((1, 3)), [transform(inverse(pose), outline)])
        own = compose(inverse(np.array(start)), pose)
        found.append(SubmapPose(("r", k), own, place - at[0], (k, k), submap))
    return found


START = np.array([3.0, -2.0, 0.8])


@pytest.mark.parametrize(("niche_m", "clear"), [(0.0, False), (4.0, True)])
def test_a_plain_hall_fits_as_well_the_other_way_round(niche_m, clear):
    """Turned by half a turn; one with a niche does not."""
    at = (-4.0, -1.0, 2.0, 5.0)
    others = alternative_alignments(
        START, in_hall(niche_m, 16.0, at), in_hall(niche_m, 16.0, at, START), MultiRobotConfig()
    )
    assert (not others) == clear
    if not clear:
        # turned about the middle of the hall; the search's cells are 0.3 m and 2.5 degrees
        half = compose(np.array([0.0, 0.0, np.pi]), START)
        np.testing.assert_allclose(between(half, others[0]), 0.0, atol=0.3)


@pytest.mark.parametrize(("niche_m", "joined"), [(0.0, False), (4.0, True)])
def test_robots_that_saw_a_plain_hall_are_not_related(niche_m, joined):
    """Both drove from its middle to its end, so only one of five places was seen the other way
    round as well: that is no second alignment, but nothing contradicts it either."""
    at = (0.0, 2.5, 5.0, 7.5, 10.0)
    here, there = in_hall(niche_m, 28.0, at), in_hall(niche_m, 28.0, at, START)
    P = np.kron(np.eye(len(at)), np.diag([0.02, 0.02, 0.005]) ** 2)
    relation = relate_places("a", "b", PlaceMap(here, P), PlaceMap(there, P), MultiRobotConfig())
    assert isinstance(relation, RelativeFrame) == joined
    if joined:
        np.testing.assert_allclose(between(START, relation.pose), 0.0, atol=0.05)
    else:
        assert "another relative pose fits" in relation
