"""What all wrappers share: the environment that is wrapped, its spaces, its steps."""

from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv

from torchrl_loco.envs import LocoEnv
from torchrl_loco.registry import make


def made(env: str | type[LocoEnv] | EnvBase, num_envs: int | None, settings: dict[str, Any]) -> EnvBase:
    """Returns the environment that is to be wrapped.

    Raises:
        TypeError: it is no environment of this package, or is made already and has settings.
        ValueError: it has no batch of worlds.
    """
    if not isinstance(env, EnvBase):
        return make(env, 1 if num_envs is None else num_envs, **settings)
    if not isinstance(base_of(env), LocoEnv):
        raise TypeError(f"env must be an id, a class or an environment of torchrl_loco, got {type(env).__name__}")
    if num_envs is not None or settings:
        names = [*(["num_envs"] if num_envs is not None else []), *settings]
        raise TypeError(f"{', '.join(names)}: the environment is made already, pass this where it is made")
    if not env.batch_size:
        raise ValueError("the environment has no batch of worlds: make it with num_envs=1")
    return env


def base_of(env: EnvBase) -> Any:
    """Returns the environment under the transforms."""
    while isinstance(env, TorchRLTransformedEnv):
        env = env.base_env
    return env


def step_worlds(env: EnvBase, td: TensorDictBase, actions: Any) -> tuple[TensorDictBase, TensorDictBase]:
    """Steps all worlds, and resets those that are done.

    Returns:
        The results of the step, and what the next one begins with, batch ``(num_envs,)`` each.
    """
    actions = torch.as_tensor(actions, device=env.device, dtype=env.action_spec.dtype)
    step, begin = env.step_and_maybe_reset(td.set("action", actions))
    return step["next"], begin


def groups_of(env: EnvBase) -> list[str]:
    """Returns the groups of observations; what is nested is none of them: the terms of the reward."""
    return [key for key, spec in env.observation_spec.items() if not isinstance(spec, Composite)]


def pictures(env: EnvBase, picture: tuple[str, int, int]) -> np.ndarray:
    """Returns the current picture of each world, uint8 ``(num_envs, height, width, 3)``."""
    return base_of(env).render(*picture).numpy(force=True)
