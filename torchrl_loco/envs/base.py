"""LocoEnv, the base of all environments: TorchRL's specs, step, reset, seeding and state."""

import copy
import dataclasses
import difflib
import inspect
import logging
import math
import multiprocessing
import os
import secrets
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import mujoco
import numpy as np
import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_loco.checks import (
    ANY,
    COUNT,
    NOT_NEGATIVE,
    SEED,
    Interval,
    check_bool,
    check_choice,
    check_device,
    check_float,
    check_int,
    check_output_file,
    check_pair,
)
from torchrl_loco.conditions import Conditions
from torchrl_loco.config import SimConfig, options_of, sim_config
from torchrl_loco.envs.hooks import HOOKS, Hooks, check_commands, declared, own_hooks
from torchrl_loco.envs.monitors import ON_OVERFLOW, warn
from torchrl_loco.envs.state import State, without_state, write_state
from torchrl_loco.envs.variation import Variation, constant_of
from torchrl_loco.envs.vary import Vary, check_randomize
from torchrl_loco.envs.world import World
from torchrl_loco.sim import Simulation, fill, models
from torchrl_loco.sim.sampling import Table, draw_from_table
from torchrl_loco.sim.simulation import set_options

if TYPE_CHECKING:
    from torchrl_loco.envs.view import View
    from torchrl_loco.viewer.viewer import Viewer

BOUNDED, UNBOUNDED = (-1.0, 1.0), (-math.inf, math.inf)
"""What ``action_range`` can be."""


STAGE_WORLDS = 64
"""Of how many worlds a stage keeps the memory, at most."""


NESTED = ("reward_terms", "metrics", "observation_terms")
"""Entries of a step that are TensorDicts."""


HOLDS = ("falls", "return", "kept", "delay", "friction", "pushes")
"""What a task can ask for: see :attr:`LocoEnv.holds`."""


class _OfModel:
    """Settings of a class that has none of its own: the options of its model."""

    def __get__(self, env: "LocoEnv | None", cls: "type[LocoEnv]") -> SimConfig:
        return SimConfig.of(models.load(cls.model, folder_of(cls)))


