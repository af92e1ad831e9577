"""Names that a package offers and imports only when they are used: packages import at once."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_exports(package: str, names: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """A ``__getattr__`` for the module of a package.

    Args:
        package: its name.
        names: module in the package -> names defined there.
    """
    modules = {name: module for module, some in names.items() for name in some}

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{modules[name]}"), name)

    return find
