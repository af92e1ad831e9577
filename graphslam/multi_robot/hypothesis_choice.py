"""Which of several hypotheses about where a path lies in a map is right, if that can be told.

Buildings repeat themselves. A hypothesis is believed if it explains enough places, over some
distance, is hardly contradicted, and no other one explains about as much, place by place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from graphslam.core.config import LoopClosureConfig, MultiRobotConfig
from graphslam.core.consistency import has_rival
from graphslam.core.geometry import between
from graphslam.core.record import replace
from graphslam.mapping.submaps import SubmapPose
from graphslam.multi_robot.map_localisation import Support, self_contradictions
from graphslam.multi_robot.place_recognition import (
    EQUIVALENT_SHARE,
    MIN_MATCHES,
    extent,
    why_too_small,
)
from graphslam.multi_robot.place_search import DISTINCT_M, DISTINCT_RAD

#: contradicted places for each confirmed one, and how many, from which there is a doubt: of 24 days
#: in the simulated office that were placed right 23 had none, one 0.19; of those in a part that
#: only looks alike 0.2 to 0.3
DOUBT_SHARE, LEAST_DOUBTED = 0.2, 2
#: a place contradicts a map if it does so by this factor more than the median of places seen again
#: (tinySLAM's room: 0.05 to 0.2 both); of how many of these that is known at least
USUAL_FACTOR, LEAST_USUAL = 1.5, 4
#: of a small room: share of all that is seen over which recognised places must extend, and share of
#: a place that may contradict it. Of simulated rooms of 4 m a right one has 0, with a cabinet that
#: was pushed 0.02; a mirrored one, which is believed in two of twelve cases otherwise, 0.05 or more
SEEN_SHARE, ROOM_ABSENT = 0.4, 0.03
#: share of the best one's support from which another hypothesis is a rival whatever contradicts it;
#: others are from half of it on, unless they are contradicted
EQUAL_SHARE = 0.7
#: share of the places that a hypothesis recognises which stands alone, and share of its support
#: that no other one reaches. Another building has 0.25 at most; in the simulated office wrong ones
#: have others with 0.18 or more
RECOGNISED_SHARE, FAINT_SHARE = 0.75, 0.1


class Telling(IntEnum):
    """How much a reason says about where a path lies, the least first.

    Little in common says nothing. What contradicts a hypothesis has at least been recognised, and
    two that explain all of it say that it is there, in one of two ways.
    """

    NOTHING, FEW, NEAR, CONTRADICTED, RIVALS = range(5)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why no hypothesis is believed, and how telling that is among the reasons of several maps."""

    text: str
    telling: Telling


def best_explanation(
    found: Sequence[Support],
    places: Sequence[SubmapPose],
    config: MultiRobotConfig,
    seen_m: float = math.inf,
) -> tuple[int, Refusal | None]:
    """The hypothesis, of at least one, that explains places best, and why it is not believed.

    That is None if it is. Others are rivals by what they explain about as well, place by place: a
    building turned by half a turn has walls everywhere too, but they fit worse. For ``seen_m``
    see `choose`.
    """
    index = max(range(len(found)), key=lambda k: (not found[k].is_contradicted, found[k].total))
    best = found[index]
    rivals = [_as_rival(one, best) for one in found if one is not best]
    alone = _stands_alone(best, found)
    chosen = choose([best, *rivals], places, config, seen_m, may_contradict=alone)
    if isinstance(chosen, Refusal):
        return index, chosen
    if chosen == 0:
        return index, None
    return index, Refusal("more than one relative pose explains what was seen", Telling.RIVALS)


def choose(
    found: Sequence[Support],
    places: Sequence[SubmapPose],
    config: MultiRobotConfig,
    seen_m: float = math.inf,
    *,
    may_contradict: bool = False,
) -> int | Refusal:
    """Which of several hypotheses, at least one, is right, or why that is not known.

    Rooms look alike, so places must extend over `min_place_extent_m`. Where nobody saw more than a
    room they cannot: over a share of ``seen_m`` m, the longest distance between points of either
    map, suffices there if hardly anything contradicts any place. In a room walls that are all
    alike outweigh the furniture by which it is known.

    ``may_contradict``: however many places contradict it, if nothing else is against it.
    """
    totals = [one.total for one in found]
    best = int(np.argmax(totals))
    one = found[best]
    count = int(one.confirmed.sum())
    if count < MIN_MATCHES:
        return Refusal(f"only {count} of {len(places)} places are recognised", Telling.FEW)
    wide_m = extent([p for p, is_seen in zip(places, one.confirmed, strict=True) if is_seen])
    near = (
        f"the places that are recognised extend over {wide_m:.1f} m only, {why_too_small(wide_m)}"
    )
    if wide_m < min(config.min_place_extent_m, SEEN_SHARE * seen_m):
        return Refusal(near, Telling.NEAR)
    others = [x for x in found if differ(one, x)]
    rivals = [x.total for x in others if not x.is_contradicted]
    if has_rival(one.total, rivals) or has_rival(one.total, [x.total for x in others], EQUAL_SHARE):
        return Refusal(
            "it has places that look alike, and the path fits into it in more than one way",
            Telling.RIVALS,
        )
    if one.is_contradicted and not may_contradict:
        against = int(one.contradicted.sum())
        return Refusal(f"{against} of {len(places)} places contradict it", Telling.CONTRADICTED)
    if wide_m < config.min_place_extent_m and one.absent.max() > ROOM_ABSENT:
        return Refusal(f"something contradicts them; {near}", Telling.CONTRADICTED)
    return best


