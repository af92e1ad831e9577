"""Which landmarks of a known map a log shows to be gone, for the map that goes on."""

from collections.abc import Sequence
from typing import Any

from graphslam.core.records import Estimate, Landmark
from graphslam.mapping.retired_landmarks import seen_through
from graphslam.pipeline.log_pass import LogPass


def retired_landmarks(
    pipeline: LogPass, landmarks: Sequence[Landmark], estimate: Estimate
) -> dict[int, dict[str, Any]]:
    """Number -> entry of summary.json, of landmarks that are to leave the map.

    None where the map does not go on. What the log observed is there, glass among it. What was
    moved a little is gone from where it was, though no beam went through.
    """
    known_map = pipeline.known.known_map
    if known_map is None or not pipeline.given_config.known_map.update:
        return {}
    seen = {a.target for step in pipeline.steps for a in step.associations}
    unseen = [m for m in landmarks if m.id in known_map.known.means and m.id not in seen]
    gone = {
        *seen_through(unseen, pipeline.keyframe_scans, estimate.states),
        *pipeline.moved.values(),
    }
    return {
        mark.id: {
            "id": mark.id,
            "kind": mark.kind,
            "extent": mark.extent.tolist(),
            "last_seen_ns": mark.last_ns,
            "gone_ns": pipeline.first_ns,
        }
        for mark in unseen
        if mark.id in gone
    }
