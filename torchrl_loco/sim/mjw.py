"""MuJoCo-Warp, imported when it is first used: that takes more than a second, and the compiled engine does without."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mujoco_warp import *  # noqa: F403


def __getattr__(name: str) -> Any:
    return getattr(importlib.import_module("mujoco_warp"), name)