def contradiction(given: Support) -> str:
    """Why a start that was given cannot be right; empty if it can.

    It is trusted further than one that was found: places outside of the map speak neither for nor
    against it, and furniture that moved in sight of every place is no reason. In another building,
    or turned round in the right one, more places contradict the map than agree with it.
    """
    against, agreeing = int(given.contradicted.sum()), int(given.confirmed.sum())
    if against <= agreeing:
        return ""
    return f"{against} of {len(given.confirmed)} places contradict it, {agreeing} agree with it"


def doubt(
    placed: Support,
    places: Sequence[SubmapPose],
    config: LoopClosureConfig,
    *,
    stands_alone: bool = False,
) -> str:
    """What is to be said of a path that is placed in a map; empty if hardly anything is against it.

    Things that were moved contradict the right place too, so it is no reason to refuse it. No doubt
    is a place that contradicts the map by no more than places of the path contradict each other.

    Args:
        placed: how the places agree.
        places: of the path.
        config: settings of submaps.
        stands_alone: whether it was believed although many contradict it.
    """
    count = len(placed.contradicted)
    against = _doubted(placed, 0.0)
    if against:
        usual = self_contradictions(places, 2.0 * config.submap_reach_m)
        if len(usual) >= LEAST_USUAL:
            against = _doubted(placed, USUAL_FACTOR * float(np.median(usual)))
    if not against:
        return ""
    why = ": much was moved, or it drove elsewhere, where it looks alike"
    if stands_alone:
        why = ", but nothing else explains them: much was moved"
    return f"{against} of {count} places contradict where it was placed{why}"


def _doubted(placed: Support, least: float) -> int:
    """How many places contradict by more than a share ``least``, 0 where these are few."""
    against = int((placed.contradicted & (placed.absent > least)).sum())
    few = max(LEAST_DOUBTED - 1, DOUBT_SHARE * int(placed.confirmed.sum()))
    return against if against > few else 0


def differ(one: Support, other: Support) -> bool:
    """Whether two hypotheses, that may have begun apart, end at different paths."""
    off = between(one.poses, other.poses)
    apart = np.hypot(off[:, 0], off[:, 1]) > DISTINCT_M
    return bool(np.median(apart | (np.abs(off[:, 2]) > DISTINCT_RAD)))


def _stands_alone(best: Support, all_of_them: Sequence[Support]) -> bool:
    """Whether a hypothesis recognises nearly all places, and no other one explains a bit of them.

    Then it is right though much was moved. The same building turned by half a turn recognises all
    places too, but is never alone: parts of it fit elsewhere, or the right pose does, contradicted
    as much.
    """
    others = [one for one in all_of_them if differ(best, one)]
    recognised = float(best.confirmed.sum())
    return bool(
        recognised >= RECOGNISED_SHARE * len(best.confirmed)
        and best.total > 0.0
        and not has_rival(best.total, (one.total for one in others), FAINT_SHARE)
        and not has_rival(recognised, (float(one.confirmed.sum()) for one in others))
    )


def _as_rival(other: Support, best: Support) -> Support:
    """Another hypothesis with what it explains about as well as the best one.

    One that is contradicted, and twice as much as the best one, often lays more of the drives into
    the map: in a building that looks the same turned by half a turn, into what was mapped, where in
    truth they went elsewhere. That alone does not speak for it: only places count that the best
    one explains too.
    """
    equivalent = other.scores > EQUIVALENT_SHARE * best.scores
    if other.is_contradicted and other.contradicted_share > 2 * best.contradicted_share:
        equivalent &= best.scores > 0.0
    return replace(other, scores=np.where(equivalent, other.scores, 0.0))
