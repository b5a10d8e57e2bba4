"""What hooks compute in, whatever the caller's networks do."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def own_precision(device: torch.device) -> Iterator[None]:
    """Float32 for new tensors and no autocast: the caller's settings are for the caller's own networks."""
    default = torch.get_default_dtype()
    with torch.autocast(device.type, enabled=False):
        if default == torch.float32:  # setting it is for all threads
            yield
            return
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            torch.set_default_dtype(default)
