"""TorchRL environments for dm_control's locomotion tasks, stepped by MuJoCo-Warp thousands of worlds at a time."""

from torchrl_loco import _versions
from torchrl_loco.collector import RolloutCollector
from torchrl_loco.config import SimConfig
from torchrl_loco.envs import (
    HumanoidRun,
    HumanoidStand,
    HumanoidWalk,
    LocoEnv,
    State,
    TransformedEnv,
    WalkerRun,
    WalkerStand,
    WalkerWalk,
)
from torchrl_loco.envs.bad_world import NonFiniteWarning
from torchrl_loco.envs.health import PhysicsOverflowError, PhysicsOverflowWarning
from torchrl_loco.policy import Policy, load_policy
from torchrl_loco.registry import list_envs, make

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

_versions.warn_if_untested()
