"""Warp's start: without the warning that a machine without a GPU would see at every command, its header parsed once."""

import contextlib
import functools
import os
import sys
import tempfile
import zlib
from pathlib import Path
from typing import Any

import torch
import warp as wp

NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


@functools.cache
def init_warp() -> None:
    """Initializes Warp. Where there is no CUDA, its line about the missing driver is left out, and no other."""
    _share_header()
    if torch.cuda.is_available() or sys.stderr is None:
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
                with contextlib.suppress(OSError):  # of a full disk
                    os.write(2, b"".join(line for line in said if NO_DRIVER not in line))
    finally:
        os.close(stderr)


def _share_header() -> None:
    """Lets all threads and processes have one precompiled header for the CPU, where Warp makes one in each thread.

    That takes as long as ten small kernels. Warp writes it under another name and renames it, and removes one that is
    older than its own header. What is changed here is no public part of Warp: where it is missing, all is as before.
    """
    runtime = wp._src.context.Runtime
    if not hasattr(runtime, "get_clang_pch_dir"):
        return
    header = Path(wp.__file__).with_name("native") / "builtin.h"
    which = zlib.crc32(f"{header} {header.stat().st_mtime_ns}".encode())

    def folder(self: Any) -> str | None:
        if self.llvm is None:
            return None
        found = Path(wp.config.kernel_cache_dir, f"wp_header_{which:08x}")  # wp.clear_kernel_cache() removes it, too
        found.mkdir(parents=True, exist_ok=True)
        return str(found)

    runtime.get_clang_pch_dir = folder
