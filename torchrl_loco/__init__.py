"""TorchRL environments for dm_control's locomotion tasks, stepped by MuJoCo-Warp thousands of worlds at a time."""

import importlib.util
from typing import TYPE_CHECKING, Any

from torchrl_loco import _versions

if TYPE_CHECKING:
    from torchrl_loco._api import *

__version__ = "0.1.0"

__all__ = [
    "HumanoidRun",
    "HumanoidStand",
    "HumanoidWalk",
    "LocoEnv",
    "NonFiniteWarning",
    "PhysicsOverflowError",
    "PhysicsOverflowWarning",
    "Policy",
    "RolloutCollector",
    "SimConfig",
    "State",
    "TransformedEnv",
    "WalkerRun",
    "WalkerStand",
    "WalkerWalk",
    "__version__",
    "list_envs",
    "load_policy",
    "make",
]

if not TYPE_CHECKING:  # to a type checker it would mean that there is every name

    def __getattr__(name: str) -> Any:
        """Imports what is public once any is asked for: torch and Warp take seconds, and not all commands need them.

        Returns:
            What goes by the name: something public, or a module of the package, which is imported alone.

        Raises:
            AttributeError: there is no such name.
        """
        if name in __all__:
            return getattr(importlib.import_module(f"{__name__}._api"), name)
        if importlib.util.find_spec(f"{__name__}.{name}") is not None:
            return importlib.import_module(f"{__name__}.{name}")
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


_versions.warn_if_untested()
