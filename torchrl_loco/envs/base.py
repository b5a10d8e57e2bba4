"""LocoEnv, the base of all environments: TorchRL's specs, step, reset, seeding and state."""

import dataclasses
import inspect
import multiprocessing
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_loco import models
from torchrl_loco.checks import (
    SEED,
    check_bool,
    check_choice,
    check_device,
    check_int,
    check_output_file,
)
from torchrl_loco.config import SimConfig, sim_config
from torchrl_loco.envs.autoreset import is_plain, reset_done_worlds, rows_of, step_and_reset
from torchrl_loco.envs.monitors import ON_OVERFLOW, warn
from torchrl_loco.envs.state import State, without_state, write_state
from torchrl_loco.envs.world import World
from torchrl_loco.sim import Simulation, fill
from torchrl_loco.sim.sampling import Table, draw_from_table


class LocoEnv(EnvBase):
    """Base of the locomotion environments: batched worlds of one body on one device.

    A subclass sets ``body``, ``mjcf`` (path of the model), ``defaults`` (settings under ``playground``),
    ``observation_size`` and ``term_names``, and names the function that writes observation and reward
    (:meth:`observation_func`). Initial states come from a table (:meth:`initial_states`) or from a function of the
    subclass (:meth:`pose_func`). docs/guides/extending.md shows it with a body outside of the package.

    Args:
        num_envs: number of worlds, the batch size. ``None`` makes one world without a batch dimension.
        device: where physics and tensors live; ``None`` takes CUDA if there is any, else the CPU.
        seed: integer in [0, 2**32). Every random draw is a function of seed, world and episode; ``None`` draws a seed.
        protocol: ``"playground"`` (few solver iterations, fast) or ``"dm_control"`` (the solver converges).
        world_offset: index of the first world among the worlds of all workers. Workers or ranks that share a seed and
            step different worlds pass different offsets: worker k of n worlds each passes ``k * n``. ``None`` means 0.
        reward_terms: whether to return each factor of the reward under ``("next", "reward_terms", name)``.
        stagger: whether a full ``reset()`` starts each world at a random point of its time limit, so that the worlds
            are not truncated together.
        on_overflow: what to do when the physics dropped contacts or constraints for want of room: ``"warn"``,
            ``"raise"`` or ``"ignore"``. It is reported within about 100 steps, without waiting for the device; see
            :meth:`health`.
        nan_dump: a file that does not exist yet. The state and action before the first step that made a world
            non-finite are written to it, within about 100 steps or at :meth:`close`; see ``torchrl-loco inspect``.
        config: fields of :class:`torchrl_loco.SimConfig` to override.

    Attributes:
        num_envs: number of worlds, 1 without a batch dimension.
        seed: the seed, also one that was drawn.
        protocol: the protocol.
        config: all settings, a :class:`torchrl_loco.SimConfig`.
        engine: what steps the worlds, ``"compiled"`` or ``"mujoco_warp"``.
        engine_reason: why.
        mj_model: the model, a ``mujoco.MjModel``.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.
        MemoryError: the device has no room for so many worlds.
    """

    body: ClassVar[str]
    mjcf: ClassVar[Path]
    defaults: ClassVar[SimConfig]
    observation_size: ClassVar[int]
    term_names: ClassVar[tuple[str, ...]]

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
        stagger: bool = False,
        on_overflow: str = "warn",
        nan_dump: Path | str | None = None,
        **config: Any,
    ) -> None:
        self.check_class()
        worlds = 1 if num_envs is None else check_int("num_envs", num_envs)
        device = check_device(device)
        seed = None if seed is None else check_int("seed", seed, SEED)
        arguments = list(inspect.signature(LocoEnv.__init__).parameters)[1:-1]
        sim_settings = sim_config(self.defaults, protocol, worlds, config, arguments)
        if world_offset is not None:
            world_offset = check_int("world_offset", world_offset, "[0, 2**31)")
            check_int("world_offset + num_envs", world_offset + worlds)
        elif seed is not None:
            _warn_if_worlds_repeat()
        reward_terms, stagger = check_bool("reward_terms", reward_terms), check_bool("stagger", stagger)
        check_choice("on_overflow", on_overflow, ON_OVERFLOW)
        nan_dump = None if nan_dump is None else check_output_file("nan_dump", nan_dump)
        mj_model = models.check(models.load(self.mjcf))

        super().__init__(device=device, batch_size=[] if num_envs is None else [worlds])
        self.num_envs, self.world_offset = worlds, world_offset
        self.seed = secrets.randbits(32) if seed is None else seed
        self.protocol, self.config, self.mj_model = protocol, sim_settings, mj_model
        self.reward_terms, self.stagger = reward_terms, stagger
        self.on_overflow, self.nan_dump = on_overflow, nan_dump
        self._action_shape = torch.Size([*self.batch_size, mj_model.nu])
        self._pid = os.getpid()
        self._world: World | None = None
        self._episodes: torch.Tensor | None = None  # of a closed environment
        self._open()
        self._make_specs()

    @classmethod
    def check_class(cls) -> None:
        """Checks what a subclass has set.

        Raises:
            TypeError: an attribute is missing or has the wrong type, or a table of initial states would not be used.
            ValueError: ``observation_size`` is less than 1.
        """
        names = ("body", "mjcf", "defaults", "observation_size", "term_names")
        missing = [name for name in names if not hasattr(cls, name)]
        if missing:
            raise TypeError(f"{cls.__name__} must set {', '.join(missing)}: see help(torchrl_loco.LocoEnv)")
        check_int(f"{cls.__name__}.observation_size", cls.observation_size)
        if not isinstance(cls.defaults, SimConfig):
            raise TypeError(f"{cls.__name__}.defaults must be a torchrl_loco.SimConfig, got {cls.defaults!r}")
        if not isinstance(cls.term_names, tuple | list) or not all(isinstance(name, str) for name in cls.term_names):
            raise TypeError(f"{cls.__name__}.term_names must be a tuple of names, got {cls.term_names!r}")
        # Of the package's own functions only LocoEnv's reads the table.
        if cls.pose_func is not LocoEnv.pose_func and cls.pose_func.__module__.startswith("torchrl_loco."):
            table = next(base for base in cls.__mro__ if {"pose_func", "initial_states"} & vars(base).keys())
            if "pose_func" not in vars(table):
                raise TypeError(
                    f"{table.__name__}.initial_states is not used, since an inherited pose_func draws the states: "
                    f"set pose_func = torchrl_loco.LocoEnv.pose_func in {table.__name__}"
                )

    def __repr__(self) -> str:
        num_envs = self.num_envs if self.batch_size else None
        device, protocol, seed = str(self.device), self.protocol, self.seed
        engine = self.engine if self.engine == "compiled" else f"{self.engine} ({self.engine_reason})"
        return f"{type(self).__name__}({num_envs=}, {device=}, {seed=}, {protocol=}, {engine=})"

    # What a body adds.

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
        observation = {"observation": Unbounded((*batch, self.observation_size), **as_float)}
        if self.reward_terms:
            terms = {name: Unbounded((*batch, 1), **as_float) for name in self.term_names}
            observation["reward_terms"] = Composite(terms, shape=batch, device=device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=device)
        self.observation_spec = Composite(observation, shape=batch, device=device)
        self.action_spec = Bounded(-1.0, 1.0, (*batch, self.mj_model.nu), **as_float)
        # Rewards lie in [0, 1], but RewardSum would copy the bounds to the sum.
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
        result = self._outputs()
        if self.reward_terms:
            result.get("reward_terms").zero_()  # nothing was rewarded yet
        return result

    def _outputs(self, *, with_reward: bool = False) -> TensorDict:
        """Returns a copy of what the kernels wrote: the buffers themselves change at the next step."""
        outputs, batch = self.world.outputs, self.batch_size
        observation, reward, terms, flags = outputs.parts(outputs.memory.clone())
        done, terminated, truncated = flags.view(3, *batch, 1).unbind()
        entries = {"done": done, "terminated": terminated, "truncated": truncated}
        entries["observation"] = observation.view(*batch, self.observation_size)
        if with_reward:
            entries["reward"] = reward.view(*batch, 1)
        result = TensorDict._new_unsafe(entries, batch_size=batch, device=self.device)  # they need no checks
        if self.reward_terms:
            columns = terms.view(*batch, len(self.term_names), 1).unbind(-2)
            result["reward_terms"] = dict(zip(self.term_names, columns, strict=True))
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
        if all(own) and is_plain(self, tensordict):
            return step_and_reset(self, tensordict, rewritten)
        return super()._step_and_maybe_reset(tensordict)

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
        self._world = World(self)
        self.engine, self.engine_reason = self._world.sim.engine_choice
        if self._episodes is not None:
            self._world.episode.torch.copy_(self._episodes)
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
        world, self._world = self._world, None
        if world is not None:
            self._episodes = world.episode.torch.cpu()
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

    def render(self, camera: str = "side", width: int = 320, height: int = 240) -> torch.Tensor:
        """Ray-traces every world, on the CPU or CUDA, without OpenGL.

        Args:
            camera: ``"side"``, ``"back"`` or ``"egocentric"``.
            width: pixels in a row.
            height: rows.

        Returns:
            uint8 tensor of shape ``(num_envs, height, width, 3)``.

        Raises:
            ValueError: the model has no such camera, or a size is not positive.
            TypeError: a size is not an integer.
        """
        model = self.mj_model
        check_choice("camera", camera, [model.camera(i).name for i in range(model.ncam)])
        pixels = self.world.render(camera, check_int("width", width), check_int("height", height))
        return pixels if self.batch_size else pixels[0]

    def health(self) -> TensorDict:
        """Returns what went wrong in the physics since the environment was opened.

        ``"worlds"`` (batch ``(num_envs,)``) and ``"total"`` count control steps in which

        - ``constraint_overflow``, ``contact_overflow``: constraints or contacts were dropped. Under ``mujoco_warp``
          contacts share one pool: if some are dropped, that counts in every world.
        - ``iteration_limit``, ``line_search_limit``: the solver or its line search used up its iterations, as is usual
          under ``protocol="playground"``.
        - ``non_finite``: the world became non-finite, and terminated.

        ``"peak"`` holds the largest number of ``constraints`` in a world and of ``contacts`` in all worlds that a
        physics step needed; use it to choose ``njmax`` and ``naconmax``. Nothing waits for the device until you read a
        number. The engine ``compiled`` counts neither peaks nor ``constraint_overflow`` nor ``line_search_limit``: they
        stay 0.
        """
        return self.world.health.summary()

    # State.

    def get_state(self) -> State:
        """Returns a copy of the state of all worlds, for ``env.reset(state, set_state=True)``."""
        state = {key: self._batched(value) for key, value in self.world.state().items()}
        return State(state, batch_size=self.batch_size, device=self.device)

    def _set_state(self, state: TensorDictBase | None, mask: torch.Tensor | None) -> None:
        """Writes a state into the worlds of ``mask``."""
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if state is not None and not self.batch_size:
            state = TensorDict({key: state[key][None] for key in State.KEYS if key in state}, batch_size=[1])
        write_state(state, self.world.state(), mask)
        self.world.refresh(mask)

    def settings(self) -> dict[str, Any]:
        """Returns the settings from which an equal environment can be made, except the seed, as JSON can hold them."""
        cls = type(self)
        return {
            "env": f"{cls.__module__}.{cls.__qualname__}",
            "protocol": self.protocol,
            "num_envs": self.num_envs,
            "world_offset": self.world_offset or 0,
            "device": str(self.device),
            "config": dataclasses.asdict(self.config),
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
        self.world.seed.torch.fill_(self.seed)

    def _identity(self) -> dict[str, Any]:
        """Returns what two environments must share to exchange their ``state_dict``."""
        settings = self.settings()
        same = {name: settings[name] for name in ("protocol", "world_offset")}
        return {"body": self.body, "batch_size": list(self.batch_size), **same}

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
