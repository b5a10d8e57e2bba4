"""LocoEnv, the base of all environments: TorchRL's specs, step, reset, seeding and state."""

import dataclasses
import functools
import inspect
import logging
import math
import multiprocessing
import os
import secrets
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded

from torchrl_loco.checks import (
    COUNT,
    NOT_NEGATIVE,
    SEED,
    check_bool,
    check_choice,
    check_device,
    check_float,
    check_int,
    check_output_file,
    check_pair,
)
from torchrl_loco.config import sim_config
from torchrl_loco.envs.access import WorldAccess
from torchrl_loco.envs.hooks import Hooks
from torchrl_loco.envs.monitors import ON_OVERFLOW, warn
from torchrl_loco.envs.pixels import Pictures, Pixels, Seen
from torchrl_loco.envs.resets import QuickResets, rows_of
from torchrl_loco.envs.state import State, before_reset, by_world
from torchrl_loco.envs.task import BOUNDED, folder_of, options_of_class, replaced_options
from torchrl_loco.envs.variation import Variation
from torchrl_loco.envs.vary import Vary, check_randomize
from torchrl_loco.sim import models
from torchrl_loco.sim.simulation import set_options

READ_ONCE = {
    "seed": "call set_seed()",
    **dict.fromkeys(
        (
            *("action_range", "compile_hooks", "episode_length", "frame_stack", "from_pixels", "history", "nan_dump"),
            *("noise", "noise_scale", "observation_terms", "on_overflow", "play", "protocol", "randomize"),
            *("reward_terms", "with_metrics"),
        ),
        "make another with this setting",
    ),
}
"""Attributes from which an environment is made, and what to do to change them."""


