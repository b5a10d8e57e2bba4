"""Checks of what a body's methods return: a function of a world and its inputs."""

from typing import Any

import numpy as np
import warp as wp

BEHIND = 4096
"""Numbers behind a row in which a write beyond its end is noticed."""


def pair_of(method: str, returned: Any) -> tuple[Any, Any]:
    """Returns what a method of a body returned, a function and its inputs.

    Raises:
        TypeError: it is something else.
    """
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise TypeError(f"{method} must return a wp.func and its inputs, got {returned!r}")
    return returned


def struct_of(method: str, func: Any, inputs: Any) -> Any:
    """Returns the struct of the inputs that a method of a body returned with a function.

    Raises:
        TypeError: they are not what the method must return.
    """
    if not isinstance(func, wp.Function):
        raise TypeError(f"{method} must return a wp.func and its inputs, got {func!r} as the function")
    if not hasattr(inputs, "_cls"):
        raise TypeError(f"the inputs of {func.key} must be an instance of a wp.struct, got {inputs!r}")
    return inputs._cls


def check_rows(func: wp.Function, inputs: Any, size: int, terms: int, device: wp.Device) -> None:
    """Checks that a body's function writes the rows of observation and terms: every number, and nothing behind them.

    It runs once, in memory of its own: a write behind a row would change the data of another world, or crash.

    Args:
        func: the body's function.
        inputs: its inputs.
        size: length of an observation.
        terms: number of the terms.
        device: where the inputs are.

    Raises:
        TypeError: the function has other parameters than it must, or the inputs are no instance of a struct.
        ValueError: the function writes too much or too little; the message says which numbers.
    """
    struct = struct_of("observation_func", func, inputs)
    if len(func.input_types) != 4:
        raise TypeError(
            f"{func.key} must take the index of the world, the inputs, the row of the observation and that of the "
            f"terms, got the parameters {', '.join(func.input_types)}"
        )
    kernel = _writer(func, struct)
    rows = {"observation_size": size, "the number of term_names": terms}
    unwritten = []  # of each row, by what it held before
    for before in (-1.5e30, 2.5e30):
        whole = [wp.full(length + BEHIND, before, dtype=float, device=device) for length in rows.values()]
        parts = [memory[:length] for memory, length in zip(whole, rows.values(), strict=True)]
        wp.launch(kernel, 1, [inputs, *parts, wp.zeros(1, dtype=float, device=device)], device=device)
        same = [memory.numpy() == np.float32(before) for memory in whole]
        for (name, length), untouched in zip(rows.items(), same, strict=True):
            if not untouched[length:].all():
                most = int(np.flatnonzero(~untouched)[-1]) + 1
                raise ValueError(f"{name} is {length}, but {func.key} writes {most} numbers")
        unwritten.append([set(np.flatnonzero(part[:length])) for part, length in zip(same, rows.values(), strict=True)])
    for (name, length), first, second in zip(rows.items(), *unwritten, strict=True):
        if left := sorted(int(index) for index in first & second):
            raise ValueError(f"{name} is {length}, but {func.key} does not write the numbers {left}")


def _writer(observe: wp.Function, Inputs: Any) -> wp.Kernel:  # noqa: N803
    @wp.kernel(enable_backward=False, module="unique")
    def write_rows_once(inputs: Inputs, observation: wp.array[float], terms: wp.array[float], reward: wp.array[float]):
        reward[0] = observe(0, inputs, observation, terms)

    return write_rows_once
