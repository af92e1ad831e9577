"""Association of one image at a time, and the life of a landmark from tentative to forgotten."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.config import AssociationConfig, OdometryConfig, RobotConfig
from graphslam.core.geometry import between, compose, compose_cov, compose_jacobians, rotate_cov
from graphslam.core.observation_models import MODELS
from graphslam.core.records import Motion, Observation, OdometryPose
from graphslam.estimation.backend import JointMarginal, block_slices
from graphslam.mapping.data_association import Associator, Image
from graphslam.mapping.gating import Pairs
from graphslam.mapping.landmark_map import Entry
from graphslam.mapping.pair_selection import (
    ALONE_M,
    ALONE_RAD,
    NEAREST_ALONE,
    NEAREST_OLD,
    NEAREST_RECENT,
    worth_comparing,
)
from graphslam.mapping.robot_candidates import (
    NOT_THERE,
    RobotTarget,
    predicted_joint,
    robots_in,
)
from graphslam.odometry.preintegration import Track

SECOND = 1_000_000_000
ORIGIN = np.zeros(3)
POINT_COV = np.diag([1e-4, 1e-4])
LINE_COV = np.diag([1e-2, 1e-4, 1e-4])
BETWEEN = "between the thresholds: neither a match nor new"
#: nothing added to innovations: so that a test knows d²
EXACT = AssociationConfig(floor_m=0.0, floor_rad=0.0)


class KnownPoses:
    """A back end that is told where the robot is; landmarks are where their first sighting put
    them. ``pose_cov`` is uncorrelated with the landmarks', which is zero."""

    def __init__(self, pose_cov):
        self.pose, self.pose_cov = ORIGIN, pose_cov
        self.landmarks, self.robots = {}, {}

    def joint(self, robot, landmarks, others=()):
        means = tuple(self.landmarks[i] for i in landmarks)
        there = tuple(self.robots[name] for name in others)
        slices = block_slices([len(mean) for mean in (*means, *there)])
        cov = np.zeros((3 + sum(map(len, (*means, *there))),) * 2)
        cov[:3, :3] = self.pose_cov
        return JointMarginal(self.pose, means, cov, slices, there)

    def landmark_means(self, landmarks):
        return [self.landmarks[i] for i in landmarks]

    def state_mean(self, robot):
        return self.pose


class Run:
    """Images one after the other; every pose is that of a state."""

    def __init__(self, config=EXACT, pose_cov=None):
        self.backend = KnownPoses(np.zeros((3, 3)) if pose_cov is None else pose_cov)
        self.associator = Associator(config, self.backend)
        self.map, self.rejected = self.associator.map, self.associator.rejected
        self.tracks, self.paths, self.poses = {}, {}, {}
        self.now_ns = 0

    def look(self, *seen, pose=ORIGIN, after_s=1.0, path_m=0.0, robot="r"):
        """The associations of an image taken ``after_s`` and ``path_m`` after the one before."""
        self.now_ns += round(after_s * SECOND)
        track = self.tracks.setdefault(robot, Track(OdometryConfig(), RobotConfig()))
        pose = np.asarray(pose, dtype=float)
        track.add(OdometryPose(robot, self.now_ns, self.now_ns, pose))
        self.paths[robot] = self.paths.get(robot, 0.0) + path_m
        self.poses[self.now_ns] = self.backend.pose = pose
        others = [RobotTarget(name, None, np.zeros(2)) for name in robots_in(seen)]
        image = Image(robot, self.now_ns, seen, pose, None, track, self.paths[robot], robots=others)
        found = self.associator.associate(image)
        for a in found:
            if a.target not in (*self.backend.landmarks, *self.backend.robots):
                place = MODELS[a.model].invert(a.z, self.poses[a.time_ns])
                self.backend.landmarks[a.target] = place
        return found

    def learn(self, *seen, **options):
        """Look three times, without moving: what is seen enters the graph."""
        for _ in range(3):
            found = self.look(*seen, **options)
        return found


