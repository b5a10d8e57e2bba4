"""Monitors: counters of overflows, and a dump of the first world that becomes non-finite.

A monitor works on the device. The host reads a few of its numbers every 100 steps, and never waits for them.
"""

import logging
import multiprocessing
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import warp as wp
from tensordict import TensorDict

from torchrl_loco import known_files, storage
from torchrl_loco.envs.state import State, by_world
from torchrl_loco.sim import Buffer, Overflow, Simulation

INTERVAL = 100  # control steps between two reads

ON_OVERFLOW = ("warn", "raise", "ignore")  # what can be done when the physics dropped contacts or constraints

NAN_DUMP = "NaN dump"  # kind of file, stored in a NaN dump


class PhysicsOverflowWarning(UserWarning):
    """The physics dropped contacts or constraints because ``naconmax`` or ``njmax`` is too small."""


class PhysicsOverflowError(RuntimeError):
    """The physics dropped contacts or constraints because ``naconmax`` or ``njmax`` is too small."""


class NonFiniteWarning(UserWarning):
    """A world became non-finite. With ``nan_dump`` the state and action before that step were written to a file."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warns. TorchRL's workers silence all warnings: there the message is logged too."""
    warnings.warn(message, category, stacklevel=3)
    if multiprocessing.parent_process() is not None and warnings.filters[:1] == [("ignore", None, Warning, None, 0)]:
        logging.getLogger("torchrl_loco").warning(message)


class Monitor(ABC):
    """Reads ``count`` numbers of what control steps have noted every 100 steps, and reports."""

    def __init__(self, count: int, device: torch.device) -> None:
        self._device = device
        on_cuda = device.type == "cuda"
        self._host = torch.zeros(count, dtype=torch.long, device="cpu", pin_memory=on_cuda)
        self._copied = torch.cuda.Event() if on_cuda else None
        self._steps, self._pending = 0, False

    @abstractmethod
    def numbers(self) -> torch.Tensor:
        """Returns the numbers to report on, shape ``(count,)`` and dtype int64, without waiting for the device."""

    @abstractmethod
    def report(self, numbers: list[int]) -> None:
        """Reports what the numbers say: warns, raises or writes a file."""

    @abstractmethod
    def clear(self) -> None:
        """Resets what is on the device."""

    def restart(self) -> None:
        """Starts from zero."""
        self._steps, self._pending = 0, False
        self.clear()

    def poll(self, steps: int = 1) -> None:
        """Requests the numbers every :data:`INTERVAL` of all ``steps``; reports once they have arrived on the host."""
        before, self._steps = self._steps, self._steps + steps
        if self._steps // INTERVAL > before // INTERVAL and not self._pending:
            self._request()
        if self._pending and (self._copied is None or self._copied.query()):  # on the CPU the copy is done at once
            self._arrived()

    def check(self) -> None:
        """Requests the numbers, waits for the device, and reports."""
        self._request()
        if self._copied is not None:
            self._copied.synchronize()
        self._arrived()

    def _arrived(self) -> None:
        self._pending = False
        self.report(self._host.tolist())

    def _request(self) -> None:
        self._host.copy_(self.numbers(), non_blocking=True)
        if self._copied is not None:
            self._copied.record(torch.cuda.current_stream(self._device))
        self._pending = True


# Health: how often the physics dropped something, used up its iterations, or was not finite.

COUNTERS = {
    "constraint_overflow": Overflow.NEFC | Overflow.NJMAX_NNZ,
    "contact_overflow": Overflow.BROADPHASE | Overflow.NARROWPHASE | Overflow.CCD,
    "iteration_limit": Overflow.ITERATIONS,
    "line_search_limit": Overflow.LS_ITERATIONS,
    "solver_failure": Overflow.UNSOLVED,
    "index_error": Overflow.INDEX,
}
"""Name of a counter and the bits of ``Data.overflow`` that it counts."""
DROPPED = ("constraints", "contacts")  # what the first two counters count as dropped


