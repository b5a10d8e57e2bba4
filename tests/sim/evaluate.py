"""Values of the scalars that the compiled step is made of, without compiling them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from torchrl_loco.sim.compiled.ir.symbols import Scalar, scalar

FUNCTIONS: dict[str, Callable[..., float]] = {
    "Math::root": np.sqrt,
    "Math::smaller": min,
    "Math::larger": max,
    "fabsf": abs,
    "Math::raised": pow,
}
COMPARISONS: dict[str, Callable[[float, float], bool]] = {"<": lambda a, b: a < b, "<=": lambda a, b: a <= b}


def evaluate(x: Any, values: dict[str, float]) -> np.ndarray:
    """Returns the value of scalars in float64.

    Args:
        x: a scalar, or nested sequences of scalars.
        values: the value of each name.
    """
    known: dict[Scalar, float] = {}

    def visit(root: Scalar) -> float:
        stack = [root]
        while stack:
            node = stack[-1]
            parts = [arg for arg in node.args if isinstance(arg, Scalar)]
            waiting = [part for part in parts if part not in known]
            if waiting:
                stack += waiting
                continue
            stack.pop()
            a = [known[part] for part in parts]
            match node.op:
                case "const":
                    known[node] = node.args[0]
                case "name" | "cell":
                    known[node] = values[node.args[0]]
                case "neg":
                    known[node] = -a[0]
                case "+":
                    known[node] = a[0] + a[1]
                case "-":
                    known[node] = a[0] - a[1]
                case "*":
                    known[node] = a[0] * a[1]
                case "/":
                    known[node] = a[0] / a[1]
                case "sin":
                    known[node] = np.sin(a[0])
                case "cos":
                    known[node] = np.cos(known[node.args[0].args[0]])  # of the angle whose sine is its argument
                case "call":
                    known[node] = FUNCTIONS[node.args[0]](*a)
                case "select":
                    known[node] = a[2] if COMPARISONS[node.args[0]](a[0], a[1]) else a[3]
        return known[root]

    return np.vectorize(lambda s: visit(scalar(s)), otypes=[float])(np.array(x, dtype=object))
