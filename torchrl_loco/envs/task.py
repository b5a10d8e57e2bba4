"""What a task is: its attributes, its hooks with their defaults, and what is checked of them. No TorchRL."""

import difflib
import functools
import logging
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, cast

import mujoco
import numpy as np
import torch
import warp as wp

from torchrl_loco.checks import ANY, EXTENDED, check_bool, check_choice, check_float, check_int, check_pair, several
from torchrl_loco.conditions import Conditions
from torchrl_loco.config import SimConfig, options_of
from torchrl_loco.envs.episode import MAX_VALUE
from torchrl_loco.envs.monitors import warn
from torchrl_loco.envs.tables import Entry, entries
from torchrl_loco.envs.vary import Vary, check_randomize
from torchrl_loco.envs.view import PUBLIC, View
from torchrl_loco.sim import fill, models
from torchrl_loco.sim.sampling import Table, draw_from_table

HOOKS = (
    *("control", "update", "reward", "terminated", "truncated", "metrics", "events", "adapt"),
    *("observation", "begin"),
)
"""The hooks of a task, in plain torch."""

FUSED = {
    "reward": ("observation_func",),
    "observation": ("observation_func",),
    "begin": ("pose_func", "initial_states"),
}
"""The methods that name a Warp function instead of a hook."""

BOUNDED, UNBOUNDED = (-1.0, 1.0), (-math.inf, math.inf)  # what action_range can be

HOLDS = ("falls", "return", "kept", "delay", "friction", "pushes")  # what a task can ask for: see Task.holds


class _OfModel:
    """Settings of a class that has none of its own: the options of its model."""

    def __get__(self, env: "Task | None", cls: "type[Task]") -> SimConfig:
        return SimConfig.of(models.load(cls.model, folder_of(cls)))


