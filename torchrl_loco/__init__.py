"""Locomotion for TorchRL on a GPU: tasks in plain torch, thousands of worlds, a MuJoCo step compiled for the body."""

import lazy_loader

from torchrl_loco import lazy_compiler

__version__ = "0.1.0"

lazy_compiler.put_off()

# The public names are those of __init__.pyi. Each is imported when it is asked for: torch and Warp take seconds.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
