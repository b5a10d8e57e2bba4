"""An environment's access to its worlds: opening and closing, looking at them, their numbers and their state."""

import copy
import dataclasses
import functools
import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_loco.checks import ANY, Interval, check_choice, check_int
from torchrl_loco.envs.hooks import Hooks
from torchrl_loco.envs.pixels import checked_camera
from torchrl_loco.envs.rotations import check_quaternions
from torchrl_loco.envs.state import State, checked_state, write_state
from torchrl_loco.envs.task import Task, folder_of
from torchrl_loco.envs.variation import Variation
from torchrl_loco.envs.world import World
from torchrl_loco.eyes.pictures import LOOKS_WELL, OPACITY, Poses, with_ghost
from torchrl_loco.eyes.tracer import KINDS, Eye
from torchrl_loco.sim import Simulation, models

STAGE_WORLDS = 64  # of how many worlds a stage keeps the memory, at most


class WorldAccess(Task, EnvBase):
    """The part of an environment that holds its worlds."""

    num_envs: int
    seed: int
    world_offset: int | None
    protocol: str
    hooks: Hooks
    options_given: dict[str, Any]
    play: bool
    variation: Variation | None
    _pid: int
    _stepped_model: mujoco.MjModel
    _world: World | None
    _episodes: torch.Tensor | None  # of a closed environment
    _stage: Mapping[str, Any]  # likewise

    # Opening and closing.

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
        stage = self._stage_of(self.num_envs) if self._world is not None else {}
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

    def _batched(self, rows: torch.Tensor) -> torch.Tensor:
        """Returns a copy of an array with one row per world, in the environment's batch size."""
        return (rows if self.batch_size else rows[0]).clone(memory_format=torch.contiguous_format)

    # Looking at them.

    def view(
        self, policy: Callable[[TensorDictBase], TensorDictBase], action_repeat: int | None = None, **server: Any
    ) -> Any:
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
        model, size = self.mj_model, self.check_picture(camera, width, height)
        worlds = self.num_envs if worlds is None else check_int("worlds", worlds, Interval(1, self.num_envs + 1))
        make = functools.partial(Eye, **LOOKS_WELL, varied=self.sim.varied_numbers)
        eye = self.world.renderer(make, model, camera, *size, worlds)
        eye.look(self.sim.data.xpos, self.sim.data.xmat)
        pixels, ghost = eye.rgb.clone(), self.ghost()
        if ghost is not None:
            poses = torch.cat([self.sim.qpos, ghost], dim=-1)[:worlds]
            both = self.world.renderer(Poses, self.model_with_ghost, camera, *size, worlds).render(poses)
            pixels = torch.lerp(pixels.float(), both.float(), OPACITY).round().to(torch.uint8)
        return pixels if self.batch_size else pixels[0]

    def check_picture(self, camera: str, width: int, height: int) -> tuple[int, int]:
        """Returns the size of what :meth:`render` draws, or raises its errors, without drawing."""
        check_choice("camera", camera, [self.mj_model.camera(i).name for i in range(self.mj_model.ncam)])
        return check_int("width", width), check_int("height", height)

    def camera(
        self, camera: str | int | None = None, width: int = 84, height: int = 84, kinds: Sequence[str] = ("rgb",)
    ) -> dict[str, torch.Tensor]:
        """Returns what a camera sees in all worlds now, as plain as ``from_pixels`` has it.

        Args:
            camera: name or number of a camera of the model; ``None`` takes the first.
            width: pixels in a row.
            height: rows.
            kinds: what is told of each pixel, some of ``"rgb"``, ``"depth"`` and ``"geoms"``.

        Returns:
            By kind ``(num_envs, height, width)``: colours, uint8 with a last dimension of 3; depth along the camera's
            axis (m), 1e10 where nothing is seen; numbers of the geoms that are seen, int32, -1 for none.

        Raises:
            ValueError: the model has no such camera, there is no such kind or none is asked for, or a size is not
                positive.
            TypeError: a number is not an integer.
        """
        which, size = checked_camera(self.mj_model, camera), (check_int("width", width), check_int("height", height))
        asked = tuple(check_choice("kind", kind, KINDS) for kind in ([kinds] if isinstance(kinds, str) else kinds))
        if not asked:
            raise ValueError(f"kinds must name at least one of {', '.join(KINDS)}, got {kinds!r}")
        make = functools.partial(Eye, varied=self.sim.varied_numbers)
        eye = self.world.renderer(make, self.mj_model, which, *size, self.num_envs, asked)
        eye.look(self.sim.data.xpos, self.sim.data.xmat)
        return {kind: self._batched(getattr(eye, kind)) for kind in asked}

    @functools.cached_property
    def model_with_ghost(self) -> mujoco.MjModel:
        """The model for pictures, with its first body once more: see :func:`torchrl_loco.eyes.pictures.with_ghost`."""
        return with_ghost(models.specification(type(self).model, folder_of(type(self))))

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
          observation, reward or memory were no numbers, or 1e10 and more, as C MuJoCo has it, or its action was none.

        ``"peak"`` holds the largest number of ``constraints`` in a world and of ``contacts`` in all worlds that a
        physics step needed; use it to choose ``njmax`` and ``naconmax``. Nothing waits for the device until you read a
        number. The engine ``compiled`` counts neither peaks nor ``constraint_overflow`` nor ``line_search_limit``: they
        stay 0.
        """
        return self.world.health.summary()

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
        settable = self.hooks.commands
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

    # The numbers of the model.

    def model_value(self, field: str) -> torch.Tensor:
        """Returns a copy of a field of the model in all worlds, ``(num_envs, *shape)``, such as ``"geom_friction"``.

        What ``randomize`` varies is each world's own, and the model's before its first reset; everything else is the
        same in all of them. ``"gravity"`` is that of the model's options.

        Raises:
            AttributeError: ``MjModel`` has no such field, or it is no array of numbers.
        """
        return self._batched(self.hooks.catalog.field(field, lambda: self.sim.numbers))

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

        That is :attr:`shared`, and of :attr:`memory` the entries from which :meth:`begin` makes the memory of the next
        episode, as a level from its former value or from an entry of its own, in at most 64 worlds, evenly spread.
        Where an entry begins from itself, what else it is made from is left out: it is of an episode that may not be
        over. Training keeps the stage with checkpoint and policy.
        """
        return self._stage_of(min(self.num_envs, STAGE_WORLDS))

    def _stage_of(self, count: int) -> dict[str, Any]:
        """Returns the stage, with what is in memory in so many worlds."""
        if not (self.world.shared or self.hooks.carried):
            return {}
        rows = torch.linspace(0, self.num_envs - 1, count).round().long()
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
            if entries and not of_task:
                raise ValueError(f"a stage with {group}, of which the task has none")
            for name, values in entries.items():
                target = of_task[check_choice(f"{group} of the stage", name, of_task)]
                given = torch.as_tensor(values, device=self.device)
                given = torch.atleast_1d(given) if group == "memory" else given
                new = given.to(target.dtype)
                if not target.is_floating_point() and (new != given).any():
                    raise ValueError(f"{group} {name!r} of a stage must be numbers of {target.dtype}, got {values}")
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

    def _set_state(self, state: TensorDictBase | None, mask: torch.Tensor | None, *, finite: bool = True) -> None:
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if state is not None and not self.batch_size:
            state = TensorDict({key: state[key].unsqueeze(0) for key in State.KEYS if key in state}, batch_size=[1])
        targets = self.world.state()
        new = checked_state(state, targets, mask, finite=finite)
        if finite:
            check_quaternions(self.mj_model, new["qpos"][mask])
            if self.variation is not None:
                self.variation.check({key[1]: rows[mask] for key, rows in new.items() if key[0] == "model"})
        write_state(new, targets, mask)
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
            "options": self.options_given,
        }

    def get_extra_state(self) -> dict[str, Any]:
        """Returns what ``state_dict`` holds: the state of all worlds and the seed."""
        return {**self._identity(), "seed": self.seed, "worlds": self.get_state().to_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores a ``state_dict``: the worlds, their random streams and the seed.

        Raises:
            ValueError: it was taken from an environment of another body, protocol, batch size or world offset, or in
                which other numbers of the model vary.
        """
        for name, value in self._identity().items():
            given: Any = state.get(name, value if name == "varied" else None)  # of which older states say nothing
            if name == "varied" and given != value:
                fields = ", ".join(sorted(key for key in {*given, *value} if given.get(key) != value.get(key)))
                raise ValueError(f"the state has numbers of other elements that vary, of {fields}")
            if given != value:
                raise ValueError(f"the state has {name}={given!r}, this environment has {value!r}")
        worlds = State(state["worlds"], batch_size=self.batch_size, device=self.device)
        self._reset(worlds, set_state=True, finite=False)  # a world that is to be reset may be not finite
        self._continue_with(state["seed"])

    def _continue_with(self, seed: int) -> None:
        """Changes the seed of all random streams, which go on."""
        self._keep_seed(seed)
        self.world.write_seed(seed)

    def _keep_seed(self, seed: int) -> None:
        self.__dict__["seed"] = seed  # past __setattr__, which warns that it has no effect

    def _identity(self) -> dict[str, Any]:
        """Returns what two environments must share to exchange their ``state_dict``."""
        same: dict[str, Any] = {"body": self.body or type(self).__name__, "batch_size": list(self.batch_size)}
        same |= {"protocol": self.protocol, "world_offset": self.world_offset or 0}
        if cases := self.cases():  # the memory of another set of motions points elsewhere
            same["cases"] = dict(cases)
        if self.variation is not None:  # a number is that of an element, which its place tells
            same["varied"] = {name: list(map(int, places)) for name, places in self.variation.varied.places.items()}
        return same

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, **kwargs: Any) -> Any:
        """Restores a ``state_dict``; see :meth:`set_extra_state`.

        With ``strict=False`` the worlds stay as they are: TorchRL's ``EnvCreator`` shares the state of transforms this
        way with every environment that it makes, and each of them must keep its own worlds. So they do if it is empty:
        TorchRL's ``Collector`` saves nothing else of an environment without transforms.

        Returns:
            The keys that were missing or not expected, as torch's own does.
        """
        if not (strict and state_dict):
            strict = False
            state_dict = {name: value for name, value in state_dict.items() if not name.endswith("_extra_state")}
        return super().load_state_dict(state_dict, strict=strict, **kwargs)


def set_stage(env: Any, stage: Mapping[str, Any]) -> None:
    """Lets episodes begin at a stage of the curriculum, unless it is of another task, which the log says."""
    try:
        env.set_stage(stage)
    except ValueError as error:
        logging.getLogger("torchrl_loco").warning("episodes begin at the first stage of the curriculum: %s", error)
