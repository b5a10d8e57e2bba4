"""Constants and tables of a model as C++: functions of ``struct Model``, which ``lanes.h`` reads."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from torchrl_loco.sim.compiled.symbols import literal


class Tables:
    """The members of struct ``Model``."""

    COMPONENTS: ClassVar = {"Vec": 3, "Quat": 4, "Symmetric": 6, "Mat": 9, "Softness": 9}

    def __init__(self) -> None:
        self.lines: list[str] = []

    def size(self, **values: int) -> None:
        """Adds integer constants."""
        self.lines += [f"  enum {{ {name} = {int(value)} }};" for name, value in values.items()]

    def constant(self, **values: float) -> None:
        """Adds functions that return a number."""
        for name, value in values.items():
            self._function("float", name, [f"return {literal(value)};"], parameter="")

    def vector(self, name: str, value: ArrayLike) -> None:
        """Adds a function that returns a vector."""
        self._function("Vec", name, [f"return {{{', '.join(map(literal, np.asarray(value, float)))}}};"], parameter="")

    def procedure(self, name: str, parameter: str, statements: list[str]) -> None:
        """Adds a function that returns nothing."""
        self._function("void", name, statements, parameter)

    def floats(self, name: str, values: Sequence[float] | np.ndarray) -> None:
        """Adds a function from an index to a number."""
        statements, result = column([literal(x) for x in values], "float", "table")
        self._function("float", name, [*statements, f"return {result};"])

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
        self._function(type_, name, [*statements, f"return {result};"])

    def structs(self, type_: str, name: str, values: Sequence[ArrayLike] | np.ndarray) -> None:
        """Adds a function from an index to a struct of numbers."""
        count = self.COMPONENTS[type_]
        rows = [[literal(x) for x in row] for row in np.asarray(values, float).reshape(-1, count)]
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
        self._function(type_, name, [*statements, f"return {{{', '.join(parts)}}};"])

    def _function(self, type_: str, name: str, statements: list[str], parameter: str = "int i") -> None:
        head, body = f"  static INLINE {type_} {name}({parameter}) {{", " ".join(statements)
        if len(head) + len(body) + 3 <= 120:
            self.lines.append(f"{head} {body} }}")
        else:
            self.lines += [head, *(f"    {s}" for s in statements), "  }"]

    def text(self) -> str:
        """Returns the struct."""
        return "\n".join(["struct Model {", *self.lines, "};"])


def column(values: list[str], type_: str, table: str) -> tuple[list[str], str]:
    """Returns statements, and an expression for the value at index ``i``: a constant if possible, else from a table."""
    distinct = [v for k, v in enumerate(values) if k == 0 or v != values[k - 1]]
    if len(distinct) <= 1:
        return [], distinct[0] if distinct else "0"
    if len(distinct) == 2:
        return [], f"i < {values.index(distinct[1])} ? {distinct[0]} : {distinct[1]}"
    return [f"static const {type_} {table}[] = {{{', '.join(values)}}};"], f"{table}[i]"
