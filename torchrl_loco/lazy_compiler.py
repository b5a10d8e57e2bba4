"""torch's compiler, imported when somebody compiles: tensordict asks for it at its import, which takes two seconds.

tensordict and TorchRL only mark functions for it. The marks are noted, and made as soon as the compiler is imported.
"""

import functools
import importlib
import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

COMPILER = "torch._dynamo"
MARKS = "allow_in_graph", "assume_constant_result"
"""Functions of the compiler that note something of a function, and return it."""

_marked: list[tuple[str, Callable[..., Any]]] = []
_own: dict[str, Callable[..., Any]] = {}
"""Functions of ``torch.compiler`` that ours stand for."""


def put_off() -> None:
    """Lets what is imported from here on mark functions without importing the compiler."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    """Sees when tensordict is about to be imported, and when the compiler is."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Returns the module's spec if it is the compiler, and leaves all else to others."""
        if name == "tensordict" and COMPILER not in sys.modules and not _own:
            _stand_in()
        if name != COMPILER or not _own or (spec := PathFinder.find_spec(name, path, target)) is None:
            return None
        loader: Any = spec.loader
        execute = loader.exec_module

        def exec_module(module: ModuleType) -> None:
            vars(sys.modules["torch.compiler"]).update(_own)
            execute(module)
            for mark, function in _marked:
                getattr(module, mark)(function)
            _marked.clear()

        loader.exec_module = exec_module
        return spec


def _stand_in() -> None:
    """Replaces what torch offers for marking, until the compiler is imported."""
    torch: Any = importlib.import_module("torch")
    ours: dict[str, Callable[..., Any]] = {mark: functools.partial(_mark, mark) for mark in MARKS}

    def disable(function: Any = None, recursive: bool = True, **_: Any) -> Any:  # as torch's own functions are
        if function is None:
            return functools.partial(torch._disable_dynamo, recursive=recursive)
        return torch._disable_dynamo(function, recursive)

    ours["disable"] = disable
    _own.update({name: getattr(torch.compiler, name) for name in ours})
    vars(torch.compiler).update(ours)
    torch._dynamo = _Stub(COMPILER)  # which the import of the compiler replaces


def _mark(mark: str, function: Any) -> Any:
    _marked.append((mark, function))
    return function


class _Stub(ModuleType):
    """The compiler as torch's attribute: it is imported when more than a mark is asked of it."""

    def __getattr__(self, name: str) -> Any:
        if name in MARKS:
            return functools.partial(_mark, name)
        return getattr(importlib.import_module(COMPILER), name)
