"""Checks of what a user passes to an environment."""

import operator
from typing import Any

import torch


def check_count(name: str, value: Any) -> int:
    """Returns ``value`` as an int of at least 1, or raises an error that names it."""
    try:
        count = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {value!r}") from None
    if isinstance(value, bool) or count < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return count


def check_seed(value: Any) -> int:
    """Returns ``value`` as an int in [0, 2**32), or raises an error that names the range."""
    try:
        seed = operator.index(value)
    except TypeError:
        raise TypeError(f"seed must be an integer or None, got {value!r}") from None
    if isinstance(value, bool) or not 0 <= seed < 2**32:
        raise ValueError(f"seed must lie in [0, 2**32), got {value!r}")
    return seed


def check_device(device: torch.device | str | None) -> torch.device:
    """Returns the device with its index, CUDA before CPU for ``None``, or raises an error that names those present."""
    cuda = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if device is None:
        device = "cuda" if cuda else "cpu"
    name = str(device)
    if name == "cuda" and cuda:
        name = f"cuda:{torch.cuda.current_device()}"
    if name not in ("cpu", *cuda):
        raise ValueError(f"no device {str(device)!r} here: choose one of {', '.join(['cpu', *cuda])}")
    return torch.device(name)
