"""Environments as Gymnasium's: many worlds as a vector environment, or one."""

from typing import Any

import numpy as np
import torch
from gymnasium import Env
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase

from torchrl_loco.checks import check_choice
from torchrl_loco.envs import LocoEnv
from torchrl_loco.wrappers import common

ARRAYS = ("numpy", "torch")


# TorchRL's specs as Gymnasium's spaces.


def observation_space(env: EnvBase) -> Box | Dict:
    """Returns the space of an observation of one world, or a dictionary of those of its groups."""
    groups = common.groups_of(env)
    boxes = {key: box(env.observation_spec[key]) for key in groups}
    return boxes["observation"] if groups == ["observation"] else Dict(boxes)


def box(spec: TensorSpec) -> Box:
    """Returns the space of one world."""
    shape, dtype = tuple(spec.shape[1:]), torch.empty(0, dtype=spec.dtype).numpy().dtype
    if dtype.kind == "b":
        return Box(0, 1, shape, np.bool_)
    if dtype.kind == "f" and not isinstance(spec, Bounded):  # TorchRL says the largest float
        return Box(-np.inf, np.inf, shape, dtype.type)
    if not hasattr(spec.space, "low"):
        raise ValueError(f"a transform makes {type(spec).__name__} of it: these wrappers take numbers between bounds")
    low, high = (bound[0].numpy(force=True) for bound in (spec.space.low, spec.space.high))
    return Box(low, high, shape, dtype.type)


class GymnasiumEnv(common.Wrapped, Env):
    """One world as Gymnasium's ``Env``, in NumPy arrays; ``reset()`` begins its next episode.

    For many worlds :class:`GymnasiumVectorEnv` is far quicker, whose arguments and errors it has.

    Raises:
        ValueError: the environment has several worlds.
    """

    metadata: dict[str, Any] = {"render_modes": list(common.RENDER_MODES)}  # noqa: RUF012, as Gymnasium has it

    def __init__(
        self,
        env: str | type[LocoEnv] | EnvBase,
        *,
        render_mode: str | None = None,
        camera: str | None = None,
        width: int = 320,
        height: int = 240,
        **settings: Any,
    ) -> None:
        if "num_envs" in settings:
            raise TypeError("num_envs: this is one world, take GymnasiumVectorEnv for several")
        self._wrap(env, None, settings, render_mode, (camera, width, height))
        if self.env.batch_size[0] != 1:
            raise ValueError(f"the environment has {self.env.batch_size[0]} worlds: take GymnasiumVectorEnv")
        self.metadata = self._render_metadata()
        self.observation_space, self.action_space = observation_space(self.env), box(self.env.action_spec)
        self._td: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins a new episode.

        Args:
            seed: decides all later draws too; ``None`` goes on with the random stream. A curriculum goes on.
            options: ignored.

        Returns:
            The observation, and an empty dictionary.
        """
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self._td = self.env.reset()
        return self._observation(self._td), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Steps the world under an action, an array or a tensor.

        Returns:
            Observation, reward, whether the episode terminated or was truncated, and the infos, which have
            ``reward_terms`` by name with ``reward_terms=True``, and ``metrics`` with ``metrics=True``.

        Raises:
            gymnasium.error.ResetNeeded: ``reset()`` was never called, or the episode is over.
        """
        if self._td is None:
            raise ResetNeeded("reset() must be called before step(), and after an episode has ended")
        action = torch.as_tensor(action, device=self.env.device, dtype=self.env.action_spec.dtype)
        after = self.env.step(self._td.set("action", action.unsqueeze(0)))["next"]
        terminated, truncated = bool(after["terminated"]), bool(after["truncated"])
        self._td = None if terminated or truncated else after.exclude("reward")
        told = common.named_numbers(after)
        infos = {kind: {name: float(values[0]) for name, values in of_kind.items()} for kind, of_kind in told.items()}
        return self._observation(after), float(after["reward"]), terminated, truncated, infos

    def _observation(self, td: TensorDictBase) -> Any:
        seen = common.to_numpy(self._seen(td))
        return {name: rows[0] for name, rows in seen.items()} if isinstance(seen, dict) else seen[0]

    def render(self) -> Any:
        """Returns the current picture, uint8 ``(height, width, 3)``, or ``None`` without a render mode."""
        return None if self.render_mode is None else self._pictures()[0]


