"""Monitors: counters of overflows, and a dump of the first world that becomes non-finite.

A monitor works on the device. The host reads a few of its numbers every 100 steps, and never waits for them.
"""

import logging
import multiprocessing
import warnings
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import torch
import warp as wp
from tensordict import TensorDict

from torchrl_loco import known_files, storage
from torchrl_loco.envs.state import State
from torchrl_loco.sim import Buffer, Overflow, Simulation, WorldFunc, fill
from torchrl_loco.sim.world_func import copy_row

INTERVAL = 100  # control steps between two reads

ON_OVERFLOW = ("warn", "raise", "ignore")  # what can be done when the physics dropped contacts or constraints

NAN_DUMP = "NaN dump"  # kind of file, stored in a NaN dump


class PhysicsOverflowWarning(UserWarning):
    """The physics dropped contacts or constraints because ``naconmax`` or ``njmax`` is too small."""


class PhysicsOverflowError(RuntimeError):
    """The physics dropped contacts or constraints because ``naconmax`` or ``njmax`` is too small."""


class NonFiniteWarning(UserWarning):
    """A world became non-finite; the state and action before that step were written to a file."""


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warns. TorchRL's workers silence all warnings: there the message is logged too."""
    warnings.warn(message, category, stacklevel=3)
    if multiprocessing.parent_process() is not None and warnings.filters[:1] == [("ignore", None, Warning, None, 0)]:
        logging.getLogger("torchrl_loco").warning(message)