def point(x, y, pose=ORIGIN, cov=POINT_COV, identity=None):
    z = MODELS["point"].predict(np.asarray(pose, float), np.array([x, y]))
    return Observation("point", z, cov, None, identity)


def wall(x, y, phi, half=2.0, pose=ORIGIN, kind="line"):
    """Part of a wall with its middle at (x, y), ``half`` metres to either side."""
    z = between(np.asarray(pose, float), np.array([x, y, phi]))
    return Observation(kind, z, rotate_cov(LINE_COV, z[2]), np.array([-half, half]))


def targets(found):
    return [a.target for a in found]


# ------------------------------------------------------------ from tentative to the graph


def test_what_was_seen_of_a_wall_stays_with_its_associations():
    """Breaks if the extent is lost on the way to the graph, or does not turn with a wall that is
    taken the other way round: afterwards walls end where these say."""
    run = Run(AssociationConfig(directed=False))
    there = replace(wall(0.0, 2.0, 0.0), extent=np.array([-1.0, 3.0]))
    back = replace(wall(0.0, 2.0, np.pi), extent=np.array([-3.0, 1.0]))
    for a in [*run.learn(there), *run.look(back)]:
        assert a.target == 0
        np.testing.assert_array_equal(a.extent, [-1.0, 3.0])


@pytest.mark.parametrize("needed", [1, 2, 3, 5])
def test_promotion_brings_the_evidence_along(needed):
    """Nothing enters before the last sighting needed; then all do, each from its own state with its
    raw measurement, those of earlier states marked late."""
    run = Run(replace(EXACT, sightings_to_promote=needed))
    seen = [point(4.0, 1.0 + 0.001 * k) for k in range(needed + 1)]
    for k in range(needed - 1):
        assert run.look(seen[k]) == ()
        assert not run.map.graph_ids()
    found = run.look(seen[needed - 1])
    assert [a.time_ns for a in found] == [(k + 1) * SECOND for k in range(needed)]
    assert [a.late for a in found] == [True] * (needed - 1) + [False]
    for a, o in zip(found, seen, strict=False):
        np.testing.assert_array_equal(a.z, o.z)
        np.testing.assert_array_equal(a.cov, o.cov)
        assert (a.robot, a.model, a.target) == ("r", "point", 0)
    assert run.map.graph_ids() == [0]
    (after,) = run.look(seen[needed])
    assert after.target == 0 and not after.late
    assert run.map.entries[0].sightings == needed + 1


def test_a_tentative_landmark_is_compared_relative_to_its_robot():
    """The robot's place in the world is 5 m uncertain, what it saw a second ago is not: a post
    0.5 m beside the first one is another one."""
    run = Run(pose_cov=np.diag([25.0, 25.0, 0.1]))
    run.look(point(4.0, 1.0))
    run.look(point(4.0, 1.5))
    assert len(run.map) == 2


def test_odometry_since_counts_for_a_tentative_landmark():
    """After 10 m of driving (half a metre sideways, sigma) the same half metre is no reason for a
    second landmark."""
    run = Run()
    run.look(point(14.0, 1.0))
    at = np.array([10.0, 0.0, 0.0])
    run.look(point(14.0, 1.5, at), pose=at, path_m=10.0)
    assert len(run.map) == 1


@pytest.mark.parametrize(
    ("after_s", "path_m", "gone"),
    [(25, 3, False), (10, 100, False), (25, 6, True), (19, 6, False), (25, 4.9, False)],
)
def test_tentative_landmarks_are_deleted_in_time_and_path(after_s, path_m, gone):
    """tentative_s 20 and tentative_m 5, both: a robot that waits for a door forgets nothing, nor
    does one that is fast."""
    run = Run()
    run.look(point(4.0, 1.0))
    run.look(after_s=after_s, path_m=path_m)
    assert len(run.map) == (0 if gone else 1)
    assert run.map.deleted == gone


