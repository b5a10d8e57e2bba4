"""What a task says of states that nobody simulated: rewards, ends and observations, with gradients."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, NoReturn

import torch

from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.fusion.trace import Tracer
from torchrl_loco.envs.hooks import ENDS, beyond, by_world
from torchrl_loco.envs.kinematics import Kinematics
from torchrl_loco.envs.tables import Entry, entries
from torchrl_loco.envs.task import Task, folder_of
from torchrl_loco.envs.view import View, usable
from torchrl_loco.sim import models

aten = torch.ops.aten
STATE = "state_of_world"  # group of the observation with all that hooks depend on, and last what events found
FOUND = "found_by_events"
"""Entry of memory with positions and velocities as physics made them, before events changed them, and its controls."""
UNKNOWN = ("contact_force", "in_contact", "sensordata")  # arrays of which a predicted state does not tell
INSTEAD = "train it with ppo or reppo"


def showing_states(cls: type[LocoEnv]) -> type[LocoEnv]:
    """Returns a task that differs from another one by a further group of its observation, ``state_of_world``.

    Its rows are positions, velocities, control steps so far, number of the env, numbers of the model, memory, and what
    events found.

    Raises:
        ValueError: a Warp function makes the reward or the observation of the task, or its memory has long integers.
    """
    for name in ("reward", "observation"):
        if getattr(cls, name) is getattr(Task, name):
            raise ValueError(f"{cls.__name__} cannot be imagined: its {name} is a Warp function, no hook: {INSTEAD}")
    declared = entries(cls, "memory", ())
    if long := [name for name, (_, kind) in declared.items() if kind == torch.int64]:
        raise ValueError(f"{cls.__name__} cannot be imagined: its memory {long[0]!r} must be of int32, not int64")
    m = models.load(cls.model, folder_of(cls))

    class Shown(cls):  # type: ignore[misc, valid-type]
        memory: ClassVar[Mapping[str, Any]] = {**cls.memory, FOUND: m.nq + m.nv + m.nu}

        def events(self, s: Any) -> dict[str, torch.Tensor]:
            rows = {} if cls.events is Task.events else super().events(s) or {}
            return {**rows, FOUND: torch.cat([s.qpos, s.qvel, s.ctrl], dim=-1)}

        def observation(self, s: Any) -> dict[str, Any]:
            groups = super().observation(s)
            groups = dict(groups) if isinstance(groups, Mapping) else {"observation": groups}
            if STATE in groups:
                raise ValueError(f"{cls.__name__}.observation has a group {STATE!r}, which svg adds: rename it")
            clock = [(s.time / s.dt).round().unsqueeze(-1), s.env_index.float().unsqueeze(-1)]
            numbers = [] if self.variation is None else [s._array("numbers")]
            memory = [as_floats(getattr(s, name).reshape(s.num_envs, -1)) for name in (*declared, FOUND)]
            return {**groups, STATE: torch.cat([s.qpos, s.qvel, *clock, *numbers, *memory], dim=-1)}

    Shown.__name__, Shown.__qualname__, Shown.__module__ = cls.__name__, cls.__qualname__, cls.__module__
    return Shown


def as_floats(rows: torch.Tensor) -> torch.Tensor:
    """Returns rows in float32, from which :func:`of_floats` makes them again; integers as two halves."""
    return torch.cat([rows >> 16, rows & 0xFFFF], dim=-1).float() if rows.dtype == torch.int32 else rows.float()


def of_floats(rows: torch.Tensor, entry: Entry) -> torch.Tensor:
    """Returns an entry of all worlds."""
    if entry.dtype == torch.int32:
        upper, lower = rows.int().chunk(2, dim=-1)
        rows = (upper << 16) + lower
    return rows.reshape(-1, *entry.shape).to(entry.dtype)


class Judgement(NamedTuple):
    """What a task says of a step, and what goes on after it, ``(worlds, ...)`` each."""

    reward: torch.Tensor
    terminated: torch.Tensor
    truncated: torch.Tensor
    over: torch.Tensor
    """Whether an episode has ended, in this step or before: its world is where it started."""
    observations: dict[str, torch.Tensor]
    """By group, also of the step that ends an episode; zeros in worlds that were over before."""
    qpos: torch.Tensor
    qvel: torch.Tensor
    rest: list[torch.Tensor]
    """What else hooks depend on."""


class Imagined:
    """Worlds whose states are predicted: the hooks of their task are called on them as on simulated ones.

    Contacts and sensors of forces are zeros there; what events do to positions and velocities does not happen, nothing
    is added to ``shared``, no time limit ends an episode, and random numbers are torch's.

    Args:
        env: an environment of a task that shows its states.
        worlds: how many states are judged at once.
        compiled: makes something faster of a module of tensors; ``None`` leaves it as it is.

    Attributes:
        unknown: names of the arrays that the hooks read and that are zeros.
        size: length of a state, which is the first part of ``state_of_world``.

    Raises:
        ValueError: the hooks depend on what is not predicted.
    """

    def __init__(self, env: LocoEnv, worlds: int, compiled: Callable[[Any], Any] | None = None) -> None:
        self._title, asked, m = type(env).__name__, env.hooks.catalog, env.mj_model
        for is_so, what in (
            (bool(asked.scans), "it scans the ground, depths or rays"),
            (bool(env.hooks.history), "its observation has a history"),
            (any(name.startswith("warp") for name in asked.arrays), "a hook of it calls a Warp function"),
        ):
            if is_so:
                self._refuse(what)
        self._hooks = copy.copy(env.hooks)
        self._hooks.catalog = catalog = copy.copy(asked)
        self._hooks.view = WithUnits
        catalog.num_envs = worlds
        self.kinematics = Kinematics(m, env.device)
        self.unknown = [name for name in UNKNOWN if name in asked.arrays or f"{name}_history" in asked.arrays]
        kept: dict[str, Any] = {"device": env.device}
        none, columns, substeps = torch.zeros(worlds, **kept) > 0, len(asked.contact_geoms), env.config.substeps
        self._fixed: dict[str, torch.Tensor] = {
            **{"mask": ~none, "ended": none, "overflow": torch.zeros(worlds, dtype=torch.int32, **kept)},
            "sensordata": torch.zeros(worlds, m.nsensordata, **kept),
            "contact_force": torch.zeros(worlds, columns, 3, **kept),
            "contact_force_history": torch.zeros(worlds, substeps, columns, 3, **kept),
            "in_contact": torch.zeros(worlds, columns, **kept),
            "in_contact_history": torch.zeros(worlds, substeps, columns, **kept),
            **{f"shared.{name}": values for name, values in env.world.shared.items()},
        }
        numbers = {} if env.variation is None else {"numbers": Entry((env.variation.count,), torch.float32)}
        clock = {name: Entry((), torch.float32) for name in ("elapsed_steps", "world")}
        memory = {f"memory.{name}": entry for name, entry in catalog.memory.items() if name != FOUND}
        self._rest = {**clock, **numbers, **memory}
        halves = (1 + (entry.dtype == torch.int32) for entry in self._rest.values())
        widths = [math.prod(entry.shape) * n for entry, n in zip(self._rest.values(), halves, strict=True)]
        self._sizes = [int(m.nq), int(m.nv), *widths]
        self.size = sum(self._sizes)
        self._groups = [name for name in self._hooks.groups if name != STATE]
        self._trace(torch.zeros(worlds, self.size, **kept), torch.zeros(worlds, int(m.nu), **kept), compiled)

    def _refuse(self, why: str) -> NoReturn:
        raise ValueError(f"{self._title} cannot be imagined: {why}; {INSTEAD}")

    def unpacked(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
        """Returns positions, velocities and the rest of states, ``(worlds, size)``, as copies."""
        qpos, qvel, *rows = state.split(self._sizes, dim=-1)
        rest = [of_floats(row, entry) for row, entry in zip(rows, self._rest.values(), strict=True)]
        return qpos.clone(), qvel.clone(), [row.clone() for row in rest]

    def control(
        self, qpos: torch.Tensor, qvel: torch.Tensor, action: torch.Tensor, rest: Sequence[torch.Tensor]
    ) -> torch.Tensor:
        """Returns the controls that actions become in states, ``(worlds, nu)``; arguments are as of :meth:`judge`."""
        return self._control(qpos, qvel, action, *rest)[0]

    def judge(
        self,
        qpos: torch.Tensor,
        qvel: torch.Tensor,
        action: torch.Tensor,
        rest: Sequence[torch.Tensor],
        start: torch.Tensor,
        over: torch.Tensor,
    ) -> Judgement:
        """Returns what the task says of a step that has led to states.

        A world in which a number is not finite terminates, without a reward, as a simulated one does.

        Args:
            qpos: positions after it, ``(worlds, nq)``.
            qvel: velocities after it, ``(worlds, nv)``.
            action: the actions, ``(worlds, nu)``.
            rest: the rest of the states before the step, as :meth:`unpacked` returns it.
            start: states, ``(worlds, size)``, to which worlds go back that are over: nothing runs away there.
            over: which were before, bool ``(worlds,)``.
        """
        units, count = torch.rand_like(self._units), len(self._groups)
        found = self._say(qpos, qvel, *self.kinematics(qpos, qvel), action, units, start, over, *rest)
        reward, terminated, truncated, over, qpos, qvel = found[:6]
        observations = dict(zip(self._groups, found[6:], strict=False))
        return Judgement(reward, terminated, truncated, over, observations, qpos, qvel, list(found[6 + count :]))

    def _trace(self, states: torch.Tensor, action: torch.Tensor, compiled: Callable[[Any], Any] | None) -> None:
        """Makes modules of the hooks, of states like those in the home pose."""
        home = self._hooks.catalog.home
        start = torch.cat([home.expand(len(states), -1), states[:, len(home) :]], dim=-1)
        qpos, qvel, rest = self.unpacked(start)
        try:
            with torch.no_grad():
                self._controlled(qpos, qvel, action, *rest)
        except ValueError as error:
            self._refuse(f"its control reads more than positions, velocities, memory and numbers ({error})")
        if WithUnits.drawn:
            self._refuse("its control draws random numbers")
        self._control = self._checked(self._controlled, (qpos, qvel, action, *rest))
        self._units = qpos.new_zeros(len(qpos), 0)
        none = torch.zeros_like(qpos[:, 0], dtype=torch.bool)
        inputs = [qpos, qvel, *self.kinematics(qpos, qvel), action, self._units, start, none, *rest]
        with torch.no_grad():
            self._called(*inputs)  # which counts random numbers
        self._units = inputs[7] = qpos.new_zeros(len(qpos), WithUnits.drawn)
        module = self._checked(self._called, inputs)
        self._say = module if compiled is None else compiled(module)

    def _checked(self, function: Callable[..., Sequence[torch.Tensor]], inputs: Sequence[torch.Tensor]) -> Any:
        """Returns what :func:`traced` makes of a function, if it does the same with other numbers."""
        module, generator = traced(function, inputs), torch.Generator().manual_seed(0)
        with torch.no_grad():
            others = [
                each + 0.1 * torch.randn(each.shape, generator=generator).to(each.device) * each.is_floating_point()
                for each in inputs
            ]
            others = [other.to(each.dtype) for other, each in zip(others, inputs, strict=True)]
            for found, expected in zip(module(*others), function(*others), strict=True):
                if not torch.allclose(found.float(), expected.float(), rtol=1e-3, atol=1e-4, equal_nan=True):
                    self._refuse("a hook leaves torch (numpy, item, tolist)")
        return module

    def _controlled(
        self, qpos: torch.Tensor, qvel: torch.Tensor, action: torch.Tensor, *rest: Any
    ) -> list[torch.Tensor]:
        """Returns the controls, in a list."""
        hooks, WithUnits.drawn = self._hooks, 0
        action = usable(action, hooks.catalog.bounded)
        if "control" in hooks.own:
            return [hooks._call("control", {**self._arrays(qpos, qvel, rest), "action": action}, args=(action,))]
        low, high = hooks.catalog.constant("actuator_ctrlrange").unbind(-1)
        return [0.5 * (low + high) + 0.5 * (high - low) * action]

    def _arrays(self, qpos: torch.Tensor, qvel: torch.Tensor, rest: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns the arrays that hooks read of states and what is the same for all."""
        WithUnits.drawn = 0
        a = {
            **self._fixed,
            "units": qpos.new_zeros(len(qpos), 0),
            "qpos": qpos,
            "qvel": qvel,
            **dict(zip(self._rest, rest, strict=True)),
        }
        found = torch.zeros(len(qpos), *self._hooks.catalog.memory[FOUND].shape, device=qpos.device)
        return a | {name: a[name].long() for name in ("elapsed_steps", "world")} | {f"memory.{FOUND}": found}

    def _called(self, qpos: torch.Tensor, qvel: torch.Tensor, *others: torch.Tensor) -> list[torch.Tensor]:
        """Returns the parts of a judgement, in their order: hooks are called as in a control step."""
        hooks, bodies, (action, units, start, over, *rest) = self._hooks, others[:4], others[4:]
        a = {**self._arrays(qpos, qvel, rest), **self.kinematics.named(bodies), "action": action, "units": units}
        if "ctrl" in hooks.catalog.arrays:
            a["ctrl"] = self._controlled(qpos, qvel, action, *rest)[0]

        def remember(rows: Mapping[str, torch.Tensor]) -> None:
            of_memory = {f"memory.{name}": row for name, row in rows.items()}
            a.update({name: row.to(self._rest[name].dtype) for name, row in of_memory.items() if name in self._rest})

        if "update" in hooks.own:
            remember(hooks._rows("update", a, hooks.catalog.memory))
        terms = hooks._call("reward", a, steps=1)
        reward: Any = sum(term.float() for term in terms.values()) if isinstance(terms, Mapping) else terms.float()
        ended, cut = (hooks._call(hook, a, steps=1) if hook in hooks.own else a["ended"] for hook in ENDS)
        a["ended"] = ended
        remember(hooks._rows("events", a, {**hooks.catalog.memory, **hooks._pose}))
        groups = hooks._groups(a, steps=1)
        seen = [groups[name] for name in self._groups]
        wrong = beyond(reward, qpos, qvel, *seen)
        seen = [row.masked_fill(by_world(over | wrong, row), 0.0) for row in seen]
        ended = ended | wrong
        over = over | ended | cut
        after = [qpos, qvel, rest[0] + 1.0, *(a[name] for name in self._rest if name != "elapsed_steps")]
        first, fast, then = self.unpacked(start)
        after = [
            torch.where(by_world(over, new), old, new) for old, new in zip([first, fast, *then], after, strict=True)
        ]
        return [reward.masked_fill(wrong, 0.0), ended, cut, over, *after[:2], *seen, *after[2:]]


