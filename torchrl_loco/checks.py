"""Checks of what a user passes: numbers, devices, paths."""

import operator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch


def check_count(name: str, value: Any) -> int:
    """Returns ``value`` as an int of at least 1.

    Raises:
        TypeError: it is no integer; the message calls it ``name``.
        ValueError: it is less than 1.
    """
    try:
        count = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {value!r}") from None
    if isinstance(value, bool) or count < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return count


def check_flag(name: str, value: Any) -> bool:
    """Returns ``value``, or raises an error that names it if it is neither True nor False.

    Raises:
        TypeError: it is something else.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_seed(value: Any) -> int:
    """Returns ``value`` as an int in [0, 2**32).

    Raises:
        TypeError: it is no integer.
        ValueError: it is out of range.
    """
    try:
        seed = operator.index(value)
    except TypeError:
        raise TypeError(f"seed must be an integer or None, got {value!r}") from None
    if isinstance(value, bool) or not 0 <= seed < 2**32:
        raise ValueError(f"seed must lie in [0, 2**32), got {value!r}")
    return seed


def check_device(device: "torch.device | str | None") -> "torch.device":
    """Returns the device with its index, CUDA before CPU for ``None``.

    Raises:
        ValueError: it is not here; the message names those that are.
    """
    import torch  # takes seconds, which the other checks need not wait for

    cuda = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if device is None:
        device = "cuda" if cuda else "cpu"
    name = str(device)
    if name == "cuda" and cuda:
        name = f"cuda:{torch.cuda.current_device()}"
    if name not in ("cpu", *cuda):
        raise ValueError(f"no device {str(device)!r} here: choose one of {', '.join(['cpu', *cuda])}")
    return torch.device(name)


def check_new_file(name: str, value: Any) -> Path:
    """Returns ``value`` as the path of a file that is not there yet, but whose folder is.

    Raises:
        TypeError: it is no path.
        ValueError: it cannot be written, or would be overwritten.
    """
    path = check_folder(name, value)
    if path.exists():
        raise ValueError(f"{name} {path} is already there: move it away, or choose another name")
    return path


def check_folder(name: str, value: Any) -> Path:
    """Returns ``value`` as the path of a file whose folder is there.

    Raises:
        TypeError: it is no path.
        ValueError: there is no such folder.
    """
    path = Path(value).absolute()  # where it is now, should the working directory change
    if not path.parent.is_dir():
        raise ValueError(f"{name} {path} cannot be written: there is no folder {path.parent}")
    return path


def check_run(path: Path) -> Path:
    """Returns ``path`` as that of a run.

    Raises:
        FileNotFoundError: it is no folder with a ``config.json``.
    """
    if not (Path(path) / "config.json").is_file():
        raise FileNotFoundError(f"{path} is no run folder: it has no config.json")
    return Path(path)
