"""Constants and tables of a model as C++: functions of ``struct Model``, which lanes read."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from torchrl_loco.sim.compiled.ir.parameters import Number, constant, evaluate, varies
from torchrl_loco.sim.compiled.ir.symbols import Block, Scalar, leaves, literal, scalar
from torchrl_loco.sim.varied import Varied


class Row:
    """What the lanes read of a world's model: its numbers that vary, then what follows from them.

    Attributes:
        derived: what follows, at the places from ``numbers`` on.
    """

    def __init__(self, numbers: int) -> None:
        self.numbers = numbers
        self.derived: list[Scalar] = []
        self._blocks: dict[tuple[Scalar, ...], int] = {}

    def place(self, *values: Number) -> int:
        """Returns where numbers of the model are one after the other, or what is made of such numbers."""
        nodes = tuple(map(scalar, values))
        start = nodes[0].args[1] if nodes[0].op == "number" else 0
        if all(x.op == "number" and x.args[1] == start + k for k, x in enumerate(nodes)):
            return start
        if nodes not in self._blocks:
            self._blocks[nodes] = self.numbers + len(self.derived)
            self.derived += nodes
        return self._blocks[nodes]

    def nominal(self, varied: Varied) -> np.ndarray:
        """Returns the row of the model itself."""
        numbers = varied.nominal()
        return np.concatenate([numbers, [evaluate(x, numbers) for x in self.derived]])

    def derive(self) -> str:
        """Returns C++ that sets what follows from the numbers of a ``row``."""
        block = Block()
        for x in sorted(leaves(self.derived, "number"), key=lambda x: x.args[1]):
            block(f"const float {x.args[0]} = row[{x.args[1]}];")
        for place, x in enumerate(self.derived, self.numbers):
            if varies(x):  # constants are there from the start
                block.set(f"row[{place}]", x)
        return block.text()


class Tables:
    """The members of struct ``Model``, and of ``Varied``, whose functions read the row of a world.

    Attributes:
        lines: the members of ``Model``.
        row: what the functions of ``Varied`` read.
    """

    COMPONENTS: ClassVar = {"Vec": 3, "Quat": 4, "Symmetric": 6, "Mat": 9, "Softness": 9}

    def __init__(self, numbers: int = 0) -> None:
        self.lines: list[str] = []
        self.row = Row(numbers)
        self._varied: dict[str, str] = {}

    def size(self, **values: int) -> None:
        """Adds integer constants."""
        self.lines += [f"  enum {{ {name} = {int(value)} }};" for name, value in values.items()]

    def constant(self, **values: float) -> None:
        """Adds functions that return a number."""
        for name, value in values.items():
            self.function("float", name, [f"return {literal(value)};"], parameter="")

    def floats(self, name: str, values: Sequence[Number] | np.ndarray) -> None:
        """Adds a function from an index to a number."""
        if any(map(varies, values)):
            self._read("float", name, list(values))
            return
        statements, result = column([literal(constant(x)) for x in values], "float", "table")
        self.function("float", name, [*statements, f"return {result};"])

    def integers(self, name: str, values: Sequence[int] | np.ndarray, type_: str = "int") -> None:
        """Adds a function from an index to an integer."""
        values = [int(x) for x in values]
        stored = type_
        if type_ == "int" and all(-128 <= x < 128 for x in values):
            stored = "signed char"
        elif type_ == "int":
            stored = "short"
        suffix = {"unsigned": "u", "unsigned long long": "ull"}.get(type_, "")
        statements, result = column([f"{x}{suffix}" for x in values], stored, "table")
        self.function(type_, name, [*statements, f"return {result};"])

    def structs(self, type_: str, name: str, values: Sequence[ArrayLike] | np.ndarray) -> None:
        """Adds a function from an index to a struct of numbers."""
        count = self.COMPONENTS[type_]
        flat = [x for row in values for x in np.ravel(np.asarray(row))]
        if any(map(varies, flat)):
            self._read(type_, name, flat)
            return
        rows = [[literal(x) for x in row] for row in np.reshape([constant(x) for x in flat], (-1, count))]
        if type_ == "Softness":  # member by member, since constraints often share all but one
            columns = [column([row[k] for row in rows], "float", f"table{k}") for k in range(count)]
            statements, parts = [s for c in columns for s in c[0]], [c[1] for c in columns]
        elif all(row == rows[0] for row in rows):
            statements, parts = [], rows[0] if rows else ["0.0f"] * count
        else:
            statements = [f"static const float table[] = {{{', '.join(x for row in rows for x in row)}}};"]
            parts = [f"table[{count} * i + {k}]" for k in range(count)]
        if type_ == "Mat":
            parts = [f"{{{', '.join(parts[k : k + 3])}}}" for k in (0, 3, 6)]
        self.function(type_, name, [*statements, f"return {{{', '.join(parts)}}};"])

    def formula(self, name: str, x: Scalar, **parts: str) -> None:
        """Adds a function from an index ``i`` to what is made of other functions of it, ``parts`` by their names."""
        block = Block()
        for part, call in parts.items():
            block(f"const float {part} = {call};")
        result = f"return {block.value(x)};"
        self._varied[name] = f"  INLINE float {name}(int i) const {{ {' '.join([*block.lines, result])} }}"

    def function(self, type_: str, name: str, statements: list[str], parameter: str = "int i") -> None:
        """Adds a function of some statements."""
        head, body = f"  static INLINE {type_} {name}({parameter}) {{", " ".join(statements)
        if len(head) + len(body) + 3 <= 120:
            self.lines.append(f"{head} {body} }}")
        else:
            self.lines += [head, *(f"    {s}" for s in statements), "  }"]

    def _read(self, type_: str, name: str, values: list[Number]) -> None:
        """Adds a function that reads the row of a world."""
        count = self.COMPONENTS.get(type_, 1)
        changing = [k // count for k, x in enumerate(values) if varies(x)]
        inside = values[count * changing[0] : count * (changing[-1] + 1)]
        if count == 1 and 2 * len(set(map(scalar, inside))) < len(inside):  # most are the same
            statements, place = column([str(self.row.place(x)) for x in values], "short", "places")
            at = f"row.data + ({place})"
        else:
            statements, at = self._side_by_side(values, count, changing[0], changing[-1])
        parts = ", ".join(f"at[{k}]" for k in range(count))
        statements += [f"const Row at = {{{at}}};", f"return {parts if type_ == 'float' else f'{{{parts}}}'};"]
        self._varied[name] = f"  INLINE {type_} {name}(int i) const {{ {' '.join(statements)} }}"

    def _side_by_side(self, values: list[Number], count: int, first: int, last: int) -> tuple[list[str], str]:
        """Returns statements, and a pointer to element ``i``: in the row, where lanes read neighbours together.

        Constants before the first and after the last element that varies are those of all worlds, which stay nearer.
        """
        inside, outside = values[count * first : count * (last + 1)], values[: count * first]
        outside = [*outside, *values[count * (last + 1) :]]
        start = self.row.place(*inside)
        place = f"{start - count * first} + {count} * i" if last > first else f"{start}"
        if not outside:
            return [], f"row.data + {place}"
        within = " && ".join([f"i >= {first}"] * (first > 0) + [f"i <= {last}"] * (count * (last + 1) < len(values)))
        if count == 1 and len(set(map(scalar, outside))) == 1:
            return [], f"row.data + ({within} ? {place} : {self.row.place(outside[0])})"
        rest = [literal(0 if varies(x) else constant(x)) for x in values]
        table = f"static const float table[] = {{{', '.join(rest)}}};"
        return [table], f"{within} ? row.data + {place} : table + {count} * i"

    def text(self) -> str:
        """Returns struct ``Model``."""
        return "\n".join(["struct Model {", *self.lines, "};"])

    def varied_text(self) -> str:
        """Returns struct ``Varied``."""
        return "\n".join(["struct Varied {", "  const Row row;", *self._varied.values(), "};"])

    def use(self, text: str) -> str:
        """Returns C++ whose calls of functions that vary are those of an object ``varied``."""
        for name in self._varied:
            text = text.replace(f"Model::{name}(", f"varied.{name}(")
        return text


def column(values: list[str], type_: str, table: str) -> tuple[list[str], str]:
    """Returns statements, and an expression for the value at index ``i``: a constant if possible, else from a table."""
    distinct = [v for k, v in enumerate(values) if k == 0 or v != values[k - 1]]
    if len(distinct) <= 1:
        return [], distinct[0] if distinct else "0"
    if len(distinct) == 2:
        return [], f"i < {values.index(distinct[1])} ? {distinct[0]} : {distinct[1]}"
    return [f"static const {type_} {table}[] = {{{', '.join(values)}}};"], f"{table}[i]"
