"""Worlds for Gymnasium (``pip install "gymnasium[array-api]"``): all data stays on the device, as torch tensors."""

from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

import torchrl_loco


class GymnasiumEnv(VectorEnv[torch.Tensor, torch.Tensor, torch.Tensor]):
    """An environment of torchrl_loco as Gymnasium's ``VectorEnv``.

    A world that is done is reset in the same step. ``info["final_obs"]`` then holds the last observation of the old
    episode, in the rows that ``info["_final_obs"]`` marks.
    """

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, env: torchrl_loco.LocoEnv) -> None:
        self.env = env
        self.num_envs, observation_size = env.observation_spec["observation"].shape
        self.single_observation_space = Box(-np.inf, np.inf, (observation_size,), np.float32)
        self.single_action_space = Box(-1, 1, env.action_spec.shape[1:], np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[torch.Tensor, dict[str, Any]]:
        """Returns the first observations of all worlds; ``seed`` decides all later draws too."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self.td = self.env.reset()
        return self.td["observation"], {}

    def step(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """Returns the step of all worlds, with the observations after the reset of those that are done."""
        step, self.td = self.env.step_and_maybe_reset(self.td.set("action", actions))
        after = step["next"]
        keys = ("reward", "terminated", "truncated", "done")
        reward, terminated, truncated, done = (after[key].squeeze(-1) for key in keys)
        info = {"final_obs": after["observation"], "_final_obs": done}
        return self.td["observation"], reward, terminated, truncated, info

    def close_extras(self) -> None:
        """Frees the device memory."""
        self.env.close()


if __name__ == "__main__":
    from gymnasium.wrappers.vector import ArrayConversion, RecordEpisodeStatistics

    env = GymnasiumEnv(torchrl_loco.make("walker_stand", num_envs=4, device="cpu", episode_length=100))
    env = RecordEpisodeStatistics(ArrayConversion(env, env_xp=torch, target_xp=np))
    observations, info = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(200):
        observations, rewards, terminations, truncations, info = env.step(env.action_space.sample())
    print("truncated:", truncations, "final_obs differs:", (info["final_obs"] != observations).any(axis=1))
    print("returns of", env.episode_count, "episodes:", np.round(env.return_queue, 2))
