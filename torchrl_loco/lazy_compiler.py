"""torch's compiler, imported when somebody compiles: tensordict asks for it at its import, which takes two seconds.

tensordict and TorchRL only mark functions for it. The marks are noted, and made as soon as the compiler is imported.
torch asks the compiler's symbolic shapes about plain numbers too, for gradients and for layers without initial weights.
Their import takes seconds again, as it imports sympy: a stand-in answers until somebody asks for more.

torch's own import of it is not safe in two threads at once: a program whose threads compile, or make optimizers of
torch, imports ``torch._dynamo`` before it starts them.
"""

import functools
import importlib
import operator
import sys
import threading
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import FunctionType, ModuleType
from typing import Any

COMPILER = "torch._dynamo"
MARKS = "allow_in_graph", "assume_constant_result"
"""Functions of the compiler that note something of a function, and return it."""

SHAPES = "torch.fx.experimental.symbolic_shapes"
_THE_NUMBER = (
    *("expect_true", "guard_bool", "guard_int", "guard_or_false", "guard_or_true", "guard_size_oblivious"),
    *("guarding_hint_or_throw", "size_hint", "statically_known_true"),
)
_PLAIN: dict[str, Callable[..., Any]] = {
    **dict.fromkeys(_THE_NUMBER, lambda number, *_: number),
    **dict.fromkeys(("has_guarding_hint", "has_hint"), lambda number: True),
    "is_nested_int": lambda number: False,
    "sym_and": lambda *known: functools.reduce(operator.and_, known),
    "sym_or": lambda *known: functools.reduce(operator.or_, known),
    "sym_eq": lambda one, other: tuple(one) == tuple(other) if isinstance(one, tuple | list) else one == other,
}
"""What functions of symbolic shapes return for plain numbers and sizes, as torch 2.11 to 2.13 asks for them."""

_marked: list[tuple[str, Callable[..., Any]]] = []
_own: dict[str, Callable[..., Any]] = {}  # functions of torch.compiler that ours stand for
_is_imported = False
_shapes_wait = True
_one_at_a_time = threading.Lock()  # else a second thread could remove what the first imports


def put_off() -> None:
    """Lets what is imported from here on mark functions without importing the compiler."""
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    """Sees when tensordict is about to be imported, and when the compiler or its symbolic shapes are."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Returns the spec of the compiler, or of what stands in for its shapes, and leaves all else to others."""
        if name == SHAPES and _shapes_wait and target is None:  # a target is a module that is reloaded
            return ModuleSpec(name, _LoaderOfShapes())
        if name == "tensordict" and COMPILER not in sys.modules and not _own:
            _put_marks_off()
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


def _put_marks_off() -> None:
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


class _LoaderOfShapes(Loader):
    """Loads the stand-in."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Shapes(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


class _Shapes(ModuleType):
    """Stands in for symbolic shapes, which are imported when somebody asks for more than plain numbers need.

    Only functions of torch get its answers: they ask at each call. Other modules may keep a function and compile it.
    """

    def __getattr__(self, name: str) -> Any:
        asks = sys._getframe(1)
        of_torch = asks.f_globals.get("__name__", "").partition(".")[0] == "torch"
        if name in _PLAIN and of_torch and asks.f_code.co_name != "<module>":
            return functools.partial(_answer, name)
        if name.startswith("__") and name != "__all__":  # many look through all modules for such
            raise AttributeError(name)
        return getattr(_symbolic_shapes(), name)


def _answer(name: str, *args: Any, **kwargs: Any) -> Any:
    """Returns what the function that is named so returns; the module itself is asked where a number is symbolic."""
    sizes = [each if isinstance(each, tuple | list) else (each,) for each in args]
    if not kwargs and all(type(number) in (bool, int) for size in sizes for number in size):
        return _PLAIN[name](*args)
    return getattr(_symbolic_shapes(), name)(*args, **kwargs)


def _symbolic_shapes() -> ModuleType:
    """Returns the module itself, in the place of what stood in for it."""
    global _shapes_wait
    with _one_at_a_time:
        _shapes_wait = False
        if isinstance(sys.modules.get(SHAPES), _Shapes):
            del sys.modules[SHAPES]
    return importlib.import_module(SHAPES)
