"""Worlds for Stable-Baselines3 (``pip install stable-baselines3``): all data is copied to the host, as NumPy arrays."""

from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import torchrl_loco


class StableBaselines3Env(VecEnv):
    """An environment of torchrl_loco as Stable-Baselines3's ``VecEnv``.

    The infos of a world that is done hold ``terminal_observation`` and ``TimeLimit.truncated``; its observation is
    already the first one of the next episode.
    """

    render_mode = None

    def __init__(self, env: torchrl_loco.LocoEnv) -> None:
        self.env = env
        num_envs, observation_size = env.observation_spec["observation"].shape
        observation_space = Box(-np.inf, np.inf, (observation_size,), np.float32)
        super().__init__(num_envs, observation_space, Box(-1, 1, env.action_spec.shape[1:], np.float32))

    def reset(self) -> np.ndarray:
        """Returns the first observations of all worlds, under the seed that ``seed()`` was given before, if any."""
        if self._seeds[0] is not None:
            self.env.set_seed(self._seeds[0])
        self._reset_seeds()
        self.td = self.env.reset()
        return self.td["observation"].numpy(force=True)

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions; ``step_wait`` steps."""
        self.td["action"] = torch.as_tensor(actions, device=self.env.device)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        """Returns the step of all worlds, with the observations after the reset of those that are done."""
        step, self.td = self.env.step_and_maybe_reset(self.td)
        last_observation = step["next", "observation"].numpy(force=True)
        keys = ("reward", "done", "terminated")
        reward, done, terminated = (step["next", key].squeeze(-1).numpy(force=True) for key in keys)
        infos = [{} for _ in range(self.num_envs)]
        for world in done.nonzero()[0]:
            infos[world]["terminal_observation"] = last_observation[world]
            infos[world]["TimeLimit.truncated"] = not terminated[world]
        return self.td["observation"].numpy(force=True), reward, done, infos

    def close(self) -> None:
        """Frees the device memory."""
        self.env.close()

    # The worlds are rows of tensors, no objects: an attribute belongs to all of them.

    def get_attr(self, attr_name: str, indices: Any = None) -> list:
        """Returns the attribute once for each world."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuses."""
        raise NotImplementedError("the worlds have no attributes of their own")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list:
        """Refuses."""
        raise NotImplementedError("the worlds have no methods of their own")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Returns False for each world."""
        return [False for _ in self._get_indices(indices)]


if __name__ == "__main__":
    env = StableBaselines3Env(torchrl_loco.make("walker_stand", num_envs=8, device="cpu", episode_length=100))
    model = PPO("MlpPolicy", VecMonitor(env), n_steps=128, batch_size=256, seed=0, verbose=1, device="cpu")
    model.learn(total_timesteps=3072)