def test_landmarks_of_the_graph_are_never_deleted():
    run = Run()
    run.learn(point(4.0, 1.0))
    run.look(after_s=1e5, path_m=1e5)
    assert run.map.graph_ids() == [0] and run.map.deleted == 0


def test_a_landmark_of_the_graph_that_is_not_seen_again_is_deleted():
    """Section 4.6, where asked for: in time alone, and no step observes it afterwards."""
    run = Run(replace(EXACT, delete_s=60.0))
    run.learn(point(4.0, 1.0))
    run.look(after_s=59)
    assert run.map.graph_ids() == [0] and run.associator.take_deleted() == ()
    run.look(after_s=2)
    assert run.map.graph_ids() == [] and run.associator.take_deleted() == (0,)
    assert (run.map.forgotten, run.map.deleted) == (1, 0)
    assert run.associator.take_deleted() == ()  # once


def test_a_landmark_is_new_at_once_where_the_thesis_says_so():
    run = Run(replace(EXACT, sightings_to_promote=1))
    (only,) = run.look(point(4.0, 1.0))
    assert not only.late and run.map.graph_ids() == [only.target]


def test_another_robots_waiting_deletes_nothing():
    """Path is that of the robot that saw it."""
    run = Run()
    run.look(point(4.0, 1.0), robot="a")
    run.look(after_s=100, path_m=100, robot="b")
    assert len(run.map) == 1
    run.look(path_m=100, robot="a")
    assert len(run.map) == 0


# ------------------------------------------------------------ two thresholds


@pytest.mark.parametrize("off_sigma", [0.0, 2.9, 3.2, 4.2, 4.4, 8.0])
def test_the_rule_of_two_thresholds(off_sigma):
    """Within the 99 % quantile a match, beyond the 99.99 % one new, between them neither: two
    landmarks for one thing are worse than a sighting less. d² is off_sigma² here."""
    run = Run()
    run.learn(point(4.0, 0.0))
    found = run.look(point(4.0 + off_sigma * 0.01, 0.0))
    match, new = chi2.ppf(0.99, 2), chi2.ppf(0.9999, 2)
    assert targets(found) == ([0] if off_sigma**2 < match else [])
    assert len(run.map) == (2 if off_sigma**2 > new else 1)
    assert run.rejected == ({BETWEEN: 1} if match < off_sigma**2 < new else {})


def test_the_floor_widens_both_thresholds_and_not_the_measurement():
    run = Run(AssociationConfig(floor_m=0.05))
    run.learn(point(4.0, 0.0))
    (found,) = run.look(point(4.08, 0.0))
    assert found.target == 0
    np.testing.assert_array_equal(found.cov, POINT_COV)


def test_innovations_are_booked_per_degree_of_freedom():
    run = Run()
    run.learn(point(4.0, 0.0))
    run.look(point(4.02, 0.0))
    times, values = zip(*run.associator.innovations["point"], strict=True)
    assert times == (2 * SECOND, 3 * SECOND, 4 * SECOND)
    assert values[-1] == pytest.approx(2.0**2 / 2, rel=1e-3)


def test_sightings_of_one_image_exclude_each_other():
    """Two posts where the map has one: the nearer is it, the other is neither it nor new."""
    run = Run()
    run.learn(point(4.0, 0.0))
    found = run.look(point(4.0, 0.02), point(4.0, 0.0))
    assert targets(found) == [0]
    np.testing.assert_array_equal(found[0].z, point(4.0, 0.0).z)
    assert run.rejected == {BETWEEN: 1}


# ------------------------------------------------------------ identities


def test_a_known_identity_bypasses_the_gates():
    """It enters the graph with its first sighting, and 5 m off it is still itself."""
    run = Run()
    (first,) = run.look(point(4.0, 0.0, identity="7"))
    assert not first.late
    (second,) = run.look(point(4.0, 5.0, identity="7"))
    assert first.target == second.target == 0
    assert run.map.entries[0].identity == "7" and not run.rejected


