"""Checks of what a body's methods return: a function of a world and its inputs."""

from typing import Any

import numpy as np
import warp as wp

AROUND = 4096
"""Numbers before and behind a row in which a write beyond its ends is noticed."""


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


def check_rows(func: wp.Function, inputs: Any, world: int, size: int, terms: int, device: wp.Device) -> None:
    """Checks that a body's function writes the rows of observation and terms: every number, and none beyond.

    A write beyond a row would change the data of another world, or crash. The function runs twice for one world, with
    rows between others that nobody reads. What it writes into its inputs stays.

    Args:
        func: the body's function.
        inputs: its inputs.
        world: the world; one with a high index tells the row of a world from the memory of all.
        size: length of an observation.
        terms: number of the terms.
        device: where the inputs are.

    Raises:
        TypeError: the function has other parameters than it must, or the inputs are no instance of a struct.
        ValueError: the function writes too much or too little; the message says which numbers.
    """
    struct = struct_of("observation_func", func, inputs)
    required = [name for name in func.input_types if name not in func.defaults]
    if not len(required) <= 4 <= len(func.input_types):
        raise TypeError(
            f"{func.key} must take the index of the world, the inputs, the row of the observation and that of the "
            f"terms, got the parameters {', '.join(func.input_types)}"
        )
    kernel = _writer(func, struct)
    rows = {"observation_size": size, "the number of term_names": terms}
    written = {name: np.zeros(length + 2 * AROUND, dtype=bool) for name, length in rows.items()}
    for before in (-1.5e30, 2.5e30):  # the function may write one of them
        memory = [wp.full(length + 2 * AROUND, before, dtype=float, device=device) for length in rows.values()]
        parts = [numbers[AROUND : numbers.size - AROUND] for numbers in memory]
        wp.launch(kernel, 1, [world, inputs, *parts, wp.zeros(1, dtype=float, device=device)], device=device)
        for name, numbers in zip(rows, memory, strict=True):
            written[name] |= numbers.numpy() != np.float32(before)
    for name, length in rows.items():
        places = set((np.flatnonzero(written[name]) - AROUND).tolist())
        if beyond := sorted(places - set(range(length))):
            raise ValueError(f"{name} is {length}, but {func.key} writes the numbers {_some(beyond)} too")
        if left := sorted(set(range(length)) - places):
            raise ValueError(f"{name} is {length}, but {func.key} does not write the numbers {_some(left)}")


def _some(numbers: list[int]) -> str:
    """Returns the first few of some numbers, as text."""
    return ", ".join(map(str, numbers[:5])) + (", ..." if len(numbers) > 5 else "")


def _writer(observe: wp.Function, Inputs: Any) -> wp.Kernel:  # noqa: N803
    @wp.kernel(enable_backward=False, module="unique")
    def write_rows_once(
        world: int, inputs: Inputs, observation: wp.array[float], terms: wp.array[float], reward: wp.array[float]
    ):
        reward[0] = observe(world, inputs, observation, terms)

    return write_rows_once