class Task:
    """What a locomotion task consists of: class attributes, and hooks in plain torch or Warp functions.

    :class:`torchrl_loco.LocoEnv` tells how they work together.
    """

    model: ClassVar[Path | str | mujoco.MjSpec]
    """Path of an MJCF file (relative to the file of the class), MJCF text, or a ``mujoco.MjSpec``."""
    config: SimConfig = cast("SimConfig", _OfModel())
    """Settings of the simulation under ``playground``; without any, the options of the model
    (:meth:`torchrl_loco.SimConfig.of`). An instance's has all that was overridden."""
    memory: ClassVar[Mapping[str, Any]] = {}
    """What a world remembers, by name. The shape of a row, its dtype, or both, such as
    ``{"command": 3, "frame": torch.int32, "bins": ((4,), torch.int32)}``; floats of float32, int32, int64 or bool.
    ``s.command`` reads it; :meth:`update`, :meth:`events` and :meth:`begin` return new rows. The state holds it."""
    shared: ClassVar[Mapping[str, Any]] = {}
    """What all worlds have in common, by name, as for :attr:`memory`, or a tensor that it begins with, else with zeros.
    ``s.name`` reads it, :meth:`adapt` returns new values after each step. The state holds it. A world of such a task
    depends on its neighbours; in training on several GPUs each rank has its own, but for those in
    :attr:`summed_over_ranks`."""
    summed_over_ranks: ClassVar[Sequence[str]] = ()
    """Names of entries of :attr:`shared`, counts that only grow, whose changes are added up over the ranks of a
    training, after each batch."""
    constants: ClassVar[Any] = {}
    """Tables that never change, tensors or arrays by name, or a method that returns them once. ``s.name`` reads them
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
    mjlab's), such as ``{"falls": 0.01, "delay": (0, 2), "pushes": 1.0}``. Where :attr:`memory` has ``delay``, too,
    the hooks hold actions back themselves, up to that of ``holds``: ``verify`` writes it."""
    command_ranges: Mapping[str, Mapping[str, tuple[float, float]]] = {}
    """Entries of :attr:`memory` that are commands: by entry, the name of each of its numbers, with its unit, and the
    least and greatest value, such as ``{"command": {"forward (m/s)": (-1.0, 2.0)}}``. With ``play=True`` they can be
    set, and the viewer has a slider for each."""
    randomize: Sequence[Vary] = ()
    """Numbers of the model that each world draws at its resets; see :class:`torchrl_loco.Vary`."""
    episode_length: int | None = None
    """Control steps after which an episode is truncated; ``None`` takes that of :attr:`config`. An environment's is the
    number that holds in it."""
    action_range: Sequence[float] = BOUNDED
    """(-1, 1), or (-inf, inf) for actions without bounds, which need an own :meth:`control`."""
    perfect: ClassVar[Mapping[str, float]] = {}
    """Terms of the reward that tell how well a case is played, and what each earns in a second without an error."""
    options: ClassVar[Mapping[str, tuple[Any, str]]] = {}
    """Settings of the task's own, by name the value that holds without one, and what it is for. An argument of the
    environment, an option of ``torchrl-loco train``, and an attribute that hooks read, such as ``self.motion`` of
    ``{"motion": ("walk.csv", "File of the motion.")}``. Runs, policies and checkpoints keep them."""
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """By algorithm, settings of training on CUDA that were tuned for this task."""
    body: ClassVar[str] = ""
    """Name of the body; a ``state_dict`` fits environments of the same body."""
    observation_size: int
    """Length of ``observation``; to be set beside :meth:`observation_func`."""
    term_names: tuple[str, ...] = ()
    """Names of the reward's terms; to be set beside :meth:`observation_func`."""

    if TYPE_CHECKING:
        mj_model: mujoco.MjModel  # which LocoEnv sets

    # The hooks, in the order in which they are called.

    def control(self, s: View, action: torch.Tensor) -> torch.Tensor:
        """Returns the controls ``(num_envs, nu)`` of actions; by default [-1, 1] is scaled to each ``ctrlrange``.

        Args:
            s: the worlds before the physics.
            action: ``(num_envs, nu)``, clipped to :attr:`action_range`, zero in worlds where one is not finite.
        """
        low, high = s.model("actuator_ctrlrange").unbind(-1)
        return 0.5 * (low + high) + 0.5 * (high - low) * action

    def update(self, s: View) -> Mapping[str, torch.Tensor]:
        """Returns new rows of :attr:`memory` by name, after the physics: what the reward must know of the past."""
        return {}

    def reward(self, s: View) -> torch.Tensor | Mapping[str, torch.Tensor]:
        """Returns the reward ``(num_envs,)``, or its terms by name, which are summed.

        By default it is that of the class's Warp function, if it has one: what ``super().reward(s)`` returns.
        """
        return s._by_warp("reward")

    def terminated(self, s: View) -> torch.Tensor:
        """Returns whether the episode ends, bool ``(num_envs,)``; by default never."""
        return torch.zeros(s.num_envs, dtype=torch.bool, device=s.device)

    def truncated(self, s: View) -> torch.Tensor:
        """Returns whether the episode is cut off before the time limit, bool ``(num_envs,)``; by default never.

        Such as where a reference ends: what comes after counts as it would at the time limit.
        """
        return torch.zeros(s.num_envs, dtype=torch.bool, device=s.device)

    def metrics(self, s: View) -> Mapping[str, torch.Tensor]:
        """Returns numbers of each world for the log alone, by name, each ``(num_envs,)``, such as an error in m.

        Those that are NaN do not count.

        It is called where they are read: in training, and with ``metrics=True``.
        """
        return {}

    def events(self, s: View) -> Mapping[str, torch.Tensor]:
        """Returns rows for what comes next, by name: of :attr:`memory` (a new command, the last action), qpos, qvel."""
        return {}

    def adapt(self, s: View) -> Mapping[str, torch.Tensor]:
        """Returns new values of :attr:`shared` by name, after the events; it alone may sum over worlds.

        ``s.terminated`` tells whose episode has ended. Sums of floats have a fixed order, so that runs repeat. A step
        of some worlds alone (TorchRL's ``"_step"``) does not call it: the others have not stepped. Where a new number
        is not finite, the old one stays.
        """
        return {}

    def observation(self, s: View) -> torch.Tensor | Mapping[str, torch.Tensor | Mapping[str, torch.Tensor]]:
        """Returns the observation ``(num_envs, n)``, or several by name: ``privileged`` is the critic's.

        Each may be terms by name, ``(num_envs, ...)``, which are joined in their order:
        ``{"observation": {"gravity": ..., "joint_positions": ...}, "privileged": {...}}``. :attr:`noise` and
        :attr:`history` go by these names.

        By default it is that of the class's Warp function, if it has one: what ``super().observation(s)`` returns.
        """
        return s._by_warp("observation")

    def begin(self, s: View) -> Mapping[str, torch.Tensor]:
        """Returns rows that begin an episode, by name: qpos, qvel, and of :attr:`memory`.

        What is not returned begins as zero, ``qpos`` as ``s.home``. The worlds are at rest; ``s`` shows the memory that
        the last episode left, and neither poses nor sensors, which are updated after it. By default a Warp function or
        table of the class begins it, if it has one.
        """
        return s._begun_by_warp()

    def ghost(self) -> torch.Tensor | None:
        """Returns poses ``(num_envs, nq)`` that pictures show beside those of the worlds, such as of a reference."""
        return None

    # What verify plays, and what a policy's file tells of the task.

    def cases(self) -> Mapping[str, int]:
        """Returns what there is to play, such as motions, with the control steps of each; by default nothing by name.

        With ``play=True`` world k plays case k, and again the first after the last.
        """
        return {}

    def reference(self) -> Mapping[str, torch.Tensor]:
        """Returns tables ``(frames, ...)`` of which an exported policy gives a row at a time step; by default none."""
        return {}

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
        """Returns what programs without this package must know to play a policy, beside :func:`.of_robot`.

        Args:
            m: the model.
            info: the policy's information: protocol, settings of its training.

        Returns:
            ``action_offset`` and ``action_scale``, each ``(nu,)``, if actions become controls in another way than
            scaled to each ``ctrlrange``; whatever else JSON can hold.
        """
        return {}

    # The same as Warp functions, which become a part of the kernel.

    def observation_func(self, world: Any) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward of one world, and its inputs.

        It is a ``wp.func`` of the index of the world, the inputs, the world's row of the observation, float
        ``(observation_size,)``, and that of the terms, float ``(len(term_names),)``; it writes every number of both,
        without reading what they held, and returns the reward.

        Args:
            world: the worlds, a :class:`.world.World`; the physics arrays are in ``world.sim.data``.

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

    def pose_func(self, world: Any) -> tuple[wp.Function, Any] | None:
        """Returns the function that draws an initial state, and its inputs; by default it draws from the table.

        It is a ``wp.func`` of the index of the world, the inputs, and the start of the world's random stream (uint32).
        The world is at rest in the default pose. The function writes ``qpos``, and ``qvel`` if it begins in motion.

        Args:
            world: the worlds, a :class:`.world.World`; the physics arrays are in ``world.sim.data``.

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

    # Checks.

    @classmethod
    def check_class(cls) -> None:
        """Checks what a subclass has set."""
        name, own = cls.__name__, own_hooks(cls)
        _warn_of_misspelt_names(cls)
        if not hasattr(cls, "model"):
            raise TypeError(f"{name} must set model: see help(torchrl_loco.LocoEnv)")
        if not isinstance(cls.config, SimConfig):
            raise TypeError(f"{name}.config must be a torchrl_loco.SimConfig, got {cls.config!r}")
        _warn_of_a_length_that_is_not_used(cls)
        if not isinstance(cls.model, str | Path | mujoco.MjSpec):
            raise TypeError(f"{name}.model must be a path, MJCF text or a mujoco.MjSpec, got {cls.model!r}")
        if wrong := [hook for hook in HOOKS if not callable(getattr(cls, hook))]:
            raise TypeError(f"{name}.{wrong[0]} must be a method, got {getattr(cls, wrong[0])!r}")
        lacking = [hook for hook in ("reward", "observation") if hook not in own]
        if lacking and cls.observation_func is Task.observation_func:
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
        check_options(cls)
        for what in cls.holds:
            check_choice(f"{name}.holds", what, HOLDS)
        Conditions().of(cls.holds).check()
        for entry in cls.summed_over_ranks:
            check_choice(f"{name}.summed_over_ranks", entry, shared)
        check_randomize(f"{name}.randomize", cls.randomize)
        # Of the package's own functions only Task's reads the table.
        if cls.pose_func is not Task.pose_func and cls.pose_func.__module__.startswith("torchrl_loco."):
            table = next(base for base in cls.__mro__ if {"pose_func", "initial_states"} & vars(base).keys())
            if "pose_func" not in vars(table):
                raise TypeError(
                    f"{table.__name__}.initial_states is not used, since an inherited pose_func draws the states: "
                    f"set pose_func = torchrl_loco.LocoEnv.pose_func in {table.__name__}"
                )

    @classmethod
    def checked_options(cls, given: Mapping[str, Any]) -> dict[str, Any]:
        """Returns values of :attr:`options` that are given, as a run keeps them: as JSON can hold them."""
        if given and not cls.options:
            raise ValueError(f"{cls.__name__} has no options, and so no {', '.join(given)}")
        return {name: cls._option(check_choice("option", name, cls.options), value) for name, value in given.items()}

    @classmethod
    def _option(cls, name: str, value: Any) -> Any:
        default, words = cls.options[name][0], f"{cls.__name__}: option {name!r}"
        is_tuple = isinstance(default, tuple)
        check = NUMBERS.get(type((*default, "")[0] if is_tuple else default), lambda _, each: each)
        return [check(words, each) for each in several(value)] if is_tuple else check(words, value)

    @classmethod
    def check_model(cls, mj_model: mujoco.MjModel) -> None:
        """Checks that a model has what the task takes for granted; by default nothing.

        Raises:
            ValueError: it has not.
        """


NUMBERS: dict[type, Callable[[str, Any], Any]] = {
    bool: check_bool,
    int: functools.partial(check_int, interval=ANY),
    float: functools.partial(check_float, interval=EXTENDED),
}
"""Checks of the values of an option, by the type of its default; the task itself checks text."""


def options_of_class(cls: type[Task], given: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Returns, checked, what classes below the one that declares an option set it to, with what is given on top."""
    found = {}
    for name in cls.options:
        *_, declares = (base for base in cls.__mro__ if name in vars(base).get("options", {}))
        last = vars(declares)["options"][name]
        for base in reversed(cls.__mro__[: cls.__mro__.index(declares)]):
            again = vars(base).get("options", {}).get(name, last)
            if name in vars(base):
                found[name] = vars(base)[name]
            elif again is not last:  # another default
                found[name] = again[0]
            last = again
    return cls.checked_options({**found, **(given or {})})


