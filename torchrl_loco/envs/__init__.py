"""The environments: one base, which knows no task. The tasks are in :mod:`torchrl_loco.tasks`."""

from torchrl_loco.envs.base import LocoEnv as LocoEnv
from torchrl_loco.envs.monitors import NonFiniteWarning as NonFiniteWarning
from torchrl_loco.envs.monitors import PhysicsOverflowError as PhysicsOverflowError
from torchrl_loco.envs.monitors import PhysicsOverflowWarning as PhysicsOverflowWarning
from torchrl_loco.envs.state import State as State
from torchrl_loco.envs.transforms import ActionRepeat as ActionRepeat
from torchrl_loco.envs.transforms import TransformedEnv as TransformedEnv
