"""How the command line tells errors of the user, in one line, with status 2; and what it does where output breaks."""

import contextlib
import os
import site
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from torchrl_loco.checks import UnknownNameError

PACKAGE = Path(__file__).parents[1]


def process_name() -> str:
    """Returns what the lines of this process begin with."""
    return f"torchrl-loco, rank {os.environ['RANK']}" if "RANK" in os.environ else "torchrl-loco"


class BestEffortStream:
    """A text stream whose errors are ignored: what a closed pipe or a full disk does not take is lost."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes, if it can."""
        with contextlib.suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flushes, if it can."""
        with contextlib.suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def tolerate_broken_streams() -> None:
    """Lets this process go on if its standard output or error is closed or breaks."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")  # noqa: SIM115, until the process ends
        setattr(sys, name, BestEffortStream(stream))


def _place_of(error: Exception) -> str:
    """Returns where an error was raised if that is in a file of the user's own, such as that of a task."""
    raised = traceback.extract_tb(error.__traceback__)[-1]
    paths = sysconfig.get_paths()
    of_others = [str(PACKAGE), site.getusersitepackages(), paths["stdlib"], paths["platlib"], paths["purelib"]]
    if raised.filename.startswith("<") or any(Path(raised.filename).is_relative_to(each) for each in of_others):
        return ""
    return f" ({raised.filename}, line {raised.lineno}, in {raised.name})"


@contextlib.contextmanager
def user_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Prints errors of the user, or errors of the given kinds, in one line and exits with status 2."""
    kinds = kinds or (ValueError, TypeError, OSError, ImportError, MemoryError, UnknownNameError)
    try:
        yield
    except kinds as error:
        print(f"{process_name()}: {error}{_place_of(error)}", file=sys.stderr)
        raise SystemExit(2) from None
