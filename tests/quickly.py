"""Lets most kernels be compiled without optimisation, which takes longer than they run in tests.

Importing it is enough, also in a process that a test starts. It does nothing where there is a GPU.
"""

import functools
from pathlib import Path

import torch
import warp as wp

HOT = ("solver", "smooth", "constraint", "collision_driver", "render")
"""Modules of MuJoCo-Warp in which most of the time is spent."""


def hot_ones_optimised(kernel):
    """Returns the decorator of kernels such that those of MuJoCo-Warp's hot modules are compiled as for users."""

    def decorator(f=None, **options):
        if f is None:
            return functools.partial(decorator, **options)
        package, _, module = (f.__module__ or "").rpartition(".")
        if package == "mujoco_warp._src" and module in HOT:
            if options.get("module") == "unique":
                options["module_options"] = {**(options.get("module_options") or {}), "optimization_level": 2}
            else:
                wp.get_module(f.__module__).options["optimization_level"] = 2
        return kernel(f, **options)

    return decorator


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
    wp.kernel = hot_ones_optimised(wp.kernel)
