"""Lets kernels be compiled without optimisation, which takes longer than they run in tests.

Importing it is enough, also in a process that a test starts. It does nothing where there is a GPU.
"""

from pathlib import Path

import torch
import warp as wp


def headers(runtime):
    """Returns the folder of Warp's parsed header, one for all: parsing takes 1.5 s, by default in every thread.

    Clang names it by the options that it depends on, and puts it there when it is complete.
    """
    folder = Path(wp.config.kernel_cache_dir, "headers")
    folder.mkdir(parents=True, exist_ok=True)
    return str(folder)


if not torch.cuda.is_available():
    wp._src.context.Runtime.get_clang_pch_dir = headers
    wp._src.codegen.cpu_linear_contiguous_specialization_candidate = lambda adj, block_dim: False  # a second body each
    wp.config.optimization_level = 0
