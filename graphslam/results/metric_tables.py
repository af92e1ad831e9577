"""Errors as tables: the columns that reports and the terminal share."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from typing import Any


@dataclass(frozen=True, slots=True)
class Column:
    """A number of a row.

    ``value`` finds it (None: there is none). The best value of the column is the smallest if
    ``target`` is 0, else the one nearest to ``target`` in ratio; without ``target`` there is none.
    """

    head: str
    value: Callable[[Mapping[str, Any]], Any]
    target: float | None = 0.0


def value_at(*keys: str) -> Callable[[Mapping[str, Any]], Any]:
    """A function that finds a value by its nested keys; None where one is missing."""

    def find(row: Mapping[str, Any]) -> Any:
        value: Any = row
        for key in keys:
            value = None if value is None else value.get(key)
        return value

    return find


def converted(convert: Callable[[Any], object], *keys: str) -> Callable[[Mapping[str, Any]], Any]:
    """As `value_at`, with the value converted; None stays None."""
    find = value_at(*keys)

    def found(row: Mapping[str, Any]) -> object:
        value = find(row)
        return None if value is None else convert(value)

    return found


def _percent(share: float) -> float:
    return 100.0 * share


def _interval(bounds: Sequence[float]) -> str:
    return f"{bounds[0]:.3f}…{bounds[1]:.3f}"


def _if_only_aligned(
    find: Callable[[Mapping[str, Any]], Any], *at: str
) -> Callable[[Mapping[str, Any]], Any]:
    """The value where the row has no error in a common frame, else None."""
    absolute = value_at(*at, "ate_rmse_m")
    return lambda row: find(row) if absolute(row) is None else None


def trajectory_columns(*at: str) -> tuple[Column, ...]:
    """Columns of the metrics of a trajectory, which are at the nested keys ``at`` of a row."""
    aligned_heading = converted(degrees, *at, "heading_aligned_rmse_rad")
    return (
        Column("ATE, m", value_at(*at, "ate_rmse_m")),
        Column("aligned, m", value_at(*at, "ate_aligned_rmse_m")),
        Column("max, m", value_at(*at, "max_m")),
        Column("aligned max, m", _if_only_aligned(value_at(*at, "max_aligned_m"), *at)),
        Column("heading, °", converted(degrees, *at, "heading_rmse_rad")),
        Column("aligned heading, °", _if_only_aligned(aligned_heading, *at)),
        Column("RPE 1 s, m", value_at(*at, "rpe", "1_s", "trans_rmse_m")),
        Column("RPE 10 m, m", value_at(*at, "rpe", "10_m", "trans_rmse_m")),
        Column("NEES/dof", value_at(*at, "nees_per_dof"), 1.0),
        Column("95 % bounds", converted(_interval, *at, "nees_bounds"), None),
        Column("coverage, %", converted(_percent, *at, "coverage"), 95.0),
    )


def landmark_columns(*at: str) -> tuple[Column, ...]:
    """Columns of the metrics of a landmark map, which are at the nested keys ``at`` of a row."""
    return (
        Column("RMSE, m", value_at(*at, "rmse_m")),
        Column("NEES/dof", value_at(*at, "nees_per_dof"), 1.0),
        Column("coverage, %", converted(_percent, *at, "coverage"), 95.0),
        Column("matched", value_at(*at, "matched"), None),
        Column("missed", value_at(*at, "missed"), None),
        Column("extra", value_at(*at, "extra"), None),
    )


_RELATION_COLUMNS = tuple(
    Column(head, value_at(key))
    for head, key in (
        ("matched", "n"),
        ("unmatched", "unmatched"),
        ("mean, m", "trans_mean_m"),
        ("std, m", "trans_std_m"),
        ("median, m", "trans_median_m"),
        ("mean, °", "rot_mean_deg"),
        ("std, °", "rot_std_deg"),
    )
) + tuple(
    Column(head, converted(_percent, key), 95.0)
    for head, key in (
        ("in 95 % (m), %", "trans_inside"),
        ("in 95 % (°), %", "rot_inside"),
        ("by closing (m), %", "trans_inside_closing"),
        ("by closing (°), %", "rot_inside_closing"),
    )
)

#: title, heads, rows; the first two cells of each are labels, the others numbers
Table = tuple[str, list[str], list[list[Any]]]


def evaluation_tables(evaluation: Mapping[str, Any]) -> Iterator[Table]:
    """Tables of what `graphslam.evaluation.metrics.evaluate` returns, as far as it has them."""
    robots = dict(evaluation.get("robots", {}))
    if len(robots) > 1 and "joint" in evaluation:
        robots["all together"] = evaluation["joint"]
    if robots:
        paths = [
            (name, kind, values) for name, both in robots.items() for kind, values in both.items()
        ]
        yield _table("Against true poses", "robot", trajectory_columns(), paths)
    if relations := evaluation.get("relations"):
        groups = [
            (group, kind, found[group])
            for kind, found in (("final", relations), ("causal", relations.get("causal", {})))
            for group in ("all", "local", "loops")
            if group in found
        ]
        yield _table("Against reference relations", "relations", _RELATION_COLUMNS, groups)
    if landmarks := evaluation.get("landmarks"):
        yield _table(
            "Against true landmarks", "landmarks", landmark_columns(), [("map", "", landmarks)]
        )


def _table(
    title: str,
    label: str,
    columns: Sequence[Column],
    rows: Sequence[tuple[str, str, Mapping[str, Any]]],
) -> Table:
    # what no row has is left out: absolute errors without a common frame, for one
    known = [c for c in columns if any(c.value(values) is not None for _, _, values in rows)]
    heads = [label, "", *(column.head for column in known)]
    cells = [[a, b, *(column.value(values) for column in known)] for a, b, values in rows]
    return title, heads, cells


# ---------------------------------------------------------------- words

NO_COMMON_FRAME = (
    "Estimate and truth have no world frame in common: errors are those after the best rigid "
    "alignment, and there is no NEES, since covariances are of errors in the world. Give --start "
    "truth (or --start ROBOT=x,y,phi) to `smooth` for absolute errors"
)
_ALIGNED_BY = {
    "poses": "the alignment of the poses",
    "identities": "an alignment by landmarks of equal identity",
    "constellation": "an alignment by the constellation of points and corners",
}


def evaluation_notes(evaluation: Mapping[str, Any]) -> list[str]:
    """What the numbers of `evaluate` mean, as far as it needs saying, one sentence each."""
    notes = []
    aligned_by = (evaluation.get("landmarks") or {}).get("aligned_by")
    if not evaluation.get("common_frame", True):
        by = f". Landmarks match after {_ALIGNED_BY[aligned_by]}" if aligned_by else ""
        if not aligned_by and "landmarks" in evaluation:
            by = ". Landmarks cannot be matched: no alignment is without doubt"
        notes.append(f"{NO_COMMON_FRAME}{by}.")
    names = dict(evaluation.get("robots", {}))
    if len(names) > 1 and "joint" in evaluation:
        names["all together"] = evaluation["joint"]
    for name, both in names.items():
        for kind, found in both.items():
            if text := nees_in_words(found):
                notes.append(f"{name}, {kind} poses: {text}.")
    return notes


def nees_in_words(found: Mapping[str, Any]) -> str:
    """What a NEES outside its bounds says; empty if it is inside, or there is none."""
    verdict = found.get("nees_verdict")
    if verdict in (None, "consistent"):
        return ""
    low, high = found["nees_bounds"]
    value = found["nees_per_dof"]
    above = value > high
    times = (value if above else 1 / max(value, 1e-9)) ** 0.5
    side = "above" if above else "below"
    count = round(found["effective_poses"])
    poses = f"{count} independent one{'s' * (count != 1)}"
    return (
        f"covariances are {verdict}: NEES/dof {value:.3g} is {side} its 95 % bounds {low:.3g} to "
        f"{high:.3g} (poses count as {poses}); "
        f"errors are "
        f"about {times:.2g} times as {'large' if above else 'small'} as stated"
    )
