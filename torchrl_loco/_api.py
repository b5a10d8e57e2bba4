"""What ``torchrl_loco`` offers under its own name, imported together."""

from torchrl_loco.collector import RolloutCollector as RolloutCollector
from torchrl_loco.config import SimConfig as SimConfig
from torchrl_loco.envs import HumanoidRun as HumanoidRun
from torchrl_loco.envs import HumanoidStand as HumanoidStand
from torchrl_loco.envs import HumanoidWalk as HumanoidWalk
from torchrl_loco.envs import LocoEnv as LocoEnv
from torchrl_loco.envs import State as State
from torchrl_loco.envs import TransformedEnv as TransformedEnv
from torchrl_loco.envs import WalkerRun as WalkerRun
from torchrl_loco.envs import WalkerStand as WalkerStand
from torchrl_loco.envs import WalkerWalk as WalkerWalk
from torchrl_loco.envs.bad_world import NonFiniteWarning as NonFiniteWarning
from torchrl_loco.envs.health import PhysicsOverflowError as PhysicsOverflowError
from torchrl_loco.envs.health import PhysicsOverflowWarning as PhysicsOverflowWarning
from torchrl_loco.ids import list_envs as list_envs
from torchrl_loco.policy import Policy as Policy
from torchrl_loco.policy import load_policy as load_policy
from torchrl_loco.registry import make as make