def test_different_identities_at_one_place_are_two_landmarks():
    run = Run()
    found = run.look(point(4.0, 0.0, identity="7"), point(4.0, 0.0, identity="8"))
    assert targets(found) == [0, 1]
    again = run.look(point(4.0, 0.0, identity="8"), point(4.0, 0.0, identity="7"))
    assert targets(again) == [1, 0]


@pytest.mark.parametrize("point_first", [True, False])
def test_an_identity_of_another_kind_is_rejected(point_first):
    """A detector that measures the direction only sometimes: a point's state has no direction, so
    the two are never compared, and one name is never two landmarks."""
    seen = [point(4.0, 0.0, identity="7"), replace(wall(4, 0, 0, kind="segment"), identity="7")]
    run = Run()
    run.look(seen[not point_first])
    assert run.look(seen[point_first]) == () and len(run.map) == 1
    assert run.rejected == {"identity: known as a landmark of another kind": 1}


def test_identities_count_after_any_distance():
    """No loop closing by geometry is needed for what has a name."""
    run = Run()
    run.look(point(4.0, 0.0, identity="7"))
    (found,) = run.look(point(4.0, 1.0, identity="7"), after_s=1e4, path_m=1e4)
    assert found.target == 0


def test_ignored_identities_are_as_if_they_were_not_there():
    """Gates, promotion, and no name in the map: a comparison of association needs that."""
    run = Run(replace(EXACT, identities="ignore"))
    assert run.look(point(4.0, 0.0, identity="7")) == ()
    run.look(point(4.0, 0.0, identity="8"))
    found = run.look(point(4.0, 0.0, identity="9"))
    assert targets(found) == [0, 0, 0]
    assert run.map.entries[0].identity is None and not run.map.by_identity
    run.look(point(4.0, 5.0, identity="7"))
    assert len(run.map) == 2


def test_a_nameless_sighting_may_be_of_a_named_landmark():
    run = Run()
    run.look(point(4.0, 0.0, identity="7"))
    (found,) = run.look(point(4.0, 0.01))
    assert found.target == 0


# ------------------------------------------------------------ old landmarks: closing a loop

ROOM = [(5.0, 0.0, np.pi / 2), (0.0, 5.0, np.pi), (-5.0, 0.0, -np.pi / 2)]
CORRIDOR = [(0.0, 2.0, np.pi), (0.0, -2.0, 0.0), (0.0, -2.6, 0.0)]
DRIFTED = np.diag([0.09, 0.09, 1e-3])


def come_back(walls, seen_again, moved=(0.0, 0.0, 0.0), config=None, robot="r", pose_cov=DRIFTED):
    """A run that knows ``walls`` and sees ``seen_again`` of them 100 m later, the estimated pose
    being off by ``moved``; what it associates then."""
    run = Run(config or AssociationConfig(), pose_cov=pose_cov)
    run.learn(*(wall(*w) for w in walls))
    found = run.look(*(wall(*w) for w in seen_again), pose=moved, path_m=100.0, robot=robot)
    return run, found


def test_old_landmarks_that_agree_together_close_the_loop():
    """Three walls of a room, all seen from a place 0.3 m and 2° off: one shift explains them."""
    run, found = come_back(ROOM, ROOM, moved=(0.25, -0.2, 0.03))
    assert targets(found) == [0, 1, 2]
    assert run.associator.closures == 1
    # and from then on they are recent: no second closure
    run.look(*(wall(*w) for w in ROOM), pose=(0.25, -0.2, 0.03), path_m=1.0)
    assert run.associator.closures == 1


@pytest.mark.parametrize("few", [1, 2])
def test_few_old_landmarks_close_no_loop(few):
    """They are likely to be of another room: tentative new ones, nothing in the graph."""
    run, found = come_back(ROOM, ROOM[:few])
    assert found == () and run.associator.closures == 0
    assert len(run.map) == 3 + few and not run.rejected


def test_a_corridor_closes_no_loop():
    """However many parallel walls agree, where along them the robot is remains free."""
    run, found = come_back(CORRIDOR, CORRIDOR, moved=(0.0, 0.1, 0.0))
    assert found == () and run.associator.closures == 0


