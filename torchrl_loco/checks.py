"""Checks of user input, one function per kind of argument. Each returns the value in its canonical type.

A value of another type is a TypeError, one that is not valid a ValueError, unless a docstring names another. A message
says what is wrong and what is valid.
"""

import dataclasses
import difflib
import importlib.util
import math
import numbers
import operator
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    import torch


class UnknownNameError(KeyError):
    """A model or a task has nothing by this name; the message is one sentence, without KeyError's quotes."""

    def __str__(self) -> str:
        return str(self.args[0])


class Interval(NamedTuple):
    """Numbers between two bounds, of which each may belong to them: by default ``low``, but not ``high``."""

    low: float
    high: float
    with_low: bool = True
    with_high: bool = False

    def __contains__(self, value: Any) -> bool:
        """Returns whether a number lies in it; NaN never does."""
        above = value >= self.low if self.with_low else value > self.low
        return above and (value <= self.high if self.with_high else value < self.high)

    def __str__(self) -> str:
        """Returns it as in mathematics, such as ``"(0, 1]"``."""
        high = {2**31: "2**31", 2**32: "2**32"}.get(int(self.high) if math.isfinite(self.high) else 0, f"{self.high:g}")
        return f"{'[' if self.with_low else '('}{self.low:g}, {high}{']' if self.with_high else ')'}"


POSITIVE_INT = Interval(1, 2**31)  # counts: kernels index with 32 bits
COUNT = Interval(0, 2**31)  # counts that may be zero
SEED = Interval(0, 2**32)
POSITIVE = Interval(0, math.inf, with_low=False)
NOT_NEGATIVE = Interval(0, math.inf)
FRACTION = Interval(0, 1, with_high=True)
POSITIVE_FRACTION = Interval(0, 1, with_low=False, with_high=True)
ANY = Interval(-math.inf, math.inf, with_low=False)  # all finite numbers
EXTENDED = Interval(-math.inf, math.inf, with_high=True)  # those, and the two infinities


def check_int(name: str, value: Any, interval: Interval = POSITIVE_INT) -> int:
    """Returns ``value`` as an int."""
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {value!r}") from None
    if isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be an integer, got {value!r}")
    _check_interval(name, number, interval)
    return number


def check_float(name: str, value: Any, interval: Interval = POSITIVE) -> float:
    """Returns ``value`` as a float."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, numbers.Real):
        raise TypeError(f"{name} must be a number, got {value!r}")
    _check_interval(name, float(value), interval)
    return float(value)


def _check_interval(name: str, value: float, interval: Interval) -> None:
    if value not in interval:
        raise ValueError(f"{name} must lie in {interval}, got {value!r}")


def check_pair(name: str, value: Any) -> tuple[float, float]:
    """Returns two numbers, which may be infinite, of a tuple, a list, an array or a tensor."""
    entries = value.tolist() if hasattr(value, "tolist") else value
    if not isinstance(entries, tuple | list) or len(entries) != 2:
        raise TypeError(f"{name} must be two numbers, got {value!r}")
    low, high = (check_float(f"each number of {name}", entry, EXTENDED) for entry in entries)
    return low, high


def check_bool(name: str, value: Any) -> bool:
    """Returns ``value`` as a bool."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_choice(name: str, value: Any, choices: Collection[str], also: Collection[str] = ()) -> str:
    """Returns ``value``; of ``also``, such as aliases, the message may suggest names too."""
    if not isinstance(value, str) or value not in choices:
        hint = suggestion(str(value), [*choices, *also])
        raise ValueError(
            f"unknown {name} {value!r}{hint}: "
            + (f"choose one of {', '.join(choices)}" if choices else "there is none")
        )
    return value


def several(value: Any) -> list[Any]:
    """Returns a list of what may be one, as text, a path or a dict is, or several."""
    is_one = isinstance(value, str | bytes | PurePath | Mapping) or not isinstance(value, Iterable)
    is_one |= getattr(value, "ndim", 1) == 0  # an array or tensor
    return [value] if is_one else list(value)


