"""The verdict: healthy evidence is good, and what is wrong is said as what it is."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
from command_line import call

from graphslam.core.geometry import between, compose, polar_points, transform_each
from graphslam.logs import LogWriter
from graphslam.logs.time_order import TOO_LATE
from graphslam.mapping.doubled_walls import Displacement
from graphslam.pipeline.path_evidence import FACTORS, PathMisfits
from graphslam.pipeline.scan_evidence import Parked, _half_changed
from graphslam.verdict.evidence import ClosureMisfits, Evidence, RobotEvidence, Seen
from graphslam.verdict.moved_points import moved_doubts
from graphslam.verdict.scan_distortion import Distortion, ScanDistortion
from graphslam.verdict.set_down import SceneChange
from graphslam.verdict.verdict import judge, with_truth

S = 1_000_000_000
N = 600  # readings, at 10 Hz
SUMMARY = {
    "noise": {}, "graph": {"error_without_kernels": 100.0, "dof": 200}, "rejected": {},
    "counts": {"scans": 100, "observations": 500, "loop_closures": 3}, "closures": {},
    "odometry": {}, "dropped": {"scan: no odometry near it": 20},
    "logs": [{"path": "log", "lost": 0, "messages": 100}],
}  # fmt: skip


def path(steps):
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def drive():
    """Motions (n, 3) of a robot in circles of changing size."""
    k = np.arange(N - 1)
    return np.column_stack([0.06 + 0 * k, 0 * k, 0.03 + 0.03 * np.sin(0.05 * k)])


def seen_from(poses, odometry, calibrated):
    rng = np.random.default_rng(0)
    points = rng.uniform((-5, -3), (5, 7), (12, 2))
    rows = []
    for k in range(0, N, 5):
        for n, point in enumerate(points):
            x, y, _ = between(poses[k], np.array([*point, 0.0]))
            if np.hypot(x, y) < 6 and abs(np.arctan2(y, x)) < 1.8:
                rows.append((k, n, np.arctan2(y, x), np.hypot(x, y)))
    rows = np.array(rows)
    k = rows[:, 0].astype(int)
    z = rows[:, 2:] + rng.normal(0, (0.005, 0.01), (len(rows), 2))
    sigmas = np.tile([0.005, 0.01], (len(rows), 1))
    times = S + k * S // 10
    targets, stands = rows[:, 1].astype(int), np.ones(len(rows), dtype=bool)
    names = tuple(f"p{n}" for n in range(len(points)))
    return Seen(
        times, targets, stands, z, sigmas, odometry[k], calibrated[k], poses[k],
        np.ones(len(rows)), names,
    )  # fmt: skip


def only(own, kept):
    """Some of the sightings."""
    columns = (f.name for f in fields(Seen) if f.name != "names")
    return replace(own, **{name: getattr(own, name)[kept] for name in columns})


def evidence(steps=None, scans=False, seen=None, calibrated=None, **changes):
    """Of a healthy run, but for ``steps`` of its odometry and other ``changes``.

    ``calibrated``: those that calibration makes of them; as they are without.
    """
    true = path(drive())
    odometry = path(drive() if steps is None else steps)
    calibrated = odometry if calibrated is None else path(calibrated)
    times = S + np.arange(N) * S // 10
    own = seen_from(true, odometry, calibrated)
    nothing = np.zeros(0, dtype=np.int64)
    robot = RobotEvidence(
        name="tom", source="odometry", readings_ns=times, readings=odometry, resets=0,
        stamps_ns=times, final=true, by_odometry=odometry, by_calibrated=calibrated,
        scans_ns=times[::3] if scans else nothing, repeated_ns=nothing.reshape(0, 2),
        motions_ns=times[1:101], contradicted=np.zeros(100, dtype=bool),
        seen=seen(own) if seen else own, parked=(),
    )  # fmt: skip
    return Evidence((replace(robot, **changes),), SUMMARY)


def reasons(found):
    verdict = judge(found)
    assert (verdict["verdict"] == "good") == (not verdict["reasons"])
    return verdict["verdict"], " | ".join(one["text"] for one in verdict["reasons"])


def changed(since, *factors):
    """Motions multiplied by ``factors`` from a reading on."""
    steps = drive()
    steps[since:] = steps[since:] * factors
    return steps


def straight(step_m, seed=0, sigma_m=0.0):
    """Motions (n, 3) along a line, some turns between."""
    steps = np.zeros((N - 1, 3))
    steps[:, 0] = step_m + np.random.default_rng(seed).normal(0, sigma_m, N - 1)
    steps[::3, 2] = 0.05
    return steps


def jumped(*jump, faster=1):
    steps = drive() * (faster, 1, 1)
    steps[300] = compose(steps[300], np.array(jump))
    return steps


def corrected(times):
    """Motions with so many corrections of the position, each by 0.12 m to the side."""
    steps = drive()
    for k in range(50, 50 + 50 * times, 50):
        steps[k] = compose(steps[k], np.array([0, 0.12, 0]))
    return steps


def from_half(change):
    """Sightings with (bearing, range) changed from the middle of the log on."""

    def seen(own):
        z = own.z.copy()
        late = own.times_ns > S + 30 * S
        z[late] = change(z[late])
        return replace(own, z=z)

    return seen


def in_steps_of(period):
    """Motions as of encoders that are read at every so many readings of odometry."""
    whole = drive()
    steps = np.zeros_like(whole)
    for k in range(0, len(whole) - period, period):
        steps[k + period - 1] = whole[k : k + period].sum(axis=0)
    return steps


@pytest.mark.parametrize(
    "steps", [corrected(1), in_steps_of(3)], ids=["one bump", "encoders that are read less often"]
)
def test_sudden_motions_that_are_rare_or_the_rule_are_no_corrections(steps):
    """0.12 m once is a bump; 0.18 m in every third period is how that odometry counts."""
    assert "jumps" not in reasons(evidence(steps))[1]


@pytest.mark.parametrize("scans", [False, True])
def test_a_healthy_run_is_good(scans):
    assert reasons(evidence(scans=scans)) == ("good", "")


@pytest.mark.parametrize("steps", [straight(0.0), straight(1e-5, sigma_m=1e-3)])
def test_a_robot_that_turns_on_the_spot_is_not_said_to_creep(steps):
    turning = evidence(steps, scans=True, seen=no_sightings, final=path(steps))
    assert reasons(turning) == ("good", "")


@pytest.mark.parametrize(("stands", "verdict"), [(True, "bad"), (False, "good")])
def test_a_parked_robot_may_watch_another_one(stands, verdict):
    """What drives past says nothing of it; a landmark that changes does."""
    steps = drive()
    steps[300:] = 0.0

    def passing(own):
        """From half of the log on one target comes nearer by 6 m in 30 s."""
        late = own.times_ns > S + 30 * S
        z = np.column_stack([0.1 * np.ones(late.sum()), np.linspace(8.0, 2.0, late.sum())])
        kept = [getattr(own, name)[late] for name in ("times_ns", "targets", "stands")]
        return Seen(kept[0], 0 * kept[1], np.full(late.sum(), stands), z,
                    own.sigmas[late], own.odometry[late], own.odometry[late], own.poses[late],
                    own.d2[late])  # fmt: skip

    still = evidence(
        steps, seen=passing, final=path(steps), parked=(Parked(31 * S, 60 * S, 0.0, 0.0),)
    )
    assert reasons(still)[0] == verdict


def mapped_twice(own):
    """From half of the log on, after an unseen turn by 0.4 rad, every point is another one."""
    late = own.times_ns > S + 30 * S
    poses = own.poses.copy()
    turned = compose(np.array([0.0, 0.0, 0.4]), between(poses[late][0], poses[late]))
    poses[late] = compose(poses[late][0], turned)
    return replace(own, targets=own.targets + 100 * late, poses=poses)


def moved_point(own):
    """From half of the log on the point p3 is 1.2 m away, as seen from a path that is right."""
    late = (own.targets == 3) & (own.times_ns > S + 30 * S)
    at = transform_each(own.poses, polar_points(own.z[:, 1], own.z[:, 0])) + np.array([0.0, 1.2])
    x, y = between(own.poses, np.column_stack([at, 0 * at[:, 0]]))[:, :2].T
    moved = np.column_stack([np.arctan2(y, x), np.hypot(x, y)])
    d2 = np.where(late, 1e4, own.d2)
    return replace(own, z=np.where(late[:, None], moved, own.z), d2=d2)


@pytest.mark.parametrize(("range_sigma_m", "doubts"), [(0.01, 1), (100.0, 0)])
def test_a_point_whose_range_is_not_measured_has_not_moved(range_sigma_m, doubts):
    """A robot that stands at two places sees it at two, if it takes the range that it is given."""
    found = evidence()
    own = found.robots[0].seen
    late = (own.times_ns > S + 30 * S)[:, None]
    poses = np.where(late, np.array([2.0, 0.0, 0.0]), np.zeros(3))
    z = np.tile([0.1, 3.0], (len(own.z), 1))
    sigmas = np.tile([0.01, range_sigma_m], (len(own.z), 1))
    seen = replace(own, poses=poses, z=z, sigmas=sigmas, targets=0 * own.targets, names=("p",))
    (robot,) = found.robots
    told = list(moved_doubts(replace(found, robots=(replace(robot, seen=seen),))))
    assert len(told) == doubts


def test_walls_that_dead_reckoning_does_not_join_say_nothing_of_the_laser():
    """They are where its drift has put them."""
    made = distorted(Distortion(0.3, 30.0, 0.3, 0.013), Distortion())
    graph = {"error_without_kernels": 0.0, "dof": 0}
    assert (
        "one after the other"
        not in reasons(replace(made, summary={**made.summary, "graph": graph}))[1]
    )


def in_a_map(known):
    """Evidence of a run with a known map."""
    made = evidence()
    return replace(made, summary={**made.summary, "known_map": known})


def distorted(sweep, spacing):
    """Evidence of walls that are turned within scans."""
    distortion = ScanDistortion(sweep, spacing)
    return evidence(scans=True, seen=no_sightings, distortion=distortion)


#: what is wrong, and what is said about it
WRONG = {
    "a recording that was interrupted while the robot drove": (
        lambda: interrupted(counted=False),
        "odometry stands for 8.",
    ),
    "curved walls": (
        lambda: evidence(scans=True, seen=no_sightings, curved=0.3),
        "30 % of what it saw of walls is of curved ones",
    ),
    "a sweep that nobody told of": (
        lambda: distorted(Distortion(0.04, 30.0, 0.3, 0.013), Distortion(0.01, 20.0, 0.2, 0.01)),
        "one after the other in 0.04 s or more",
    ),
    "a known map that is doubtful": (
        lambda: in_a_map({"name": "monday", "verdict": "doubtful"}),
        "monday: the map is doubtful itself",
    ),
    "beams that are farther apart than is stated": (
        lambda: distorted(Distortion(0.04, 20.0, 0.2, 0.01), Distortion(0.01, 30.0, 0.3, 0.013)),
        "1.0 % or more farther apart than angle_increment says",
    ),
    "beams that are closer together than is stated": (
        lambda: distorted(Distortion(), Distortion(-0.01, 30.0, 0.3, 0.013)),
        "1.0 % or more closer together",
    ),
    "a named point that is moved": (
        lambda: evidence(seen=moved_point),
        "the point p3: its sightings until 27.5 s agree on one place",
    ),
    "an unseen turn, points without names": (
        lambda: evidence(seen=mapped_twice),
        "part of the map is there twice",
    ),
    "turning negated": (lambda: evidence(changed(0, 1, -1, -1)), "wrong sign"),
    "turning negated, seen by scans": (
        lambda: evidence(changed(300, 1, -1, -1), scans=True, seen=no_sightings),
        "turning has the other sign",
    ),
    "backwards": (lambda: evidence(changed(300, -1, 1, 1)), "drives backwards"),
    "millimetres": (lambda: evidence(changed(0, 1000, 1000, 1)), "is it in metres?"),
    "degrees": (lambda: evidence(changed(0, 1, 1, 57.3)), "is it in radians?"),
    "half as long": (
        lambda: evidence(changed(0, 0.5, 1, 1), scans=True, seen=no_sightings),
        "forward motion by odometry is 0.5 times",
    ),
    "kilometres": (lambda: evidence(straight(6e-5)), "never stops: is it in metres?"),
    "jump of a fast robot": (lambda: evidence(jumped(0.3, 0, 0, faster=5)), "jumps by 0.6"),
    "jump": (lambda: evidence(jumped(0.3, 0, 0)), "jumps by 0.36 m"),
    "turn": (lambda: evidence(jumped(0, 0, 2.0)), "jumps by 0.06 m and 2.0"),
    "odometry that a localisation corrects": (
        lambda: evidence(corrected(10)),
        "jumps 10 times within one period, by 0.12 m",
    ),
    "resets": (lambda: evidence(resets=2), "jumped 2 times"),
    "carried while the laser pauses, to where nothing is as before": (
        lambda: paused(lost_ns=np.array([[199 * S, 241 * S]]) // 10),
        "before and after a pause of 4.2 s, 18.9 s after the first one",
    ),
    "carried while the laser pauses, to where scans say": (
        lambda: paused(
            contradicted=np.arange(100) == 50,
            motions_ns=np.append(S + np.arange(50) * S // 3, 24 * S + np.arange(50) * S // 3),
        ),
        "it was moved meanwhile",
    ),
    "frozen, by sightings": (
        lambda: evidence(changed(300, 0, 0, 0), parked=(Parked(31 * S, 60 * S, 0.0, 0.0),)),
        "is frozen, or far too small, from 30.0 s to 59.0 s: the landmarks that it sees",
    ),
    "frozen, by scans": (
        lambda: evidence(scans=True, parked=(Parked(31 * S, 60 * S, 0.9, 0.0),)),
        "its scans change meanwhile",
    ),
    "frozen along a corridor": (
        lambda: evidence(scans=True, parked=(Parked(31 * S, 60 * S, 0.3, 0.06),)),
        "its scans change meanwhile",
    ),
    "frozen between doors": (
        lambda: evidence(scans=True, parked=(Parked(31 * S, 60 * S, 0.3, 0.0, 0.5),)),
        "its scans change meanwhile",
    ),
    "half as long, by doors": (
        lambda: evidence(scans=True, along_walls=along_walls(column=8)),
        "along the walls its scans fit 2 times the path from 24.0 s on",
    ),
    "turning has the other sign in one corner": (
        lambda: evidence(
            scans=True, seen=no_sightings, final=path(in_a_corner(drive() * (1, 1, -1)))
        ),
        "turning has the other sign from",
    ),
    "bridged along a corridor": (
        lambda: evidence(scans=True, bridged_sigma_m=0.4),
        "is silent for a while",
    ),
    "gap": (
        lambda: with_gap(evidence(scans=True, seen=no_sightings)),
        "has no reading for 28",
    ),
    "late scans": (
        lambda: evidence(drive()[np.arange(N - 1) - 8], scans=True, seen=no_sightings),
        "stamped 0.8 s",
    ),
    "laser repeats": (
        lambda: evidence(scans=True, repeated_ns=S * np.array([[k, 31] for k in range(32, 40)])),
        "from 30.0 s on while odometry moves: the laser is frozen; 8 scans were left out",
    ),
    "sparse": (
        lambda: sparse(evidence(scans=True, seen=no_sightings)),
        "too little in common",
    ),
    "contradictions": (
        lambda: evidence(scans=True, contradicted=np.arange(100) % 4 == 0),
        "contradict its odometry in 25 of 100",
    ),
    "bearings negated": (
        lambda: evidence(seen=from_half(lambda z: z * (-1, 1))),
        "have the wrong sign, from 3",
    ),
    "bearings off": (
        lambda: evidence(seen=from_half(lambda z: z + np.array([0.5, 0.0]))),
        "off by 0.5 rad",
    ),
    "ranges doubled": (
        lambda: evidence(seen=from_half(lambda z: z * (1, 2))),
        "2 times too large",
    ),
    "ranges in millimetres": (
        lambda: evidence(seen=from_half(lambda z: z * (1, 1000))),
        "100 or more times too large",
    ),
    "image repeated": (
        lambda: evidence(seen=from_half(lambda z: 0 * z + np.array([0.3, 3.0]))),
        "repeat an image",
    ),
    "one name": (
        lambda: evidence(seen=lambda own: replace(own, targets=0 * own.targets)),
        "several landmarks have one name",
    ),
    "names exchanged": (
        lambda: evidence(seen=lambda own: replace(own, d2=np.where(own.times_ns > 40 * S, 90, 1))),
        "were names exchanged?",
    ),
}


def along_walls(column):
    """Pairs of scans, of which those from 24 s on fit another path."""
    misfits = np.full((40, len(FACTORS)), 3.0)
    misfits[:, 0] = 0.7
    misfits[24:, 0], misfits[24:, column] = 2.5, 0.8
    return PathMisfits(S + S * np.arange(40), misfits)


def in_a_corner(turned):
    """Motions that differ from `drive` for 4.5 s, in which it turns by 2.6 rad."""
    steps = drive()
    steps[260:305] = turned[260:305]
    return steps


def no_sightings(own):
    none = own.times_ns < 0
    return only(own, none)


def in_convoy(stands):
    """Sightings with most landmarks exchanged for one thing that stays 1.5 m ahead."""

    def seen(own):
        ahead = own.targets > 2
        z = np.where(ahead[:, None], [0.3, 1.5], own.z)
        targets = np.where(ahead, 3, own.targets)
        return replace(own, targets=targets, stands=own.stands & (stands | ~ahead), z=z)

    return seen


def with_gap(found):
    (robot,) = found.robots
    kept = (robot.readings_ns < 20 * S) | (robot.readings_ns > 48 * S)
    made = replace(robot, readings_ns=robot.readings_ns[kept], readings=robot.readings[kept])
    return replace(found, robots=(made,))


def paused(**changes):
    """A robot that stands from 20 to 24 s by its odometry, without scans; it is moved by 2 m."""
    steps = drive()
    true = steps.copy()
    steps[190:230], true[190:230] = 0.0, [0.05, 0.0, 0.0]
    found = evidence(scans=True, seen=no_sightings)
    (robot,) = found.robots
    kept = (robot.scans_ns <= 20 * S) | (robot.scans_ns >= 24 * S)
    made = replace(
        robot, scans_ns=robot.scans_ns[kept], final=path(true), by_odometry=path(steps),
        by_calibrated=path(steps),
        readings=path(steps), **changes,
    )  # fmt: skip
    return replace(found, robots=(made,))


def test_a_laser_that_pauses_while_its_robot_stands_is_no_doubt():
    assert reasons(paused()) == ("good", "")
    # nor are scans that have nothing in common without a pause
    lost = np.array([[196 * S, 199 * S]]) // 10
    assert reasons(evidence(scans=True, seen=no_sightings, lost_ns=lost)) == ("good", "")


@pytest.mark.parametrize(
    ("seen", "expected"),
    [
        ((0.3, 0.2, 0.1, 0.2), "doubtful"),
        ((0.9, 0.04, 0.04, 0.2), "good"),  # a door that was opened
        ((0.3, 0.2, 0.0, 0.2), "good"),  # who stood in front of the laser, for long, left
        ((0.3, 0.2, 0.1, 0.02), "good"),  # somebody passed: scans agree again
    ],
)
def test_a_robot_sees_another_place_where_scans_deny_each_other_and_never_agree_again(
    seen, expected
):
    changes = (SceneChange(20 * S, 20 * S + S // 10, *seen),)
    verdict, text = reasons(evidence(scans=True, seen=no_sightings, changes=changes))
    assert verdict == expected and ("another place" in text) == (expected == "doubtful")


def interrupted(*, counted):
    """Nothing is recorded from 20 to 28 s, while the robot drives on."""
    steps = drive()
    found = evidence(scans=True, seen=no_sightings)
    (robot,) = found.robots
    inside = slice(191, 270)
    if not counted:
        steps[inside] = 0.0
    poses = path(steps)
    kept = np.ones(N, dtype=bool)
    kept[inside] = False
    times = robot.scans_ns
    made = replace(
        robot, scans_ns=times[(times <= 20 * S) | (times >= 28 * S)], final=poses,
        by_odometry=poses, by_calibrated=poses, readings=poses[kept],
        readings_ns=robot.readings_ns[kept],
    )  # fmt: skip
    return replace(found, robots=(made,))


def test_odometry_that_counts_in_a_pause_of_the_laser_is_no_doubt_there():
    assert "odometry stands" not in reasons(interrupted(counted=True))[1]


@pytest.mark.parametrize("scans", [False, True])
@pytest.mark.parametrize("turning", [0.5, 1.7])
def test_turning_that_calibration_explains_is_no_doubt(scans, turning):
    """A robot that skids as it turns is calibrated. As recorded, its odometry contradicts all."""
    seen, steps = no_sightings if scans else None, changed(0, 1, 1, turning)
    raw = evidence(steps, scans=scans, seen=seen)
    assert "contradict" in reasons(raw)[1]
    assert reasons(evidence(steps, scans=scans, seen=seen, calibrated=drive())) == ("good", "")


@pytest.mark.parametrize("scans", [False, True])
@pytest.mark.parametrize("longer", [0.5, 2.0])
def test_a_path_that_calibration_explains_is_doubted(scans, longer):
    """Breaks if ranges in half metres are explained by odometry that is half as long, and good."""
    seen, steps = no_sightings if scans else None, changed(0, longer, 1, 1)
    found = evidence(steps, scans=scans, seen=seen, calibrated=drive())
    assert reasons(found)[0] != "good"


def test_a_part_that_calibration_does_not_explain_is_doubted():
    """Breaks if odometry that fails in the end is taken for calibrated."""
    failing = changed(300, 1, 1, 0.1)
    found = evidence(failing, scans=True, seen=no_sightings, calibrated=failing * [1, 1, 2.0])
    assert "contradict each other: turning" in reasons(found)[1]


def sparse(found):
    (robot,) = found.robots
    made = replace(
        robot, scans_ns=robot.scans_ns[::15], stamps_ns=robot.stamps_ns[::45],
        final=robot.final[::45], by_odometry=robot.by_odometry[::45],
        by_calibrated=robot.by_calibrated[::45],
    )  # fmt: skip
    return replace(found, robots=(made,))


def test_a_robot_that_drives_along_is_no_repeated_image_but_a_landmark_that_does_is_doubted():
    assert reasons(evidence(seen=in_convoy(stands=False))) == ("good", "")
    verdict, told = reasons(evidence(seen=in_convoy(stands=True)))
    assert verdict != "good" and "repeat an image" in told


@pytest.mark.parametrize("taken", ["no longer", "at first not"])
def test_things_that_were_taken_away_are_no_second_map(taken):
    """Nor are things that came: only both together are what odometry that slips leaves behind."""

    def some(own):
        far = own.times_ns > S + 30 * S if taken == "no longer" else own.times_ns < S + 30 * S
        kept = ~(far & (own.targets < 6))
        return only(own, kept)

    assert reasons(evidence(seen=some)) == ("good", "")


def test_a_sensor_that_sees_the_nearest_alone_loses_nothing():
    """What is behind the farthest thing in an image, or beside all of them, is not in sight."""

    def nearest(own):
        order = np.lexsort((own.z[:, 1], own.times_ns))
        _, first = np.unique(own.times_ns[order], return_index=True)
        rank = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
        kept = np.sort(order[rank < 3])
        return only(own, kept)

    assert reasons(evidence(seen=nearest)) == ("good", "")


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said_as_what_it_is(name):
    make, text = WRONG[name]
    verdict, told = reasons(make())
    assert verdict != "good" and text in told, told


@pytest.mark.parametrize(
    ("change", "level", "text"),
    [
        ({"noise": {"tom point": {"measured": {"bearings": 5e3}}}}, "bad", "bearings are 71"),
        ({"graph": {"error_without_kernels": 2e3, "dof": 100}}, "doubtful", "6.32 times"),
        ({"rejected": {"why": 4000}}, "doubtful", "4000 of 4500 observations"),
        ({"logs": [{"path": "x", "lost": 9, "messages": 91}]}, "doubtful", "9 of 100 messages"),
        ({"logs": [{"path": "x", "lost": None, "messages": 91}]}, "doubtful", "nobody knows"),
        ({"dropped": {TOO_LATE: 30}}, "doubtful", "30 messages were left out, as they came later"),
        ({"dropped": {"scan: no odometry near it": 50}}, "doubtful", "50 of 150 scans were left"),
        ({"dropped": {"sighting: no odometry near it": 300}}, "doubtful", "300 of 800 sightings"),
        ({"sessions": {"apart": {"day1": "why"}}}, "doubtful", "day1: is no part of the map: why"),
        ({"sessions": {"doubts": {"day1": "much was moved"}}}, "doubtful", "day1: much was moved"),
        ({"known_map": {"name": "monday", "doubt": "much"}}, "doubtful", "monday: much"),
        ({"counts": {"scans": 100, "observations": 0, "loop_closures": 0}}, "doubtful", "dead"),
    ],
)  # fmt: skip
def test_counts_of_the_run_are_judged(change, level, text):
    verdict, told = reasons(replace(evidence(), summary=SUMMARY | change))
    assert verdict == level and text in told


@pytest.mark.parametrize(
    ("once_m", "level"), [(0.0, "doubtful"), (9.0, "doubtful"), (90.0, "good")]
)
def test_walls_of_the_building_that_stand_twice_are_said(once_m, level):
    """All furniture was pushed by 25 cm: the second day lay off by that, with a good verdict."""
    found = {"day1": Displacement(np.array([0.2, 0.15]), 13.0, once_m, 8.0, 13.0)}
    verdict, told = reasons(replace(evidence(), displacements=found))
    assert verdict == level
    said = "day1: walls of the building appear twice over 13 m, displaced alike by 0.25 m"
    assert (said in told) is (level != "good")


@pytest.mark.parametrize(
    ("source", "scans", "other"),
    [
        ("tom motion", True, "scans"),
        ("tom motion", False, "sightings"),
        ("tom robot-point", True, "sightings"),
    ],
)
def test_noise_is_told_by_the_sensor_that_contradicts_odometry(source, scans, other):
    """That of motions by scans where there are any; that of sightings by themselves."""
    noise = {"noise": {source: {"measured": {"one": 100.0}}}}
    _, told = reasons(replace(evidence(scans=scans), summary=SUMMARY | noise))
    assert f"tom: its {other} and its odometry contradict each other: errors of one" in told


def test_a_closure_that_the_path_misses_is_doubted_and_one_that_leaves_a_direction_open_is_not():
    """A robust kernel bears it: 1 m of slip along a corridor bent no path, and nobody was told."""
    times = np.array([[S + 50 * S, S], [S + 40 * S, S + 2 * S]])
    fits = ClosureMisfits(times, np.array([0.02, 0.0]), np.array([4.0, 1e-3]))
    assert reasons(replace(evidence(), closures=fits)) == ("good", "")
    verdict, told = reasons(
        replace(evidence(), closures=replace(fits, off_m=fits.off_m + 1.0, d2=fits.d2 + 900.0))
    )
    assert verdict == "doubtful" and "the places at 50.0 s and 0.0 s are the same" in told


@pytest.mark.parametrize(
    ("refused", "between", "verdict"), [(3, 0, "good"), (6, 0, "doubtful"), (6, 5, "good")]
)
def test_places_that_look_the_same_and_are_not_joined_are_doubted(refused, between, verdict):
    """Of 20 laps through a building with some rooms that are alike a few are to be expected. Those
    between sessions that were placed by all that they have in common were judged then: three of six
    right maps of five days in a building whose halves are alike were doubtful by them."""
    counts = {
        "consolidated": {
            "closures_refused": refused,
            "closures_refused_between": between,
            "closures_verified": 26,
        }
    }
    assert reasons(replace(evidence(), summary=SUMMARY | counts))[0] == verdict


def test_the_truth_in_a_log_is_a_witness_where_it_is():
    good = judge(evidence())
    assert with_truth(good, None) == good
    near, far = ({"robots": {"tom": {"final": {"nees_per_dof": nees}}}} for nees in (3.0, 1e4))
    assert with_truth(good, near) == good
    found = with_truth(good, far)
    assert found["verdict"] == "bad" and "100 times what the covariances say" in str(found)


def test_truth_without_a_common_frame_is_a_witness_by_aligned_errors():
    good = judge(evidence())
    near, far = (
        {"robots": {"tom": {"final": {"nees_per_dof": None, "ate_aligned_rmse_m": error}}}}
        for error in (0.05, 5.0)
    )
    assert with_truth(good, near, {"tom": 0.02}) == good
    assert with_truth(good, far, {"tom": 0.02})["verdict"] == "bad"
    assert with_truth(good, far, {}) == good  # nothing is stated


def test_what_saw_much_and_used_nothing_is_dead_reckoning():
    verdict, told = reasons(replace(evidence(), observed=False))
    assert verdict == "doubtful" and "dead reckoning" in told


def test_a_robot_that_nothing_was_seen_by_or_of_is_named():
    """The others' landmarks say nothing of it; one without odometry is where its scans say."""
    alone = replace(evidence(), unobserved=("tom",))
    verdict, told = reasons(alone)
    assert verdict == "doubtful" and "tom: nothing that it saw" in told
    assert reasons(replace(alone, without_odometry=("tom",)))[0] == "good"


