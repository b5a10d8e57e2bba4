"""Environments as RSL-RL's."""

from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_loco.envs import LocoEnv
from torchrl_loco.wrappers.common import base_of, groups_of, made, named_numbers, step_worlds


class RslRlVecEnv(VecEnv):
    """An environment as RSL-RL's ``VecEnv``: all data stays on the device, and nothing waits for it.

    Observations are a ``TensorDict``, batch ``(num_envs,)``, with a group for each entry of the task's observation.
    ``observation`` is called ``policy``, as RSL-RL's defaults expect; the others, such as ``privileged``, keep their
    names. A configuration then has ``"obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]}``, say.

    ``extras`` of a step has:

    - ``time_outs``, bool ``(num_envs,)``: the worlds that were truncated and not terminated;
    - ``final_observations``: in the form of the observations, the true last ones in worlds that are done, and the
      same as the observations in the others;
    - ``log``, with ``reward_terms=True`` or ``metrics=True``: the mean of each over the worlds that count, which RSL-RL
      logs; where none counts in a step, that of the last step, as NaN would be the mean of all.

    Arguments and errors are those of :class:`.GymnasiumVectorEnv`, but for what it says of arrays and pictures.

    Attributes:
        env: the environment.
        num_envs: number of worlds.
        num_actions: numbers in an action.
        max_episode_length: the time limit, in control steps.
        device: where the worlds are.
        cfg: all settings, a :class:`torchrl_loco.SimConfig`.
    """

    def __init__(self, env: str | type[LocoEnv] | EnvBase, num_envs: int | None = None, **settings: Any) -> None:
        self.env = made(env, num_envs, settings)
        self.cfg, self.device = base_of(self.env).config, self.env.device
        self.num_envs, self.num_actions = self.env.action_spec.shape
        self.max_episode_length = self.cfg.episode_length
        self._names = {key: "policy" if key == "observation" else key for key in groups_of(self.env)}
        if len({*self._names.values()}) < len(self._names):
            raise ValueError("the group 'observation' is called 'policy' in RSL-RL: no other may have that name")
        self._td = self.env.reset()
        self._log: dict[str, torch.Tensor] = {}

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since the reset of each world, int32 ``(num_envs,)``; the runner assigns random ones."""
        return base_of(self.env).get_state()["elapsed_steps"]

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        state = base_of(self.env).get_state()
        if steps.shape != state["elapsed_steps"].shape:
            raise ValueError(f"episode_length_buf must have shape ({self.num_envs},), got {tuple(steps.shape)}")
        self._td = self.env.reset(state.set("elapsed_steps", steps.to(torch.int32)), set_state=True)

    def get_observations(self) -> TensorDict:
        """Returns the current observations, batch ``(num_envs,)``."""
        return self._observations(self._td)

    def _observations(self, td: TensorDictBase) -> TensorDict:
        groups = {name: td[key].clone() for key, name in self._names.items()}
        return TensorDict(groups, batch_size=td.batch_size, device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Steps all worlds under actions ``(num_envs, num_actions)``, and resets those that are done.

        RSL-RL's Gaussian has no bounds; the task clips actions to its own.

        Returns:
            The observations after the resets; rewards and dones of the step, ``(num_envs,)`` each; and the extras.
        """
        after, self._td = step_worlds(self.env, self._td, actions)
        time_outs = after["truncated"] & ~after["terminated"]
        extras = {"time_outs": time_outs.squeeze(-1), "final_observations": self._observations(after)}
        told = named_numbers(after)
        for kind, values in told.items():
            for name, value in values.items():
                key, mean = f"/{kind}/{name}", value.nanmean()
                self._log[key] = torch.where(mean.isnan(), self._log.get(key, mean), mean)
        if told:
            extras["log"] = dict(self._log)
        return self.get_observations(), after["reward"].squeeze(-1), after["done"].squeeze(-1), extras

    def close(self) -> None:
        """Frees the memory of the worlds."""
        self.env.close()