def test_walls_that_contradict_each_other_close_no_loop():
    """Each fits within the pose's 0.3 m, but the room would have to be 1.1 m wider: another one."""
    wider = [(5.55, 0.0, np.pi / 2), (0.0, 5.0, np.pi), (-5.55, 0.0, -np.pi / 2)]
    single = [come_back(ROOM, [w], config=AssociationConfig(reacquire_m=1e9))[1] for w in wider]
    assert [targets(found) for found in single] == [[0], [1], [2]]  # one by one they do fit
    run, found = come_back(ROOM, wider)
    assert found == () and run.associator.closures == 0


def test_what_another_robot_saw_is_old_to_this_one():
    """Its pose may be anywhere relative to the other's: it is to find agreement first."""
    run, found = come_back(ROOM, ROOM[:2], robot="b")
    assert found == ()
    run, found = come_back(ROOM, ROOM, robot="b")
    assert targets(found) == [0, 1, 2] and run.associator.closures == 1


@pytest.mark.parametrize(
    ("off_m", "sigma", "wanted"), [(0.06, 0.5, [0]), (0.06, 1.1, []), (0.4, 0.5, [])]
)
def test_an_old_wall_is_matched_alone_where_its_place_is_known(off_m, sigma, wanted):
    """A robot that has driven around a room and never lost its other walls: the first one is where
    it should be, to half of what is asked for. Not if the pose is less certain than that, by the
    tenth that the wall's own noise does not take, nor what is 0.4 m behind, which fits with less
    than one in a million. Breaks if each round adds the walls that come into view alone."""
    pose_cov = np.diag([ALONE_M, ALONE_M, ALONE_RAD]) ** 2 * sigma**2
    pose_cov[2, 2] = 1e-6  # the lever is 5 m
    moved = (off_m, 0.0, 0.0)
    run, found = come_back(ROOM, ROOM[:1], moved=moved, pose_cov=pose_cov)
    assert targets(found) == wanted and run.associator.closures == 0
    # what another robot saw is old to this one, however certain both are
    _, others = come_back(ROOM, ROOM[:1], moved=moved, pose_cov=pose_cov, robot="b")
    assert others == ()


def test_an_old_point_is_not_matched_alone():
    """One point is like another: walls have a direction and a length besides."""
    run = Run(AssociationConfig())
    run.learn(point(4.0, 0.0))
    assert run.look(point(4.0, 0.0), path_m=100.0) == ()


def test_recent_landmarks_need_no_agreement():
    run, found = come_back(ROOM, ROOM[:1], config=AssociationConfig(reacquire_m=101.0))
    assert targets(found) == [0] and run.associator.closures == 0


# ------------------------------------------------------------ walls in parts


def test_a_wall_seen_in_two_parts_is_one_landmark():
    """A pillar hides its middle: both parts are the wall, though sightings exclude each other."""
    run = Run()
    run.learn(wall(0, 4, 0, half=3))
    found = run.look(wall(-2, 4, 0, half=1), wall(2, 4, 0, half=1))
    assert targets(found) == [0, 0] and len(run.map) == 1
    # a tentative wall likewise
    run = Run()
    run.look(wall(0, 4, 0, half=3))
    found = run.look(wall(-2, 4, 0, half=1), wall(2, 4, 0, half=1))
    assert targets(found) == [0, 0, 0] and len(run.map) == 1


def test_a_door_behind_its_wall_is_not_taken_for_a_part_of_it():
    """Alone it would be: the pose is off by 5 cm. Beside its wall it is known to lie elsewhere."""
    run = Run(AssociationConfig(), pose_cov=np.diag([0.05, 0.05, 0.01]) ** 2)
    run.learn(wall(0.0, 2.0, 0.0))
    door = wall(1.0, 2.1, 0.0, half=0.4)
    assert targets(run.look(wall(-0.5, 2.0, 0.0, half=1.0), door)) == [0]
    assert targets(run.look(door)) == [0]


