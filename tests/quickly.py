"""Lets kernels be compiled without optimisation, which takes longer than they run in tests; but for a few.

Importing it is enough, also in a process that a test starts, which may be ``python -m quickly MODULE ARGUMENTS``. It
does nothing where there is a GPU.
"""

import fcntl
import runpy
import sys
from pathlib import Path

import torch
import warp as wp

plain = wp._src.build.build_cpu
LONG = "wp_tracer", "wp_torchrl_loco.training.adam"
"""What is optimised: without, a picture takes 40 times as long, and so does a step of Adam."""
parsed = set()
"""Options with which the header is there."""


def build(obj_path, cpp_path, *args, **options):
    """Compiles a kernel.

    The first that needs the header with its options lets all others wait, in this process and in others. It
    instantiates the templates that the header uses itself: by default each kernel does, 0.06 s long, for the same code.
    """
    options["extra_flags"] += " -fpch-instantiate-templates"
    if Path(cpp_path).name.startswith(LONG):
        options["optimization_level"] = 2
    key = options["optimization_level"], options["block_dim"]
    if key in parsed:
        return plain(obj_path, cpp_path, *args, **options)
    with Path(wp.config.kernel_cache_dir, "header.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        try:
            plain(obj_path, cpp_path, *args, **options)
            parsed.add(key)
        finally:
            fcntl.flock(lock, fcntl.LOCK_UN)  # a process that was forked meanwhile has the file open, too


if not torch.cuda.is_available():
    wp._src.build.build_cpu = build
    wp._src.codegen.cpu_linear_contiguous_specialization_candidate = lambda adj, block_dim: False  # a second body each
    wp.config.optimization_level = 0

if __name__ == "__main__":
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
