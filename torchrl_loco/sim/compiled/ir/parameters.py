"""Numbers of a model as the compiled step has them: constants, or read for each world where they vary.

Which rows and axes there are is decided once, on nominal numbers; a number that varies counts as one that is not zero.
"""

import operator
import types
from collections.abc import Callable, Sequence
from typing import Any, TypeGuard

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.ir.symbols import Scalar, maximum
from torchrl_loco.sim.varied import Varied, field, subtree_masses

Number = float | Scalar  # a constant, or what varies
OPERATORS: dict[str, Callable[..., float]] = {
    "neg": operator.neg,
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
}


class VariedModel:
    """Stands in for an ``MjModel``: where numbers vary, its arrays hold scalars that read them for each world.

    Attributes:
        nominal: the model.
        varied: which of its numbers vary.
        opt: its options, likewise.
    """

    def __init__(self, m: mujoco.MjModel, varied: Varied) -> None:
        self.nominal, self.varied = m, varied
        self._arrays: dict[str, np.ndarray] = {}
        for name, places in varied.places.items():
            values = field(m, name).astype(object)
            for place, column in zip(places, range(varied.count)[varied.columns[name]], strict=True):
                values.flat[place] = number(column)
            self._arrays[name] = values
        if "dof_frictionloss" in self._arrays:  # MuJoCo leaves out what is negative
            losses = self._arrays["dof_frictionloss"]
            losses[:] = [maximum(x, 0) if varies(x) else x for x in losses]
        if "body_mass" in self._arrays:
            self._arrays["body_subtreemass"] = self._subtree_masses()
        given = {name: getattr(m.opt, name) for name in dir(m.opt) if not name.startswith("_")}
        self.opt = types.SimpleNamespace(**given | {"gravity": self._arrays.get("gravity", m.opt.gravity)})

    def _subtree_masses(self) -> np.ndarray:
        m = self.nominal
        masses = subtree_masses(m, self._arrays["body_mass"])
        return np.array([x if varies(x) else y for x, y in zip(masses, m.body_subtreemass, strict=True)], dtype=object)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return self._arrays[name] if name in self._arrays else getattr(self.nominal, name)


def number(column: int) -> Scalar:
    """Returns the number at a place in the row of a world, the C++ variable ``number{column}``."""
    return Scalar("number", f"number{column}", column)


def varies(x: Any) -> TypeGuard[Scalar]:
    """Returns whether a number of a model, or what is made of it, varies."""
    return isinstance(x, Scalar) and x.constant is None


def constant(x: Number) -> float:
    """Returns the value of a number that does not vary."""
    return x.args[0] if isinstance(x, Scalar) else float(x)


def present(values: np.ndarray) -> bool:
    """Returns whether any number is not zero, or varies."""
    return any(varies(x) or constant(x) != 0 for x in values.flat)


def positive(values: np.ndarray) -> bool:
    """Returns whether any number is greater than zero, or varies."""
    return any(varies(x) or constant(x) > 0 for x in values.flat)


def largest(a: Number, b: Number) -> Number:
    """Returns the larger of two numbers of a model."""
    return maximum(a, b) if varies(a) or varies(b) else max(constant(a), constant(b))


def nominal(m: Any) -> mujoco.MjModel:
    """Returns a model with all its numbers as constants."""
    return m.nominal if isinstance(m, VariedModel) else m


def evaluate(x: Scalar, row: Sequence[float] | np.ndarray) -> float:
    """Returns the value of an expression of numbers of the model for a row of them."""
    a = [evaluate(arg, row) for arg in x.args if isinstance(arg, Scalar)]
    if x.op in OPERATORS:
        return OPERATORS[x.op](*a)
    match x.op:
        case "const":
            return x.args[0]
        case "number":
            return float(row[x.args[1]])
        case "call" if x.args[0] == "Math::larger":
            return max(a)
        case "select" if x.args[0] == "<=":
            return a[2] if a[0] <= a[1] else a[3]
    raise NotImplementedError(f"{x.op} of numbers of a model: add it here")
