"""Sums in an order that is always the same, on CUDA too, for what worlds share."""

import contextlib
from collections.abc import Iterator
from typing import Any

import torch
from torch.overrides import TorchFunctionMode


@contextlib.contextmanager
def fixed_order() -> Iterator[None]:
    """Lets torch take kernels that add up in a fixed order; one that has none raises an error that names it.

    Running sums, which have none on CUDA, are :func:`running_sum` there.
    """
    before = torch.get_deterministic_debug_mode()
    torch.set_deterministic_debug_mode("error")  # use_deterministic_algorithms imports torch's compiler, for seconds
    try:
        with _RunningSums():
            yield
    finally:
        torch.set_deterministic_debug_mode(before)


class _RunningSums(TorchFunctionMode):
    """Replaces ``cumsum`` of floats on CUDA."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in (torch.cumsum, torch.Tensor.cumsum) and args[0].is_cuda and args[0].is_floating_point():
            return running_sum(args[0], args[1] if len(args) > 1 else kwargs["dim"])
        return func(*args, **kwargs)


def running_sum(values: torch.Tensor, dim: int) -> torch.Tensor:
    """Returns what ``values.cumsum(dim)`` does, of the same shape, by sums of ever longer runs (Hillis and Steele)."""
    sums, step = values.movedim(dim, -1), 1
    while step < sums.shape[-1]:
        sums = torch.cat([sums[..., :step], sums[..., step:] + sums[..., :-step]], dim=-1)
        step *= 2
    return sums.movedim(-1, dim)
