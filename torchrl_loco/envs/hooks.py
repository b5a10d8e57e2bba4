"""The hooks of a task: which are its own, what they return and ask for, and the parts of a control step they make."""

import contextlib
import weakref
from collections.abc import Iterator, Mapping
from typing import Any, cast

import mujoco
import torch

from torchrl_loco.checks import Interval, check_choice, check_float, check_int, suggestion
from torchrl_loco.envs.episode import MAX_VALUE
from torchrl_loco.envs.fixed_order import fixed_order
from torchrl_loco.envs.precision import own_precision
from torchrl_loco.envs.resets import NESTED
from torchrl_loco.envs.rotations import unit_quaternions
from torchrl_loco.envs.stage import carried
from torchrl_loco.envs.state import State, by_world
from torchrl_loco.envs.tables import Entry, constants
from torchrl_loco.envs.task import Task, declared, draws_by_warp, own_hooks
from torchrl_loco.envs.view import CONTACT_HISTORY, PUBLIC, Arrays, Catalog, View, usable
from torchrl_loco.sim import models
from torchrl_loco.sim.overflow import Overflow

PARTS = {
    "control": ("control",),
    "judge": ("update", "reward", "terminated", "truncated", "metrics", "events"),
    "adapt": ("adapt",),
    "observe": ("observation",),
    "begin": ("begin",),
    "observe_begun": ("observation",),
    "observe_restored": ("observation",),
}
"""The hooks that each part of a step or reset calls, in their order."""

ENDS = {"terminated": "ended", "truncated": "cut_off"}  # the hooks that end an episode, and the flag that each writes


@contextlib.contextmanager
def reads_of(env: Any) -> Iterator[set[str]]:
    """Yields the names of the attributes of an environment that are read, by whomever, in full at the end."""
    found, cls = set[str](), cast("Any", type(env))

    def __getattribute__(self: Any, name: str) -> Any:  # noqa: N807
        found.add(name)
        return cls.__getattribute__(self, name)

    names = {"__getattribute__": __getattribute__, "__module__": cls.__module__, "__qualname__": cls.__qualname__}
    object.__setattr__(env, "__class__", type(cls)(cls.__name__, (cls,), names))
    try:
        yield found
    finally:
        object.__setattr__(env, "__class__", cls)