class LocoEnv(EnvBase):
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
        config: fields of :class:`torchrl_loco.SimConfig` to override.

    Attributes:
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

    model: ClassVar[Path | str | mujoco.MjSpec]
    """Path of an MJCF file (relative to the file of the class), MJCF text, or a ``mujoco.MjSpec``."""
    config: SimConfig = cast("SimConfig", _OfModel())
    """Settings of the simulation under ``playground``; without any, the options of the model
    (:meth:`torchrl_loco.SimConfig.of`). An instance's has all that was overridden."""
    memory: ClassVar[Mapping[str, Any]] = {}
    """What a world remembers, by name: the shape of a row, its dtype, or both, such as
    ``{"command": 3, "frame": torch.int32, "bins": ((4,), torch.int32)}``; floats of float32, int32, int64 or bool.
    ``s.command`` reads it; :meth:`update`, :meth:`events` and :meth:`begin` return new rows. The state holds it."""
    shared: ClassVar[Mapping[str, Any]] = {}
    """What all worlds have in common, by name, as for :attr:`memory`, or a tensor that it begins with, else with zeros.
    ``s.name`` reads it, :meth:`adapt` returns new values after each step. The state holds it. A world of such a task
    depends on its neighbours; in training on several GPUs each rank has its own, but for those in
    :attr:`summed_over_ranks`."""
    summed_over_ranks: ClassVar[Sequence[str]] = ()
    """Names of entries of :attr:`shared`, such as counts, whose changes are added up over the ranks of a training,
    after each batch."""
    constants: ClassVar[Any] = {}
    """Tables that never change, tensors or arrays by name, or a method that returns them once: ``s.name`` reads them
    on the device. ``s.table[s.frame]`` looks up a row in each world; where an index is out of range it gives NaN, which
    :meth:`health` counts as ``index_error``."""
    noise: ClassVar[Mapping[str, Any]] = {}
    """By term of the observation, the most that is added to its numbers or taken away, drawn uniformly at each step; or
    that and the name of an entry of :attr:`memory` that is added too, an offset, such as ``{"gravity": 0.05,
    "joint_positions": (0.01, "bias")}``. The policy's groups have it, ``privileged`` has not; nor has it in play."""
    history: ClassVar[Mapping[str, int]] = {}
    """By group of the observation, how many of the last ones it has, with noise, the newest last; at a reset all are
    the first. The state holds them."""
    observation_names: ClassVar[Mapping[str, int]] = {}
    """Names and sizes of the terms of a Warp function's observation, in their order."""
    holds: ClassVar[Mapping[str, Any]] = {}
    """What ``torchrl-loco verify`` asks for: ``falls``, the greatest share of episodes that terminate; ``return``, the
    least return; without either ``kept``, the least share of the return in the training, 0.9. And in which conditions:
    ``delay`` (least and greatest, control steps), ``friction`` (least and greatest), ``pushes`` (a multiple of
    mjlab's), such as ``{"falls": 0.01, "delay": (0, 2), "pushes": 1.0}``."""
    command_ranges: ClassVar[Mapping[str, Mapping[str, tuple[float, float]]]] = {}
    """Entries of :attr:`memory` that are commands: by entry, the name of each of its numbers, with its unit, and the
    least and greatest value, such as ``{"command": {"forward (m/s)": (-1.0, 2.0)}}``. With ``play=True`` they can be
    set, and the viewer has a slider for each."""
    randomize: Sequence[Vary] = ()
    """Numbers of the model that each world draws at its resets; see :class:`torchrl_loco.Vary`."""
    episode_length: ClassVar[int | None] = None
    """Control steps after which an episode is truncated; ``None`` takes that of :attr:`config`."""
    action_range: Sequence[float] = BOUNDED
    """(-1, 1), or (-inf, inf) for actions without bounds, which need an own :meth:`control`."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """By algorithm, settings of training on CUDA that were tuned for this task."""
    body: ClassVar[str] = ""
    """Name of the body; a ``state_dict`` fits environments of the same body."""
    observation_size: int
    """Length of ``observation``; to be set beside :meth:`observation_func`."""
    term_names: tuple[str, ...] = ()
    """Names of the reward's terms; to be set beside :meth:`observation_func`."""

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
        **config: Any,
    ) -> None:
        self.check_class()
        worlds = 1 if num_envs is None else check_int("num_envs", num_envs)
        device = check_device(device)
        seed = None if seed is None else check_int("seed", seed, SEED)
        arguments = list(inspect.signature(LocoEnv.__init__).parameters)[1:-1]
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
        mj_model = models.load(self.model, folder_of(type(self)))
        self.check_model(mj_model)
        variation = Variation(varys, mj_model, device) if varys else None

        super().__init__(device=device, batch_size=[] if num_envs is None else [worlds])
        self.num_envs, self.world_offset = worlds, world_offset
        self.seed = secrets.randbits(32) if seed is None else seed
        self.protocol, self.config, self.mj_model = protocol, sim_settings, mj_model
        self._replaced = self._replaced_options()
        _say_what_is_missing(mj_model)
        self.with_metrics, self.noise_scale = with_metrics, noise_scale
        self.stagger, self.compile_hooks, self.play = stagger, compile_hooks, play
        self.randomize, self.variation = varys, variation
        self.action_range = check_pair("action_range", self.action_range)  # a class may have a list or an array
        self.on_overflow, self.nan_dump = on_overflow, nan_dump
        self._action_shape = torch.Size([*self.batch_size, mj_model.nu])
        self._pid = os.getpid()
        self._world: World | None = None
        self._episodes: torch.Tensor | None = None  # of a closed environment
        self._stage: Mapping[str, Any] = {}
        self.hooks = (
            Hooks(self, mj_model)
            if own_hooks(type(self)) or self.memory or self.shared or models.has_home(mj_model)
            else None
        )
        own = self.hooks.own if self.hooks else frozenset()
        self.groups = dict(self.hooks.groups) if self.hooks else {}
        if "observation" not in own:
            self.groups["observation"] = (self.observation_size,)
        if self.hooks and self.hooks.term_names is not None:
            self.term_names = self.hooks.term_names
        self.metric_names = self.hooks.metric_names if self.hooks else ()
        self.observation_layout = dict(self.hooks.terms) if self.hooks else {}
        if "observation" not in own:
            self.observation_layout["observation"] = dict(self.observation_names)
            if self.noise or self.history:
                raise ValueError(
                    f"{type(self).__name__} has noise or history, but a Warp function observes: "
                    'def observation(self, s): return {"observation": {"all": super().observation(s)}}'
                )
        self._apart = {group: sizes for group, sizes in self.observation_layout.items() if sizes and apart}
        if "observation" in self.groups:
            self.observation_size = math.prod(self.groups["observation"])
        self.reward_terms = reward_terms and len(self.term_names) > 0
        self._stepped_model = self._without_unread_sensors(own)
        self._open()
        self._make_specs()

    def _without_unread_sensors(self, own: frozenset[str]) -> mujoco.MjModel:
        """Returns the model that is stepped: without sensors that no hook asks an engine for, if hooks do all."""
        model, stepped = self.mj_model, self.mj_model
        by_warp = self.hooks and "warp" in self.hooks.catalog.arrays
        if self.hooks and model.nsensor and {"reward", "observation"} <= own and not by_warp:
            kept = sorted(self.hooks.catalog.sensors)
            stepped = models.load(self.model, folder_of(type(self)), kept)
            sizes = [int(size) for size in model.sensor_dim[kept]]
            self.hooks.catalog.sensor_address = {i: sum(sizes[:k]) for k, i in enumerate(kept)}
            set_options(model, self.config)
        return models.check(stepped, own_control="control" in own)

    @classmethod
    def check_class(cls) -> None:
        """Checks what a subclass has set.

        Raises:
            TypeError: an attribute or a hook is missing or has the wrong type, or a table of initial states would not
                be used.
            ValueError: ``observation_size`` is less than 1, or an attribute is none of the valid values.
        """
        name, own = cls.__name__, own_hooks(cls)
        _warn_of_misspelt_names(cls)
        if not hasattr(cls, "model"):
            raise TypeError(f"{name} must set model: see help(torchrl_loco.LocoEnv)")
        if not isinstance(cls.config, SimConfig):
            raise TypeError(f"{name}.config must be a torchrl_loco.SimConfig, got {cls.config!r}")
        if not isinstance(cls.model, str | Path | mujoco.MjSpec):
            raise TypeError(f"{name}.model must be a path, MJCF text or a mujoco.MjSpec, got {cls.model!r}")
        lacking = [hook for hook in ("reward", "observation") if hook not in own]
        if lacking and cls.observation_func is LocoEnv.observation_func:
            raise TypeError(f"{name} must define {' and '.join(f'{hook}(self, s)' for hook in lacking)}")
        if lacking:
            if not hasattr(cls, "observation_size"):
                raise TypeError(f"{name} must set observation_size: see help(torchrl_loco.LocoEnv)")
            check_int(f"{name}.observation_size", cls.observation_size)
            if not isinstance(cls.term_names, tuple | list) or not all(isinstance(key, str) for key in cls.term_names):
                raise TypeError(f"{name}.term_names must be a tuple of names, got {cls.term_names!r}")
        if cls.episode_length is not None:
            check_int(f"{name}.episode_length", cls.episode_length)
        action_range = check_pair(f"{name}.action_range", cls.action_range)
        if action_range not in (BOUNDED, UNBOUNDED):
            raise ValueError(f"{name}.action_range must be (-1, 1) or (-inf, inf), got {cls.action_range!r}")
        if action_range == UNBOUNDED and "control" not in own:
            raise TypeError(f"{name} has actions without bounds, so it must define control(self, s, action)")
        memory, shared = declared(cls)
        check_commands(cls, memory)
        for attribute in ("noise", "history", "holds"):
            if not isinstance(getattr(cls, attribute), Mapping):
                raise TypeError(f"{name}.{attribute} must be a dict by name, got {getattr(cls, attribute)!r}")
        if isinstance(cls.summed_over_ranks, str):
            raise TypeError(f"{name}.summed_over_ranks must be a tuple of names, got {cls.summed_over_ranks!r}")
        for what in cls.holds:
            check_choice(f"{name}.holds", what, HOLDS)
        Conditions().of(cls.holds).check()
        for entry in cls.summed_over_ranks:
            check_choice(f"{name}.summed_over_ranks", entry, shared)
        check_randomize(f"{name}.randomize", cls.randomize)
        # Of the package's own functions only LocoEnv's reads the table.
        if cls.pose_func is not LocoEnv.pose_func and cls.pose_func.__module__.startswith("torchrl_loco."):
            table = next(base for base in cls.__mro__ if {"pose_func", "initial_states"} & vars(base).keys())
            if "pose_func" not in vars(table):
                raise TypeError(
                    f"{table.__name__}.initial_states is not used, since an inherited pose_func draws the states: "
                    f"set pose_func = torchrl_loco.LocoEnv.pose_func in {table.__name__}"
                )

    @classmethod
    def check_model(cls, mj_model: mujoco.MjModel) -> None:
        """Checks that a model has what the task takes for granted; by default nothing.

        Raises:
            ValueError: it has not.
        """

    def __setattr__(self, name: str, value: Any) -> None:
        fixed = getattr(self.__dict__.get("_world"), "fixed", ())
        if name in fixed and name != "seed" and value is not getattr(self, name, None):  # set_seed() sets that
            warn(
                f"{type(self).__name__}.{name} was read when the environment was made, and changes nothing now: make "
                "it a tensor that you change in place, or close() and reset() the environment"
            )
        super().__setattr__(name, value)

    def __repr__(self) -> str:
        num_envs = self.num_envs if self.batch_size else None
        device, protocol, seed = str(self.device), self.protocol, self.seed
        engine = self.engine if self.engine == "compiled" else f"{self.engine} ({self.engine_reason})"
        randomize = f", randomize={list(self.randomize)}" if self.randomize else ""
        contacts = "" if self.config.contacts == "all" else f", contacts={self.config.contacts!r}"
        replaced = f", replaced={self._replaced}" if self._replaced else ""
        kinds = dict[str, list[str]]()
        for hook, kind in (self._world.kinds if self._world else {}).items():
            kinds.setdefault(kind, []).append(hook)
        hooks = "".join(f", {kind}: {' '.join(of_kind)}" for kind, of_kind in kinds.items())
        settings = f"{num_envs=}, {device=}, {seed=}, {protocol=}, {engine=}{contacts}{replaced}{randomize}{hooks}"
        return f"{type(self).__name__}({settings})"

    def _replaced_options(self) -> dict[str, str]:
        """Returns which options of the model ``config`` replaces, and logs them, unless both are this package's.

        Of defaults, which an MJCF may not have named, it is the damping alone, where there is any.
        """
        owners = [next(each for each in type(self).__mro__ if name in vars(each)) for name in ("model", "config")]
        if all(owner.__module__.startswith("torchrl_loco.tasks") for owner in owners):
            return {}
        of_model, default = options_of(self.mj_model.opt), options_of(mujoco.MjSpec().option)
        if self.config.integrator != "euler" or not self.mj_model.dof_damping.any():
            del of_model["euler_damping"]
        if self.config.engine == "mujoco":  # which has all other options from the model
            of_model = {name: of_model[name] for name in ("sim_dt", "integrator")}
        replaced = {
            name: f"{value} -> {new}"
            for name, value in of_model.items()
            if (new := getattr(self.config, name)) != value and (value != default[name] or name == "euler_damping")
        }
        if said := {name: text for name, text in replaced.items() if name != "integrator"}:  # of which Simulation tells
            listed = ", ".join(f"{name} {text}" for name, text in said.items())
            logging.getLogger("torchrl_loco").warning(
                "%s: config replaces options of the model: %s; without config, or by SimConfig.of(model), they stay",
                type(self).__name__,
                listed,
            )
        return replaced

    # The hooks of a task, in plain torch, in the order in which they are called.

    def control(self, s: "View", action: torch.Tensor) -> torch.Tensor:
        """Returns the controls ``(num_envs, nu)`` of actions; by default [-1, 1] is scaled to each ``ctrlrange``.

        Args:
            s: the worlds before the physics.
            action: ``(num_envs, nu)``, clipped to :attr:`action_range`, zero in worlds where one is not finite.
        """
        low, high = s.model("actuator_ctrlrange").unbind(-1)
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def update(self, s: "View") -> Mapping[str, torch.Tensor]:
        """Returns new rows of :attr:`memory` by name, after the physics: what the reward must know of the past."""
        return {}

    def reward(self, s: "View") -> torch.Tensor | Mapping[str, torch.Tensor]:
        """Returns the reward ``(num_envs,)``, or its terms by name, which are summed.

        By default it is that of the class's Warp function, if it has one: what ``super().reward(s)`` returns.
        """
        return s._by_warp("reward")

    def terminated(self, s: "View") -> torch.Tensor:
        """Returns whether the episode ends, bool ``(num_envs,)``; by default never."""
        return torch.zeros(s.num_envs, dtype=torch.bool, device=s.device)

    def metrics(self, s: "View") -> Mapping[str, torch.Tensor]:
        """Returns numbers of each world for the log alone, by name, each ``(num_envs,)``, such as an error in m.

        Those that are NaN do not count.

        It is called where they are read: in training, and with ``metrics=True``.
        """
        return {}

    def events(self, s: "View") -> Mapping[str, torch.Tensor]:
        """Returns rows for what comes next, by name: of :attr:`memory` (a new command, the last action), qpos, qvel."""
        return {}

    def adapt(self, s: "View") -> Mapping[str, torch.Tensor]:
        """Returns new values of :attr:`shared` by name, after the events; it alone may sum over worlds.

        ``s.terminated`` tells whose episode has ended. Sums of floats have a fixed order, so that runs repeat.
        """
        return {}

    def observation(self, s: "View") -> torch.Tensor | Mapping[str, torch.Tensor | Mapping[str, torch.Tensor]]:
        """Returns the observation ``(num_envs, n)``, or several by name: ``privileged`` is the critic's.

        Each may be terms by name, ``(num_envs, ...)``, which are joined in their order:
        ``{"observation": {"gravity": ..., "joint_positions": ...}, "privileged": {...}}``. :attr:`noise` and
        :attr:`history` go by these names.

        By default it is that of the class's Warp function, if it has one: what ``super().observation(s)`` returns.
        """
        return s._by_warp("observation")

    def begin(self, s: "View") -> Mapping[str, torch.Tensor]:
        """Returns rows that begin an episode, by name: qpos, qvel, and of :attr:`memory`.

        What is not returned begins as zero, ``qpos`` as ``s.home``. The worlds are at rest; ``s`` shows the memory that
        the last episode left. By default a Warp function or table of the class begins it, if it has one.
        """
        return s._begun_by_warp()

    # Looking at a policy.

    def set_command(self, command: Sequence[float] | torch.Tensor | None, entry: str | None = None) -> None:
        """Sets a command that the worlds follow from their next step or reset on.

        Args:
            command: a row of the memory, or one for each world, ``(num_envs, *row)``; ``None`` lets the worlds draw it
                again, as at first.
            entry: which entry of :attr:`command_ranges`; ``None`` takes the only one.

        Raises:
            ValueError: the environment was made without ``play=True``, the class has no such command, or the shape is
                another one.
        """
        if not self.play:
            raise ValueError("commands are drawn in training: make the environment with play=True to set them")
        settable = self.hooks.commands if self.hooks else {}
        if not settable:
            raise ValueError(f"{type(self).__name__} has no command: its command_ranges are empty")
        if entry is None and len(settable) > 1:
            raise ValueError(f"{type(self).__name__} has several commands: pass one of {', '.join(settable)} as entry")
        values, is_set = settable[check_choice("entry", next(iter(settable)) if entry is None else entry, settable)]
        row = values.shape[1:]
        rows = torch.zeros(row) if command is None else torch.as_tensor(command, dtype=torch.float32)
        if rows.shape not in (row, values.shape):
            raise ValueError(f"command must have shape {tuple(row)} or {tuple(values.shape)}, got {tuple(rows.shape)}")
        if not rows.isfinite().all():
            raise ValueError(f"command must have finite numbers, got {rows.tolist()}")
        values.copy_(rows)
        is_set.fill_(command is not None)

    def view(
        self, policy: Callable[[TensorDictBase], TensorDictBase], action_repeat: int | None = None, **server: Any
    ) -> "Viewer":
        """Plays a policy in these worlds in the browser, in a thread of its own; a notebook shows the page inline.

        Args:
            policy: reads ``observation`` and writes ``action``.
            action_repeat: control steps for which an action is held; ``None`` takes that of ``policy.info``, else 1.
            server: ``host`` and ``port``, as for :class:`torchrl_loco.viewer.viewer.Viewer`.

        Returns:
            The viewer. Leave the worlds to it until its ``close()``.

        Raises:
            ImportError: the extra ``viewer`` is not installed.
            ValueError: there are more than 64 worlds.
        """
        from torchrl_loco.viewer.viewer import Viewer

        return Viewer(self, policy, action_repeat, **server).start()

    # What verify plays, and what a policy's file tells of the task.

    @classmethod
    def stage_of(cls, info: Mapping[str, Any]) -> Mapping[str, Any]:
        """Returns the stage of the curriculum that a policy has reached, as :meth:`set_stage` takes it.

        Args:
            info: the policy's information; training writes ``stage`` into it.
        """
        return info.get("stage", {})

    @classmethod
    def fixed_commands(cls, info: Mapping[str, Any]) -> Mapping[str, Sequence[Sequence[float]]]:
        """Returns by entry of :attr:`command_ranges` the commands that half of ``verify``'s episodes have throughout.

        Args:
            info: the policy's information: ``frames``, ``num_envs`` of its training.
        """
        return {}

    @classmethod
    def facts(cls, m: mujoco.MjModel, info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns what programs without this package must know to play a policy, beside :mod:`torchrl_loco.deployment`.

        Args:
            m: the model.
            info: the policy's information: protocol, settings of its training.

        Returns:
            ``action_offset`` and ``action_scale``, each ``(nu,)``, if actions become controls in another way than
            scaled to each ``ctrlrange``; whatever else JSON can hold.
        """
        return {}

    # The same as Warp functions, which become a part of the kernel.

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward of one world, and its inputs.

        It is a ``wp.func`` of the index of the world, the inputs, the world's row of the observation, float
        ``(observation_size,)``, and that of the terms, float ``(len(term_names),)``; it writes every number of both,
        without reading what they held, and returns the reward.

        Args:
            world: the worlds; the physics arrays are in ``world.sim.data``.

        Returns:
            The function and its inputs. These are an instance of a ``wp.struct``; see :func:`torchrl_loco.sim.fill`.
        """
        raise NotImplementedError(f"{type(self).__name__} must have a method observation_func")

    def initial_states(self) -> np.ndarray | None:
        """Returns a table of which each reset draws a row; ``None`` for the default pose.

        A row is a pose, in which the world is at rest (``(count, nq)``), or a pose and its velocities
        (``(count, nq + nv)``: qpos, then qvel).

        It is called when the environment is made, and again when it opens after :meth:`close`, so it must return the
        same table every time.
        """
        return None

    def pose_func(self, world: World) -> tuple[wp.Function, Any] | None:
        """Returns the function that draws an initial state, and its inputs; by default it draws from the table.

        It is a ``wp.func`` of the index of the world, the inputs, and the start of the world's random stream (uint32).
        The world is at rest in the default pose. The function writes ``qpos``, and ``qvel`` if it begins in motion.

        Args:
            world: the worlds; the physics arrays are in ``world.sim.data``.

        Returns:
            The function and its inputs. These are an instance of a ``wp.struct`` with ``world.sim.data.qvel`` among its
            fields if worlds begin in motion; ``None`` for the default pose.

        Raises:
            ValueError: the table has the wrong shape, or a number that is not finite.
        """
        states = self.initial_states()
        if states is None:
            return None
        table, data = np.asarray(states, dtype=np.float32), world.sim.data
        nq, nv = self.mj_model.nq, self.mj_model.nv
        if table.ndim != 2 or table.shape[1] not in (nq, nq + nv) or len(table) == 0:
            raise ValueError(
                f"initial_states must return an array of shape (count > 0, {nq}) or (count > 0, {nq + nv}), "
                f"got {table.shape}"
            )
        if not np.isfinite(table).all():
            raise ValueError("initial_states must return finite numbers")
        return draw_from_table, fill(Table, data, states=wp.array(table, device=world.sim.device))

    # TorchRL's side.

    def _make_specs(self) -> None:
        batch, device = self.batch_size, self.device
        as_float: dict[str, Any] = {"device": device, "dtype": torch.float32}
        observation: dict[str, Any] = {
            name: Unbounded((*batch, *shape), **as_float) for name, shape in self.groups.items()
        }
        if self.reward_terms:
            terms = {name: Unbounded((*batch, 1), **as_float) for name in self.term_names}
            observation["reward_terms"] = Composite(terms, shape=batch, device=device)
        if self.metric_names:
            metrics = {name: Unbounded((*batch, 1), **as_float) for name in self.metric_names}
            observation["metrics"] = Composite(metrics, shape=batch, device=device)
        if self._apart:
            apart = {
                group: Composite(
                    {name: Unbounded((*batch, size), **as_float) for name, size in sizes.items()},
                    shape=batch,
                    device=device,
                )
                for group, sizes in self._apart.items()
            }
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
        action, part = action.reshape(self.num_envs, -1), tensordict.get("_step", None)
        if part is not None:
            return self._step_part(tensordict, action, part.reshape(self.num_envs))
        self.world.step(action)
        return self._outputs(with_reward=True)

    def _step_part(self, tensordict: TensorDictBase, action: torch.Tensor, part: torch.Tensor) -> TensorDictBase:
        """Steps the worlds of a mask ``(num_envs,)``.

        The worlds cannot be stepped apart: the others are stepped too, without control, and put back.

        Returns:
            The results of the step, of the other worlds what they began with and no reward.
        """
        before, held = self.get_state(), ~part.to(self.device)
        self.world.step(action.masked_fill(held.unsqueeze(-1), 0.0))
        after = self._outputs(with_reward=True)
        self._set_state(before, held)
        stay = self._skip_tensordict(tensordict.select(*self.full_done_spec, *self.full_observation_spec, strict=False))
        return after.apply(lambda new, old: torch.where(rows_of(held.view(*self.batch_size, 1), new), old, new), stay)

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False) -> TensorDictBase:
        self._refuse_after_fork()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            if mask.dtype != torch.bool:
                raise TypeError(f"'_reset' must be a mask of dtype bool, got {mask.dtype}")
            if mask.numel() != self.num_envs:
                raise ValueError(f"'_reset' must have shape {(*self.batch_size, 1)}, got {tuple(mask.shape)}")
            mask = mask.reshape(self.num_envs).to(self.device)
        if self._world is None:
            if mask is not None and not mask.all():
                raise ValueError("this environment is closed: reset all worlds to open it again")
            self._open()
        if set_state:
            self._set_state(tensordict, mask)
        else:
            self.world.reset(mask, stagger=self.stagger and mask is None)
        everywhere = torch.ones((*self.batch_size, 1), dtype=torch.bool, device=self.device)
        return self._outputs(unrewarded=everywhere)

    def _outputs(self, *, with_reward: bool = False, unrewarded: torch.Tensor | None = None) -> TensorDict:
        """Returns a copy of what the kernels wrote: the buffers themselves change at the next step.

        Args:
            with_reward: whether the reward is in it.
            unrewarded: worlds ``(*batch, 1)`` whose terms of the reward, and metrics, are zero.
        """
        outputs, batch = self.world.outputs, self.batch_size
        *groups, reward, terms, metrics, flags = outputs.parts(outputs.memory.clone())
        done, terminated, truncated = flags.view(3, *batch, 1).unbind()
        entries = {"done": done, "terminated": terminated, "truncated": truncated}
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
            result["observation_terms"] = {
                group: dict(
                    zip(sizes, result[group][..., -sum(sizes.values()) :].split([*sizes.values()], -1), strict=True)
                )
                for group, sizes in self._apart.items()
            }
        return result

    def _batched(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns a copy of an array with one row per world, in the environment's batch size."""
        return (rows if self.batch_size else rows[0]).clone(memory_format=torch.contiguous_format)

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase, rewritten: frozenset[str] = frozenset()
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Returns what TorchRL's method returns; for a plain TensorDict, after a third of the work on the host.

        Args:
            tensordict: has an ``action``, batch ``(num_envs,)``.
            rewritten: entries that the next step need not begin with.
        """
        own = (getattr(type(self), name) is getattr(LocoEnv, name) for name in ("step", "_reset", "maybe_reset"))
        if not all(own) or not self._is_plain(tensordict):
            return super()._step_and_maybe_reset(tensordict)
        after = self._step(tensordict)
        self.world.reset_masked()
        done = after.get("done")
        begin = self._outputs(unrewarded=done)  # in the worlds that go on, nothing has changed
        # As in TorchRL, the policy's outputs are zero where a world was reset.
        for key, value in tensordict.items():
            if key not in begin and key not in rewritten and key != "reward":
                begin._set_str(key, value.masked_fill(rows_of(done, value), 0), inplace=False, validated=True)
        tensordict.set("next", after)
        return tensordict, begin

    def _is_plain(self, tensordict: TensorDictBase) -> bool:
        """Returns whether a step needs none of TorchRL's further features.

        Those are partial steps, results given in advance, nested entries, checks of types, hooks.
        """
        return (
            type(tensordict) is TensorDict
            and tensordict.batch_size == self.batch_size
            and tensordict.device == self.device
            and not self.run_type_checks
            and self._post_step_mdp_hooks is None
            and all(isinstance(value, torch.Tensor) or key in NESTED for key, value in tensordict.items())
            and "_step" not in tensordict
        )

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Resets the worlds that are done, without reading from the device.

        Args:
            tensordict: what ``step_mdp`` makes of a step, batch ``(num_envs,)``.

        Returns:
            The same, batch ``(num_envs,)``, with new episodes in the worlds that were done.
        """
        return reset_done_worlds(self, tensordict)

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Returns what ``reset`` returns, without a state that was passed to it, which would become stale."""
        return super()._reset_proc_data(without_state(tensordict, self.device), tensordict_reset)

    def _set_seed(self, seed: int | None) -> None:
        """Starts the random streams of all worlds again, at their episode 0."""
        self.seed = secrets.randbits(32) if seed is None else check_int("seed", seed, SEED)
        if self._world is not None:
            self._world.set_seed(self.seed)
        elif self._episodes is not None:
            self._episodes.zero_()

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

    # The worlds.

    def _open(self) -> None:
        """Makes the worlds. Those of an environment that was open before continue with their next episodes."""
        self._world = World(self, self._stepped_model)
        self.engine, self.engine_reason = self._world.sim.engine_choice
        if self._episodes is not None:
            self._world.episode.torch.copy_(self._episodes)
            self.set_stage(self._stage)
        self.is_closed = False

    @property
    def world(self) -> World:
        """The worlds on the device.

        Raises:
            RuntimeError: the environment is closed.
        """
        if self._world is None:
            being_made = self._episodes is None
            state = "being made: use the hook's argument world" if being_made else "closed: reset() opens it again"
            raise RuntimeError(f"this {type(self).__name__} is {state}")
        return self._world

    @property
    def sim(self) -> Simulation:
        """The physics of all worlds."""
        return self.world.sim

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Frees the memory of the worlds; a ``reset()`` opens the environment again, with its next episodes.

        TorchRL's collectors close their environment when they end. Counters start again. Other methods that need the
        worlds raise an error while it is closed.

        Args:
            raise_if_closed: ignored; part of TorchRL's signature.
        """
        super().close(raise_if_closed=False)
        stage = self.get_stage() if self._world is not None else {}
        world, self._world = self._world, None
        if world is not None:
            self._episodes, self._stage = world.episode.torch.cpu(), stage
            world.close()

    def _refuse_after_fork(self) -> None:
        if self.device.type == "cuda" and os.getpid() != self._pid:
            raise RuntimeError("CUDA cannot be used after a fork: make the environment in the process that steps it")

    def __del__(self) -> None:
        """Does nothing: World reports at its own end, and TorchRL's ``__del__`` would hide the monitors' errors."""

    def __reduce__(self) -> Any:
        raise TypeError(
            "an environment cannot be copied or pickled: pass functools.partial(torchrl_loco.make, ...) to make "
            "another, or env.get_state() to copy its worlds"
        )

    def render(
        self, camera: str = "side", width: int = 320, height: int = 240, worlds: int | None = None
    ) -> torch.Tensor:
        """Ray-traces worlds, on the CPU or CUDA, without OpenGL.

        Args:
            camera: name of one of the model's cameras; those of the package have ``"side"``, ``"back"`` and
                ``"egocentric"``.
            width: pixels in a row.
            height: rows.
            worlds: how many worlds, the first of all; ``None`` is all.

        Returns:
            uint8 tensor of shape ``(worlds, height, width, 3)``.

        Raises:
            ValueError: the model has no such camera, a size is not positive, or there are not so many worlds.
            TypeError: a size or number is not an integer.
        """
        model = self.mj_model
        check_choice("camera", camera, [model.camera(i).name for i in range(model.ncam)])
        size = check_int("width", width), check_int("height", height)
        worlds = self.num_envs if worlds is None else check_int("worlds", worlds, Interval(1, self.num_envs + 1))
        pixels = self.world.render(camera, *size, worlds)
        return pixels if self.batch_size else pixels[0]

    def health(self) -> TensorDict:
        """Returns what went wrong in the physics since the environment was opened.

        ``"worlds"`` (batch ``(num_envs,)``) and ``"total"`` count control steps in which

        - ``constraint_overflow``, ``contact_overflow``: constraints or contacts were dropped. Under ``mujoco_warp``
          contacts share one pool: if some are dropped, that counts in every world.
        - ``iteration_limit``, ``line_search_limit``: the solver or its line search used up its iterations, as is usual
          under ``protocol="playground"``.
        - ``solver_failure``: the solver of ``compiled`` found no step, or lacked digits: accelerations may be wrong.
        - ``index_error``: a hook indexed one of its ``constants`` or ``shared`` out of range, which gave NaN.
        - ``non_finite``: the world became non-finite, and terminated: its positions, velocities, accelerations,
          observation, reward or action were no numbers, or 1e10 and more, as C MuJoCo has it.

        ``"peak"`` holds the largest number of ``constraints`` in a world and of ``contacts`` in all worlds that a
        physics step needed; use it to choose ``njmax`` and ``naconmax``. Nothing waits for the device until you read a
        number. The engine ``compiled`` counts neither peaks nor ``constraint_overflow`` nor ``line_search_limit``: they
        stay 0.
        """
        return self.world.health.summary()

    # The numbers of the model.

    def model_value(self, field: str) -> torch.Tensor:
        """Returns a copy of a field of the model in all worlds, ``(num_envs, *shape)``, such as ``"geom_friction"``.

        What ``randomize`` varies is each world's own, and the model's before its first reset; everything else is the
        same in all of them. ``"gravity"`` is that of the model's options.

        Raises:
            AttributeError: ``MjModel`` has no such field, or it is no array of numbers.
        """
        if self.variation is not None and field in self.variation.varied.places:
            return self._batched(self.variation.field(field, self.sim.numbers))
        numbers = torch.tensor(constant_of(self.mj_model, field), dtype=torch.float32, device=self.device)
        return self._batched(numbers.expand(self.num_envs, *numbers.shape))

    def mujoco_model(self, world: int = 0) -> mujoco.MjModel:
        """Returns a copy of the model with the present numbers of a world, for C MuJoCo.

        Args:
            world: index of the world, negative from the end.

        Raises:
            IndexError: there is no such world.
            TypeError: ``world`` is no integer.
        """
        world = check_int("world", world, ANY)
        if not -self.num_envs <= world < self.num_envs:
            raise IndexError(f"there is no world {world}: these are the worlds 0 to {self.num_envs - 1}")
        if self.variation is None:
            return copy.copy(self.mj_model)
        return self.variation.varied.edited(self.sim.numbers[world].cpu().numpy())

    # State.

    def get_stage(self) -> dict[str, Any]:
        """Returns how far a curriculum has come, as JSON can hold it: what episodes go on from.

        That is :attr:`shared`, and of :attr:`memory` the entries that :meth:`begin` makes from their former values, as
        a level, in at most 64 worlds, evenly spread. Training keeps it with checkpoint and policy.
        """
        if self.hooks is None or not (self.world.shared or self.hooks.carried):
            return {}
        rows = torch.linspace(0, self.num_envs - 1, min(self.num_envs, STAGE_WORLDS)).round().long()
        memory = {name: self.world.memory[name].cpu()[rows].tolist() for name in self.hooks.carried}
        return {"shared": {name: values.tolist() for name, values in self.world.shared.items()}, "memory": memory}

    def set_stage(self, stage: Mapping[str, Any]) -> None:
        """Lets the next episodes begin where a curriculum has come to.

        Args:
            stage: what :meth:`get_stage` returned, of any number of worlds, or parts of it, such as
                ``{"memory": {"level": [3.0]}}``: rows are dealt to the worlds in turn.

        Raises:
            ValueError: the task has no such entry, or it has another shape.
        """
        known = {"shared": self.world.shared, "memory": self.world.memory}
        for group, entries in stage.items():
            of_task = known[check_choice("stage", group, known)]
            for name, values in entries.items():
                target = of_task[check_choice(f"{group} of the stage", name, of_task)]
                new = torch.as_tensor(values, device=self.device).to(target.dtype)
                if group == "memory" and len(new):
                    new = new[torch.arange(self.num_envs, device=self.device) % len(new)]
                if new.shape != target.shape:
                    shape = tuple(target.shape[group == "memory" :])
                    raise ValueError(f"{group} {name!r} of a stage must have rows of shape {shape}")
                target.copy_(new)

    def get_state(self) -> State:
        """Returns a copy of the state of all worlds, for ``env.reset(state, set_state=True)``."""
        state = State({}, batch_size=self.batch_size, device=self.device)
        for key, value in self.world.state().items():
            state.set(key, self._batched(value))
        return state

    def _set_state(self, state: TensorDictBase | None, mask: torch.Tensor | None) -> None:
        """Writes a state into the worlds of ``mask``."""
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if state is not None and not self.batch_size:
            state = TensorDict({key: state[key].unsqueeze(0) for key in State.KEYS if key in state}, batch_size=[1])
        write_state(state, self.world.state(), mask)
        self.world.refresh(mask)

    def settings(self) -> dict[str, Any]:
        """Returns the settings from which an equal environment can be made, except the seed, as JSON can hold them."""
        cls = type(self)
        return {
            "env": f"{cls.__module__}.{cls.__qualname__}",
            "file": getattr(sys.modules.get(cls.__module__), "__file__", None),
            "protocol": self.protocol,
            "num_envs": self.num_envs,
            "world_offset": self.world_offset or 0,
            "device": str(self.device),
            "config": dataclasses.asdict(self.config),
            "randomize": [dataclasses.asdict(vary) for vary in self.randomize],
        }

    def get_extra_state(self) -> dict[str, Any]:
        """Returns what ``state_dict`` holds: the state of all worlds and the seed."""
        return {**self._identity(), "seed": self.seed, "worlds": self.get_state().to_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores a ``state_dict``: the worlds, their random streams and the seed.

        Raises:
            ValueError: it was taken from an environment of another body, protocol, batch size or world offset.
        """
        for name, value in self._identity().items():
            if state.get(name) != value:
                raise ValueError(f"the state has {name}={state.get(name)!r}, this environment has {value!r}")
        self.reset(State(state["worlds"], batch_size=self.batch_size, device=self.device), set_state=True)
        self.seed = state["seed"]
        self.world.write_seed(self.seed)

    def _identity(self) -> dict[str, Any]:
        """Returns what two environments must share to exchange their ``state_dict``."""
        settings = self.settings()
        same = {name: settings[name] for name in ("protocol", "world_offset")}
        return {"body": self.body or type(self).__name__, "batch_size": list(self.batch_size), **same}

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, **kwargs: Any) -> Any:
        """Restores a ``state_dict``; see :meth:`set_extra_state`.

        With ``strict=False`` the worlds stay as they are: TorchRL's ``EnvCreator`` shares the state of transforms this
        way with every environment that it makes, and each of them must keep its own worlds.

        Returns:
            The keys that were missing or not expected, as torch's own does.
        """
        if not strict:
            state_dict = {name: value for name, value in state_dict.items() if not name.endswith("_extra_state")}
        return super().load_state_dict(state_dict, strict=strict, **kwargs)


def _warn_of_misspelt_names(cls: type[LocoEnv]) -> None:
    """Warns of what a class defines by a name that is almost that of a hook or an attribute: nobody would call it."""
    meant = {*HOOKS, *LocoEnv.__annotations__}
    for base in cls.__mro__[: cls.__mro__.index(LocoEnv)]:
        if base.__module__.startswith("torchrl_loco."):
            continue
        inherited = {name for other in base.__mro__[1:] for name in vars(other)}
        for name in vars(base).keys() - inherited - meant:
            near = difflib.get_close_matches(name, meant, n=1, cutoff=0.85)
            if near:
                warn(f"torchrl_loco: {base.__name__} defines {name}, which nothing reads: did you mean {near[0]}?")


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


def set_stage(env: LocoEnv, info: Mapping[str, Any]) -> None:
    """Lets episodes begin at the stage that a policy has reached, unless it is of another task, which a log line says.

    Args:
        env: the worlds.
        info: the policy's information.
    """
    try:
        env.set_stage(env.stage_of(info))
    except ValueError as error:
        logging.getLogger("torchrl_loco").warning("episodes begin at the first stage of the curriculum: %s", error)


def rows_of(mask: torch.Tensor, entry: torch.Tensor) -> torch.Tensor:
    """Returns a mask of worlds, ``(*batch, 1)``, in a shape that broadcasts with an entry, ``(*batch, ...)``."""
    return mask.view(*mask.shape[:-1], *[1] * (entry.ndim - mask.ndim + 1))


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


def folder_of(cls: type) -> Path | None:
    """Returns the folder of the file that sets the model of a class, from which a relative path is meant."""
    base = next(base for base in cls.__mro__ if "model" in vars(base))
    file = getattr(sys.modules.get(base.__module__), "__file__", None)
    return Path(file).parent if file else None


def reset_done_worlds(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Does what TorchRL's ``maybe_reset`` does, without reading from the device.

    The result is the same. What is left out is TorchRL's check that no world is done after its reset; the environments
    of this package cannot be.

    Args:
        env: an environment of this package, or one around it.
        tensordict: what ``step_mdp`` makes of a step, batch ``(num_envs,)``.

    Returns:
        The same TensorDict, batch ``(num_envs,)``, with the first observation of the next episode in the worlds that
        were done.
    """
    mask, batch = tensordict.get("done").clone(), tensordict.batch_size
    request = TensorDict({"_reset": mask}, batch_size=batch, device=tensordict.device)
    fresh = env._reset(request, set_state=False)

    def merge(old: torch.Tensor, new: torch.Tensor | None) -> torch.Tensor:
        rows = rows_of(mask, old)
        return old.masked_fill(rows, 0) if new is None else torch.where(rows, new, old)

    # As in TorchRL, entries that a reset does not return (a policy's other outputs) are zero where a world was reset.
    merged = tensordict._fast_apply(merge, fresh.exclude("_reset"), default=None)
    return merged.update(fresh.exclude(*merged.keys(True, True)).exclude("_reset"))
