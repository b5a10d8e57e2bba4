"""Environments for other libraries: Gymnasium, RSL-RL and Stable-Baselines3.

A wrapper is an instance of its library's own class too, which it becomes when it is made: this module can be imported
without the libraries. The extra ``wrappers`` installs them.

All wrappers end an episode in the same way. A world that is done is reset in the same step, so the observation that it
returns is the first one of its next episode; the true last observation of the old episode is returned beside it.
"""

import functools
import importlib
import types
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import EnvBase
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv

from torchrl_loco.checks import check_choice, check_packages
from torchrl_loco.envs import LocoEnv
from torchrl_loco.registry import make

if TYPE_CHECKING:
    from gymnasium.spaces import Box, Dict

ARRAYS = ("numpy", "torch")
RENDER_MODES = ("rgb_array",)


class GymnasiumVectorEnv:
    """An environment as Gymnasium's ``VectorEnv``, with its autoreset mode ``SAME_STEP``.

    Spaces, observations and actions are those of the task. A task with ``observation`` alone has a ``Box``; one with
    further groups, such as ``privileged``, has a ``Dict`` of them. Actions without bounds have infinite ones.

    In the infos ``_final_obs`` marks the worlds that are done, and ``final_obs`` has the true last observation of each:

    - with ``arrays="numpy"`` as Gymnasium's own vector environments: in steps in which a world is done, an array of
      objects with an observation for each world that is done and ``None`` for the others;
    - with ``arrays="torch"`` in every step, in the form of an observation, batch ``(num_envs,)``, because only the
      device knows which worlds are done. In the other worlds it equals the observation.

    With ``reward_terms=True``, ``info["reward_terms"]`` has the terms of the step by name, each ``(num_envs,)``.

    Args:
        env: an id, a class, or an environment that is made already, with TorchRL's transforms or without.
        num_envs: number of worlds of an id or a class; ``None`` means 1.
        arrays: what is returned: ``"numpy"`` arrays on the host, which Gymnasium's wrappers expect, or ``"torch"``
            tensors on the device, for which nothing waits. Actions may be either.
        render_mode: ``"rgb_array"`` if ``render()`` is to return pixels, else ``None``.
        camera: name of the camera.
        width: pixels in a row.
        height: rows.
        settings: arguments of :func:`torchrl_loco.make`, for an id or a class.

    Attributes:
        env: the environment.
        num_envs: number of worlds.
        metadata: ``autoreset_mode``, ``render_modes`` and ``render_fps``, the control steps in a second.

    Raises:
        ImportError: Gymnasium is not installed; the message says how to install it.
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
        camera: str = "side",
        width: int = 320,
        height: int = 240,
        **settings: Any,
    ) -> None:
        _become(self, "gymnasium.vector", "VectorEnv")
        from gymnasium.vector import AutoresetMode
        from gymnasium.vector.utils import batch_space

        self._torch = check_choice("arrays", arrays, ARRAYS) == "torch"
        self.render_mode = _check_render_mode(render_mode)
        self._picture = (camera, width, height)
        self.env = _made(env, num_envs, settings)
        self.num_envs = self.env.batch_size[0]
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, **_render_metadata(self.env)}
        self.single_observation_space = _observation_space(self.env)
        self.single_action_space = _box(self.env.action_spec)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._groups = _groups(self.env)
        self._td: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins new episodes.

        Args:
            seed: decides all later draws too; ``None`` goes on with the random streams.
            options: ``{"reset_mask": mask}``, bool ``(num_envs,)``, resets the worlds of the mask alone.

        Returns:
            The observations of all worlds, and an empty dictionary.
        """
        from gymnasium.vector import VectorEnv

        VectorEnv.reset(self, seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        mask = None if options is None else options.get("reset_mask")
        if mask is None or self._td is None:
            self._td = self.env.reset()
        else:
            rows = torch.as_tensor(mask, device=self.env.device).unsqueeze(-1)
            self._td = self.env.reset(self._td.copy().set("_reset", rows))
        return self._convert(_observations(self._td, self._groups)), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Steps all worlds and resets those that are done.

        Args:
            actions: array or tensor, ``(num_envs, ...)``.

        Returns:
            The observations after the resets; rewards, terminations and truncations of the step, ``(num_envs,)`` each;
            and the infos.

        Raises:
            gymnasium.error.ResetNeeded: ``reset()`` was never called.
        """
        if self._td is None:
            from gymnasium.error import ResetNeeded

            raise ResetNeeded("reset() must be called before step()")
        after, self._td = _step(self.env, self._td, actions)
        rewards, terminations, truncations, done = (
            self._convert(after[key].squeeze(-1)) for key in ("reward", "terminated", "truncated", "done")
        )
        infos = {}
        if self._torch or done.any():
            last = self._convert(_observations(after, self._groups))
            infos = {"final_obs": last if self._torch else _rows_as_objects(last, done), "_final_obs": done}
        if "reward_terms" in after:
            infos["reward_terms"] = {k: self._convert(x.squeeze(-1)) for k, x in after["reward_terms"].items()}
        return self._convert(_observations(self._td, self._groups)), rewards, terminations, truncations, infos

    def _convert(self, data: Any) -> Any:
        return data if self._torch else _to_numpy(data)

    def render(self) -> tuple[np.ndarray, ...]:
        """Returns the current picture of each world, uint8 ``(height, width, 3)``; worlds that were done are new.

        Raises:
            ValueError: the environment was made without ``render_mode="rgb_array"``.
        """
        if self.render_mode is None:
            raise ValueError('nothing can be rendered: make the environment with render_mode="rgb_array"')
        return tuple(_render(self.env, self._picture))

    def close_extras(self, **_: Any) -> None:
        """Frees the memory of the worlds."""
        self.env.close()


class RslRlVecEnv:
    """An environment as RSL-RL's ``VecEnv``: all data stays on the device, and nothing waits for it.

    Observations are a ``TensorDict``, batch ``(num_envs,)``, with a group for each entry of the task's observation.
    ``observation`` is called ``policy``, as RSL-RL's defaults expect; the others, such as ``privileged``, keep their
    names. A configuration then has ``"obs_groups": {"actor": ["policy"], "critic": ["policy", "privileged"]}``, say.

    ``extras`` of a step has:

    - ``time_outs``, bool ``(num_envs,)``: the worlds that were truncated and not terminated;
    - ``final_observations``: in the form of the observations, the true last ones in worlds that are done, and the
      same as the observations in the others;
    - ``log``, with ``reward_terms=True``: the mean of each term of the reward, which RSL-RL logs.

    Args:
        env: an id, a class, or an environment that is made already, with TorchRL's transforms or without.
        num_envs: number of worlds of an id or a class; ``None`` means 1.
        settings: arguments of :func:`torchrl_loco.make`, for an id or a class.

    Attributes:
        env: the environment.
        num_envs: number of worlds.
        num_actions: numbers in an action.
        max_episode_length: the time limit, in control steps.
        device: where the worlds are.
        cfg: all settings, a :class:`torchrl_loco.SimConfig`.

    Raises:
        ImportError: RSL-RL is not installed; the message says how to install it.
        ValueError: an argument is out of range or unknown, or the environment has no batch of worlds.
        TypeError: ``env`` is no environment of this package, or has settings though it is made already.
    """

    def __init__(self, env: str | type[LocoEnv] | EnvBase, num_envs: int | None = None, **settings: Any) -> None:
        _become(self, "rsl_rl.env", "VecEnv")
        self.env = _made(env, num_envs, settings)
        self.cfg, self.device = _base(self.env).config, self.env.device
        self.num_envs, self.num_actions = self.env.action_spec.shape
        self.max_episode_length = self.cfg.episode_length
        self._names = {key: "policy" if key == "observation" else key for key in _groups(self.env)}
        self._td = self.env.reset()

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Control steps since the reset of each world, int32 ``(num_envs,)``; the runner assigns random ones."""
        return _base(self.env).get_state()["elapsed_steps"]

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        state = _base(self.env).get_state()
        self._td = self.env.reset(state.set("elapsed_steps", steps), set_state=True)

    def get_observations(self) -> TensorDict:
        """Returns the current observations, batch ``(num_envs,)``."""
        return self._observations(self._td)

    def _observations(self, td: TensorDictBase) -> TensorDict:
        groups = {name: td[key] for key, name in self._names.items()}
        return TensorDict(groups, batch_size=td.batch_size, device=self.device)

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Steps all worlds and resets those that are done.

        Args:
            actions: ``(num_envs, num_actions)``. RSL-RL's Gaussian has no bounds; the task clips them to its own.

        Returns:
            The observations after the resets; rewards and dones of the step, ``(num_envs,)`` each; and the extras.
        """
        after, self._td = _step(self.env, self._td, actions)
        time_outs = after["truncated"] & ~after["terminated"]
        extras = {"time_outs": time_outs.squeeze(-1), "final_observations": self._observations(after)}
        if "reward_terms" in after:
            extras["log"] = {f"/reward_terms/{name}": term.mean() for name, term in after["reward_terms"].items()}
        return self.get_observations(), after["reward"].squeeze(-1), after["done"].squeeze(-1), extras

    def close(self) -> None:
        """Frees the memory of the worlds."""
        self.env.close()


class StableBaselines3VecEnv:
    """An environment as Stable-Baselines3's ``VecEnv``: all data is copied to the host, as NumPy arrays.

    A task with ``observation`` alone has a ``Box``; one with further groups, such as ``privileged``, has a ``Dict`` of
    them, for ``MultiInputPolicy``. Stable-Baselines3 refuses actions without bounds.

    The infos of a world that is done have ``terminal_observation``, the true last one, and ``TimeLimit.truncated``,
    whether it was truncated and not terminated.

    Args:
        env: an id, a class, or an environment that is made already, with TorchRL's transforms or without.
        num_envs: number of worlds of an id or a class; ``None`` means 1.
        render_mode: ``"rgb_array"`` if ``render()`` is to return pixels, else ``None``.
        camera: name of the camera.
        width: pixels in a row.
        height: rows.
        settings: arguments of :func:`torchrl_loco.make`, for an id or a class.

    Attributes:
        env: the environment.
        num_envs: number of worlds.
        metadata: ``render_modes`` and ``render_fps``, the control steps in a second.

    Raises:
        ImportError: Stable-Baselines3 is not installed; the message says how to install it.
        ValueError: an argument is out of range or unknown, or the environment has no batch of worlds.
        TypeError: ``env`` is no environment of this package, or has settings though it is made already.
    """

    _seeds: list[int | None]

    def __init__(
        self,
        env: str | type[LocoEnv] | EnvBase,
        num_envs: int | None = None,
        *,
        render_mode: str | None = None,
        camera: str = "side",
        width: int = 320,
        height: int = 240,
        **settings: Any,
    ) -> None:
        _become(self, "stable_baselines3.common.vec_env", "VecEnv")
        from stable_baselines3.common.vec_env import VecEnv

        self.render_mode = _check_render_mode(render_mode)
        self._picture = (camera, width, height)
        self.env = _made(env, num_envs, settings)
        self.num_envs = self.env.batch_size[0]
        VecEnv.__init__(self, self.num_envs, _observation_space(self.env), _box(self.env.action_spec))
        self.metadata = _render_metadata(self.env)
        self._groups = _groups(self.env)

    def reset(self) -> Any:
        """Returns the first observations of all worlds, under the seed that ``seed()`` was given before, if any."""
        if self._seeds[0] is not None:
            self.env.set_seed(self._seeds[0])
        self._seeds = [None] * self.num_envs
        self._td = self.env.reset()
        return _to_numpy(_observations(self._td, self._groups))

    def step_async(self, actions: np.ndarray) -> None:
        """Takes the actions, ``(num_envs, ...)``; ``step_wait`` steps."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Steps all worlds and resets those that are done.

        Returns:
            The observations after the resets; rewards and dones of the step, ``(num_envs,)`` each; and the infos of
            each world.
        """
        after, self._td = _step(self.env, self._td, self._actions)
        rewards, dones, terminated = (_to_numpy(after[key].squeeze(-1)) for key in ("reward", "done", "terminated"))
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if dones.any():
            last = _rows_as_objects(_to_numpy(_observations(after, self._groups)), dones)
            for world in dones.nonzero()[0]:
                infos[world] = {"terminal_observation": last[world], "TimeLimit.truncated": not terminated[world]}
        return _to_numpy(_observations(self._td, self._groups)), rewards, dones, infos

    def get_images(self) -> list[np.ndarray]:
        """Returns the current picture of each world, uint8 ``(height, width, 3)``, which ``render()`` joins."""
        return list(_render(self.env, self._picture))

    def close(self) -> None:
        """Frees the memory of the worlds."""
        self.env.close()

    # The worlds are rows of tensors, no objects: an attribute belongs to all of them.

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns the attribute once for each world of ``indices``."""
        worlds = range(self.num_envs) if indices is None else [indices] if isinstance(indices, int) else indices
        return [getattr(self, attr_name) for _ in worlds]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuses.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"{attr_name!r} cannot be set in single worlds, which are no objects: set it in .env")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Refuses.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"{method_name}() cannot be called in single worlds, which are no objects: use .env")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Returns False for each world of ``indices``."""
        return [False for _ in self.get_attr("num_envs", indices)]


# What they share.


def _become(wrapper: object, module: str, base: str) -> None:
    """Adds a class of a library to the bases of a wrapper that is being made.

    Raises:
        ImportError: the library is not installed.
    """
    cls: Any = type(wrapper)
    check_packages(cls.__name__, [module.split(".")[0]], "wrappers")
    wrapper.__class__ = _with_base(cls, getattr(importlib.import_module(module), base))


@functools.cache
def _with_base(cls: type, base: type) -> type:
    """Returns a subclass of both, under the name of the first, whose attributes win."""
    names = {"__module__": cls.__module__, "__qualname__": cls.__qualname__, "__doc__": cls.__doc__}
    return types.new_class(cls.__name__, (cls, base), exec_body=lambda namespace: namespace.update(names))


def _made(env: str | type[LocoEnv] | EnvBase, num_envs: int | None, settings: dict[str, Any]) -> EnvBase:
    """Returns the environment that is to be wrapped.

    Raises:
        TypeError: it is no environment of this package, or is made already and has settings.
        ValueError: it has no batch of worlds.
    """
    if not isinstance(env, EnvBase):
        return make(env, 1 if num_envs is None else num_envs, **settings)
    if not isinstance(_base(env), LocoEnv):
        raise TypeError(f"env must be an id, a class or an environment of torchrl_loco, got {type(env).__name__}")
    if num_envs is not None or settings:
        names = [*(["num_envs"] if num_envs is not None else []), *settings]
        raise TypeError(f"{', '.join(names)}: the environment is made already, pass this where it is made")
    if not env.batch_size:
        raise ValueError("the environment has no batch of worlds: make it with num_envs=1")
    return env


def _base(env: EnvBase) -> Any:
    """Returns the environment under the transforms."""
    while isinstance(env, TorchRLTransformedEnv):
        env = env.base_env
    return env


def _step(env: EnvBase, td: TensorDictBase, actions: Any) -> tuple[TensorDictBase, TensorDictBase]:
    """Steps all worlds, and resets those that are done.

    Returns:
        The results of the step, and what the next one begins with, batch ``(num_envs,)`` each.
    """
    actions = torch.as_tensor(actions, device=env.device, dtype=env.action_spec.dtype)
    step, begin = env.step_and_maybe_reset(td.set("action", actions))
    return step["next"], begin


def _groups(env: EnvBase) -> list[str]:
    """Returns the groups of observations; what is nested is none of them: the terms of the reward."""
    return [key for key, spec in env.observation_spec.items() if not isinstance(spec, Composite)]


def _observations(td: TensorDictBase, groups: list[str]) -> Any:
    """Returns the tensor of the policy, or a dictionary where there are further groups."""
    return td["observation"] if groups == ["observation"] else {key: td[key] for key in groups}


def _to_numpy(data: Any) -> Any:
    return {key: x.numpy(force=True) for key, x in data.items()} if isinstance(data, dict) else data.numpy(force=True)


def _rows_as_objects(data: Any, mask: np.ndarray) -> np.ndarray:
    """Returns an array of objects, ``(num_envs,)``: the rows of the mask, each an observation; ``None`` elsewhere."""
    rows = np.full(len(mask), None, dtype=object)
    for i in mask.nonzero()[0]:
        rows[i] = {key: x[i] for key, x in data.items()} if isinstance(data, dict) else data[i]
    return rows


def _observation_space(env: EnvBase) -> "Box | Dict":
    from gymnasium.spaces import Dict

    groups = _groups(env)
    boxes = {key: _box(env.observation_spec[key]) for key in groups}
    return boxes["observation"] if groups == ["observation"] else Dict(boxes)


def _box(spec: TensorSpec) -> "Box":
    """Returns the space of one world."""
    from gymnasium.spaces import Box

    shape, dtype = tuple(spec.shape[1:]), torch.empty(0, dtype=spec.dtype).numpy().dtype
    if dtype.kind == "b":
        return Box(False, True, shape, np.bool_)
    if dtype.kind == "f" and not isinstance(spec, Bounded):  # TorchRL says the largest float
        return Box(-np.inf, np.inf, shape, dtype.type)
    low, high = (bound[0].numpy(force=True) for bound in (spec.space.low, spec.space.high))
    return Box(low, high, shape, dtype.type)


def _check_render_mode(mode: str | None) -> str | None:
    return None if mode is None else check_choice("render_mode", mode, RENDER_MODES)


def _render_metadata(env: EnvBase) -> dict[str, Any]:
    return {"render_modes": list(RENDER_MODES), "render_fps": round(1 / _base(env).config.ctrl_dt)}


def _render(env: EnvBase, picture: tuple[str, int, int]) -> np.ndarray:
    """Returns the current picture of each world, uint8 ``(num_envs, height, width, 3)``."""
    return _base(env).render(*picture).numpy(force=True)