class Hooks:
    """The hooks of an environment's task that are plain torch.

    If there are any, they are called once when this is made, in worlds at rest in the home pose, which tells what they
    return and what of the physics they ask for. No reference that would keep the environment alive is kept.
    """

    view: type[View] = View
    """What hooks see."""

    @torch.inference_mode(False)  # writes of hooks are noticed by versions of tensors
    def __init__(self, env: Any, mj_model: mujoco.MjModel) -> None:
        self._env = weakref.ref(env)
        self._title = type(env).__name__
        self.own = own_hooks(type(env))  # their names
        self._substeps, (memory, shared) = env.config.substeps, declared(type(env))
        self.catalog = Catalog(env, mj_model, memory, shared)
        self.catalog.draws_states = draws_by_warp(type(env))
        if models.has_home(mj_model) and type(env).begin is Task.begin and not self.catalog.draws_states:
            self.own |= {"begin"}
        if type(env).observation_func is not Task.observation_func:
            self.catalog.warp_outputs = type(env).observation_size
        starts = {name: value for name, value in type(env).shared.items() if isinstance(value, torch.Tensor)}
        self.catalog.starts = {name: value.detach().to(env.device) for name, value in starts.items()}
        own_tables = env.constants() if callable(env.constants) else env.constants
        self.catalog.constants = constants(self._title, own_tables, {*PUBLIC, *memory, *shared}, env.device)
        if not env.with_metrics:
            self.own -= {"metrics"}
        kept: dict[str, Any] = {"device": env.device, "dtype": torch.float32}
        self.commands = {  # those that can be set, in worlds to play with: their values, and in which worlds they are
            entry: (torch.zeros(env.num_envs, *memory[entry].shape, **kept), torch.zeros(env.num_envs, **kept) > 0)
            for entry in (env.command_ranges if env.play else ())
        }
        self.groups: dict[str, tuple[int, ...]] = {}  # shapes of rows; empty if a Warp function observes
        self.terms: dict[str, dict[str, int]] = {}  # by group, sizes of its terms in their order, if they have names
        self.history: dict[str, int] = {}  # by group, how many of the last ones it has, where it is more than one
        self._shapes: dict[str, dict[str, tuple[int, ...]]] = {}  # by group, those of its terms
        self._noise_scale = env.noise_scale
        self._noise: dict[tuple[str, str], tuple[float, str | None]] = {}
        self.term_names: tuple[str, ...] | None = None  # those of the reward; None if a Warp function rewards
        self.metric_names: tuple[str, ...] = ()
        self.moves = False  # whether events changes qpos or qvel
        self.carried: tuple[str, ...] = ()  # entries of memory that begin from what the last episode left: a level
        self._pose = {"qpos": Entry((mj_model.nq,), torch.float32), "qvel": Entry((mj_model.nv,), torch.float32)}
        self.read: dict[str, set[str]] = {}  # by hook, the attributes of the environment that it reads
        if self.own:
            with torch.no_grad(), own_precision(env.device):
                self._probe(self._at_home())
        self.catalog.complete = True

    def _call(
        self, hook: str, arrays: Arrays, *, steps: int = 0, args: tuple[Any, ...] = (), view: View | None = None
    ) -> Any:
        env = self._env()
        assert env is not None
        view = self.view(self.catalog, arrays, hook, steps) if view is None else view
        if self.catalog.complete:
            returned = getattr(env, hook)(view, *args)
            if view._lost:
                self._count_lost(arrays, view._lost, masked=hook in ("begin", "observation") and steps == 0)
            return returned
        shown = {**arrays, **self.catalog.constants, "home": self.catalog.home}
        before, own = {name: rows._version for name, rows in shown.items()}, dict(vars(env))
        of_model = {name: rows._version for name, rows in self.catalog.of_model.items()}
        try:
            with reads_of(env) as self.read[hook]:
                returned = getattr(env, hook)(view, *args)
        except AttributeError as error:
            if str(error).startswith(f"'{self._title}' object has no attribute"):
                late = "hooks are called while the environment is made: set what they read of self before that"
                error.add_note(f"did you mean s.{error.name}?" if error.name in PUBLIC else late)
            raise
        for name, version in before.items():
            if shown[name]._version != version:
                raise ValueError(f"{self._title}.{hook} writes to s.{name.rpartition('.')[2]}: work on a clone")
        for name, rows in self.catalog.of_model.items():
            if rows._version != of_model.get(name, 0):
                raise ValueError(f"{self._title}.{hook} writes to {name!r} of the model: work on a clone")
        for name, value in vars(env).items():
            if own.get(name, own) is not value:
                instead = "declare it in memory, and return it from update() or events()"
                raise ValueError(f"{self._title}.{hook} sets self.{name}, but hooks are pure: {instead}")
        return returned

    def _count_lost(self, a: Arrays, lost: Mapping[bool, torch.Tensor], *, masked: bool) -> None:
        """Flags worlds in which an index of a table was out of range; ``masked``, those of the mask alone."""
        bits = a["overflow"]
        for gave_nan, worlds in lost.items():
            flag = Overflow.INDEX if gave_nan else Overflow.INDEX | Overflow.INDEX_OF_INTEGERS
            bits = torch.where(worlds, bits | int(flag), bits)
        a["overflow"].copy_(torch.where(a["mask"], bits, a["overflow"]) if masked else bits)

    # Calling the hooks once.

    def _at_home(self) -> dict[str, torch.Tensor]:
        """Returns arrays of worlds at rest in the home pose."""
        catalog = self.catalog
        m, n, device = catalog.mj_model, catalog.num_envs, catalog.device
        data = mujoco.MjData(m)
        data.qpos[:] = catalog.home.cpu().numpy()
        mujoco.mj_forward(m, data)
        rows: dict[str, Any] = {name: getattr(data, name) for name in ("qpos", "qvel", "ctrl", "xpos", "cvel")}
        rows |= {"xmat": data.xmat.reshape(-1, 3, 3), "subtree_com": data.subtree_com, "sensordata": data.sensordata}
        rows |= {"contact_force": [[0.0] * 3], "in_contact": [0.0], "action": [0.0] * m.nu}
        rows |= {name: [rows[name.removesuffix("_history")]] * self._substeps for name in CONTACT_HISTORY}
        rows |= {"numbers": catalog.variation.varied.nominal()} if catalog.variation else {}
        if catalog.warp_outputs is not None:
            rows |= {"warp.observation": [0.0] * catalog.warp_outputs, "warp.reward": 0.0}
        arrays = {name: torch.as_tensor(row, dtype=torch.float32, device=device) for name, row in rows.items()}
        arrays = {name: row.repeat(n, *[1] * row.ndim) for name, row in arrays.items()}
        memory, shared = catalog.zeros()
        arrays |= {f"memory.{name}": rows for name, rows in memory.items()}
        arrays |= {f"shared.{name}": catalog.starts.get(name, values).clone() for name, values in shared.items()}
        zeros = torch.zeros(n, dtype=torch.long, device=device)
        arrays |= {"seed": zeros[:1], "world": torch.arange(n, device=device), "ended": zeros.bool()}
        return {**arrays, "episode": zeros, "elapsed_steps": zeros}

    def _probe(self, arrays: dict[str, torch.Tensor]) -> None:
        m, n = self.catalog.mj_model, self.catalog.num_envs
        if "control" in self.own:
            controls = self._call("control", arrays, args=(arrays["action"],))
            self._check("control", controls, (n, m.nu))
        memory, pose = self.catalog.memory, self._pose
        self._remember(arrays, self._rows("update", arrays, memory))
        if "reward" in self.own:
            terms = self._call("reward", arrays, steps=1)
            if isinstance(terms, Mapping) and not (terms and all(isinstance(name, str) for name in terms)):
                raise ValueError(f"{self._title}.reward must return a tensor, or tensors by name, got {terms!r}")
            for name, term in terms.items() if isinstance(terms, Mapping) else [("", terms)]:
                self._check("reward", term, (n,), name)
            self.term_names = tuple(terms) if isinstance(terms, Mapping) else ()
        for hook in (hook for hook in ENDS if hook in self.own):
            ended = self._call(hook, arrays, steps=1)
            self._check(hook, ended, (n,))
            if ended.dtype != torch.bool:
                raise TypeError(f"{self._title}.{hook} must return a bool tensor, got {ended.dtype}")
        if "metrics" in self.own:
            numbers = self._metrics(arrays)
            for name, number in numbers.items():
                self._check("metrics", number, (n,), name)
            self.metric_names = tuple(numbers)
        rows = self._rows("events", arrays, {**memory, **pose})
        self.moves = bool(pose.keys() & rows.keys())
        self._remember(arrays, {name: row for name, row in rows.items() if name in memory})
        self._adapted(arrays)
        for name, row in self._begun(arrays).items():
            if not row.isfinite().all():
                raise ValueError(f"{self._title}.begin returns {name} with numbers that are not finite")
        self.carried = carried(self._begun, arrays, memory)
        self.groups = {name: tuple(values.shape[1:]) for name, values in self._groups(arrays).items()}
        self._declare_noise_and_history()

    def _declare_noise_and_history(self) -> None:
        env = self._env()
        assert env is not None
        seen, memory = {name: shapes for name, shapes in self._shapes.items() if name != CRITIC}, self.catalog.memory
        known = list(dict.fromkeys(term for shapes in seen.values() for term in shapes))
        declares = next(base.__name__ for base in type(env).__mro__ if "noise" in vars(base))
        base = self._title if "noise" in vars(env) else declares
        of = "" if base == self._title else f" (of which {self._title} is a subclass, where noise = {{}} leaves it out)"
        for term, value in env.noise.items():
            check_choice(f"{base}.noise{of}", term, known)
            title = f"{self._title}.noise[{term!r}]"
            most, entry = value if isinstance(value, tuple) else (value, None)
            check_float(title, most, Interval(0.0, MAX_VALUE))
            if entry is not None:
                check_choice(title, entry, list(memory))
            for group, shape in ((group, shapes[term]) for group, shapes in seen.items() if term in shapes):
                if entry is not None and (has := memory[entry].shape) != shape:
                    raise ValueError(f"{title}: {entry!r} must have the term's shape {shape}, not {has}")
                if env.noise_scale:
                    self._noise[group, term] = env.noise_scale * float(most), entry
        for group, count in env.history.items():
            check_choice(f"{self._title}.history", group, list(self.groups))
            if len(self.groups[group]) != 1:
                raise ValueError(f"{self._title}.history[{group!r}] must be of rows, not of shape {self.groups[group]}")
            if check_int(f"{self._title}.history[{group!r}]", count) > 1:
                (size,) = self.groups[group]
                self.catalog.memory[HISTORY.format(group)] = Entry((count, size), torch.float32)
                self.history[group], self.groups[group] = count, (count * size,)

    def _groups(self, arrays: Arrays, steps: int = 0) -> dict[str, torch.Tensor]:
        """Returns the present observation by group, if a hook makes it: its terms joined in their order, with noise."""
        if "observation" not in self.own:
            return {}
        view = self.view(self.catalog, arrays, "observation", steps)
        groups = self._call("observation", arrays, steps=steps, view=view)
        if not isinstance(groups, Mapping):
            groups = {"observation": groups}
        wrong = [name for name in groups if not isinstance(name, str) or name in NO_GROUPS or "." in name]
        if wrong or not groups:
            raise ValueError(
                f"{self._title}.observation must return a tensor or tensors by name, such as 'observation' and "
                f"'privileged'{f'; {wrong[0]!r} is no name that they can have' if wrong else ''}"
            )
        return {name: self._joined(view, name, values) for name, values in groups.items()}

    def _joined(self, view: View, group: str, values: Any) -> torch.Tensor:
        """Returns a group of the observation: the tensor that a hook returned, or its terms in their order."""
        named = isinstance(values, Mapping)
        terms = values if named else {group: values}
        if not self.catalog.complete:
            if not terms:
                raise ValueError(f"{self._title}.observation: {group!r} has no terms")
            for term, rows in terms.items():
                self._check_term(group, term, rows)
            self._shapes[group] = {term: tuple(rows.shape[1:]) for term, rows in terms.items()}
            self.terms[group] = {term: rows[0].numel() for term, rows in terms.items()} if named else {}
        found = []
        for term, rows in terms.items():
            if (noise := self._noise.get((group, term))) is not None:
                most, entry = noise
                drawn = view.uniform(-most, most, *rows.shape[1:])
                if entry is not None:
                    offset = getattr(view, entry)
                    drawn = drawn + (offset if self._noise_scale == 1.0 else self._noise_scale * offset)
                rows = rows + drawn
            found.append(rows)
        if not named:
            return found[0]
        return torch.cat([rows.unsqueeze(-1) if rows.ndim == 1 else rows.flatten(1) for rows in found], dim=-1)

    def _check_term(self, group: str, term: Any, rows: Any) -> None:
        if not isinstance(term, str):
            raise ValueError(f"{self._title}.observation{_of(group)} must have terms by name, got {term!r}")
        name = f"{group}.{term}" if term != group else group
        shape = (self.catalog.num_envs, *(rows.shape[1:] if isinstance(rows, torch.Tensor) else ()))
        self._check("observation", rows, shape, name)
        if not rows.is_floating_point():
            raise TypeError(f"{self._title}.observation{_of(name)} must be of floats, got {rows.dtype}")

    def _metrics(self, arrays: Arrays) -> dict[str, torch.Tensor]:
        values = self._call("metrics", arrays, steps=1)
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            raise TypeError(f"{self._title}.metrics must return numbers of each world by name, got {_kind(values)}")
        return dict(values)

    def _begun(self, arrays: Arrays) -> dict[str, torch.Tensor]:
        """Returns what episodes begin with, of pose and memory."""
        return self._rows("begin", arrays, {**self.catalog.memory, **self._pose})

    def _adapted(self, arrays: Arrays) -> dict[str, torch.Tensor]:
        """Returns new values of what worlds share, by name; sums over worlds have a fixed order."""
        with fixed_order():
            return self._rows("adapt", arrays, self.catalog.shared, by_world=False)

    def _rows(
        self, hook: str, arrays: Arrays, known: Mapping[str, Entry], *, by_world: bool = True
    ) -> dict[str, torch.Tensor]:
        """Returns the new rows that a hook returns, if it is the task's own, by name, each of full shape."""
        if hook not in self.own:
            return {}
        rows = self._call(hook, arrays, steps=0 if hook == "begin" else 1)
        if not isinstance(rows, Mapping):
            raise TypeError(f"{self._title}.{hook} must return new rows by name, got {_kind(rows)}")
        first, kind = ([self.catalog.num_envs], "memory") if by_world else ([], "shared")
        for name, row in rows.items():
            if name not in known:
                raise ValueError(
                    f"{self._title}.{hook} returns {name!r}{suggestion(str(name), list(known))}: choose of "
                    f"{', '.join(known) or f'the names of {kind}, which has no entries'}"
                )
            shape = (*first, *known[name].shape)
            if not isinstance(row, torch.Tensor) or tuple(row.shape) != shape:
                raise ValueError(f"{self._title}.{hook} must return {name} of shape {shape}, got {_kind(row)}")
            if not torch.can_cast(row.dtype, known[name].dtype):
                raise TypeError(f"{self._title}.{hook} must return {name} of {known[name].dtype}, got {row.dtype}")
        return dict(rows)

    def _check(self, hook: str, values: Any, shape: tuple[int, ...], name: str = "") -> None:
        what = f"{self._title}.{hook}{_of(name)} must return"
        if not isinstance(values, torch.Tensor):
            raise TypeError(f"{what} a tensor, got {_kind(values)}")
        if tuple(values.shape) != shape:
            raise ValueError(f"{what} shape {shape}, the worlds first, got {tuple(values.shape)}")
        if values.device != self.catalog.device:
            raise ValueError(f"{what} a tensor on {self.catalog.device}")

    # The parts of a control step, in their order. Each reads and writes arrays of all worlds in place.

    def control(self, a: Arrays) -> None:
        """Before the physics: writes ``ctrl``. Worlds whose action or control is not finite are marked; that is 0."""
        action = usable(a["action"], self.catalog.bounded)
        controls = self._call("control", a, args=(action,))
        finite = controls.isfinite()
        a["ctrl"].copy_(torch.where(finite, controls, 0.0))
        a["non_finite"].copy_(~(finite & a["action"].isfinite()).all(-1))

    def judge(self, a: Arrays) -> None:
        """After the physics: writes memory, reward, terms, both flags of the end; what events change, and ``moved``."""
        self._remember(a, self._rows("update", a, self.catalog.memory))
        if "reward" in self.own:
            terms = self._call("reward", a, steps=1)
            if isinstance(terms, Mapping):
                columns = torch.stack([term.float() for term in terms.values()], dim=-1)
                a["terms"].copy_(columns)
                terms = columns.sum(-1)
            a["reward"].copy_(terms)
        for hook, flag in ENDS.items():
            if hook in self.own:
                a[flag].copy_(self._call(hook, a, steps=1))
        if self.metric_names:
            a["metrics"].copy_(torch.stack([value.float() for value in self._metrics(a).values()], dim=-1))
        rows = self._rows("events", a, {**self.catalog.memory, **self._pose})
        if changed := [(rows[name] != a[name]).any(-1) for name in self._pose if name in rows]:
            a["moved"].copy_(torch.stack(changed).any(0))
        self._remember(a, rows)
        self._remember(a, self._commanded(a))

    def adapt(self, a: Arrays) -> None:
        """After the events: writes what worlds share, but numbers that are not finite: they would end all worlds."""
        new = {name: value.clone() for name, value in self._adapted(a).items()}  # one may be another's old one
        for name, value in new.items():
            old = a[f"shared.{name}"]
            old.copy_(torch.where(value.isfinite(), value, old))

    def observe(self, a: Arrays) -> None:
        """At the end of a step: writes the observation, and marks and zeroes worlds that are not finite."""
        groups = self._groups(a, steps=1)
        for name, values in groups.items():
            if name in self.history:
                past = a[f"memory.{HISTORY.format(name)}"]
                values = torch.cat([past[:, 1:], values.unsqueeze(1)], dim=1)
                past.copy_(values)
                values = values.flatten(1)
            a[f"out.{name}"].copy_(values)
        outputs = [a[name] for name in a if name.startswith("out.")]
        memory = [a[f"memory.{name}"] for name, (_, kind) in self.catalog.memory.items() if kind.is_floating_point]
        wrong = a["non_finite"] | beyond(a["reward"], a["qpos"], a["qvel"], *memory, *outputs) | self._lost(a)
        a["non_finite"].copy_(wrong)
        for values in (*outputs, a["reward"], a["terms"], *([a["metrics"]] if self.metric_names else [])):
            values.masked_fill_(by_world(wrong, values), 0.0)

    def begin(self, a: Arrays) -> None:
        """At a reset, in the masked worlds, which are at rest: writes pose and memory."""
        memory = self.catalog.memory
        self._remember(a, self._commanded(a), a["mask"])  # commands may say where to begin
        rows: dict[str, torch.Tensor] = {}
        if "begin" in self.own:
            home = {"qpos": self.catalog.home.expand_as(a["qpos"])}
            rows = {**home, **self._begun(a)}
        zeros = {name: torch.zeros_like(a[f"memory.{name}"]) for name in memory if name not in rows}
        self._remember(a, {**zeros, **rows}, a["mask"])
        self._remember(a, self._commanded(a), a["mask"])

    def _commanded(self, a: Arrays) -> dict[str, torch.Tensor]:
        """Returns the commands of all worlds, by entry of memory: those that are set, in the others what they drew."""
        return {
            entry: torch.where(by_world(is_set, values), values, a[f"memory.{entry}"])
            for entry, (values, is_set) in self.commands.items()
        }

    def observe_begun(self, a: Arrays, *, restored: bool = False) -> None:
        """After a reset: writes the observation of the masked worlds, which is all of their history."""
        groups = self._groups(a)
        for name, count in self.history.items():
            past = a[f"memory.{HISTORY.format(name)}"]
            values = groups[name].unsqueeze(1).expand(-1, count, -1)
            if restored:
                has_past = past.isfinite().flatten(1).all(-1)
                values = torch.where(by_world(has_past, past), past, values)
            past.copy_(torch.where(by_world(a["mask"], past), values, past))
            groups[name] = values.flatten(1)
        wrong = beyond(a["qpos"], a["qvel"], *groups.values()) | self._lost(a)
        a["non_finite"].copy_(torch.where(a["mask"], a["non_finite"] | wrong, a["non_finite"]))
        for name, values in groups.items():
            target, values = a[f"out.{name}"], values.masked_fill(by_world(wrong, values), 0.0)
            target.copy_(torch.where(by_world(a["mask"], target), values, target))

    def observe_restored(self, a: Arrays) -> None:
        """After a state was written: does what :meth:`observe_begun` does, with the state's history, if any."""
        self.observe_begun(a, restored=True)

    def _lost(self, a: Arrays) -> Any:
        """Returns in which worlds an index out of range gave what looks like a number."""
        has_tables = self.catalog.constants or self.catalog.shared
        return (a["overflow"] & int(Overflow.INDEX_OF_INTEGERS)) != 0 if has_tables else False

    def _remember(self, a: Arrays, rows: Mapping[str, torch.Tensor], mask: torch.Tensor | None = None) -> None:
        new = []  # all of them before the first is written: a row may be a view of another entry
        for name, row in rows.items():
            target = a[f"memory.{name}"] if name in self.catalog.memory else a[name]
            row = unit_quaternions(self.catalog.mj_model, row) if name == "qpos" else row
            row = row.clone() if mask is None else torch.where(by_world(mask, target), row.to(target.dtype), target)
            new.append((target, row))
        for target, row in new:
            target.copy_(row)


CRITIC = "privileged"  # group of the observation that the critic alone sees: it has no noise
HISTORY = "{}.history"  # name of the entry of memory that keeps the last observations of a group
NO_GROUPS = (*("reward", "done", "terminated", "truncated", "action", "next", "_reset", "_step"), *NESTED, *State.KEYS)
"""Names that a tensor of the observation cannot have: those of a step's other entries, and of a state."""


def beyond(*arrays: torch.Tensor) -> torch.Tensor:
    """Returns in which worlds a number of arrays ``(num_envs, ...)`` is not finite, or as good as that."""
    finite = [(values.flatten(1) if values.ndim > 1 else values.unsqueeze(1)).abs() < MAX_VALUE for values in arrays]
    return ~torch.stack([part.all(-1) for part in finite]).all(0)


def _kind(value: Any) -> str:
    return f"a tensor of shape {tuple(value.shape)}" if isinstance(value, torch.Tensor) else repr(value)


def _of(name: str) -> str:
    return f"[{name!r}]" if name else ""
