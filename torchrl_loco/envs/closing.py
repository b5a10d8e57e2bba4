"""Worlds that nobody closes: when they are collected, and when the process ends."""

import atexit
import contextlib
import warnings
import weakref
from typing import Protocol


class Closable(Protocol):
    """What is closed."""

    def close(self) -> None:
        """Closes it."""


OPEN: "weakref.WeakSet[Closable]" = weakref.WeakSet()
"""What is closed before torch is torn down."""


def close_quietly(world: Closable) -> None:
    """Closes a world in a finalizer, where errors can only be warnings."""
    with contextlib.suppress(Warning):  # warnings may be configured as errors
        try:
            world.close()
        except Exception as error:
            warnings.warn(str(error), RuntimeWarning, stacklevel=2)


@atexit.register
def _close_all() -> None:
    for world in list(OPEN):
        close_quietly(world)
