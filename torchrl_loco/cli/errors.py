"""How the command line tells errors of the user: in one line, with status 2."""

import contextlib
import os
import sys
from collections.abc import Iterator

from torchrl_loco.checks import UnknownNameError


def process_name() -> str:
    """Returns what the lines of this process begin with."""
    return f"torchrl-loco, rank {os.environ['RANK']}" if "RANK" in os.environ else "torchrl-loco"


@contextlib.contextmanager
def user_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Prints errors of the user, or errors of the given kinds, in one line and exits with status 2."""
    kinds = kinds or (ValueError, TypeError, OSError, ImportError, MemoryError, UnknownNameError)
    try:
        yield
    except kinds as error:
        print(f"{process_name()}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