class Monitor(ABC):
    """Adds functions to each control step, reads ``count`` of their numbers every 100 steps, and reports."""

    def __init__(self, count: int, device: torch.device) -> None:
        self._device = device
        on_cuda = device.type == "cuda"
        self._host = torch.zeros(count, dtype=torch.long, device="cpu", pin_memory=on_cuda)
        self._copied = torch.cuda.Event() if on_cuda else None
        self._steps, self._pending = 0, False

    def first_of_step(self, action: wp.array) -> list[WorldFunc]:
        """Returns what each world does before any of them is stepped under ``action`` ``(nworld, nu)``."""
        return []

    def last_of_step(self) -> list[WorldFunc]:
        """Returns what each world does after all of them were stepped."""
        return []

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
    steps that ended non-finite.
    """

    def __init__(self, sim: Simulation, on_overflow: str) -> None:
        self._sim, self._on_overflow = sim, on_overflow
        self.counter_bits = wp.array([int(bits) for bits in COUNTERS.values()], dtype=int, device=sim.device)
        self.counts = Buffer((sim.num_envs, len(COUNTERS) + 1), int, sim.device)
        super().__init__(len(DROPPED) + 2, self.counts.torch.device)
        self._reported = 0

    def numbers(self) -> torch.Tensor:
        """Returns the steps in which constraints and contacts were dropped, and the most of each needed, ``(4,)``."""
        dropped = self.counts.torch[:, : len(DROPPED)].sum(dim=0)
        return torch.cat([dropped, torch.stack([*self._peaks().values()])])

    def _peaks(self) -> dict[str, torch.Tensor]:
        engine = self._sim.engine
        return {"constraints": engine.peak_constraints.torch.max(), "contacts": engine.peak_contacts.torch.max()}

    def report(self, numbers: list[int]) -> None:
        """Warns or raises if something was dropped since the last report.

        Raises:
            PhysicsOverflowError: something was dropped and ``on_overflow`` is "raise".
        """
        dropped, needed = numbers[: len(DROPPED)], numbers[len(DROPPED) :]
        if self._on_overflow == "ignore" or sum(dropped) <= self._reported:
            return
        self._reported = sum(dropped)
        messages = [
            f"{what} were dropped in {count} world-steps; {self._sim.engine.remedy(what, most)}"
            for what, count, most in zip(DROPPED, dropped, needed, strict=True)
            if count
        ]
        message = "; ".join(messages) + "; or pass on_overflow='ignore'"
        if self._on_overflow == "raise":
            raise PhysicsOverflowError(message)
        warn(message, PhysicsOverflowWarning)

    def clear(self) -> None:
        """Sets all counters and peaks to zero."""
        engine = self._sim.engine
        for counter in (self.counts, engine.peak_constraints, engine.peak_contacts):
            counter.torch.zero_()
        self._sim.overflow.zero_()
        self._reported = 0

    def summary(self) -> TensorDict:
        """Returns the counters, without waiting for the device; see :meth:`torchrl_loco.LocoEnv.health`."""
        names, counts = [*COUNTERS, "non_finite"], self.counts.torch.clone()
        kept: dict[str, Any] = {"device": counts.device}
        worlds = TensorDict(dict(zip(names, counts.unbind(1), strict=True)), batch_size=[len(counts)], **kept)
        total = dict(zip(names, counts.sum(dim=0).unbind(), strict=True))
        return TensorDict({"worlds": worlds, "total": total, "peak": self._peaks()}, batch_size=[], **kept)


# NaN guard: keeps the inputs of the last control step until a world becomes non-finite.


@wp.struct
class StepInputs:
    """What a control step begins with, or where it is kept."""

    action: wp.array2d[float]
    episode: wp.array[int]
    elapsed_steps: wp.array[int]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    act: wp.array2d[float]
    numbers: wp.array2d[float]


@wp.struct
class Guarded:
    """What a step begins with, and where it is kept until a world was found that is not finite: ``first``."""

    first: wp.array[int]
    found: wp.array[bool]
    non_finite: wp.array[bool]
    present: StepInputs
    kept: StepInputs


@wp.func
def keep_inputs(world: int, args: Guarded):
    """Copies what a control step begins with, until a world that is not finite was found."""
    found = args.first[0] < args.present.episode.shape[0]
    if world == 0:
        args.found[0] = found
    if found:
        return
    args.kept.episode[world] = args.present.episode[world]
    args.kept.elapsed_steps[world] = args.present.elapsed_steps[world]
    copy_row(args.present.action[world], args.kept.action[world])
    copy_row(args.present.qpos[world], args.kept.qpos[world])
    copy_row(args.present.qvel[world], args.kept.qvel[world])
    copy_row(args.present.qacc_warmstart[world], args.kept.qacc_warmstart[world])
    copy_row(args.present.act[world], args.kept.act[world])
    copy_row(args.present.numbers[world], args.kept.numbers[world])


@wp.func
def find_first(world: int, args: Guarded):
    """Notes the first world that is not finite, unless an earlier step had one."""
    if args.non_finite[world] and not args.found[0]:
        wp.atomic_min(args.first, 0, world)


class NanGuard(Monitor):
    """Writes the state and action before the first step that made a world non-finite to a file, a NaN dump.

    The file is never overwritten; no reference to the :class:`.world.World` is kept.
    """

    def __init__(self, path: Path, world: Any, settings: dict[str, Any]) -> None:
        self._path, self._settings = path, settings
        self._sim, self._seed = world.sim, world.seed
        sim, data = self._sim, self._sim.data
        physics = {name: getattr(data, name) for name in State.PHYSICS}
        clock = {"episode": world.episode.warp, "elapsed_steps": world.elapsed_steps.warp}
        self._inputs = {**clock, **physics, "numbers": wp.from_torch(sim.numbers)}
        self._kept = {name: wp.zeros_like(array) for name, array in {"action": data.ctrl, **self._inputs}.items()}
        self._first = Buffer(1, int, sim.device)
        self._found = Buffer(1, bool, sim.device)
        self._guarded = {"first": self._first.warp, "found": self._found.warp, "non_finite": world.non_finite.warp}
        self._guarded["kept"] = fill(StepInputs, **self._kept)
        super().__init__(1, self._first.torch.device)
        self._reported = False

    def first_of_step(self, action: wp.array) -> list[WorldFunc]:
        """Returns what keeps what a control step under ``action`` ``(nworld, nu)`` begins with."""
        present = fill(StepInputs, action=action, **self._inputs)
        return [WorldFunc(keep_inputs, fill(Guarded, present=present, **self._guarded))]

    def last_of_step(self) -> list[WorldFunc]:
        """Returns what looks for a non-finite world."""
        return [WorldFunc(find_first, fill(Guarded, present=self._guarded["kept"], **self._guarded))]

    def numbers(self) -> torch.Tensor:
        """Returns the index of the world that was found, or the number of worlds if none was, shape ``(1,)``."""
        return self._first.torch.long()

    def clear(self) -> None:
        """Forgets the world that was found."""
        self._first.torch.fill_(self._sim.num_envs)
        self._found.torch.zero_()

    def report(self, numbers: list[int]) -> None:
        """Writes the file and warns, once, if a world was found."""
        (world,) = numbers
        if self._reported or world == self._sim.num_envs:
            return
        self._reported = True
        arrays = self._kept.items()
        kept = {name: wp.to_torch(array)[world].clone() for name, array in arrays if array.size}  # act may be empty
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
