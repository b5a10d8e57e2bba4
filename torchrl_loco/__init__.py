"""TorchRL environments for dm_control's locomotion tasks, stepped by MuJoCo-Warp thousands of worlds at a time."""

import importlib
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
        """Imports everything once anything is asked for: torch and Warp take seconds, and not all commands need them.

        Returns:
            What goes by the name: something public, or a module that is imported with it.

        Raises:
            AttributeError: there is no such name.
        """
        api = importlib.import_module("torchrl_loco._api")
        for names in (vars(api), globals()):
            if name in names:
                return names[name]
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


_versions.warn_if_untested()