class Health(Monitor):
    """Counts, for each world, the control steps in which something went wrong in the physics.

    What ends a control step counts (:func:`torchrl_loco.envs.episode.finish_step`): bits of ``overflow`` and, last,
    steps that ended non-finite; of these it warns, unless a guard does.
    """

    def __init__(self, sim: Simulation, on_overflow: str, *, guarded: bool) -> None:
        self._sim, self._on_overflow, self._tells_non_finite = sim, on_overflow, not guarded
        self.counter_bits = wp.array([int(bits) for bits in COUNTERS.values()], dtype=int, device=sim.device)
        self.counts = Buffer((sim.num_envs, len(COUNTERS) + 1), int, sim.device)
        super().__init__(len(DROPPED) + 3, self.counts.torch.device)
        self._next_report = 1  # world-steps in which something was dropped

    def numbers(self) -> torch.Tensor:
        """Returns the steps in which constraints and contacts were dropped, the most of each needed, and lost steps."""
        dropped, lost = self.counts.torch[:, : len(DROPPED)].sum(dim=0), self.counts.torch[:, -1:].sum(dim=0)
        return torch.cat([dropped, torch.stack([*self._peaks().values()]), lost])

    def _peaks(self) -> dict[str, torch.Tensor]:
        engine = self._sim.engine
        return {"constraints": engine.peak_constraints.torch.max(), "contacts": engine.peak_contacts.torch.max()}

    def report(self, numbers: list[int]) -> None:
        """Warns once of worlds that became non-finite; warns or raises at what was dropped, and at ten times that."""
        dropped, needed, lost = numbers[: len(DROPPED)], numbers[len(DROPPED) : -1], numbers[-1]
        if lost and self._tells_non_finite and not any(dropped):  # of which it may be a consequence
            self._tells_non_finite = False
            warn(
                f"{lost} of {self._steps * self._sim.num_envs} world-steps ended an episode, as an action, a state, or "
                "what a hook returned was not finite: nan_dump=FILE keeps what was before the first, health() counts",
                NonFiniteWarning,
            )
        if self._on_overflow == "ignore" or sum(dropped) < self._next_report:
            return
        self._next_report, steps = 10 * sum(dropped), self._steps * self._sim.num_envs
        messages = [
            f"{what} were dropped in {count} of {steps} world-steps; {self._sim.engine.remedy(what, most)}"
            for what, count, most in zip(DROPPED, dropped, needed, strict=True)
            if count
        ]
        message = "; ".join(messages) + "; or pass on_overflow='ignore'"
        if self._on_overflow == "raise":
            raise PhysicsOverflowError(message)
        warn(message, PhysicsOverflowWarning)

    def check(self) -> None:
        """Reports what was dropped; of a few lost steps at the end of an environment nobody needs to hear."""
        self._tells_non_finite = False
        super().check()

    def clear(self) -> None:
        """Sets all counters and peaks to zero."""
        engine = self._sim.engine
        for counter in (self.counts, engine.peak_constraints, engine.peak_contacts):
            counter.torch.zero_()
        self._sim.overflow.zero_()
        self._next_report = 1

    def summary(self) -> TensorDict:
        """Returns the counters, without waiting for the device; see :meth:`torchrl_loco.LocoEnv.health`."""
        names, counts = [*COUNTERS, "non_finite"], self.counts.torch.clone()
        kept: dict[str, Any] = {"device": counts.device}
        worlds = TensorDict(dict(zip(names, counts.unbind(1), strict=True)), batch_size=[len(counts)], **kept)
        total = dict(zip(names, counts.sum(dim=0).unbind(), strict=True))
        return TensorDict({"worlds": worlds, "total": total, "peak": self._peaks()}, batch_size=[], **kept)


# NaN guard: keeps the inputs of the last control step of each world until it becomes non-finite.

NEVER = torch.iinfo(torch.long).max  # where no world was lost


class NanGuard(Monitor):
    """Writes the state and action before the first step that made a world non-finite to a file, a NaN dump.

    The file is never overwritten; no reference to the :class:`.world.World` is kept. By name, ``arrays`` are what
    :meth:`keep` reads and writes.
    """

    def __init__(self, path: Path, world: Any, settings: dict[str, Any]) -> None:
        self._path, self._settings = path, settings
        self._sim, self._seed = world.sim, world.seed
        clock = {name: getattr(world, name).torch for name in ("episode", "elapsed_steps")}
        held = {name: getattr(self._sim, name) for name in State.PHYSICS if name != "act" or self._sim.mj_model.na}
        held |= {"numbers": self._sim.numbers} if self._sim.varied is not None else {}
        present = {"action": world.action.torch, **clock, **held}
        self._kept = {name: torch.zeros_like(rows) for name, rows in present.items()}
        self._lost = world.health.counts.torch[:, -1]  # steps that ended non-finite
        self._passed = torch.zeros_like(self._lost)  # those that were kept
        kept = {f"kept.{name}": rows for name, rows in self._kept.items()}
        self.arrays = {**present, **kept, "lost": self._lost, "steps": self._passed}
        super().__init__(1, self._lost.device)
        self._reported = False

    def keep(self, a: Mapping[str, torch.Tensor]) -> None:
        """Before a step: copies what it begins with, in worlds in which no step has ended non-finite."""
        goes_on = a["lost"] == 0
        for name in self._kept:
            kept = a[f"kept.{name}"]
            kept.copy_(torch.where(by_world(goes_on, kept), a[name], kept))
        a["steps"].add_(goes_on)

    def numbers(self) -> torch.Tensor:
        """Returns ``step * num_envs + world`` of the first loss, ``NEVER`` if there was none, shape ``(1,)``."""
        worlds = torch.arange(len(self._passed), device=self._passed.device)
        order = self._passed.long() * len(worlds) + worlds
        return torch.where(self._lost > 0, order, NEVER).min().view(1)

    def clear(self) -> None:
        """Starts to count steps."""
        self._passed.zero_()

    def report(self, numbers: list[int]) -> None:
        """Writes the file and warns, once, if a world was found."""
        if self._reported or numbers == [NEVER]:
            return
        self._reported, world = True, numbers[0] % self._sim.num_envs
        kept = {name: rows[world].clone() for name, rows in self._kept.items()}
        counters = {name: int(kept.pop(name)) for name in ("episode", "elapsed_steps")}
        if self._sim.varied is not None:
            row, columns = kept.pop("numbers"), self._sim.varied.columns
            kept |= {f"model.{name}": row[which].clone() for name, which in columns.items()}
        settings = {**self._settings, "seed": int(self._seed.torch[0]), "world": world, **counters}
        try:
            self._path.open("x").close()  # nothing is overwritten
        except FileExistsError:
            where = f"{self._path} already exists and was left as it is"
        else:
            try:
                storage.save(self._path, NAN_DUMP, kept, settings)
            except BaseException:
                self._path.unlink()  # an empty file would keep a later one from being written
                raise
            where = f"its state and action before that step are in {self._path}: see torchrl-loco inspect"
            if (file := self._settings["file"]) and not self._settings["env"].startswith("torchrl_loco."):
                known_files.remember(Path(file).resolve())
        step = counters["elapsed_steps"] + 1
        warn(f"world {world} became non-finite in step {step} of its episode; {where}", NonFiniteWarning)
