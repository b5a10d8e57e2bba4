"""TorchRL environments for dm_control's locomotion tasks, stepped by MuJoCo-Warp thousands of worlds at a time."""

from typing import TYPE_CHECKING

from torchrl_loco import _versions
from torchrl_loco._lazy import lazy

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
    __getattr__, __dir__ = lazy(__name__, __all__)

_versions.warn_if_untested()