def own_hooks(cls: type) -> frozenset[str]:
    """Returns the hooks that are plain torch in a class: of each, the most derived definition wins, torch or Warp."""
    found = set()
    for hook in HOOKS:
        for base in cls.__mro__[: cls.__mro__.index(Task)]:
            if hook in vars(base):
                found.add(hook)
            if {hook, *FUSED.get(hook, ())} & vars(base).keys():
                break
    return frozenset(found)


def draws_by_warp(cls: type[Task]) -> bool:
    """Returns whether a class has a Warp function or a table that begins its episodes."""
    return any(getattr(cls, name) is not getattr(Task, name) for name in FUSED["begin"])


def declared(cls: type[Task]) -> tuple[dict[str, Entry], dict[str, Entry]]:
    """Returns the entries of ``memory`` and of ``shared`` that a class declares."""
    memory = entries(cls, "memory", PUBLIC)
    return memory, entries(cls, "shared", {*PUBLIC, *memory})


def check_commands(cls: type[Task], memory: Mapping[str, Entry]) -> None:
    """Checks the commands that a class with this memory declares."""
    title, entries = f"{cls.__name__}.command_ranges", cls.command_ranges
    if not isinstance(entries, Mapping) or not all(isinstance(ranges, Mapping) for ranges in entries.values()):
        raise TypeError(f"{title} must be a dict such as {{'command': {{'forward (m/s)': (-1.0, 2.0)}}}}")
    for entry, ranges in entries.items():
        if entry not in memory:
            raise ValueError(f"{title}: {entry!r} is no entry of memory, which has {', '.join(memory) or 'none'}")
        shape, dtype = memory[entry]
        if len(shape) > 1 or len(ranges) != math.prod(shape) or dtype != torch.float32:
            raise ValueError(f"{title}: {entry!r} must be a row of {len(ranges)} numbers, as many as there are ranges")
        for name, bounds in ranges.items():
            low, high = bounds
            if not -MAX_VALUE < low < high < MAX_VALUE:
                raise ValueError(f"{title}: {name!r} must have a least and a greatest value, got {bounds}")


