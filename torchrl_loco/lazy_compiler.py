"""torch's compiler, imported when somebody compiles: tensordict asks for it at its import, which takes two seconds.

tensordict and TorchRL only mark functions for it. The marks are noted, and made as soon as the compiler is imported.

torch's own import of it is not safe in two threads at once: a program whose threads compile, or make optimizers of
torch, imports ``torch._dynamo`` before it starts them.
"""

import functools
import importlib
import sys
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import FunctionType, ModuleType
from typing import Any

COMPILER = "torch._dynamo"
MARKS = "allow_in_graph", "assume_constant_result"
"""Functions of the compiler that note something of a function, and return it."""

_marked: list[tuple[str, Callable[..., Any]]] = []
_own: dict[str, Callable[..., Any]] = {}  # functions of torch.compiler that ours stand for
_is_imported = False


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
            global _is_imported
            vars(sys.modules["torch.compiler"]).update(_own)
            execute(module)
            _is_imported = True
            while _marked:
                mark, function = _marked.pop()
                getattr(module, mark)(function)

        loader.exec_module = exec_module
        return spec


def _stand_in() -> None:
    """Replaces what torch offers for marking, until the compiler is imported."""
    torch: Any = importlib.import_module("torch")
    ours = {"disable": disable, **{name: functools.partial(_mark, name) for name in MARKS}}
    _own.update({name: getattr(torch.compiler, name) for name in ours})
    vars(torch.compiler).update(ours)
    torch._dynamo = _Stub(COMPILER)  # which the import of the compiler replaces


def _mark(mark: str, fn: Any) -> Any:
    """Returns what the function of ``torch.compiler`` that is named ``mark`` does, which has its effect later."""
    if _is_imported or not callable(fn):  # several, or an error
        return _own[mark](fn)
    _marked.append((mark, fn))
    return fn


def disable(fn: Any = None, recursive: bool = True, *, reason: str | None = None) -> Any:
    """Returns what ``torch.compiler.disable`` does; a plain function imports the compiler when it is called."""
    if fn is None:
        return functools.partial(disable, recursive=recursive, reason=reason)
    if _is_imported or not isinstance(fn, FunctionType):
        return _own["disable"](fn, recursive, reason=reason)
    return sys.modules["torch"]._disable_dynamo(fn, recursive)


class _Stub(ModuleType):
    """The compiler as torch's attribute: it is imported when more than a mark is asked of it."""

    def __getattr__(self, name: str) -> Any:
        if name in MARKS:
            return functools.partial(_mark, name)
        return getattr(importlib.import_module(COMPILER), name)