def test_a_wall_grows_with_what_is_seen_of_it():
    run = Run()
    run.learn(wall(0, 4, 0, half=1))
    for x in (1.5, 3.0, 4.5):
        run.look(wall(x, 4, 0, half=1))
    np.testing.assert_allclose(run.map.entries[0].extent, [-1, 5.5], atol=1e-12)


def test_two_walls_in_one_row_stay_two():
    run = Run()
    run.learn(wall(-2, 4, 0, half=1), wall(2, 4, 0, half=1))
    assert targets(run.look(wall(-2, 4, 0, half=1), wall(2, 4, 0, half=1))) == [0, 1]


def test_a_segment_seen_whole_each_time_stays_a_segment():
    run = Run()
    found = run.learn(wall(0, 4, 0, half=1, kind="segment"))
    assert [a.model for a in found] == ["segment"] * 3
    assert run.map.entries[0].kind == "segment"


@pytest.mark.parametrize("partly", [0, 1, 2])
def test_a_segment_seen_partly_later_becomes_a_line(partly):
    """One of the sightings before its promotion lacks an end: as a line all of them agree, as a
    segment that one would be a lie."""
    run = Run()
    for k in range(3):
        kind, half = ("line", 0.6) if k == partly else ("segment", 1.0)
        found = run.look(wall(0.4 * (k == partly), 4, 0, half=half, kind=kind))
    assert [a.model for a in found] == ["line"] * 3
    assert run.map.entries[0].kind == "line"


def test_a_segment_of_the_graph_seen_partly_gives_its_line():
    """And keeps its own ends."""
    run = Run()
    run.learn(wall(0, 4, 0, half=1, kind="segment"))
    (found,) = run.look(wall(0.5, 4, 0, half=0.8))
    assert (found.target, found.model) == (0, "line")
    assert run.map.entries[0].kind == "segment"
    np.testing.assert_array_equal(run.map.entries[0].extent, [-1, 1])


@pytest.mark.parametrize("directed", [True, False])
def test_the_other_side_of_a_wall(directed):
    """A directed wall has two sides, two landmarks; undirected, the measurement is turned round."""
    run = Run(replace(EXACT, directed=directed))
    run.learn(wall(0, 4, 0))
    found = run.look(wall(0, 4, np.pi))
    if directed:
        assert found == () and len(run.map) == 2
    else:
        assert targets(found) == [0] and abs(found[0].z[2]) < 1e-12


# ------------------------------------------------------------ what is compared, and with what


def entries(n, in_graph):
    args = ("line", ORIGIN, np.eye(3), np.zeros(2), 0, 0, None)
    return [Entry(k, *args, in_graph=bool(g)) for k, g in zip(range(n), in_graph, strict=True)]


def worth(observation, miss, in_graph, recent, reacquire_min=2):
    n = len(observation)
    pairs = Pairs(
        np.array(observation), np.arange(n), ("line",) * n, np.zeros(n, bool), np.array(miss, float)
    )
    kept = worth_comparing(pairs, entries(n, in_graph), np.array(recent, bool), reacquire_min)
    return np.flatnonzero(kept).tolist()


def test_only_the_nearest_recent_landmarks_of_each_observation_are_compared():
    """A joint marginal costs with every landmark in it. The crude distance ranks them."""
    assert NEAREST_RECENT == 3
    observation, miss = [0] * 6 + [1] * 2, [5, 1, 4, 2, 0, 3, 9, 8]
    kept = worth(observation, miss, [True] * 8, [True] * 8)
    assert kept == [1, 3, 4, 6, 7]


def test_tentative_landmarks_are_all_compared():
    """They need no marginal."""
    assert worth([0] * 9, range(9), [False] * 9, [True] * 9) == list(range(9))