def check_options(cls: type[Task]) -> None:
    """Checks the options that a class declares."""
    taken = {*SimConfig.__dataclass_fields__}  # and all that environments have, and take
    for base in cls.__mro__:
        if base.__module__.startswith(("torchrl_loco.envs.", "torchrl.", "torch.")):
            begins = vars(base).get("__init__")
            taken |= {*vars(base), *vars(base).get("__annotations__", {})}
            taken |= signature(begins).parameters.keys() if begins else set()
    for name, entry in cls.options.items():
        if not (isinstance(entry, tuple) and len(entry) == 2 and isinstance(entry[1], str)):
            raise TypeError(f"{cls.__name__}.options[{name!r}] must be a value and what it is for, got {entry!r}")
        if name in taken or not str(name).isidentifier() or str(name).startswith("_"):
            raise ValueError(f"{cls.__name__}.options: {name!r} is no name that an option can have")
        value = entry[0]
        kinds = {type(each) for each in (value if isinstance(value, tuple) else [value])}
        if len(kinds) > 1 or not kinds <= {bool, int, float, str}:
            raise TypeError(
                f"{cls.__name__}.options[{name!r}] must be True or False, a number, text or a tuple of one of these, "
                f"not {value!r}"
            )
        *_, declares = (base for base in cls.__mro__ if name in vars(base).get("options", {}))
        if name in vars(declares):
            raise TypeError(
                f"{declares.__name__}: {name} is an option, whose value belongs in options, and an attribute"
            )


