"""What the options of `smooth` stand for, as settings."""

from pathlib import Path


def smoothing_settings(
    backend: str | None,
    front_end: str | None,
    start: list[str] | None,
    settings: list[str] | None,
    *,
    causal: bool = False,
    same_place: bool = False,
    prior_map: Path | None = None,
    update: bool = False,
    horizon: float | None = None,
) -> list[str]:
    """What the options of `smooth` stand for, as ``key=value``; those of --set come last."""
    return [
        *([f"backend.name={backend}"] if backend else ()),
        *(["backend.causal=true"] if causal else ()),
        *(["logs.same_place=true"] if same_place else ()),
        *([f"known_map.directory={prior_map}"] if prior_map else ()),
        *(["known_map.update=true"] if update else ()),
        *([] if horizon is None else [f"backend.horizon_s={horizon}"]),
        *([f"front_end.name={front_end}"] if front_end else ()),
        *(start or ()),
        *(settings or ()),
    ]