def test_old_landmarks_are_compared_only_where_they_could_close_a_loop():
    """Two observations have old candidates: with 2 that close a loop the nearest four of each are
    worth their price; where 3 are needed, the nearest two may be known well enough alone."""
    assert (NEAREST_OLD, NEAREST_ALONE) == (4, 2)
    observation, miss = [0] * 6 + [1] * 2, [5, 1, 4, 2, 0, 3, 9, 8]
    old = ([True] * 8, [False] * 8)
    assert worth(observation, miss, *old, reacquire_min=3) == [1, 4, 6, 7]
    assert worth(observation, miss, *old, reacquire_min=2) == [1, 3, 4, 5, 6, 7]


def test_old_and_recent_landmarks_have_places_of_their_own():
    recent = [True] * 4 + [False] * 5
    kept = worth([0] * 9, [0, 1, 2, 3, 0, 1, 2, 3, 4], [True] * 9, recent, reacquire_min=1)
    assert kept == [0, 1, 2, 4, 5, 6, 7]


def test_prediction_moves_the_pose_block_and_its_correlations():
    """System update 4.4-4.7: P_xx as `compose_cov` has it, P_xt by F, P_tt not at all."""
    rng = np.random.default_rng(2)
    root = rng.normal(size=(8, 8))
    joint = JointMarginal(np.array([1.0, 2.0, 0.5]), (np.ones(2), np.ones(3)), root @ root.T, ())
    motion = Motion(0, 1, np.array([0.5, 0.1, 0.3]), 0.01 * np.eye(3), np.zeros((3, 0)), 0.5)
    moved = predicted_joint(joint, motion)
    F, _ = compose_jacobians(joint.pose, motion.delta)
    P = joint.cov
    expected = compose_cov(joint.pose, P[:3, :3], motion.delta, motion.cov)
    np.testing.assert_allclose(moved.pose, compose(joint.pose, motion.delta))
    np.testing.assert_allclose(moved.cov[:3, :3], expected, atol=1e-13)
    np.testing.assert_allclose(moved.cov[:3, 3:], F @ P[:3, 3:], atol=1e-13)
    np.testing.assert_allclose(moved.cov, moved.cov.T, atol=1e-13)
    np.testing.assert_array_equal(moved.cov[3:, 3:], P[3:, 3:])
    assert predicted_joint(joint, None) is joint


