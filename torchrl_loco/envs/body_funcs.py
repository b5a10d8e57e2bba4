"""Checks of what a body's methods return: a function of a world and its inputs."""

from typing import Any

import numpy as np
import warp as wp

AROUND = 4096  # numbers before and behind a row in which a write beyond its ends is noticed


def check_pair(method: str, returned: Any) -> tuple[wp.Function, Any]:
    """Returns what a method of a body returned: a function, and an instance of the ``wp.struct`` that it takes."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise TypeError(f"{method} must return a wp.func and its inputs, got {returned!r}")
    func, inputs = returned
    if not isinstance(func, wp.Function):
        raise TypeError(f"{method} must return a wp.func and its inputs, got {func!r} as the function")
    if not hasattr(inputs, "_cls"):
        raise TypeError(f"the inputs of {func.key} must be an instance of a wp.struct, got {inputs!r}")
    return func, inputs


def check_rows(func: wp.Function, inputs: Any, world: int, size: int, terms: int, device: wp.Device) -> None:
    """Checks that a body's function writes the rows of observation and terms: every number, and none beyond."""
    # A write beyond a row would change the data of another world, or crash. The function runs twice for one world, with
    # rows in memory of their own: one with a high index tells the row of a world from the memory of all. What it writes
    # into its inputs stays.
    required = [name for name in func.input_types if name not in func.defaults]
    if not len(required) <= 4 <= len(func.input_types):
        raise TypeError(
            f"{func.key} must take the index of the world, the inputs, the row of the observation and that of the "
            f"terms, got the parameters {', '.join(func.input_types)}"
        )
    Inputs: Any = inputs._cls  # noqa: N806

    @wp.kernel(enable_backward=False, module="unique")
    def write_rows(
        world: int, inputs: Inputs, observation: wp.array[float], terms: wp.array[float], reward: wp.array[float]
    ):
        reward[0] = func(world, inputs, observation, terms)

    rows = {"observation_size": size, "the number of term_names": terms}
    written = {name: np.zeros(length + 2 * AROUND, dtype=bool) for name, length in rows.items()}
    for before in (-1.5e30, 2.5e30):  # the function may write one of them
        memory = [wp.full(length + 2 * AROUND, before, dtype=float, device=device) for length in rows.values()]
        parts = [numbers[AROUND : numbers.size - AROUND] for numbers in memory]
        wp.launch(write_rows, 1, [world, inputs, *parts, wp.zeros(1, dtype=float, device=device)], device=device)
        for name, numbers in zip(rows, memory, strict=True):
            written[name] |= numbers.numpy() != np.float32(before)
    for name, length in rows.items():
        places = set((np.flatnonzero(written[name]) - AROUND).tolist())
        if beyond := sorted(places - set(range(length))):
            raise ValueError(f"{name} is {length}, but {func.key} also writes at index {_some(beyond)}")
        if left := sorted(set(range(length)) - places):
            raise ValueError(f"{name} is {length}, but {func.key} does not write at index {_some(left)}")


def _some(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:5])) + (", ..." if len(numbers) > 5 else "")


def of_package(cls: type) -> bool:
    """Returns whether the function that observes in a class, and the sizes that it must fit, are this package's."""
    for base in cls.__mro__:
        if {"observation_func", "observation_size", "term_names"} & vars(base).keys():
            return base.__module__.startswith("torchrl_loco.")
    return False
