"""Warp's start without the warning that a machine without a GPU would see at every command."""

import functools
import os
import sys
import tempfile

import torch
import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


@functools.cache
def init_warp() -> None:
    """Initializes Warp. Where there is no CUDA, its line about the missing driver is left out, and no other."""
    if torch.cuda.is_available():
        wp.init()
        return
    sys.stderr.flush()
    stderr = os.dup(2)  # Warp's C code writes there
    try:
        with tempfile.TemporaryFile() as said:
            os.dup2(said.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(stderr, 2)
                said.seek(0)
                os.write(2, b"".join(line for line in said if NO_DRIVER not in line))
    finally:
        os.close(stderr)
