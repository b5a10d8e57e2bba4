"""Numbers of a model that can be read but not written, since the compiled step has them as constants."""

import dataclasses
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
import warp as wp

REMEDY = (
    "the compiled step has the numbers of the model as constants. Pass randomize=[Vary(...)] for numbers that differ "
    "from world to world, or edit the model before the simulation is made (a mujoco.MjSpec)"
)


class ReadOnly:
    """An object whose attributes can be read only, and so can the arrays and objects that they hold."""

    _source: Any

    def __init__(self, source: Any) -> None:
        self.__dict__["_source"] = source

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        self.__dict__[name] = value = read_only(getattr(self._source, name))
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"{name} cannot be set: {REMEDY}")


def _read_only_view(method: Callable[..., Any]) -> Any:
    return lambda self, *args, **options: read_only(method(self, *args, **options))


class ReadOnlyArray(wp.array):
    """A Warp array that kernels and structs take like any other, and that Python cannot write.

    ``numpy()`` returns a copy that cannot be written either. There is no view for torch, where nothing is read-only.
    What Warp does with pointers cannot be caught: ``wp.copy`` into it, and kernels of your own that write to it.
    """

    def assign(self, *args: Any) -> NoReturn:
        """Writes nothing, and raises TypeError."""
        raise TypeError(f"this array cannot be written: {REMEDY}")

    fill_ = zero_ = assign

    def numpy(self, **options: Any) -> np.ndarray:
        """Returns a copy that cannot be written."""
        values = wp.clone(self).numpy(**options)
        values.flags.writeable = False
        return values

    def _no_view(self) -> NoReturn:
        raise TypeError(f"other libraries could write this array, so use its numpy(), a copy: {REMEDY}")

    __array_interface__ = __cuda_array_interface__ = property(_no_view)

    def __dlpack__(self, stream: Any = None) -> NoReturn:
        self._no_view()

    __getitem__, flatten, reshape, view, transpose = map(
        _read_only_view, (wp.array.__getitem__, wp.array.flatten, wp.array.reshape, wp.array.view, wp.array.transpose)
    )


def read_only(value: Any) -> Any:
    """Returns an array, an object with fields, or a tuple of these as one that can be read only; all else as it is."""
    if isinstance(value, wp.array) and value.ptr:
        layout = {name: getattr(value, name) for name in ("ptr", "dtype", "shape", "strides", "capacity", "device")}
        array = ReadOnlyArray(**layout)
        array._source = value  # owns the memory
        return array
    if isinstance(value, tuple):
        return tuple(map(read_only, value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return ReadOnly(value)
    return value