class WithUnits(View):
    """What hooks see, with random numbers that are given: to compile how the simulation draws them takes long."""

    drawn: ClassVar[int] = 0
    """How many numbers of each world the hooks have drawn, in their order."""

    def uniform(self, low: float | torch.Tensor, high: float | torch.Tensor, *shape: int) -> torch.Tensor:
        """Returns draws from [low, high), ``(num_envs, *shape)``."""
        return low + (high - low) * self._given(math.prod(shape)).view(self.num_envs, *shape)

    def normal(self, *shape: int) -> torch.Tensor:
        """Returns draws from the standard normal distribution, ``(num_envs, *shape)`` (Box and Muller)."""
        first, second = self._given(2 * math.prod(shape)).chunk(2, dim=1)
        drawn = (-2.0 * (1.0 - first).log()).sqrt() * (2.0 * math.pi * second).cos()
        return drawn.view(self.num_envs, *shape)

    def _given(self, count: int) -> torch.Tensor:
        first, units = WithUnits.drawn, self._arrays["units"]
        WithUnits.drawn += count
        return units[:, first : first + count] if units.shape[1] else units.new_zeros(self.num_envs, count)


def traced(function: Callable[..., Sequence[torch.Tensor]], inputs: Sequence[torch.Tensor]) -> torch.fx.GraphModule:
    """Returns a function of tensors as a module of torch's operators, through which gradients flow.

    Products of matrices of at most 4 x 4 become sums, which join the kernels around them.
    """
    tracer = Tracer({str(i): each.detach() for i, each in enumerate(inputs)})
    with torch.no_grad(), tracer:
        results = function(*tracer.arrays)
    graph = tracer.graph
    graph.output(tuple(tracer.argument(result) for result in results))
    graph.eliminate_dead_code()
    for node in [node for node in graph.nodes if node.target is aten.bmm.default]:
        if max(node.meta["val"].shape[1:]) > 4:
            continue
        with graph.inserting_before(node):
            one = graph.call_function(aten.unsqueeze.default, (node.args[0], -1))
            other = graph.call_function(aten.unsqueeze.default, (node.args[1], -3))
            products = graph.call_function(aten.mul.Tensor, (one, other))
            node.replace_all_uses_with(graph.call_function(aten.sum.dim_IntList, (products, [-2])))
        graph.erase_node(node)
    return torch.fx.GraphModule(tracer.constants, graph)
