"""Symbolic scalars: arithmetic on them is traced, simplified, and comes out as C++.

The physics is written once, in NumPy on arrays of these scalars. Numbers of the model are constants: zeros vanish,
constants fold, and an expression that occurs twice is computed once, so that a planar body costs planar arithmetic.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np

Vector = Sequence[Any] | np.ndarray

LEAVES = ("const", "name", "cell", "number")  # what has no parts


class Scalar:
    """A node of an expression. Nodes are unique: equal expressions are the same object.

    Args:
        op: "const", "name", "cell", "number", "+", "-", "*", "/", "neg", "call", "select", or "sin" and "cos".
        args: numbers, names or other scalars.
    """

    __slots__ = ("__weakref__", "args", "constant", "op")
    op: str
    args: tuple[Any, ...]
    constant: float | None  # the value of a constant, ``None`` for any other expression

    _unique: ClassVar["WeakValueDictionary[tuple, Scalar]"] = WeakValueDictionary()

    def __new__(cls, op: str, *args: Any) -> "Scalar":
        """Returns the node, a new one if there is none like it."""
        key = (op, *(id(arg) if isinstance(arg, Scalar) else arg for arg in args))
        node = cls._unique.get(key)
        if node is None:
            node = object.__new__(cls)
            node.op, node.args, node.constant = op, args, args[0] if op == "const" else None
            cls._unique[key] = node
        return node

    def __add__(self, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        a, b = self, scalar(other)
        if a.constant is not None and b.constant is not None:
            return _sum(a.constant, b.constant)
        if a.constant == 0:
            return b
        if b.constant == 0:
            return a
        if b.op == "neg":
            return a - b.args[0]
        if a.op == "neg":
            return b - a.args[0]
        return Scalar("+", a, b)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        a, b = self, scalar(other)
        if a.constant is not None and b.constant is not None:
            return _sum(a.constant, -b.constant)
        if b.constant == 0:
            return a
        if a.constant == 0:
            return -b
        if a is b:
            return scalar(0)
        if b.op == "neg":
            return a + b.args[0]
        return Scalar("-", a, b)

    def __rsub__(self, other: Any) -> Any:
        return scalar(other) - self

    def __neg__(self) -> "Scalar":
        if self.constant is not None:
            return scalar(-self.constant)
        if self.op == "neg":
            return self.args[0]
        if self.op == "-":
            return self.args[1] - self.args[0]
        return Scalar("neg", self)

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        a, b = self, scalar(other)
        if a.constant is not None and b.constant is not None:
            return scalar(a.constant * b.constant)
        if b.constant is not None:
            a, b = b, a
        if a.constant == 0:
            return a
        if a.constant == 1:
            return b
        if a.constant == -1:
            return -b
        if a.op == "neg":
            return -(a.args[0] * b)
        if b.op == "neg":
            return -(a * b.args[0])
        if a.constant is not None and a.constant < 0:
            return -(scalar(-a.constant) * b)
        if a.constant is not None and b.op == "*" and b.args[0].constant is not None:
            return scalar(a.constant * b.args[0].constant) * b.args[1]
        return Scalar("*", a, b)

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return NotImplemented
        b = scalar(other)
        if b.constant is not None:
            return self * (1.0 / b.constant)
        return self if self.constant == 0 else Scalar("/", self, b)

    def __rtruediv__(self, other: Any) -> Any:
        return scalar(other) / self

    def __repr__(self) -> str:
        return f"Scalar({self.op!r}, {', '.join(map(repr, self.args))})"


ROUNDING = 1e-14  # what is left of numbers that cancel, relative to them


def scalar(x: Any) -> Scalar:
    """Returns ``x`` as a scalar. Numbers within rounding of an integer become that integer, so that 1 folds.

    That is not so of zero, of which nothing is within rounding: a small number may be all that there is.
    """
    if isinstance(x, Scalar):
        return x
    x = float(x)
    nearest = float(round(x)) if abs(x) < 1e15 else x
    return Scalar("const", nearest if nearest and abs(x - nearest) < ROUNDING else x + 0.0)  # + 0.0: no negative zero


def _sum(a: float, b: float) -> Scalar:
    """Returns the sum of two constants, which is zero where they cancel."""
    return scalar(0 if abs(a + b) < ROUNDING * max(abs(a), abs(b)) else a + b)


def name(text: str) -> Scalar:
    """Returns the scalar of a C++ expression whose value does not change in its scope."""
    return Scalar("name", text)


def names(text: str, count: int) -> list[Scalar]:
    """Returns the elements of a C++ array that does not change in its scope."""
    return [name(f"{text}[{i}]") for i in range(count)]


def vec(text: str) -> np.ndarray:
    """Returns the components of a C++ ``Vec`` that does not change in its scope, ``(3,)``."""
    return np.array([name(f"{text}.{component}") for component in "xyz"], dtype=object)


def cell(text: str) -> Scalar:
    """Returns the scalar of a C++ variable or array element that is assigned more than once."""
    return Scalar("cell", text)


def cells(text: str, count: int) -> list[Scalar]:
    """Returns the elements of a C++ array that is assigned more than once."""
    return [cell(f"{text}[{i}]") for i in range(count)]


def call(function: str, *args: Any) -> Scalar:
    """Returns the result of a C++ function of scalars."""
    return Scalar("call", function, *map(scalar, args))


def sqrt(x: Any) -> Scalar:
    """Returns the square root."""
    x = scalar(x)
    return scalar(np.sqrt(x.constant)) if x.constant is not None else call("Math::root", x)


def minimum(a: Any, b: Any) -> Scalar:
    """Returns the smaller of two scalars."""
    return call("Math::smaller", a, b)


def maximum(a: Any, b: Any) -> Scalar:
    """Returns the larger of two scalars."""
    return call("Math::larger", a, b)


def absolute(x: Any) -> Scalar:
    """Returns the magnitude."""
    return call("fabsf", x)


def sincos(x: Any) -> tuple[Scalar, Scalar]:
    """Returns sine and cosine, which are computed together."""
    x = scalar(x)
    if x.constant is not None:
        return scalar(np.sin(x.constant)), scalar(np.cos(x.constant))
    sine = Scalar("sin", x)
    return sine, Scalar("cos", sine)


def leaves(expressions: Iterable[Scalar], *ops: str) -> set[Scalar]:
    """Returns the leaves of some kinds, of :data:`LEAVES`, that some expressions read."""
    seen, stack = set(), list(expressions)
    while stack:
        node = stack.pop()
        if node not in seen:
            seen.add(node)
            stack += [arg for arg in node.args if isinstance(arg, Scalar)]
    return {node for node in seen if node.op in ops}


def select(left: Any, comparison: str, right: Any, if_true: Any, if_false: Any) -> Scalar:
    """Returns ``if_true`` where ``left comparison right`` holds, such as ``a < b``, else ``if_false``."""
    a, b = scalar(if_true), scalar(if_false)
    return a if a is b else Scalar("select", comparison, scalar(left), scalar(right), a, b)


# Arrays of scalars.

_scalars: Callable[..., np.ndarray] = np.vectorize(scalar, otypes=[object])


def array(x: Any) -> np.ndarray:
    """Returns numbers as an array of scalars, zero where rounding left something else beside the largest of them."""
    numbers = np.asarray(x)
    if numbers.dtype == object and not any(isinstance(number, Scalar) for number in numbers.flat):
        numbers = numbers.astype(float)
    if numbers.dtype != object and numbers.size:
        numbers = np.where(np.abs(numbers) < ROUNDING * np.abs(numbers).max(), 0.0, numbers)
    return _scalars(numbers)


def zeros(*shape: int) -> np.ndarray:
    """Returns an array of zeros."""
    return array(np.zeros(shape))


def identity(n: int) -> np.ndarray:
    """Returns the identity matrix."""
    return array(np.eye(n))


def cross(a: Vector, b: Vector) -> np.ndarray:
    """Returns the cross product."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]], dtype=object)