SAID_ELSEWHERE = {
    **dict.fromkeys(("termination", "terminations", "is_terminated", "done"), "terminated"),
    **dict.fromkeys(("compute_reward", "get_reward", "_reward"), "reward"),
    **dict.fromkeys(("compute_observations", "get_observations", "get_obs", "_get_obs"), "observation"),
    **dict.fromkeys(("reset_model", "reset_idx", "_reset_idx"), "begin"),
}
"""Names that other frameworks have for hooks."""


def _warn_of_misspelt_names(cls: type[Task]) -> None:
    """Warns of what a class defines by a name that is almost that of a hook or an attribute: nobody would call it."""
    ours = [base for base in cls.__mro__ if base.__module__.startswith("torchrl_loco.tasks")]
    meant = {*HOOKS, *Task.__annotations__, *(name for base in ours for name in vars(base).get("__annotations__", {}))}
    for base in cls.__mro__[: cls.__mro__.index(Task)]:
        if base.__module__.startswith("torchrl_loco."):
            continue
        inherited = {name for other in base.__mro__[1:] for name in vars(other)}
        for name in vars(base).keys() - inherited - meant:
            near = difflib.get_close_matches(name, meant, n=1, cutoff=0.85)
            if hook := near[0] if near else SAID_ELSEWHERE.get(name):
                warn(f"torchrl_loco: {base.__name__} defines {name}, which nothing reads: did you mean {hook}?")


def _warn_of_a_length_that_is_not_used(cls: type[Task]) -> None:
    """Warns of an episode length in a config that that of a class above hides."""
    order: tuple[Any, ...] = cls.__mro__
    above = next((k for k, base in enumerate(order) if vars(base).get("episode_length") is not None), 0)
    configs = [vars(base)["config"] for base in order[:above] if "config" in vars(base)]
    if configs and configs[0].episode_length != order[above].config.episode_length:
        warn(
            f"torchrl_loco: {cls.__name__}.config has episode_length={configs[0].episode_length}, but the class "
            f"{order[above].__name__} sets {cls.episode_length}, which counts: set episode_length in {cls.__name__}"
        )


def definer(cls: type, attribute: str) -> type:
    """Returns which class of its method resolution order an attribute of a class is from."""
    return next(base for base in cls.__mro__ if attribute in vars(base))


def folder_of(cls: type, attribute: str = "model") -> Path | None:
    """Returns the folder of the file that sets a class's model, or another path: relative ones are meant from there."""
    base = definer(cls, attribute)
    file = getattr(sys.modules.get(base.__module__), "__file__", None)
    return Path(file).parent if file else None


def replaced_options(cls: type[Task], m: mujoco.MjModel, config: SimConfig) -> dict[str, str]:
    """Returns which options of the model ``config`` replaces, and logs them, unless both are this package's.

    Of defaults, which an MJCF may not have named, it is the damping alone, where there is any.
    """
    if all(definer(cls, name).__module__.startswith("torchrl_loco.tasks") for name in ("model", "config")):
        return {}
    of_model, default = options_of(m.opt), options_of(mujoco.MjSpec().option)
    if config.integrator != "euler" or not m.dof_damping.any():
        del of_model["euler_damping"]
    if config.engine == "mujoco":  # which has all other options from the model
        of_model = {name: of_model[name] for name in ("sim_dt", "integrator")}
    replaced = {
        name: f"{value} -> {new}"
        for name, value in of_model.items()
        if (new := getattr(config, name)) != value and (value != default[name] or name == "euler_damping")
    }
    if said := {name: text for name, text in replaced.items() if name != "integrator"}:  # of which Simulation tells
        listed = ", ".join(f"{name} {text}" for name, text in said.items())
        logging.getLogger("torchrl_loco").warning(
            "%s: config replaces options of the model: %s. To keep one, name it in config; without config, or by "
            "SimConfig.of(model), all stay",
            cls.__name__,
            listed,
        )
    return replaced
