"""The numbers of a world as nodes of a graph, and the C++ of operators on them."""

from dataclasses import dataclass, field
from typing import Any

import torch

TYPES = {torch.float32: "float", torch.int64: "long long", torch.int32: "int", torch.bool: "bool"}
MOST_NUMBERS = 100_000  # numbers of a tensor, or of a part, that are still worth writing out one by one

ADD, SUB, MUL, NEG, SHL = "{0} + {1}", "{0} - {1}", "{0} * {1}", "-{0}", "{0} << {1}"
WRAPPING = (ADD, SUB, MUL, NEG, SHL)  # operators that wrap around for integers: C++ defines that for unsigned ones only
WHERE = "{0} ? {1} : {2}"
LEAST, MOST = "{0} < {1} || {0} != {0} ? {0} : {1}", "{0} > {1} || {0} != {0} ? {0} : {1}"  # NaN wins, as in torch
OF_INTEGERS = {LEAST: "{0} < {1} ? {0} : {1}", MOST: "{0} > {1} ? {0} : {1}"}


class CannotFuse(Exception):  # noqa: N818
    """A graph that is no straight-line code of each world; the message tells which operator or shape.

    ``operator`` is the name of its node in the graph, if it is one.
    """

    def __init__(self, message: str, operator: str | None = None) -> None:
        super().__init__(message)
        self.operator = operator


@dataclass(slots=True, eq=False)
class Node:
    """A number of a world."""

    text: str  # C++ of it, in which {0} is its first part; of a constant, a literal
    dtype: torch.dtype
    args: tuple["Node", ...]  # its parts
    number: Any  # value of a constant
    place: Any
    """Of what is read from memory, the index of the tensor, and how many elements the world's begins later than that of
    the first (``None`` where the world looks it up), and how many each world's later than that of the last."""
    varies: bool = field(init=False)  # whether it may differ from world to world

    def __post_init__(self) -> None:
        self.varies = any(arg.varies for arg in self.args) or bool(self.place and self.place[2])
