"""What all wrappers share: the environment that is wrapped, its spaces, its steps."""

import math
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import EnvBase, FrameSkipTransform

from torchrl_loco.checks import check_choice
from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.pixels import checked_camera
from torchrl_loco.envs.resets import NESTED
from torchrl_loco.envs.transforms import named_transforms, unwrap
from torchrl_loco.registry import make

RENDER_MODES = ("rgb_array",)


def made(env: str | type[LocoEnv] | EnvBase, num_envs: int | None, settings: dict[str, Any]) -> EnvBase:
    """Returns the environment that is to be wrapped."""
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
    return unwrap(env)[0]


def step_worlds(env: EnvBase, td: TensorDictBase, actions: Any) -> tuple[TensorDictBase, TensorDictBase]:
    """Returns the results of a step of all worlds, and what the next begins with: those that are done are reset."""
    spec = env.action_spec
    actions = torch.as_tensor(actions, device=env.device, dtype=spec.dtype)
    if actions.shape != spec.shape:
        raise ValueError(f"actions must have shape {tuple(spec.shape)}, got {tuple(actions.shape)}")
    step, begin = env.step_and_maybe_reset(td.set("action", actions))
    return step["next"], begin


def groups_of(env: EnvBase) -> list[str]:
    """Returns the groups of observations; terms of rewards and observations and metrics, which are nested, are none.

    Raises:
        ValueError: others are nested.
    """
    groups = [key for key in env.observation_spec if key not in NESTED]
    if nested := [key for key in groups if isinstance(env.observation_spec[key], Composite)]:
        raise ValueError(
            f"observations in {', '.join(nested)} are nested: give them keys of their own by RenameTransform"
        )
    return groups


def named_numbers(after: TensorDictBase) -> dict[str, Any]:
    """Returns terms of the reward and metrics of a step, where they were asked for, each ``(num_envs,)`` by name."""
    kinds = [kind for kind in ("reward_terms", "metrics") if kind in after]
    return {kind: {name: values.squeeze(-1) for name, values in after[kind].items()} for kind in kinds}


def to_numpy(data: Any) -> Any:
    """Returns copies of a tensor, or of those of a dictionary, as arrays on the host."""
    if isinstance(data, dict):
        return {key: to_numpy(x) for key, x in data.items()}
    return data.detach().to("cpu", copy=True).numpy()


def rows_as_objects(data: Any, mask: np.ndarray) -> np.ndarray:
    """Returns an array of objects, ``(num_envs,)``: the rows of the mask, each an observation; ``None`` elsewhere."""
    rows = np.full(len(mask), None, dtype=object)
    for i in mask.nonzero()[0]:
        rows[i] = {key: x[i] for key, x in data.items()} if isinstance(data, dict) else data[i]
    return rows


class Wrapped:
    """What wrappers share that make pictures: the environment, its groups of observations and its camera."""

    def _wrap(
        self,
        env: Any,
        num_envs: int | None,
        settings: dict[str, Any],
        mode: str | None,
        picture: tuple[str | None, int, int],
    ) -> None:
        self.render_mode = None if mode is None else check_choice("render_mode", mode, RENDER_MODES)
        camera, width, height = picture
        if camera is not None and (settings.get("from_pixels") or settings.get("depth")):
            settings["camera"] = camera
        self.env, self._picture = made(env, num_envs, settings), (camera or "side", width, height)
        pixels = base_of(self.env).pixels
        if camera is not None and pixels and checked_camera(base_of(self.env).mj_model, camera) != pixels.camera:
            raise TypeError(f"the pixels of this environment are of another camera than {camera!r}: pass none")
        self._groups = groups_of(self.env)
        if mode is not None or camera is not None:
            base_of(self.env).check_picture(*self._picture)

    def _render_metadata(self) -> dict[str, Any]:
        skipping = [part for part in named_transforms(self.env).values() if isinstance(part, FrameSkipTransform)]
        seconds = base_of(self.env).config.ctrl_dt * math.prod(part.frame_skip for part in skipping)
        return {"render_modes": list(RENDER_MODES), "render_fps": round(1 / seconds)}

    def _seen(self, td: TensorDictBase) -> Any:
        """Returns the tensor of the policy, or a dictionary where there are further groups."""
        return td["observation"] if self._groups == ["observation"] else {key: td[key] for key in self._groups}

    def _pictures(self) -> np.ndarray:
        """Returns the current picture of each world, uint8 ``(num_envs, height, width, 3)``."""
        return base_of(self.env).render(*self._picture).numpy(force=True)

    def close(self) -> None:
        """Frees the memory of the worlds."""
        self.env.close()