class GymnasiumVectorEnv(VectorEnv, common.Wrapped):
    """An environment as Gymnasium's ``VectorEnv``, with its autoreset mode ``SAME_STEP``.

    Spaces, observations and actions are those of the task. A task with ``observation`` alone has a ``Box``; one with
    further groups, such as ``privileged``, has a ``Dict`` of them. Actions without bounds have infinite ones.

    In the infos ``_final_obs`` marks the worlds that are done, and ``final_obs`` has the true last observation of each:

    - with ``arrays="numpy"`` as Gymnasium's own vector environments: in steps in which a world is done, an array of
      objects with an observation for each world that is done and ``None`` for the others;
    - with ``arrays="torch"`` in every step, in the form of an observation, batch ``(num_envs,)``, because only the
      device knows which worlds are done. In the other worlds it equals the observation.

    With ``reward_terms=True``, ``info["reward_terms"]`` has the terms of the step by name, each ``(num_envs,)``; so has
    ``info["metrics"]`` with ``metrics=True``. Where there is ``final_obs`` they stand in ``final_info``, too.

    Args:
        env: an id, a class, or an environment that is made already, with TorchRL's transforms or without.
        num_envs: number of worlds of an id or a class; ``None`` means 1.
        arrays: what is returned: ``"numpy"`` arrays on the host, which Gymnasium's wrappers expect, or ``"torch"``
            tensors on the device, for which nothing waits. Actions may be either.
        render_mode: ``"rgb_array"`` if ``render()`` is to return pixels, else ``None``.
        camera: name of the camera of these pixels, "side" by default, and of those of ``from_pixels``.
        width: pixels in a row.
        height: rows.
        settings: arguments of :func:`torchrl_loco.make`, for an id or a class.

    Attributes:
        env: the environment.
        num_envs: number of worlds.
        metadata: ``autoreset_mode``, ``render_modes`` and ``render_fps``, the control steps in a second.

    Raises:
        ValueError: an argument is out of range or unknown, or the environment has no batch of worlds.
        TypeError: ``env`` is no environment of this package, or has settings though it is made already.
    """

    def __init__(
        self,
        env: str | type[LocoEnv] | EnvBase,
        num_envs: int | None = None,
        *,
        arrays: str = "numpy",
        render_mode: str | None = None,
        camera: str | None = None,
        width: int = 320,
        height: int = 240,
        **settings: Any,
    ) -> None:
        self._torch = check_choice("arrays", arrays, ARRAYS) == "torch"
        self._wrap(env, num_envs, settings, render_mode, (camera, width, height))
        self.num_envs = self.env.batch_size[0]
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, **self._render_metadata()}
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = box(self.env.action_spec)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._td: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes.

        Args:
            seed: decides all later draws too; ``None`` goes on with the random streams. A curriculum goes on.
            options: ``{"reset_mask": mask}``, bool ``(num_envs,)``, resets the worlds of the mask alone.

        Returns:
            The observations of all worlds, and an empty dictionary.

        Raises:
            ValueError: there is no such option, or the mask has another shape or type.
        """
        super().reset(seed=seed)
        self.closed = False  # else Gymnasium would not close again what a reset opens again
        if seed is not None:
            self.env.set_seed(seed)
        for name in options or ():
            check_choice("option of reset", name, ("reset_mask",))
        mask = None if options is None else options.get("reset_mask")
        if mask is None or self._td is None:
            self._td = self.env.reset()
        else:
            rows = torch.as_tensor(mask, device=self.env.device).unsqueeze(-1)
            if rows.shape != (self.num_envs, 1) or rows.dtype != torch.bool:
                raise ValueError(f"reset_mask must be bool of shape ({self.num_envs},), got {mask!r}")
            self._td = self.env.reset(self._td.copy().set("_reset", rows))
        return self._convert(self._seen(self._td)), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all worlds under actions, an array or a tensor ``(num_envs, ...)``, and resets those that are done.

        Returns:
            The observations after the resets; rewards, terminations and truncations of the step, ``(num_envs,)`` each;
            and the infos.

        Raises:
            gymnasium.error.ResetNeeded: ``reset()`` was never called.
        """
        if self._td is None:
            raise ResetNeeded("reset() must be called before step()")
        after, self._td = common.step_worlds(self.env, self._td, actions)
        rewards, terminations, truncations, done = (
            self._convert(after[key].squeeze(-1)) for key in ("reward", "terminated", "truncated", "done")
        )
        infos: dict[str, Any] = {}
        told = {kind: self._convert(of_kind) for kind, of_kind in common.named_numbers(after).items()}
        if self._torch or done.any():
            last = self._convert(self._seen(after))
            infos = {"final_obs": last if self._torch else common.rows_as_objects(last, done), "_final_obs": done}
            infos |= {"final_info": {}, "_final_info": done}
            for kind, of_kind in told.items():
                marks = {f"_{name}": done for name in of_kind}
                infos["final_info"] |= {kind: {**of_kind, **marks}, f"_{kind}": done}
        infos |= told
        return self._convert(self._seen(self._td)), rewards, terminations, truncations, infos

    def _convert(self, data: Any) -> Any:
        """Returns copies, which the caller may change."""
        if not self._torch:
            return common.to_numpy(data)
        return {key: x.clone() for key, x in data.items()} if isinstance(data, dict) else data.clone()

    def render(self) -> tuple[np.ndarray, ...]:
        """Returns the current picture of each world, uint8 ``(height, width, 3)``; worlds that were done are new.

        Raises:
            ValueError: the environment was made without ``render_mode="rgb_array"``.
        """
        if self.render_mode is None:
            raise ValueError('nothing can be rendered: make the environment with render_mode="rgb_array"')
        return tuple(self._pictures())

    def close_extras(self, **_: Any) -> None:
        """Frees the memory of the worlds."""
        self.env.close()