class LocoEnv(WorldAccess, QuickResets):
    """Base of the locomotion environments: batched worlds of one body on one device.

    A task is a subclass: class attributes, and hooks in plain torch, of which :meth:`reward` and :meth:`observation`
    must be there. A hook is a pure function of the view ``s`` of all worlds (:class:`torchrl_loco.View`) and returns
    tensors whose first dimension is the world. They are called in the order :meth:`control`, physics, :meth:`update`,
    :meth:`reward`, :meth:`terminated`, :meth:`events`, :meth:`observation`; at a reset :meth:`begin`, then
    :meth:`observation`. docs/guides/your-own-task.md shows it.

    Instead of hooks a task can name Warp functions, which become a part of the kernel that steps the physics
    (:meth:`observation_func`, :meth:`pose_func`), as the built-in tasks do. The most derived definition of each hook
    wins.

    Args:
        num_envs: number of worlds, the batch size. ``None`` makes one world without a batch dimension.
        device: where physics and tensors live; ``None`` takes CUDA if there is any, else the CPU.
        seed: integer in [0, 2**32). Every random draw is a function of seed, world and episode; ``None`` draws a seed.
        protocol: ``"playground"`` (few solver iterations, fast) or ``"dm_control"`` (the solver converges).
        world_offset: index of the first world among the worlds of all workers. Workers or ranks that share a seed and
            step different worlds pass different offsets: worker k of n worlds each passes ``k * n``. ``None`` means 0.
        reward_terms: whether to return each term of the reward, if it has any, under
            ``("next", "reward_terms", name)``.
        observation_terms: whether to return each term of the observation, if it has names, also apart, under
            ``("observation_terms", group, name)``; of a history it is the newest.
        noise_scale: what :attr:`noise` is multiplied by; ``None`` is 1, and 0 with ``play=True``.
        metrics: whether to call :meth:`metrics`, and return each number under ``("next", "metrics", name)``.
        stagger: whether a full ``reset()`` starts each world at a random point of its time limit, so that the worlds
            are not truncated together.
        on_overflow: what to do when the physics dropped contacts or constraints for want of room: ``"warn"``,
            ``"raise"`` or ``"ignore"``. It is reported within about 100 steps, without waiting for the device; see
            :meth:`health`.
        nan_dump: a file that does not exist yet. The state and action before the first step that made a world
            non-finite are written to it, within about 100 steps or at :meth:`close`; see ``torchrl-loco inspect``.
        randomize: a list of :class:`torchrl_loco.Vary`, the numbers of the model that differ from world to world;
            ``None`` takes the class's, ``[]`` is none.
        compile_hooks: whether hooks in torch become kernels; what they read of Python is fixed then. ``False`` runs
            them as they are at every step, to print from them or to debug them.
        play: whether the worlds are for looking at a policy, not for training: commands can be set with
            :meth:`set_command`, ``randomize=None`` varies nothing, and tasks leave out noise and pushes.
        from_pixels: whether to return what a camera sees as ``"pixels"``, uint8 ``(num_envs, height, width, 3)``.
        pixels_only: whether the groups of the observation are left out; ``None`` leaves them out with
            ``from_pixels``. Terms of the reward and metrics that are asked for stay.
        camera: name or number of a camera of the model; ``None`` takes the first.
        size: width and height of the pixels; ``None`` is 84 by 84.
        frame_stack: how many of the last pictures ``"pixels"`` holds, one after the other along its last dimension, the
            newest last; ``None`` is 1. An episode begins with copies of its first.
        depth: greatest depth (m); if it is not 0, ``"depth"`` ``(num_envs, height, width)`` tells how far along the
            camera's axis lies what it sees (m).
        config: fields of :class:`torchrl_loco.SimConfig` to override, and the task's own :attr:`options`.

    Attributes:
        options_given: options of the task that were passed, as JSON can hold them.
        num_envs: number of worlds, 1 without a batch dimension.
        seed: the seed, also one that was drawn.
        protocol: the protocol.
        config: all settings, a :class:`torchrl_loco.SimConfig`.
        engine: what steps the worlds, ``"compiled"``, ``"mujoco_warp"`` or ``"mujoco"``.
        engine_reason: why.
        mj_model: the model, a ``mujoco.MjModel``.
        groups: shape of a row of each tensor of the observation, by name.
        term_names: names of the reward's terms.
        play: whether the worlds are for looking at a policy; hooks may read it.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.
        MemoryError: the device has no room for so many worlds.
    """

    _has_frame_skip = True  # the substeps are our own
    _supports_set_state = True

    def __init__(
        self,
        num_envs: int | None = 1,
        device: torch.device | str | None = None,
        seed: int | None = None,
        protocol: str = "playground",
        *,
        world_offset: int | None = None,
        reward_terms: bool = False,
        observation_terms: bool = False,
        noise_scale: float | None = None,
        metrics: bool = False,
        stagger: bool = False,
        on_overflow: str = "warn",
        nan_dump: Path | str | None = None,
        randomize: Sequence[Vary] | None = None,
        compile_hooks: bool = True,
        play: bool = False,
        from_pixels: bool = False,
        pixels_only: bool | None = None,
        camera: str | int | None = None,
        size: tuple[int, int] | None = None,
        frame_stack: int | None = None,
        depth: float = 0.0,
        **config: Any,
    ) -> None:
        self.check_class()
        worlds = 1 if num_envs is None else check_int("num_envs", num_envs)
        device = check_device(device)
        seed = None if seed is None else check_int("seed", seed, SEED)
        given = {name: config.pop(name) for name in self.options if name in config}
        options_given = options_of_class(type(self), given)
        own = {name: options_given.get(name, default) for name, (default, _) in self.options.items()}
        own |= {name: tuple(own[name]) for name, (default, _) in self.options.items() if isinstance(default, tuple)}
        arguments = [*list(inspect.signature(LocoEnv.__init__).parameters)[1:-1], *own]
        of_class = type(self).config
        if self.episode_length is not None:
            of_class = dataclasses.replace(of_class, episode_length=self.episode_length)
        sim_settings = sim_config(of_class, protocol, worlds, config, arguments)
        if world_offset is not None:
            world_offset = check_int("world_offset", world_offset, COUNT)
            check_int("world_offset + num_envs", world_offset + worlds)
        elif seed is not None:
            _warn_if_worlds_repeat()
        reward_terms, stagger = check_bool("reward_terms", reward_terms), check_bool("stagger", stagger)
        with_metrics, apart = check_bool("metrics", metrics), check_bool("observation_terms", observation_terms)
        compile_hooks, play = check_bool("compile_hooks", compile_hooks), check_bool("play", play)
        noise_scale = float(not play) if noise_scale is None else check_float("noise_scale", noise_scale, NOT_NEGATIVE)
        check_choice("on_overflow", on_overflow, ON_OVERFLOW)
        nan_dump = None if nan_dump is None else check_output_file("nan_dump", nan_dump)
        if randomize is None:
            randomize = () if play else self.randomize
        varys = check_randomize("randomize", randomize)
        mj_model = models.load(self.model, folder_of(type(self)), None, sim_settings.solids_on_terrain)
        self.check_model(mj_model)
        seen = {"from_pixels": from_pixels, "pixels_only": pixels_only, "camera": camera, "size": size, "depth": depth}
        seen["frame_stack"] = frame_stack
        pixels = Pixels.checked(mj_model, seen, worlds, device)
        if apart and pixels and pixels.only:
            raise ValueError("observation_terms are of the observation, which pixels leave out: pass pixels_only=False")
        variation = Variation(varys, mj_model, device) if varys else None

        super().__init__(device=device, batch_size=[] if num_envs is None else [worlds])
        self.options_given = options_given
        for name, value in own.items():
            setattr(self, name, value)
        self.num_envs, self.world_offset = worlds, world_offset
        self.seed = secrets.randbits(32) if seed is None else seed
        self.protocol, self.config, self.mj_model = protocol, sim_settings, mj_model
        self.episode_length = sim_settings.episode_length
        self._replaced = replaced_options(type(self), mj_model, sim_settings)
        _say_what_is_missing(mj_model)
        self.with_metrics, self.noise_scale = with_metrics, noise_scale
        self.stagger, self.compile_hooks, self.play = stagger, compile_hooks, play
        self.randomize, self.variation, self.pixels = varys, variation, pixels
        self.action_range = check_pair("action_range", self.action_range)  # a class may have a list or an array
        self.on_overflow, self.nan_dump = on_overflow, nan_dump
        self._action_shape = torch.Size([*self.batch_size, mj_model.nu])
        replaceable = ("step", "_step", "_reset", "maybe_reset")
        self._steps_as_base = all(getattr(type(self), name) is getattr(LocoEnv, name) for name in replaceable)
        self._pid = os.getpid()
        self._world, self._episodes, self._stage = None, None, {}
        self.hooks = Hooks(self, mj_model)
        hooks, self.groups = self.hooks.own, dict(self.hooks.groups)
        if self.hooks.term_names is not None:
            self.term_names = self.hooks.term_names
        self.metric_names, self.observation_layout = self.hooks.metric_names, dict(self.hooks.terms)
        if "observation" not in hooks:
            self.groups["observation"] = (self.observation_size,)
            self.observation_layout["observation"] = dict(self.observation_names)
            if self.noise or self.history:
                raise ValueError(
                    f"{type(self).__name__} has noise or history, but a Warp function observes: "
                    'def observation(self, s): return {"observation": {"all": super().observation(s)}}'
                )
        self.observation_terms = apart
        self._apart = {group: sizes for group, sizes in self.observation_layout.items() if sizes and apart}
        if "observation" in self.groups:
            self.observation_size = math.prod(self.groups["observation"])
        self.reward_terms = reward_terms and len(self.term_names) > 0
        self._stepped_model = self._without_unread_sensors(hooks)
        if play and (cases := self.cases()) and "episode_length" not in config:  # each is played to its end
            self.episode_length = max(cases.values())
            self.config = dataclasses.replace(self.config, episode_length=self.episode_length)
        self._open()
        self._make_specs()

    def _without_unread_sensors(self, own: frozenset[str]) -> mujoco.MjModel:
        """Returns the model that is stepped: without sensors that no hook asks an engine for, if hooks do all."""
        model, stepped = self.mj_model, self.mj_model
        if model.nsensor and {"reward", "observation"} <= own and "warp" not in self.hooks.catalog.arrays:
            kept = sorted(self.hooks.catalog.sensors)
            stepped = models.load(self.model, folder_of(type(self)), kept, self.config.solids_on_terrain)
            sizes = [int(size) for size in model.sensor_dim[kept]]
            self.hooks.catalog.sensor_address = {i: sum(sizes[:k]) for k, i in enumerate(kept)}
            set_options(model, self.config)
        return models.check(stepped, own_control="control" in own)

    def __setattr__(self, name: str, value: Any) -> None:
        world = self.__dict__.get("_world")
        read = world is not None and (name in READ_ONCE or name in world.fixed)
        if read and value is not getattr(self, name, None):
            in_place = "make it a tensor that you change in place, or close() and reset() the environment"
            warn(
                f"{type(self).__name__}.{name} was read when the environment was made, and changes nothing now: "
                f"{READ_ONCE.get(name, in_place)}"
            )
        super().__setattr__(name, value)

    def __repr__(self) -> str:
        num_envs = self.num_envs if self.batch_size else None
        device, protocol, seed = str(self.device), self.protocol, self.seed
        engine = self.engine if self.engine == "compiled" else f"{self.engine} ({self.engine_reason})"
        randomize = f", randomize={list(self.randomize)}" if self.randomize else ""
        of_config = {"contacts": "all", "solids_on_terrain": "exact"}
        chosen = {name: getattr(self.config, name) for name in of_config}
        contacts = "".join(f", {name}={own!r}" for name, own in chosen.items() if own != of_config[name])
        replaced = f", replaced={self._replaced}" if self._replaced else ""
        kinds = dict[str, list[str]]()
        for hook, kind in (self._world.kinds if self._world else {}).items():
            kinds.setdefault(kind, []).append(hook)
        hooks = "".join(f", {kind}: {' '.join(of_kind)}" for kind, of_kind in kinds.items())
        settings = f"{num_envs=}, {device=}, {seed=}, {protocol=}, {engine=}{contacts}{replaced}{randomize}{hooks}"
        return f"{type(self).__name__}({settings})"

    # TorchRL's side.

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.device
        as_float: dict[str, Any] = {"device": device, "dtype": torch.float32}
        groups = {} if self.pixels and self.pixels.only else self.groups
        observation: dict[str, Any] = {name: Unbounded((*batch, *shape), **as_float) for name, shape in groups.items()}
        if self.pixels:
            seen = self.pixels.specs(batch, device)
            if taken := sorted(groups.keys() & seen.keys()):
                raise ValueError(f"{taken[0]!r} is what a camera sees: give the group of the observation another name")
            observation |= seen

        def numbers(sizes: Mapping[str, int]) -> Composite:
            entries = {name: Unbounded((*batch, size), **as_float) for name, size in sizes.items()}
            return Composite(entries, shape=batch, device=device)

        if self.reward_terms:
            observation["reward_terms"] = numbers(dict.fromkeys(self.term_names, 1))
        if self.metric_names:
            observation["metrics"] = numbers(dict.fromkeys(self.metric_names, 1))
        if self._apart:
            apart = {group: numbers(sizes) for group, sizes in self._apart.items()}
            observation["observation_terms"] = Composite(apart, shape=batch, device=device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
        self.observation_spec = Composite(observation, shape=batch, device=device)
        bounded, actions = self.action_range == BOUNDED, (*batch, self.mj_model.nu)
        self.action_spec = Bounded(*BOUNDED, actions, **as_float) if bounded else Unbounded(actions, **as_float)
        # Those of the built-in tasks lie in [0, 1], but RewardSum would copy the bounds to the sum.
        self.reward_spec = Unbounded((*batch, 1), **as_float)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=batch, device=device
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._refuse_after_fork()
        shape = self._action_shape
        action = tensordict.get("action", None)
        if action is None:
            raise KeyError(f"step needs an 'action' of shape {tuple(shape)} in its TensorDict")
        if action.shape != shape:
            raise ValueError(f"action must have shape {tuple(shape)}, got {tuple(action.shape)}")
        action, part = action.reshape(self.num_envs, -1), self._mask_of("_step", tensordict)
        if part is not None:
            return self._step_part(tensordict, action, part)
        self.world.step(action)
        return self._outputs(Seen.step, with_reward=True)

    def _step_part(self, tensordict: TensorDictBase, action: torch.Tensor, part: torch.Tensor) -> TensorDictBase:
        """Returns the results of a step of the worlds of a mask ``(num_envs,)``; of the others, what they began with.

        The worlds cannot be stepped apart: the others are stepped too, without control, and put back. What all share
        stays, unless all are stepped.
        """
        before, felt, held = self.get_state(), [rows.clone() for rows in self.world.felt], ~part
        passed = tensordict.select(*self.full_done_spec, *self.full_observation_spec, strict=False)
        stay = self._skip_tensordict(self._outputs(lambda seen: {}).update(passed))
        self.world.step(action.masked_fill(held.unsqueeze(-1), 0.0), adapts=not held.any())
        after = self._outputs(Seen.step, with_reward=True)
        self._set_state(before, held, finite=False)  # one of them may have been not finite
        for rows, kept in zip(self.world.felt, felt, strict=True):
            rows.copy_(torch.where(by_world(held, rows), kept, rows))
        return after.apply(lambda new, old: torch.where(rows_of(held.view(*self.batch_size, 1), new), old, new), stay)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool = False,
        finite: bool = True,
        others: bool = True,
    ) -> TensorDictBase:
        """Returns what follows a reset; ``finite`` is for a state, ``others`` for pixels of worlds beyond the mask."""
        self._refuse_after_fork()
        mask = self._mask_of("_reset", tensordict)
        if self._world is None:
            if mask is not None and not mask.all():
                raise ValueError("this environment is closed: reset all worlds to open it again")
            self._open()
        if set_state:
            self._set_state(tensordict, mask, finite=finite)
        else:
            if isinstance(tensordict, State) and mask is None:
                warn("reset() begins new episodes and ignores the state that was passed: pass set_state=True, too")
            self.world.reset(mask, stagger=self.stagger and mask is None)
        everywhere = torch.ones((*self.batch_size, 1), dtype=torch.bool, device=self.device)
        look = functools.partial(Seen.begin, last=None if others else {}, restored=set_state)
        return self._outputs(look, unrewarded=everywhere)

    def _mask_of(self, name: str, tensordict: TensorDictBase | None) -> torch.Tensor | None:
        """Returns a mask of worlds, ``(num_envs,)``, if there is one."""
        mask = None if tensordict is None else tensordict.get(name, None)
        if mask is None:
            return None
        if mask.dtype != torch.bool:
            raise TypeError(f"{name!r} must be a mask of dtype bool, got {mask.dtype}")
        if mask.numel() != self.num_envs:
            raise ValueError(f"{name!r} must have shape {(*self.batch_size, 1)}, got {tuple(mask.shape)}")
        return mask.reshape(self.num_envs).to(self.device)

    def _outputs(
        self, look: Callable[[Seen], Pictures], *, with_reward: bool = False, unrewarded: torch.Tensor | None = None
    ) -> TensorDict:
        """Returns a copy of what the kernels wrote, as the buffers themselves change at the next step, and pixels.

        Terms of the reward, and metrics, are zero in the worlds ``unrewarded``, ``(*batch, 1)``.
        """
        outputs, batch = self.world.outputs, self.batch_size
        *groups, reward, terms, metrics, flags = outputs.parts(outputs.memory.clone())
        done, terminated, truncated = flags.view(3, *batch, 1).unbind()
        entries = {"done": done, "terminated": terminated, "truncated": truncated}
        if seen := self.world.seen:
            entries |= {key: image.view(*batch, *image.shape[1:]) for key, image in look(seen).items()}
        if not (self.pixels and self.pixels.only):
            for (name, shape), group in zip(self.groups.items(), groups, strict=True):
                entries[name] = group.view(*batch, *shape)
        if with_reward:
            entries["reward"] = reward.view(*batch, 1)
        result = TensorDict._new_unsafe(entries, batch_size=batch, device=self.device)  # they need no checks
        for key, names, numbers in (
            ("reward_terms", self.term_names if self.reward_terms else (), terms),
            ("metrics", self.metric_names, metrics),
        ):
            if names:
                numbers = numbers.view(*batch, len(names))
                if unrewarded is not None:
                    numbers.masked_fill_(unrewarded, 0.0)
                result[key] = dict(zip(names, numbers.unsqueeze(-1).unbind(-2), strict=True))
        if self._apart:
            newest = {group: result[group][..., -sum(sizes.values()) :] for group, sizes in self._apart.items()}
            result["observation_terms"] = {
                group: dict(zip(sizes, newest[group].split([*sizes.values()], -1), strict=True))
                for group, sizes in self._apart.items()
            }
        return result

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Returns what ``reset`` returns, in worlds that it leaves out what was passed, or what there is."""
        before = before_reset(tensordict, tensordict_reset, self.device)
        return super()._reset_proc_data(before, tensordict_reset)

    def _set_seed(self, seed: int | None) -> None:
        """Starts the random streams of all worlds again, at their episode 0."""
        self._keep_seed(secrets.randbits(32) if seed is None else check_int("seed", seed, SEED))
        if self._world is not None:
            self._world.set_seed(self.seed)
        elif self._episodes is not None:
            self._episodes.zero_()

    def double(self) -> "LocoEnv":
        """Raises, as :meth:`to` does: an environment computes in float32."""
        return self.to(torch.float64)

    def half(self) -> "LocoEnv":
        """Raises, as :meth:`to` does."""
        return self.to(torch.float16)

    def bfloat16(self) -> "LocoEnv":
        """Raises, as :meth:`to` does."""
        return self.to(torch.bfloat16)

    def cuda(self, device: int | torch.device | None = None) -> "LocoEnv":
        """Returns the environment itself if it lives there: see :meth:`to`."""
        return self.to(torch.device("cuda", device) if isinstance(device, int) else device or "cuda")

    def cpu(self) -> "LocoEnv":
        """Returns the environment itself if it lives there: see :meth:`to`."""
        return self.to("cpu")

    def to(self, device: Any) -> "LocoEnv":
        """Returns the environment itself if it lives on ``device``; the physics cannot move.

        Raises:
            TypeError: ``device`` is something else, such as a dtype.
            ValueError: ``device`` is another one.
        """
        if not isinstance(device, torch.device | str):
            raise TypeError(
                f"an environment cannot be converted to {device!r}: it computes in float32 on {self.device}. "
                "To cast what it returns, use torchrl.envs.DTypeCastTransform"
            )
        if check_device(device) != self.device:
            raise ValueError(
                f"the physics lives on {self.device} and cannot move: make a new environment with device={device!r}"
            )
        return self


def _warn_if_worlds_repeat() -> None:
    """Warns where a seed is passed in one of several processes: the same seed makes the same worlds in each."""
    distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
    ranks = torch.distributed.get_world_size() if distributed else int(os.environ.get("WORLD_SIZE", "1"))
    if multiprocessing.parent_process() is not None or ranks > 1:
        warn(
            "torchrl_loco: this process is one of several and passes a seed without world_offset. Workers with the "
            "same seed step identical worlds: give worker k of n worlds each its own function, with world_offset=k*n "
            "(ParallelEnv and collectors take a list of functions)"
        )


def _say_what_is_missing(m: mujoco.MjModel) -> None:
    """Says in the log if a body that floats has nothing to stand on, or nothing moves it."""
    say = logging.getLogger("torchrl_loco").warning
    touching = (m.geom_contype | m.geom_conaffinity) != 0
    fixed = m.body_weldid[m.geom_bodyid] == 0
    floats = (m.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)).any()
    if floats and m.opt.gravity.any() and not (touching & fixed).any() and m.npair == 0:
        say("nothing that is fixed to the world touches anything: bodies fall for ever. Add a plane")
    if m.nu == 0:
        say("the model has no actuators: actions change nothing")
    if models.has_home(m) and m.key("home").act.any():
        say("episodes begin with activations of 0: those of the keyframe 'home' are not used")
