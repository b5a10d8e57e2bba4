"""Environments as Stable-Baselines3's."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from torchrl_loco.envs import LocoEnv
from torchrl_loco.wrappers import common
from torchrl_loco.wrappers.gymnasium import box, observation_space


class StableBaselines3VecEnv(common.Wrapped, VecEnv):
    """An environment as Stable-Baselines3's ``VecEnv``: all data is copied to the host, as NumPy arrays.

    A task with ``observation`` alone has a ``Box``; one with further groups, such as ``privileged``, has a ``Dict`` of
    them, for ``MultiInputPolicy``. Stable-Baselines3 refuses actions without bounds.

    The infos of a world that is done have ``terminal_observation``, the true last one, and ``TimeLimit.truncated``,
    whether it was truncated and not terminated. They have no terms of the reward and no metrics: a dictionary of these
    for each world would take longer than a step.

    Arguments, attributes and errors are those of :class:`.GymnasiumVectorEnv`.
    """

    _seeds: list[int | None]

    def __init__(
        self,
        env: str | type[LocoEnv] | EnvBase,
        num_envs: int | None = None,
        *,
        render_mode: str | None = None,
        camera: str | None = None,
        width: int = 320,
        height: int = 240,
        **settings: Any,
    ) -> None:
        self._wrap(env, num_envs, settings, render_mode, (camera, width, height))
        self._td: TensorDictBase | None = None
        self.num_envs = self.env.batch_size[0]
        super().__init__(self.num_envs, observation_space(self.env), box(self.env.action_spec))
        self.metadata = self._render_metadata()

    def reset(self) -> Any:
        """Returns the first observations of all worlds, under the seed that ``seed()`` was given before, if any."""
        if self._seeds[0] is not None:
            self.env.set_seed(self._seeds[0])
        self._seeds = [None] * self.num_envs
        self._td = self.env.reset()
        return common.to_numpy(self._seen(self._td))

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions, ``(num_envs, ...)``; ``step_wait`` steps."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Steps all worlds and resets those that are done.

        Returns:
            The observations after the resets; rewards and dones of the step, ``(num_envs,)`` each; and the infos of
            each world.

        Raises:
            RuntimeError: ``reset()`` was never called.
        """
        if self._td is None:
            raise RuntimeError("reset() must be called before step()")
        after, self._td = common.step_worlds(self.env, self._td, self._actions)
        rewards, dones, terminated = (
            common.to_numpy(after[key].squeeze(-1)) for key in ("reward", "done", "terminated")
        )
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            last = common.rows_as_objects(common.to_numpy(self._seen(after)), dones)
            for world in dones.nonzero()[0]:
                infos[world] = {"terminal_observation": last[world], "TimeLimit.truncated": not terminated[world]}
        return common.to_numpy(self._seen(self._td)), rewards, dones, infos

    def get_images(self) -> list[np.ndarray]:
        """Returns the current picture of each world, uint8 ``(height, width, 3)``, which ``render()`` joins."""
        return list(self._pictures())

    # The worlds are rows of tensors, no objects: an attribute belongs to all of them.

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns the attribute once for each world of ``indices``."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Raises NotImplementedError."""
        raise NotImplementedError(f"{attr_name!r} cannot be set in single worlds, which are no objects: set it in .env")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Raises NotImplementedError."""
        raise NotImplementedError(f"{method_name}() cannot be called in single worlds, which are no objects: use .env")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Returns False for each world of ``indices``."""
        return [False for _ in self.get_attr("num_envs", indices)]
