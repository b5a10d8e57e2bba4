"""The environments: one base that knows no task, and a file for each body."""

from torchrl_loco.envs.autoreset import TransformedEnv as TransformedEnv
from torchrl_loco.envs.base import LocoEnv as LocoEnv
from torchrl_loco.envs.cheetah import CheetahRun as CheetahRun
from torchrl_loco.envs.hopper import HopperHop as HopperHop
from torchrl_loco.envs.hopper import HopperStand as HopperStand
from torchrl_loco.envs.humanoid import HumanoidRun as HumanoidRun
from torchrl_loco.envs.humanoid import HumanoidStand as HumanoidStand
from torchrl_loco.envs.humanoid import HumanoidWalk as HumanoidWalk
from torchrl_loco.envs.monitors import NonFiniteWarning as NonFiniteWarning
from torchrl_loco.envs.monitors import PhysicsOverflowError as PhysicsOverflowError
from torchrl_loco.envs.monitors import PhysicsOverflowWarning as PhysicsOverflowWarning
from torchrl_loco.envs.quadruped import QuadrupedRun as QuadrupedRun
from torchrl_loco.envs.quadruped import QuadrupedWalk as QuadrupedWalk
from torchrl_loco.envs.state import State as State
from torchrl_loco.envs.walker import WalkerRun as WalkerRun
from torchrl_loco.envs.walker import WalkerStand as WalkerStand
from torchrl_loco.envs.walker import WalkerWalk as WalkerWalk