def suggestion(word: str, choices: Collection[str]) -> str:
    """Returns ``", did you mean 'x'?"`` for the choice nearest to ``word``, or an empty string."""
    near = difflib.get_close_matches(word, choices, n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def within(interval: Interval, default: Any) -> Any:
    """Returns a field of a dataclass whose numbers must lie in an interval, for :func:`check_fields`."""
    return dataclasses.field(default=default, metadata={"interval": interval})


def check_fields(config: Any) -> None:
    """Checks the fields of a dataclass that are numbers or flags, and stores them in their canonical type.

    It may be frozen and just being made. Fields that are not made by :func:`within` are positive.
    """
    checks: dict[Any, Any] = {bool: check_bool, int: check_int, float: check_float, float | None: check_float}
    for field in dataclasses.fields(config):
        value, check = getattr(config, field.name), checks.get(field.type)
        if check is not None and not (value is None and field.type == float | None):
            interval = [field.metadata["interval"]] if "interval" in field.metadata else []  # else that of the check
            object.__setattr__(config, field.name, check(field.name, value, *interval))


def number_of(text: str) -> float | None:
    """Returns the number that a text is, ``None`` if it is none."""
    try:
        return float(text)
    except ValueError:
        return None


def check_multiple(name: str, value: float, base_name: str, base: float) -> int:
    """Returns ``value / base`` as a whole number."""
    ratio = round(value / base)
    if ratio < 1 or not math.isclose(value, ratio * base, rel_tol=1e-6):
        raise ValueError(
            f"{name} ({value}) must be a whole multiple of {base_name} ({base}), for example {max(ratio, 1) * base:g}"
        )
    return ratio


def check_device(device: "torch.device | str | None") -> "torch.device":
    """Returns the device with its index; ``None`` stands for CUDA if there is any, else the CPU."""
    import torch  # takes seconds, which the other checks need not wait for

    cuda = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if device is None:
        device = "cuda" if cuda else "cpu"
    name = str(device)
    if name == "cuda" and cuda:
        name = f"cuda:{torch.cuda.current_device()}"
    if name not in ("cpu", *cuda):
        why = "" if cuda or not name.startswith("cuda") else f" ({why_no_cuda()})"
        raise ValueError(f"no device {str(device)!r} on this machine{why}: choose one of {', '.join(['cpu', *cuda])}")
    return torch.device(name)


def why_no_cuda() -> str:
    """Returns why torch finds no CUDA device."""
    import torch

    if torch.version.cuda is None:
        return "torch is built without CUDA, pytorch.org has builds with it"
    return f"torch is built for CUDA {torch.version.cuda}, but finds no driver or no device, nvidia-smi says more"


def check_output_file(name: str, value: Any, suffixes: Collection[str] = ()) -> Path:
    """Returns ``value`` as the absolute path of a file that can be created, with one of ``suffixes``, if any."""
    path = Path(value).absolute()  # the working directory may change
    if suffixes and path.suffix not in suffixes:
        raise ValueError(f"{name} must end in one of {', '.join(suffixes)}, got {path}")
    if not path.parent.is_dir():
        raise ValueError(f"{name} {path} cannot be written: the folder {path.parent} does not exist")
    if path.exists():
        raise ValueError(f"{name} {path} already exists: move it away, or choose another name")
    if not os.access(path.parent, os.W_OK):
        raise ValueError(f"{name} {path} cannot be written: no permission in the folder {path.parent}")
    return path


def checked_size(size: Any) -> tuple[int, int]:
    """Returns the width and height of pixels."""
    if isinstance(size, str) or not isinstance(size, Sequence) or len(size) != 2:
        raise ValueError(f"size must be the width and height of pixels, such as (84, 84), got {size!r}")
    return check_int("width", size[0]), check_int("height", size[1])


def check_run(path: Path) -> Path:
    """Returns ``path`` as that of a run folder, or raises FileNotFoundError if it has no ``config.json``."""
    if not is_run(path):
        inside = [entry for entry in Path(path).glob("*/") if is_run(entry)]
        newest = sorted(inside, key=lambda entry: (entry.stat().st_mtime, entry.name))[-5:]
        hint = f"; name one of those in it, such as {', '.join(entry.name for entry in newest)}" if newest else ""
        raise FileNotFoundError(f"{path} is not a run folder: it has no config.json{hint}")
    return Path(path)


def is_run(path: Path) -> bool:
    """Returns whether ``path`` is a run folder."""
    return (Path(path) / "config.json").is_file()


def check_packages(purpose: str, packages: Collection[str], extra: str) -> None:
    """Raises ImportError if a package that an extra of this one installs is missing; none is imported."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(
            f"{purpose} needs {', '.join(missing)}: pip install 'torchrl-loco[{extra}]', or pip install '.[{extra}]'"
        )
