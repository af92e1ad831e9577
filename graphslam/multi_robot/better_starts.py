"""Whether a path that was placed in a map as told fits the map clearly better somewhere else.

A told start decides between parts of a building that look alike. One that is turned by half a turn,
or told at a wrong door, often fits as well as corridors fit each other: four fifths of what is seen
are walls there too, and no place contradicts it by itself. Where it was in truth hardly anything
contradicts the map. So the place as told is compared with others in the same part of the building.

What was moved or built contradicts the right place, but every other one as well. Where nothing is
mapped nothing is contradicted. So another start is better only if the whole path fits there, and
much less of it contradicts the map.
"""

from collections.abc import Sequence

import numpy as np

from graphslam.core.config import MultiRobotConfig
from graphslam.core.geometry import Array, compose
from graphslam.core.record import replace
from graphslam.mapping.submaps import SubmapPose
from graphslam.multi_robot.map_localisation import Support, support
from graphslam.multi_robot.place_search import alternative_alignments

#: places that are compared at most, from the first one on that lies in the map: some 15 m of path.
#: Longer drives are contradicted by places, if they were told wrong
MOST_PLACES = 6
#: other starts that are judged, those that fit best
MOST_RIVALS = 3
#: m: farther away no other start is looked for, so that time does not grow with the building
NEARBY_M = 40.0
#: m: an other start is farther away, or turned (`place_search.DISTINCT_RAD`)
APART_M = 0.5
#: mean score of places, and mean share that contradicts the map, by which another start must be
#: better. Of 173 drives of 1 to 12 m in the simulated office that were told right, with furniture
#: moved, doors turned and walls built, others were better by 0.06 and 0.018 at most; of those told
#: half a turn wrong, or in the opposite part, the right ones by 0.16 and 0.02 or more
BETTER_SCORE, LESS_ABSENT = 0.12, 0.018
#: mean share that contradicts the map, below which the search is not worth its time: of the drives
#: that were told wrong all that are found but one have more, of the right ones two thirds have less
LEAST_ABSENT = 0.03


def better_alignment(
    known: Sequence[SubmapPose],
    places: Sequence[SubmapPose],
    placed: Support,
    config: MultiRobotConfig,
) -> Array | None:
    """The motion (3,) of the world by which a path fits a map clearly better; None without any.

    Args:
        known: places of the map.
        places: (n) of the path, in the order in which it came to them, laid into the map.
        placed: how they agree with it.
        config: settings of the search.
    """
    in_map = placed.confirmed | placed.contradicted
    if not in_map.any():
        return None
    first = int(in_map.argmax())
    part = slice(first, first + MOST_PLACES)
    own, judged = places[part], in_map[part]
    score, absent = placed.scores[part][judged].mean(), placed.absent[part][judged].mean()
    if absent < LEAST_ABSENT or score > 1.0 - BETTER_SCORE:
        return None
    near = _nearby(known, own)
    best, best_score = None, score + BETTER_SCORE
    shared = [place for place, is_there in zip(own, judged, strict=True) if is_there]
    for motion in alternative_alignments(np.zeros(3), near, shared, config, APART_M)[:MOST_RIVALS]:
        moved = [replace(place, pose=compose(motion, place.pose)) for place in own]
        found = support(near, moved)
        if not found.confirmed.all() or found.contradicted.any():
            continue
        is_less = found.absent[judged].mean() <= absent - LESS_ABSENT
        if is_less and found.scores[judged].mean() >= best_score:
            best, best_score = motion, found.scores[judged].mean()
    return best


def _nearby(known: Sequence[SubmapPose], own: Sequence[SubmapPose]) -> list[SubmapPose]:
    """Places of a map that are not far from those of a path, wherever it is turned to."""
    at = own[0].pose[:2]
    return [place for place in known if np.hypot(*(place.pose[:2] - at)) < NEARBY_M]