def test_other_robots_move_in_the_prediction_like_the_robot_itself():
    """Only their own blocks get noise; their clocks widen them along their paths alone."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(11, 11))
    poses = np.array([[1.0, 2.0, 0.5], [4.0, 1.0, np.pi / 2], [0.0, 3.0, -1.0]])
    joint = JointMarginal(
        poses[0], (np.ones(2),), root @ root.T, block_slices([2, 3, 3]), tuple(poses[1:])
    )
    motion = Motion(0, 1, np.array([0.5, 0.1, 0.3]), 0.01 * np.eye(3), np.zeros((3, 0)), 0.5)
    others = [RobotTarget("b", motion, np.array([0.2, 0.0])), RobotTarget("c", None, np.zeros(2))]
    moved = predicted_joint(joint, None, others)
    F, _ = compose_jacobians(poses[1], motion.delta)
    expected = compose_cov(poses[1], joint.cov[5:8, 5:8], motion.delta, motion.cov)
    ahead = 0.2 * np.array([np.cos(np.pi / 2 + 0.3), np.sin(np.pi / 2 + 0.3)])
    expected[:2, :2] += np.outer(ahead, ahead)
    np.testing.assert_allclose(moved.others[0], compose(poses[1], motion.delta))
    np.testing.assert_allclose(moved.cov[5:8, 5:8], expected, atol=1e-12)
    np.testing.assert_allclose(moved.cov[:3, 5:8], joint.cov[:3, 5:8] @ F.T, atol=1e-12)
    np.testing.assert_array_equal(moved.others[1], poses[2])
    for same in (slice(0, 5), slice(8, 11)):
        np.testing.assert_array_equal(moved.cov[same, same], joint.cov[same, same])


# ------------------------------------------------------------ other robots


def robot_at(x, y, *names, is_landmark=False):
    """A sighting at (x, y) that may be of robots."""
    return replace(point(x, y), robots=names, is_landmark=is_landmark)


def run_with_robots(**robots):
    run = Run()
    run.backend.robots = {name: np.array([*at, 0.0]) for name, at in robots.items()}
    return run


def test_a_robot_is_where_its_name_says_or_the_sighting_is_rejected():
    """Within the gate of two degrees of freedom at 1 cm; breaks if names are trusted ungated.

    Landmarks have names here.
    """
    run = run_with_robots(b=(4.0, 0.0), c=(0.0, 3.0))
    run.look(point(1.0, 1.0, identity="post"))
    (found,) = run.look(robot_at(4.02, 0.0, "b"))
    assert (found.target, found.model) == ("b", "robot-point")
    assert run.look(robot_at(4.02, 0.0, "c")) == ()
    assert run.look(robot_at(4.04, 0.0, "b")) == ()
    assert run.rejected == {NOT_THERE: 2}
    assert len(run.map.entries) == 1, "a sighting of a robot makes no landmark"


@pytest.mark.parametrize("named", [False, True])
def test_robots_that_are_never_where_expected_are_believed_where_landmarks_have_no_names(named):
    """The estimate may have taken one landmark for another; sightings of robots put that right."""
    run = run_with_robots(a=(5.0, 0.0), b=(0.0, 9.0))
    if named:
        run.look(point(1.0, 1.0, identity="post"))
    used = [targets(run.look(robot_at(8.0, 0.0, "a"))) for _ in range(2)]
    assert used == ([[], []] if named else [["a"], ["a"]])
    assert targets(run.look(robot_at(5.0, 0.0, "a"))) == ["a"]
    twice = targets(run.look(robot_at(8.0, 0.0, "a"), robot_at(8.1, 0.0, "a")))
    assert twice == ([] if named else ["a"]), "one sighting of an image"
    assert not targets(run.look(robot_at(8.0, 0.0, "a", "b"))), "it does not tell of which"


def test_unnamed_robots_are_assigned_together():
    """b and c 4 cm apart, seen 1.5 cm and -2.2 cm from b: alone the first would be b's, and the
    second too. A robot takes one sighting of an image."""
    run = run_with_robots(b=(4.0, 0.0), c=(4.03, 0.0))
    found = run.look(robot_at(4.014, 0.0, "b", "c"), robot_at(3.99, 0.0, "b", "c"))
    assert targets(found) == ["c", "b"]
    assert targets(run.look(robot_at(4.0, 0.0, "b"), robot_at(4.001, 0.0, "b"))) == ["b"]


def test_robots_and_landmarks_compete_for_what_may_be_either():
    """A landmark 3 cm from a robot: each sighting goes to what is nearest, and one that lies
    between the two thresholds of a robot is neither its nor a new landmark."""
    run = run_with_robots(b=(4.0, 0.0))
    run.learn(point(4.03, 0.0))
    either = [robot_at(x, 0.0, "b", is_landmark=True) for x in (4.028, 4.004)]
    assert targets(run.look(*either)) == [0, "b"]
    assert targets(run.look(*either[::-1])) == ["b", 0]
    before = len(run.map.entries)
    assert run.look(robot_at(3.964, 0.0, "b", is_landmark=True)) == ()
    assert run.rejected == {BETWEEN: 1} and len(run.map.entries) == before
    run.look(robot_at(3.0, 0.0, "b", is_landmark=True))
    assert len(run.map.entries) == before + 1, "far from every robot it is a landmark"


def test_the_map_follows_the_estimate():
    """A loop closure moves old landmarks by metres; the gates without covariance read the map,
    which is refreshed before fifty images have gone by."""
    run = Run()
    run.learn(point(4.0, 0.0))
    run.backend.landmarks[0] = np.array([14.0, 0.0])
    for _ in range(60):
        run.look()
    (found,) = run.look(point(14.0, 0.0))
    assert found.target == 0