def test_a_back_end_without_observations_is_not_said_to_contradict_them():
    graph = {"graph": {"error_without_kernels": 4e5, "dof": 0}}
    assert reasons(replace(evidence(), summary=SUMMARY | graph))[0] == "good"


@pytest.mark.parametrize(("sign", "code"), [(1, 0), (-1, 3)])
def test_strict_tells_by_its_exit_code_and_the_result_is_written(tmp_path, sign, code):
    """Bearings of the wrong sign, from end to end: terminal, summary and report."""
    log, target = tmp_path / "log.mcap", tmp_path / "out"
    found = evidence().robots[0]
    with LogWriter(log) as out:
        for k in range(0, 200, 2):
            out.odometry("tom", int(found.readings_ns[k]), found.readings[k])
        for n in np.flatnonzero(found.seen.times_ns < 20 * S).tolist():
            z = found.seen.z[n] * (sign, 1)
            out.sighting(
                "tom", int(found.seen.times_ns[n]), z, np.diag([2.5e-5, 1e-4]),
                identity=f"p{found.seen.targets[n]}",
            )  # fmt: skip
    done = call("smooth", log, "-o", target, "--strict")
    assert done.code == code, done.err
    verdict = json.loads((target / "summary.json").read_text())["verdict"]
    page = (target / "report.html").read_text()
    assert f"verdict: {verdict['verdict']}" in done.out
    assert (verdict["verdict"] == "good") == (code == 0)
    assert ("wrong sign" in page) == ("wrong sign" in done.out) == (code == 3)


@pytest.mark.parametrize("sigma_m", [0.005, 0.03, 0.1])
def test_noise_and_people_do_not_change_half_of_the_ranges_but_a_step_does(sigma_m):
    rng = np.random.default_rng(4)
    side = np.abs(np.sin(np.radians(np.arange(-85.0, 86.0))))
    walls = np.minimum(1.2 / np.maximum(side, 1e-9), 9 / np.sqrt(1 - side**2))  # of a corridor

    def noisy(ranges):
        return ranges + rng.normal(0, sigma_m, len(ranges))

    before, people = noisy(walls), noisy(walls)
    people[20:90] = 0.8
    assert _half_changed(before, people) == 0.0
    assert _half_changed(before, noisy(1.05 * walls + 0.5)) > 0.4
