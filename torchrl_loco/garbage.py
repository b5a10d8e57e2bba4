"""Python's garbage collection, put off."""

import contextlib
import gc
import sys
import threading
from collections.abc import Iterator

_LOCK = threading.RLock()
_blocks, _was_enabled = 0, False  # blocks that threads are in, and whether garbage was collected before the first


OWN_PROCESS = threading.Event()
"""Set where the process is that of the command, to whose end everything stays that it imports."""


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Is :func:`no_collection` for a block that imports; in a process of the command, later collections skip all of it.

    Python would look three times at half a million objects, which takes a second.
    """
    known = len(sys.modules)
    with no_collection():
        yield
        if OWN_PROCESS.is_set() and len(sys.modules) > known:  # else the garbage of a training might be kept
            gc.freeze()


@contextlib.contextmanager
def no_collection() -> Iterator[None]:
    """Keeps garbage from being collected, in all threads, while the block lasts.

    A dropped environment in it would free its memory, which ends a recording on CUDA with an error.
    """
    global _blocks, _was_enabled
    with _LOCK:
        if _blocks == 0:
            _was_enabled = gc.isenabled()
            gc.disable()
        _blocks += 1
    try:
        yield
    finally:
        with _LOCK:
            _blocks -= 1
            if _blocks == 0 and _was_enabled:
                gc.enable()
