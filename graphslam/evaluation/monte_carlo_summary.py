"""The summary of an experiment: tables and curves over time, against the Cramér-Rao bound."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.stats import chi2, norm

from graphslam.core.geometry import Array
from graphslam.evaluation.cramer_rao_bound import Bound, cramer_rao_bound
from graphslam.evaluation.monte_carlo_definition import Definition
from graphslam.evaluation.thesis_chapter import summarise_chapter

Row = Mapping[str, Any]

#: two-sided level of the test of the joint NEES, over all noise scales together
LEVEL = 0.999
#: probability of the bands around curves and of intervals
BAND = 0.95
#: samples of a bootstrap
RESAMPLES = 2000
#: a run on the bench has diverged if its final joint NEES has less than this tail probability, or
#: if its position error is more than this many times the bound
DIVERGED_TAIL, DIVERGED_RATIO = 1e-6, 4.0


def summarise(definition: Definition, rows: Sequence[Row]) -> dict[str, Any]:
    """The results of an experiment: plain numbers, named with their units.

    ``table`` has a row per variant and noise scale (and scenario and front end); of an experiment
    on the bench ``curves[scale]`` has the curves over time. Runs that failed are counted and are in
    no mean; runs that diverged are in all.
    """
    bench = definition.bench is not None
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["scenario"], row["front_end"], row["scale"], row["variant"]].append(row)
    errors: dict[str, int] = defaultdict(int)
    for row in rows:
        if row["error"]:
            errors[f"{row['variant']}: {row['error']}"] += 1
    codes = sorted({row["code"] for row in rows})
    settings = [text for name in definition.variants for text in definition.config(name).warnings]
    warnings = list(dict.fromkeys(settings))
    if len(codes) > 1:
        warnings.append(f"the rows are of {len(codes)} versions of the code: {', '.join(codes)}")
    if errors:
        warnings.append(f"{sum(errors.values())} of {len(rows)} runs failed")
    found: dict[str, Any] = {
        "name": definition.name,
        "description": definition.description,
        "kind": "bench" if bench else "chapter" if definition.chapter else "logs",
        "runs": definition.runs,
        "seed": definition.seed,
        "noise_scales": list(definition.noise_scales),
        "variants": {name: list(value) for name, value in definition.variants.items()},
        "settings": list(definition.settings),
        "rows": len(rows),
        "seconds": round(sum(row.get("seconds", 0.0) for row in rows), 1),
        "code": codes,
        "diverged_if": _diverged_if(definition),
        "errors": dict(sorted(errors.items())),
        "warnings": warnings,
    }
    if bench:
        return {**found, **_bench(definition, groups)}
    if definition.chapter:
        return {**found, "chapter": summarise_chapter(rows)}
    limit = definition.logs.diverged_m if definition.logs else 0.0
    return {**found, "table": [_log_row(key, group, limit) for key, group in groups.items()]}


def _diverged_if(definition: Definition) -> str:
    if definition.chapter:
        return "not judged"
    if definition.logs:
        return f"the final trajectory is more than {definition.logs.diverged_m:g} m off somewhere"
    return (
        f"final joint NEES above the chi-square quantile of 1 - {DIVERGED_TAIL:g}, or root mean "
        f"square position error over the run above {DIVERGED_RATIO:g} times the Cramér-Rao bound"
    )


# ---------------------------------------------------------------- on the bench


def _bench(definition: Definition, groups: Mapping[tuple[Any, ...], list[Row]]) -> dict[str, Any]:
    table, curves = [], {}
    reference = list(definition.variants)[-1]
    for scale in definition.noise_scales:
        assert definition.bench is not None  # narrows the type
        rng = np.random.default_rng(np.random.SeedSequence(definition.seed))
        bound = cramer_rao_bound(definition.bench, scale, rng)
        over_time: dict[str, Any] = {"bound": _bound_curves(bound), "variants": {}}
        ends = {row["run"]: row for row in groups["", "", scale, reference] if not row["error"]}
        for variant in definition.variants:
            group = groups["", "", scale, variant]
            good = [row for row in group if not row["error"]]
            line: dict[str, Any] = {"variant": variant, "scale": scale, "runs": len(group)}
            line["failed"] = len(group) - len(good)
            if good:
                line |= _bench_row(good, bound, len(definition.noise_scales))
                line["from_reference_m"] = _distance(good, ends)
                over_time["variants"][variant] = _curves(good)
            table.append(line)
        robots = len(definition.bench.robots)
        n = 3 * robots * definition.runs
        over_time["nees_bounds"] = _quantiles(n, BAND)
        curves[f"{scale:g}"] = over_time
    return {"reference": reference, "level": LEVEL, "table": table, "curves": curves}


def _bench_row(rows: Sequence[Row], bound: Bound, scales: int) -> dict[str, Any]:
    dof = int(rows[0]["dof"])
    nees = _array(rows, _at("nees"))
    finite = nees[np.isfinite(nees)]
    # Bonferroni: all scales together leave the bounds with 1 - LEVEL
    low, high = (
        _quantiles(dof * len(finite), 1 - (1 - LEVEL) / scales) if len(finite) else (0.0, 0.0)
    )
    mean = float(finite.mean() / dof) if len(finite) else None
    position = _array(rows, _at("final", "position_m2"))
    limit = DIVERGED_RATIO**2 * float(bound.final.position_m2.mean())
    lost = ~(nees <= chi2.isf(DIVERGED_TAIL, dof)) | ~(position <= limit)
    verdict = None if mean is None else _verdict(mean, low, high)
    messages = {
        kind: {name: float(_array(rows, _at(kind, name)).mean()) for name in rows[0][kind]}
        for kind in ("exchanged", "ties")
        if kind in rows[0]
    }
    return {
        **messages,
        "error_frame": rows[0]["error_frame"],
        "dof": dof,
        "nees_per_dof": mean,
        "nees_bounds": [low, high],
        "nees_verdict": verdict,
        "nees_undefined": len(nees) - len(finite),
        "diverged": int(lost.sum()),
        "diverged_interval": _share_interval(int(lost.sum()), len(rows)),
        "final": _against(rows, "final", asdict(bound.final)),
        "causal": _against(rows, "causal", asdict(bound.causal)),
        "landmarks": {
            name: _ratio(_array(rows, _at("landmarks", name)), value)
            for name, value in bound.landmarks.items()
        },
    }


def _verdict(value: float, low: float, high: float) -> str:
    return "below" if value < low else "above" if value > high else "inside"


def _against(rows: Sequence[Row], kind: str, bound: Mapping[str, Array]) -> dict[str, Any]:
    """Root mean squares over all runs and times, and their ratio to the bound."""
    return {
        name: _ratio(_array(rows, _at(kind, name)), float(value.mean()))
        for name, value in bound.items()
    }


def _ratio(squares: Array, bound: float) -> dict[str, float]:
    """Root mean square of runs (n,), root of the bound, and their ratio with its standard error."""
    mean = float(squares.mean())
    error = float(squares.std(ddof=1) / np.sqrt(len(squares))) if len(squares) > 1 else 0.0
    ratio = float(np.sqrt(mean / bound))
    return {
        "rmse": float(np.sqrt(mean)),
        "bound": float(np.sqrt(bound)),
        "over_bound": ratio,
        "over_bound_sigma": ratio * error / (2 * mean) if mean else 0.0,
    }


def _distance(rows: Sequence[Row], reference: Mapping[int, Row]) -> float | None:
    """Root mean square distance of the last positions from those of the reference, same runs."""
    pairs = [(row["end"], reference[row["run"]]["end"]) for row in rows if row["run"] in reference]
    if not pairs:
        return None
    ends = np.array(pairs, dtype=float)[..., :2]
    return float(np.sqrt(np.square(ends[:, 0] - ends[:, 1]).sum(axis=-1).mean()))


def _curves(rows: Sequence[Row]) -> dict[str, Any]:
    """Mean and band over the runs, at each step."""
    nees = np.array([row["causal"]["nees"] for row in rows], dtype=float)
    dof = 3 * len(rows[0]["end"])
    found = {"nees_per_dof": _band(nees / dof, root=False)}
    for kind in ("causal", "final"):
        for name, unit in (("position_m2", "position_m"), ("heading_rad2", "heading_rad")):
            squares = np.array([row[kind][name] for row in rows], dtype=float)
            found[f"{kind}_{unit}"] = _band(squares, root=True)
    return found


def _band(values: Array, *, root: bool) -> dict[str, Any]:
    """Mean of runs (n, K) with its normal confidence band; of squares the root of all three."""
    mean = np.nanmean(values, axis=0)
    n = np.isfinite(values).sum(axis=0)
    error = np.nanstd(values, axis=0) / np.sqrt(np.maximum(n - 1, 1))
    wide = norm.ppf(0.5 + BAND / 2) * error
    three = (mean, mean - wide, mean + wide)
    if root:
        three = tuple(np.sqrt(np.maximum(v, 0.0)) for v in three)
    return dict(zip(("mean", "low", "high"), (v.tolist() for v in three), strict=True))


def _bound_curves(bound: Bound) -> dict[str, Any]:
    return {
        f"{kind}_{name}": np.sqrt(values).tolist()
        for kind, curves in (("causal", bound.causal), ("final", bound.final))
        for name, values in (
            ("position_m", curves.position_m2),
            ("heading_rad", curves.heading_rad2),
        )
    }


# ---------------------------------------------------------------- over logs


def _log_row(key: tuple[Any, ...], rows: Sequence[Row], diverged_m: float) -> dict[str, Any]:
    scenario, front_end, scale, variant = key
    good = [row for row in rows if not row["error"]]
    found: dict[str, Any] = {
        "scenario": scenario,
        "front_end": front_end,
        "scale": scale,
        "variant": variant,
        "runs": len(rows),
        "failed": len(rows) - len(good),
    }
    if not good:
        return found
    lost = sum(row["joint"]["final"]["max_m"] > diverged_m for row in good)
    found |= {"diverged": lost, "diverged_interval": _share_interval(lost, len(good))}
    for kind in ("final", "causal"):
        found[kind] = {
            name: _spread(_array(good, _at("joint", kind, name)))
            for name in ("ate_rmse_m", "heading_rmse_rad", "max_m", "nees_per_dof", "coverage")
        }
    marks = [row for row in good if row.get("landmarks")]
    if marks:
        found["landmarks"] = {
            name: _spread(_array(marks, _at("landmarks", name)))
            for name in ("rmse_m", "nees_per_dof", "coverage", "matched", "missed", "extra")
        }
    return found


def _spread(values: Array) -> dict[str, Any]:
    """Mean, standard deviation, median and maximum over runs; undefined values are left out.

    Also the ``interval`` of the mean, see `bootstrap_interval`.
    """
    values = values[np.isfinite(values)]
    if not len(values):
        return dict.fromkeys(("mean", "std", "median", "max", "interval"))
    std = float(values.std(ddof=1)) if len(values) > 1 else None
    return {
        "mean": float(values.mean()),
        "std": std,
        "median": float(np.median(values)),
        "max": float(values.max()),
        "interval": bootstrap_interval(values),
    }


# ---------------------------------------------------------------- statistics


def _at(*keys: str) -> Callable[[Any], Any]:
    """A function that finds a number of a row by its keys; of a list the mean."""

    def value(row: Any) -> Any:
        for key in keys:
            row = row[key]
        return np.mean(row) if isinstance(row, list) else row

    return value


def _array(rows: Sequence[Row], value: Callable[[Any], Any]) -> Array:
    """A number (n,) of each row; NaN for null."""
    return np.array([value(row) for row in rows], dtype=float)


def _quantiles(dof: int, level: float) -> tuple[float, float]:
    """Two-sided bounds of a mean NEES per degree of freedom, ``dof`` of them altogether."""
    tail = (1 - level) / 2
    return float(chi2.ppf(tail, dof) / dof), float(chi2.isf(tail, dof) / dof)


def bootstrap_interval(values: Array) -> tuple[float, float]:
    """Interval of the mean of runs (n,) at `BAND`: percentiles of the means of drawn samples.

    Poses of one run share their errors, so that their number says nothing; runs are independent.

    Source: B. Efron, Bootstrap methods: another look at the jackknife, Annals of Statistics 7,
    1979, DOI 10.1214/aos/1176344552.
    """
    rng = np.random.default_rng(0)
    means = rng.choice(values, (RESAMPLES, len(values))).mean(axis=1)
    low, high = np.quantile(means, [0.5 - BAND / 2, 0.5 + BAND / 2])
    return float(low), float(high)


def _share_interval(hits: int, n: int) -> tuple[float, float]:
    """Wilson's interval of a share at `BAND`.

    Source: E. B. Wilson, Probable inference, the law of succession, and statistical inference,
    JASA 22, 1927, DOI 10.1080/01621459.1927.10502953.
    """
    z2 = float(norm.ppf(0.5 + BAND / 2)) ** 2
    share = hits / n
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = np.sqrt(z2 * (share * (1 - share) / n + z2 / (4 * n * n))) / (1 + z2 / n)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))