def dot(a: Iterable, b: Iterable) -> Scalar:
    """Returns the inner product."""
    return total(x * y for x, y in zip(a, b, strict=True))


def total(terms: Iterable) -> Any:
    """Returns the sum of scalars or arrays."""
    return sum(terms, scalar(0))


class Block:
    """C++ statements, and which expressions already have a name in their scope.

    What depends on a cell is computed again in every inner block and after every assignment, since the cell may have
    changed; everything else is computed once. The names of the block around it are visible.
    """

    def __init__(self, outer: "Block | None" = None) -> None:
        self.lines: list[str] = []
        self._names: dict[Scalar, str] = {}
        self._cells: dict[Scalar, frozenset[str]] = outer._cells if outer else {}
        self._readers: dict[str, list[Scalar]] = {}  # named expressions by the cells that they depend on
        self._counter: list[int] = outer._counter if outer else [0]
        if outer:
            self._names = {node: text for node, text in outer._names.items() if not self._cells[node]}

    def __call__(self, text: str) -> None:
        """Appends a statement."""
        self.lines.append(text)

    def value(self, x: Any) -> str:
        """Returns a C++ expression for a scalar, after statements that compute its parts, each once."""
        x = scalar(x)
        stack = [(x, False)]
        while stack:
            node, ready = stack.pop()
            if node in self._names or node.op in LEAVES:
                continue
            parts = [arg for arg in node.args if isinstance(arg, Scalar)]
            if ready:
                self._compute(node, parts)
            else:
                stack += [(node, True), *((part, False) for part in reversed(parts))]
        return self._reference(x)

    def _reference(self, node: Scalar) -> str:
        if node.constant is not None:
            return literal(node.constant)
        return node.args[0] if node.op in LEAVES else self._names[node]

    def _reads(self, node: Scalar) -> frozenset[str]:
        """Returns the variables that a node depends on, of those that are assigned more than once."""
        if node.op in LEAVES:
            return frozenset([node.args[0].split("[")[0]] if node.op == "cell" else [])
        return self._cells[node]

    def _compute(self, node: Scalar, parts: list[Scalar]) -> None:
        self._cells[node] = frozenset().union(*map(self._reads, parts))
        for variable in self._cells[node]:
            self._readers.setdefault(variable, []).append(node)
        a = [self._reference(part) for part in parts]
        if node.op == "cos":  # computed with its sine
            self._names[node] = f"{a[0]}_cos"
            return
        self._counter[0] += 1
        result = self._names[node] = f"t{self._counter[0]}"
        if node.op == "sin":
            self(f"float {result}, {result}_cos; Math::sincos({a[0]}, {result}, {result}_cos);")
            return
        match node.op:
            case "neg":
                text = f"-{a[0]}"
            case "/":
                text = f"Math::divide({a[0]}, {a[1]})"
            case "call":
                text = f"{node.args[0]}({', '.join(a)})"
            case "select":
                text = f"{a[0]} {node.args[0]} {a[1]} ? {a[2]} : {a[3]}"
            case operator:
                text = f"{a[0]} {operator} {a[1]}"
        self(f"const float {result} = {text};")

    def keep(self, x: Any) -> Any:
        """Returns scalars as names of their values now, which inner blocks can use: cells may change, these not."""
        if isinstance(x, np.ndarray):
            return np.array([self.keep(y) for y in x], dtype=object)
        x = scalar(x)
        return x if x.constant is not None else name(self.value(x))

    def set(self, target: str, x: Any, how: str = "=") -> None:
        """Assigns a scalar to a C++ variable; ``how`` may also be ``+=``."""
        if how == "+=" and scalar(x).constant == 0:
            return
        value = self.value(x)
        self(f"{target} {how} {value};")
        for node in self._readers.pop(target.split()[-1].split("[")[0], ()):
            self._names.pop(node, None)

    @contextmanager
    def scope(self, head: str) -> Iterator["Block"]:
        """Yields a block under a head such as ``if (...)`` or ``for (...)``, which is appended at the end."""
        inner = Block(self)
        yield inner
        self(f"{head} {{")
        self.lines += [f"  {line}" for line in inner.lines]
        self("}")
        self._names = {node: text for node, text in self._names.items() if not self._cells[node]}

    @contextmanager
    def function(self, title: str, parameters: str = "") -> Iterator["Block"]:
        """Yields the body of a function that sees what is here, which is appended at the end."""
        with self.scope(f"const auto {title} = [&]({parameters})") as body:
            yield body
        self.lines[-1] = "};"

    @contextmanager
    def loop(self, variable: str, count: int | str) -> Iterator["Block"]:
        """Yields the body of a loop of ``variable`` from 0 to ``count``, which is not unrolled."""
        self("#pragma unroll 1")
        with self.scope(f"for (int {variable} = 0; {variable} < {count}; ++{variable})") as body:
            yield body

    def text(self) -> str:
        """Returns the statements."""
        return "\n".join(self.lines)


def cpp_function(head: str, *results: Any) -> str:
    """Returns a C++ function of names, which returns scalars: one, or the members of a struct in their order."""
    block = Block()
    listed = ", ".join([block.value(x) for x in results])
    value = listed if len(results) == 1 else f"{{{listed}}}"  # Clang warns of a scalar in braces
    return f"{head} {{\n{block.text()}\nreturn {value};\n}}"


LARGEST = float(np.finfo(np.float32).max)


def literal(x: float) -> str:
    """Returns a float32 literal of C++, which has none for infinity: that becomes the largest number."""
    return _literal(x) if x else f"{float(x)}f"  # a cache takes 0.0 and -0.0 for one


@functools.lru_cache(100_000)
def _literal(x: float) -> str:
    number = np.float32(np.clip(x, -LARGEST, LARGEST))
    plain = number == 0 or 1e-4 <= abs(number) < 1e7
    text = np.format_float_positional(number, trim="0") if plain else f"{number:.9g}"
    return f"{text}f" if "." in text or "e" in text else f"{text}.0f"
