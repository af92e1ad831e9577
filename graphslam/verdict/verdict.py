"""Whether a result can be trusted: good, doubtful or bad, with the reasons in words.

Pure checks, a row of `CHECKS` each, look at the evidence of a run (`graphslam.verdict.evidence`).
What a sensor does wrong is said as what it is, where the witnesses tell; otherwise, who contradicts
whom. The thresholds are far from what healthy logs show, see docs/reliability.md.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

import numpy as np

from graphslam.estimation.log_noise import MOTION
from graphslam.logs.time_order import TOO_LATE
from graphslam.verdict.corrected_scales import scale_facts
from graphslam.verdict.doubts import Reason, seconds
from graphslam.verdict.evidence import Evidence
from graphslam.verdict.excursions import excursion_doubts
from graphslam.verdict.gross_errors import misplaced_doubts, without_harmless
from graphslam.verdict.moved_points import moved_doubts, moved_facts
from graphslam.verdict.odometry_doubts import odometry_doubts
from graphslam.verdict.regular_landmarks import regular_landmark_doubts
from graphslam.verdict.scan_doubts import scan_doubts
from graphslam.verdict.sighting_doubts import sighting_doubts
from graphslam.verdict.told_starts import contradictions
from graphslam.verdict.turned_sensors import large_error_doubts, turned_sensor_doubts
from graphslam.verdict.vanished_points import vanished_doubts

#: factors on a stated variance that a log shows: from the first one doubtful, from the other bad
NOISE_FACTORS = 30.0, 1000.0
#: squared residuals per degree of freedom without kernels: of healthy logs up to 4
MISFITS = 16.0, 200.0
#: squared distance of a closure, three degrees of freedom: of healthy logs up to 6
CONTRADICTED_CLOSURE = 50.0
#: pairs of places that are not joined though they look the same, and their share of all such pairs
REFUSED = 4, 0.1
#: share of observations that fit nowhere
REJECTED = 0.6
#: share of messages that are lost
LOST = 0.02
#: share of the scans, or sightings, at whose time it is not known how the robot moved
UNPLACED = 0.3
#: mean squared error over its covariance: of healthy logs up to 5
NEES = 30.0, 1000.0

_NONE: Mapping[str, float] = MappingProxyType({})


def judge(evidence: Evidence) -> dict[str, Any]:
    """The key ``verdict`` of summary.json: the worst of what all `CHECKS` say, and all of it.

    Gross errors that do no harm are facts, and no check sees them.
    """
    rest, errors = without_harmless(evidence)
    reasons = (reason for check in CHECKS.values() for reason in check(rest))
    facts = (*errors, *scale_facts(evidence), *moved_facts(evidence))
    return to_summary(reasons, [asdict(fact) for fact in facts])


def to_summary(
    reasons: Iterable[Reason], facts: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """The key ``verdict`` for these reasons, and facts that are none."""
    told = sorted(reasons, key=lambda reason: reason.level != "bad")
    level = "good" if not told else "bad" if told[0].level == "bad" else "doubtful"
    return {
        "verdict": level,
        "reasons": [
            {"level": one.level, "check": one.check, "about": one.about, "text": one.text}
            for one in told
        ],
        "facts": list(facts),
    }


def with_truth(
    verdict: Mapping[str, Any],
    errors: Mapping[str, Any] | None,
    sigmas_m: Mapping[str, float] = _NONE,
) -> dict[str, Any]:
    """A verdict that knows the errors against the truth of the log, where there is one.

    Args:
        verdict: without them.
        errors: see `graphslam.evaluation.metrics.evaluate`.
        sigmas_m: of the positions of each robot, root mean square. Where truth and result have no
            frame in common, aligned errors are held against these: an alignment only makes errors
            smaller, and sigmas are those of a path that begins where it is told.
    """
    reasons = [Reason(**one) for one in verdict["reasons"]]
    for name, found in ((errors or {}).get("robots") or {}).items():
        final = found.get("final") or {}
        nees = float(final.get("nees_per_dof") or 0.0)
        if not nees and sigmas_m.get(name):
            nees = float(((final.get("ate_aligned_rmse_m") or 0.0) / sigmas_m[name]) ** 2)
        level = _level(nees, NEES)
        if level:
            times = f"{math.sqrt(nees):.0f} times what the covariances say"
            text = f"{name}: its errors against the truth in the log are {times}"
            reasons.append(Reason(level, "truth", name, text))
    return to_summary(reasons, verdict.get("facts", ()))


def _level(value: float, limits: tuple[float, float]) -> str | None:
    if not value > limits[0]:
        return None
    return "bad" if value > limits[1] else "doubtful"


def _noise(evidence: Evidence) -> Iterable[Reason]:
    """Noise that is nowhere near what was stated: no noise at all, but a contradiction."""
    others = {robot.name: robot.other_sensor for robot in evidence.robots}
    for source, found in evidence.summary["noise"].items():
        measured = found.get("measured", {})
        worst = max(measured, key=lambda name: float(measured[name]), default="")
        level = _level(measured[worst], NOISE_FACTORS) if worst else None
        if level:
            robot, _, model = source.rpartition(" ")
            other = others.get(robot, "sightings") if model == MOTION else "sightings"
            text = (
                f"{robot}: its {other} and its odometry contradict each other: errors of {worst} "
                f"are {measured[worst] ** 0.5:.0f} times what "
                f"{'is stated' if found.get('stated', True) else 'sensors commonly have'}"
            )
            yield Reason(level, "noise", robot, text)


def _misfit(evidence: Evidence) -> Iterable[Reason]:
    graph = evidence.summary["graph"]
    if not graph["dof"]:  # back ends that use no observations
        return
    misfit = 2 * graph["error_without_kernels"] / graph["dof"]  # it is half the squared residuals
    level = _level(misfit, MISFITS)
    if level:
        times = misfit**0.5
        text = f"observations contradict each other: residuals are {times:.3g} times their noise"
        yield Reason(level, "residuals", "", text)


def _closures(evidence: Evidence) -> Iterable[Reason]:
    """A path that comes back elsewhere than where its scans, or the log, say that it is."""
    counts = evidence.summary.get("consolidated") or {}
    refused, between, verified = (
        counts.get(f"closures_{which}", 0) for which in ("refused", "refused_between", "verified")
    )
    refused -= between  # what they say of where a session is, the sessions' own check says
    if refused >= REFUSED[0] and refused > REFUSED[1] * (refused + verified):
        text = (
            f"{refused} of {refused + verified} pairs of places that look the same are not joined, "
            "as all else contradicts that: odometry slipped, or much of the place is alike"
        )
        yield Reason("doubtful", "closures", "", text)
    found = evidence.closures
    if found is None or not (found.d2 > CONTRADICTED_CLOSURE).any():
        return
    worst = int(np.argmax(found.d2))
    here, there = (seconds(int(time), evidence.begin_ns) for time in found.times_ns[worst])
    text = (
        f"the places at {here} and {there} are the same, but the path between them does not lead "
        f"back by {found.off_m[worst]:.2f} m: odometry slipped where no wall shows it, or they are "
        "two places that look alike"
    )
    yield Reason("doubtful", "closures", "", text)


def _rejected(evidence: Evidence) -> Iterable[Reason]:
    rejected = sum(evidence.summary["rejected"].values())
    used = evidence.summary["counts"]["observations"]
    if rejected > REJECTED * (rejected + used) and rejected > 50:
        text = f"{rejected} of {rejected + used} observations of landmarks fit nowhere"
        yield Reason("doubtful", "rejected", "", text)


def _lost(evidence: Evidence) -> Iterable[Reason]:
    for log in evidence.summary["logs"]:
        lost, read = log["lost"], log["messages"]
        if lost is None:
            text = f"{log['path']}: is damaged, and nobody knows how many messages are lost"
            yield Reason("doubtful", "lost", log["path"], text)
        elif lost > LOST * (lost + read):
            text = f"{log['path']}: {lost} of {lost + read} messages are lost"
            yield Reason("doubtful", "lost", log["path"], text)
    late = evidence.summary["dropped"].get(TOO_LATE, 0)
    if late > LOST * sum(log["messages"] for log in evidence.summary["logs"]):
        text = (
            f"{late} messages were left out, as they came later than logs.reorder_s allows; see "
            "graphslam info"
        )
        yield Reason("doubtful", "lost", "", text)


def _unplaced(evidence: Evidence) -> Iterable[Reason]:
    """Much that was recorded is not in the result: of another robot, say, or by another clock."""
    dropped, counts = evidence.summary["dropped"], evidence.summary["counts"]
    for kind, used in (("scan", counts["scans"]), ("sighting", counts["observations"])):
        left_out = dropped.get(f"{kind}: no odometry near it", 0)
        if left_out > UNPLACED * (left_out + used):
            part = f"{left_out} of {left_out + used} {kind}s"
            text = (
                f"{part} were left out: no odometry is near them; two clocks, or it is missing? "
                "See graphslam info"
            )
            yield Reason("doubtful", "unplaced", "", text)


def _starts(evidence: Evidence) -> Iterable[Reason]:
    """Starts that were told, but not where robots saw that they are from a map or each other."""
    for name, at in evidence.summary.get("starts_better", {}).items():
        text = (
            f"{name}: fits clearly better elsewhere than where its start was told: if it begins at "
            f"{at['x']:.2f},{at['y']:.2f},{at['phi']:.3f}, all of its first places are confirmed "
            "and less contradicts them; is the told start wrong?"
        )
        yield Reason("doubtful", "starts", name, text)
    found = contradictions(evidence.told)
    if not found:
        return
    worst = found[0]
    text = (
        f"the starts told of {' and '.join(worst.robots)} contradict what the robots saw by "
        f"{worst.off_m:.2f} m and {math.degrees(worst.off_rad):.1f} degrees: "
    )
    one = set(worst.robots).intersection(*(pair.robots for pair in found))
    is_one = len(found) > 1 and len(one) == 1
    text += f"that of {one.pop()} is wrong" if is_one else "one of them is wrong"
    yield Reason("doubtful", "starts", "", f"{text}, and the map lies between the two")


def _sessions(evidence: Evidence) -> Iterable[Reason]:
    """Recordings of one place that are not one map, or of which much speaks against it."""
    found = evidence.summary.get("sessions", {})
    for name, why in found.get("apart", {}).items():
        yield Reason("doubtful", "sessions", name, f"{name}: is no part of the map: {why}")
    for name, said in found.get("doubts", {}).items():
        yield Reason("doubtful", "sessions", name, f"{name}: {said}")


def _doubled_walls(evidence: Evidence) -> Iterable[Reason]:
    """Walls of the building do not move, but all of the furniture may be pushed alike."""
    for name, found in evidence.displacements.items():
        if found.is_doubtful:
            text = (
                f"{name}: walls of the building appear twice over {found.twice_m:.0f} m, displaced "
                f"alike by {math.hypot(*found.by):.2f} m: much was pushed alike, and is taken for "
                "what stayed"
            )
            yield Reason("doubtful", "doubled walls", name, text)


def _known_map(evidence: Evidence) -> Iterable[Reason]:
    """A known map that is doubtful itself, or a place in it of which much speaks against it."""
    known = evidence.summary.get("known_map", {})
    if known.get("verdict", "good") != "good":
        text = f"{known['name']}: the map is {known['verdict']} itself: see its report"
        yield Reason("doubtful", "known map", known["name"], text)
    if known.get("doubt"):
        yield Reason("doubtful", "known map", known["name"], f"{known['name']}: {known['doubt']}")


def _unobserved(evidence: Evidence) -> Iterable[Reason]:
    counts = evidence.summary["counts"]
    if not evidence.observed or not (counts["observations"] or counts["loop_closures"]):
        if evidence.summary["closures"].get("used"):
            return
        text = "no landmark and no closure entered the estimate: this is dead reckoning by odometry"
        if "known_map" in evidence.summary:
            text += ", from where it was placed in the map"
        yield Reason("doubtful", "observations", "", text)
        return
    for name in evidence.unobserved:
        if name not in evidence.without_odometry:
            text = (
                f"{name}: nothing that it saw, and nobody who saw it, entered the estimate: it is "
                "where its odometry says"
            )
            yield Reason("doubtful", "observations", name, text)


#: what is looked at, in the order in which it is told
CHECKS: dict[str, Callable[[Evidence], Iterable[Reason]]] = {
    "odometry": odometry_doubts,
    "scans": scan_doubts,
    "sightings": sighting_doubts,
    "excursions": excursion_doubts,
    "turned sensors": turned_sensor_doubts,
    "sensor errors": large_error_doubts,
    "regular landmarks": regular_landmark_doubts,
    "points": vanished_doubts,
    "moved": moved_doubts,
    "misplaced": misplaced_doubts,
    "noise": _noise,
    "residuals": _misfit,
    "closures": _closures,
    "rejected": _rejected,
    "lost": _lost,
    "unplaced": _unplaced,
    "starts": _starts,
    "sessions": _sessions,
    "doubled walls": _doubled_walls,
    "known map": _known_map,
    "observations": _unobserved,
}
