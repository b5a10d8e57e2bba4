"""Packages that import their public names when one is asked for: torch and Warp take seconds, and not all need them."""

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any


def lazy(package: str, names: list[str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Returns ``__getattr__`` and ``__dir__`` of a package.

    Args:
        package: its full name.
        names: what its module ``_api`` holds. The modules of the package are found besides, each imported alone.
    """

    def find(name: str) -> Any:
        if name in names:
            return getattr(importlib.import_module(f"{package}._api"), name)
        if importlib.util.find_spec(f"{package}.{name}") is not None:
            return importlib.import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def listed() -> list[str]:
        return sorted({*vars(importlib.import_module(package)), *names})

    return find, listed
