"""Landmarks and paths as drawings for other programs: SVG, DXF, GeoJSON.

All coordinates are metres in the world frame of the result, x to the right and y up.
"""

import json
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.records import Landmark, Trajectory

#: m: points of a path closer than this are left out
PATH_STEP_M = 0.05
#: layers of the drawings; colours by number of DXF (AutoCAD's index) and for SVG
LAYERS = {"walls": (7, "#111111"), "points": (3, "#2a7d2a"), "paths": (5, "#2b5fb4")}
_MARGIN_M = 0.5


def line_map_files(
    landmarks: Sequence[Landmark], paths: Mapping[str, Trajectory], name: str
) -> list[tuple[str, str | bytes]]:
    """Names and contents of the drawings of landmarks and of each robot's path."""
    points = {robot: path.poses[:, :2] for robot, path in sorted(paths.items())}
    thin = {robot: xy[thinned_index(xy)] for robot, xy in points.items()}
    return [
        (f"{name}.svg", svg_text(landmarks, thin)),
        (f"{name}.dxf", dxf_text(landmarks, thin)),
        (f"{name}.geojson", geojson_text(landmarks, thin)),
    ]


def thinned_index(points: Array, step_m: float = PATH_STEP_M) -> list[int]:
    """Which points (n, 2) of a path to keep: those ``step_m`` or more from the one before."""
    kept = [0] if len(points) else []
    for k, (x, y) in enumerate(points.tolist()):
        if k:
            dx, dy = x - points[kept[-1], 0], y - points[kept[-1], 1]
            if dx * dx + dy * dy >= step_m**2:
                kept.append(k)
    return kept


def svg_text(landmarks: Sequence[Landmark], paths: Mapping[str, Array]) -> str:
    """An SVG, one unit 1 m, north up; walls, points and ``paths`` (n, 2) are groups."""
    corners = np.concatenate([*(m.extent for m in landmarks), *paths.values(), np.zeros((0, 2))])
    if not len(corners):
        corners = np.zeros((1, 2))
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    width, height = (high - low).tolist()

    def at(point: Array) -> tuple[str, str]:
        return f"{point[0] - low[0]:.4f}", f"{high[1] - point[1]:.4f}"

    groups: dict[str, list[str]] = {layer: [] for layer in LAYERS}
    for m in landmarks:
        (x1, y1), (x2, y2) = at(m.extent[0]), at(m.extent[1])
        named = f"<title>{escape(_title(m))}</title>"
        if m.kind == "point":
            groups["points"].append(f'<circle cx="{x1}" cy="{y1}" r="0.06">{named}</circle>')
        else:
            line = f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}">{named}</line>'
            groups["walls"].append(line)
    for robot, points in paths.items():
        drawn = " ".join(",".join(at(point)) for point in points)
        title = f"<title>{escape(robot)}</title>"
        groups["paths"].append(f'<polyline points="{drawn}">{title}</polyline>')
    body = "\n".join(
        f'<g id="{layer}" fill="none" stroke="{color}" stroke-width="0.03">\n'
        + "\n".join(groups[layer])
        + "\n</g>"
        for layer, (_, color) in reversed(LAYERS.items())
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.4f} {height:.4f}" '
        f'width="{min(1200.0, 40 * width):.0f}">\n'
        f"<desc>metres; x = {low[0]:.4f} + right, y = {high[1]:.4f} - down</desc>\n{body}\n</svg>\n"
    )


def dxf_text(landmarks: Sequence[Landmark], paths: Mapping[str, Array]) -> str:
    """A DXF of release 12, in metres, which every program for drawings reads."""
    pairs: list[tuple[int, object]] = [
        *((0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009")),
        *((9, "$INSUNITS"), (70, 6), (0, "ENDSEC")),
        *((0, "SECTION"), (2, "TABLES"), (0, "TABLE"), (2, "LAYER"), (70, len(LAYERS))),
    ]
    for layer, (color, _) in LAYERS.items():
        pairs += [(0, "LAYER"), (2, layer), (70, 0), (62, color), (6, "CONTINUOUS")]
    pairs += [(0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES")]
    for m in landmarks:
        (x1, y1), (x2, y2) = m.extent.tolist()
        if m.kind == "point":
            pairs += [(0, "POINT"), (8, "points"), (10, x1), (20, y1), (30, 0.0)]
        else:
            pairs += [(0, "LINE"), (8, "walls"), (10, x1), (20, y1), (30, 0.0)]
            pairs += [(11, x2), (21, y2), (31, 0.0)]
    for points in paths.values():
        pairs += [(0, "POLYLINE"), (8, "paths"), (66, 1), (70, 0)]
        pairs += [(10, 0.0), (20, 0.0), (30, 0.0)]
        for x, y in points.tolist():
            pairs += [(0, "VERTEX"), (8, "paths"), (10, x), (20, y), (30, 0.0)]
        pairs += [(0, "SEQEND"), (8, "paths")]
    pairs += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(
        f"{code:>3}\n{f'{value:.6f}' if isinstance(value, float) else value}\n"
        for code, value in pairs
    )


def geojson_text(landmarks: Sequence[Landmark], paths: Mapping[str, Array]) -> str:
    """A GeoJSON FeatureCollection with paths (n, 2) m; ``units``: coordinates are no degrees."""
    features = [_feature(m) for m in landmarks]
    features += [
        _geo("LineString", np.round(points, 6).tolist(), {"layer": "paths", "robot": robot})
        for robot, points in paths.items()
        if len(points) > 1
    ]
    collection = {
        "type": "FeatureCollection",
        "units": "metres in the world frame of the result, no geographic coordinates",
        "features": features,
    }
    return json.dumps(collection, ensure_ascii=False, allow_nan=False) + "\n"


def _feature(m: Landmark) -> dict[str, Any]:
    about: dict[str, Any] = {
        "layer": "points" if m.kind == "point" else "walls",
        "id": m.id,
        "kind": m.kind,
        "sightings": m.sightings,
        "identity": m.identity,
    }
    ends = np.round(m.extent, 6).tolist()
    if m.kind == "point":
        return _geo("Point", ends[0], about)
    return _geo("LineString", ends, about)


def _geo(kind: str, coordinates: Any, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _title(m: Landmark) -> str:
    return f"{m.kind} {m.id}" + (f" ({m.identity})" if m.identity else "")
