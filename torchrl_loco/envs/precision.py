"""What hooks compute in, whatever the caller's networks do."""

import contextlib
import threading
from collections.abc import Iterator

import torch

_LOCK = threading.Lock()
_inside, _callers = 0, torch.float32  # how many are in hooks now, and what was the default before the first of them


@contextlib.contextmanager
def own_precision(device: torch.device) -> Iterator[None]:
    """Float32 for new tensors and no autocast: the caller's settings are for the caller's own networks.

    Torch has one default dtype for all threads: where it is another, tensors that a thread makes meanwhile are float32.
    """
    global _inside, _callers
    with _LOCK:
        if _inside == 0:
            _callers = torch.get_default_dtype()
            if _callers != torch.float32:
                torch.set_default_dtype(torch.float32)
        _inside += 1
    try:
        with torch.autocast(device.type, enabled=False):
            yield
    finally:
        with _LOCK:
            _inside -= 1
            if _inside == 0 and _callers != torch.float32:
                torch.set_default_dtype(_callers)
