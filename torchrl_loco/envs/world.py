"""Everything of an environment that lives on its device, and the control step from top to bottom."""

import atexit
import contextlib
import functools
import logging
import os
import warnings
import weakref
from collections.abc import Callable, Collection
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
import torch._subclasses.schema_check_mode  # noqa: F401, which closing needs: an import while garbage is collected may fail
import warp as wp

from torchrl_loco.envs import episode
from torchrl_loco.envs.body_funcs import check_pair, check_rows, of_package
from torchrl_loco.envs.hooks import PARTS, reads_of
from torchrl_loco.envs.monitors import Health, Monitor, NanGuard
from torchrl_loco.envs.part import Part
from torchrl_loco.envs.pixels import Seen
from torchrl_loco.envs.precision import own_precision
from torchrl_loco.envs.scan import Scans
from torchrl_loco.envs.state import State
from torchrl_loco.envs.view import CONTACT_HISTORY, Arrays
from torchrl_loco.sim import (
    EXCLUSIVE,
    Around,
    Buffer,
    Graph,
    PackedBuffers,
    Simulation,
    TorchGraph,
    WorldFunc,
    fill,
    joined_to_torch,
    torch_is_recording,
)
from torchrl_loco.sim.models import FORCE_SENSORS

if TYPE_CHECKING:
    from torchrl_loco.envs.base import LocoEnv

FELT = ("contact_force", "in_contact", *CONTACT_HISTORY, "sensordata")
"""Arrays of hooks that a state does not give again: forces are those of the last step."""


class World:
    """The worlds of an environment on their device: simulation, buffers, monitors and graphs.

    It is made when the environment opens and dropped when it closes. It keeps no reference to the task, and steps the
    task's model without the sensors that nothing reads. Buffers hold one row per world and always show the current
    values.

    Attributes:
        sim: the physics.
        action: actions of the last control step, ``(nworld, nu)``, unless torch recorded it; ``sim.ctrl`` holds the
            controls that they became.
        outputs: the memory of what a step returns: each group of the observation, reward, terms; done, terminated and
            truncated.
        groups, memory: groups of the observation and entries of the memory by name, tensors ``(nworld, *row)``.
        shared: what worlds share, by name.
        reward, terms, metrics: ``(nworld,)``, ``(nworld, len(term_names))`` and ``(nworld, count)``.
        stream, episode, elapsed_steps: start of the random stream of the episode (uint32), episodes drawn so far, and
            control steps since the reset, ``(nworld,)``.
        mask, non_finite: which worlds to reset, and which are not finite, ``(nworld,)``.
        ended, cut_off: whether the task's hooks terminate or truncate the episode, ``(nworld,)``.
        done, terminated, truncated: how the episode ends, by the hooks, the time limit, or as the world is not finite.
        seed: seed of all random streams, ``(1,)``.
        seen: what draws the pixels, if the environment returns any.
        health: counts what went wrong in the physics.
        felt: what only a step measures, of what hooks read: contact forces and sensors, tensors ``(nworld, ...)``.
        kinds: by hook of the task in torch, how it runs: see ``Part.kind`` in ``part.py``.
        fixed: attributes of the task that were read when this was made, and never again.
    """

    def __init__(self, task: "LocoEnv", mj_model: mujoco.MjModel) -> None:
        self._closed = True  # until it is made in full
        n, nu, hooks = task.num_envs, mj_model.nu, task.hooks
        self._ctrl_dt, self._own = task.config.ctrl_dt, hooks.own
        self._title, self._variation, self._records = type(task).__name__, task.variation, task.compile_hooks
        # Buffers made in inference mode could not be written outside it; without the device, torch's views would be on
        # the caller's default device.
        with torch.inference_mode(False), EXCLUSIVE, task.device, own_precision(task.device):
            geoms, history = hooks.catalog.contact_geoms, not hooks.catalog.arrays.isdisjoint(CONTACT_HISTORY)
            asked: dict[str, Any] = {"contact_geoms": geoms, "contact_history": history}
            varied = task.variation.varied if task.variation else None
            self.sim = Simulation(mj_model, task.config, n, task.device, varied=varied, **asked)
            nominal = self.sim.numbers.clone()
            device = self.sim.device
            self.action = Buffer((n, nu), float, device)
            shapes = task.groups
            sizes = [torch.Size(shape).numel() for shape in shapes.values()]
            sizes += [1, len(task.term_names), len(hooks.metric_names)]
            self.outputs = PackedBuffers([n * size for size in sizes], 3 * n, task.device)
            *groups, reward, terms, metrics, flags = self.outputs.parts(self.outputs.memory)
            self.groups = {name: part.view(n, *shapes[name]) for name, part in zip(shapes, groups, strict=True)}
            self.reward, self.terms = Buffer.around(reward), Buffer.around(terms.view(n, -1))
            self.metrics = metrics.view(n, -1)
            self.done, self.terminated, self.truncated = map(Buffer.around, flags.view(3, n))
            self.memory, self.shared = hooks.catalog.zeros()
            self._starts = hooks.catalog.starts
            self.mask, self.non_finite, self.ended, self.cut_off = (Buffer(n, bool, device) for _ in range(4))
            self.episode, self.elapsed_steps = (Buffer(n, int, device) for _ in range(2))
            self.stream, self.seed = (Buffer(count, wp.uint32, device) for count in (n, 1))
            self._seed_of_hooks = torch.zeros(1, dtype=torch.long, device=task.device)
            self._stagger = Buffer(1, bool, device)
            self.mask.warp.fill_(True)
            self.seen = task.pixels.seen(self.sim, self.mask.torch) if task.pixels else None

            self.health = Health(self.sim, task.on_overflow, guarded=task.nan_dump is not None)
            self._guard = None if task.nan_dump is None else NanGuard(task.nan_dump, self, task.settings())
            self._monitors: list[Monitor] = [self.health, *([self._guard] if self._guard else [])]

            with reads_of(task) as self.fixed:
                self._make_funcs(task)
            self._make_parts(task)
            wp.synchronize_device(device)  # made on Warp's stream, used on torch's
            self.forget()  # recording wrote into it
            self.sim.numbers.copy_(nominal)
            self.set_seed(task.seed)  # recording ran resets, which advanced the episodes
            for monitor in self._monitors:
                monitor.restart()
        self._renderers: dict[Any, Any] = {}
        self._pid, self._closed = os.getpid(), False
        OPEN.add(self)

    # The control step and the reset, from top to bottom. Each line is a recorded launch, a part of hooks, or nothing.

    def _take_step(self, *action: wp.array, adapts: bool = True) -> None:
        """The control step: under the actions in the buffer, unless torch records it with others."""
        self._keep()  # what the step begins with, for the NaN guard
        self._control()  # own control(): actions to controls
        self._physics(*action)  # default control; the substeps; fused reward and observation
        self._judge()  # update(), reward(), terminated(), truncated(), metrics(), events()
        if adapts:
            self._adapt()  # adapt(): what worlds share
        self._move()  # poses and velocities again, if events() changed the state
        self._observe()  # observation(); worlds that are not finite
        self._conclude()  # time limit, flags, counters
        self._place()  # what lies before the camera, for pixels

    def _begin_masked(self) -> None:
        """A new episode in the worlds of the mask."""
        self._rest()  # home pose, random stream, clock; fused begin
        self._vary()  # numbers of the model, if randomize names any
        self._begin()  # begin(): pose and memory
        self._settle()  # poses and sensors; fused observation
        self._observe_begun()  # observation()
        self._place_begun()  # what lies before the camera, for pixels

    # What each world does besides the physics, in Warp.

    def _make_funcs(self, task: "LocoEnv") -> None:
        data, n, device = self.sim.data, task.num_envs, self.sim.device
        flags = ("non_finite", "done", "terminated", "truncated", "ended", "cut_off", "mask")
        names = (*flags, "seed", "episode", "stream", "elapsed_steps")
        of_world = SimpleNamespace(**{name: getattr(self, name).warp for name in names}, overflow=data.overflow)
        of_world.flags, of_world.episode_length = fill(episode.Flags, of_world), task.config.episode_length
        self._fused: list[WorldFunc] = []
        self._check_finite: list[WorldFunc] = []
        asked = task.hooks.catalog.arrays
        if not {"reward", "observation"} <= self._own or "warp" in asked:
            outputs, size, terms = self._fused_outputs(task)
            func, inputs = check_pair("observation_func", task.observation_func(self))
            if not of_package(type(task)):  # the tests check those of the package
                check_rows(func, inputs, n - 1, size, terms, device)
            coalesced = self.sim.engine.coalesced
            self._fused = [episode.observer(func, inputs, outputs, self.non_finite.warp, size, coalesced=coalesced)]
            finite = fill(episode.FiniteCheck, data, outputs=outputs, non_finite=self.non_finite.warp)
            self._check_finite = [] if self._own else [WorldFunc(episode.zero_non_finite, finite)]
        counted = {"counter_bits": self.health.counter_bits, "counts": self.health.counts.warp}
        self._finish = WorldFunc(episode.finish_step, fill(episode.StepEnd, of_world, **counted))
        first = {"world_offset": task.world_offset or 0, "stagger": self._stagger.warp}
        self._start = [WorldFunc(episode.begin_episode, fill(episode.EpisodeStart, of_world, **first))]
        pose = task.pose_func(self) if "begin" not in self._own or "warp.begin" in asked else None
        if pose is not None:
            func, inputs = check_pair("pose_func", pose)
            self._start.append(episode.poser(func, inputs, self.stream.warp))

    def _fused_outputs(self, task: "LocoEnv") -> tuple[Any, int, int]:
        """Returns where a fused function writes, and the sizes of its rows; what a hook returns instead is not used."""
        cls, n, device = type(task), task.num_envs, self.sim.device
        if "observation" in self._own:
            observation = Buffer((n, cls.observation_size), float, device)
        else:
            observation = Buffer.around(self.groups["observation"])
        reward, terms = self.reward, self.terms
        if "reward" in self._own:
            reward, terms = Buffer(n, float, device), Buffer((n, len(cls.term_names)), float, device)
        self._kept_alive = observation, reward, terms
        outputs = fill(episode.Outputs, observation=observation.warp, reward=reward.warp, terms=terms.warp)
        return outputs, observation.warp.shape[1], terms.warp.shape[1]

    def _launch_step(self, action: wp.array | None = None) -> None:
        """The physics of a step, under actions ``(nworld, nu)`` or those in the buffer; without hooks, all of it."""
        sim, action = self.sim, self.action.warp if action is None else action
        control = {"ctrlrange": sim.model.actuator_ctrlrange, "ctrl": sim.data.ctrl, "non_finite": self.non_finite.warp}
        apply = [WorldFunc(episode.apply_action, fill(episode.Control, action=action, **control))]
        after = [*self._fused, *self._check_finite, *([] if self._own else [self._finish])]
        sim.step(Around(before=[] if "control" in self._own else apply, after=after))

    def _launch_conclude(self) -> None:
        self.sim.apart([self._finish])

    def _launch_rest(self) -> None:
        self.sim.rest(self.mask.warp, self._start)

    def _launch_reset(self) -> None:
        """A reset as one launch, or what follows the draws of numbers and the begin of hooks."""
        if self._own or self._variation is not None:
            self.sim.forward(self.mask.warp, after=self._fused)
        else:
            self.sim.reset(self.mask.warp, before=self._start, after=self._fused)

    def _launch_move(self) -> None:
        self.sim.forward(self._moved.warp, contacts=False)  # which belong to the step

    def _launch_look(self) -> None:
        self.sim.apart(self._fused, self._moved.warp)

    def _launch_refresh(self) -> None:
        self.sim.forward(self.mask.warp, after=[*self._fused, *self._check_finite])

    # The parts of the step, and what they become on the device.

    def _make_parts(self, task: "LocoEnv") -> None:
        sim, hooks, own, variation = self.sim, task.hooks, self._own, self._variation
        self._moved = Buffer(task.num_envs, bool, sim.device)
        self._scans = Scans(sim, hooks.catalog.scans, lambda: hooks.catalog.ground)
        arrays = self._arrays(task)
        self.felt = [arrays[name] for name in FELT if name in arrays]

        parts: dict[Part, set[str]] = {}  # and what attributes of the task each reads
        of_hook: dict[str, Part] = {}
        said: set[str] = set()  # an observation is part of a step and of a reset

        def made(work: Callable[[Arrays], None], title: str, fixed: Any = (), arrays: Any = arrays) -> Part:
            one = Part(work, arrays, f"{self._title}: {title}", fixed, said)
            parts[one] = set()
            return one

        def part(name: str, needed: Collection[str] | None = None) -> Callable[[], None]:
            if not own & set(PARTS[name] if needed is None else needed):
                return _nothing
            called = [hook for hook in PARTS[name] if hook in own] or [name]
            one = made(getattr(hooks, name), ", ".join(called), hooks.catalog.fixed())
            parts[one] = set().union(*(hooks.read.get(hook, ()) for hook in called))
            of_hook.update({hook: one for hook in called if hook in own and hook not in of_hook})
            return one

        self._vary = made(variation.vary, "randomize", variation.fixed()) if variation else _nothing
        self._keep = made(self._guard.keep, "NaN guard", arrays=self._guard.arrays) if self._guard else _nothing
        self._control, self._judge = part("control"), part("judge", own if hooks.commands else None)
        self._adapt = part("adapt")
        self._observe = part("observe", own)  # it looks for what is not finite, too
        self._begin = part("begin", own if self.memory else None)  # it zeroes memory, too
        self._observe_begun = self._observe_restored = part("observe_begun")
        if hooks.history:
            self._observe_restored = part("observe_restored")
        alone = [each for each in parts if each is not self._adapt]  # which sums over worlds
        kernels = [each for each in alone if task.compile_hooks and each.compile(task.num_envs, sim.device)]

        launches = [self._launch_step, self._launch_reset, *(each.launch for each in kernels)]
        launches += [self._launch_rest] if own or variation else []
        launches += [self._launch_conclude] if own else []
        launches += self._everywhere_and_begun(self._scans) if self._scans.arrays else []
        if self.seen:
            launches += [*self._everywhere_and_begun(self.seen), functools.partial(self.seen.eye.draw, [None] * 3)]
        sim.compile(*launches, *([self._launch_move, self._launch_look] if hooks.moves else []))
        for each in kernels:
            each.record(sim)
        self.kinds = {hook: part.kind for hook, part in of_hook.items()}
        for each, names in parts.items():
            if each.kind != "plain torch" or (sim.device.is_cuda and task.compile_hooks):  # the step is a graph then
                self.fixed |= names
        if self._scans.arrays:
            self._scan_first(hooks.catalog.scanning)
        self._physics, self._settle = sim.capture(self._launch_step), sim.capture(self._launch_reset)
        self._rest = sim.capture(self._launch_rest) if own or variation else _nothing
        self._conclude = sim.capture(self._launch_conclude) if own else _nothing
        self._move = self._keeping_what_was() if hooks.moves else _nothing
        self._place = self._place_begun = _nothing
        if self.seen:
            self._place, self._place_begun = map(sim.capture, self._everywhere_and_begun(self.seen))
        self._run_step = self._as_graph("_take_step", several=bool(own or self.seen))
        self._run_reset = self._as_graph("_begin_masked", several=bool(own or self.seen) or variation is not None)

    def _scan_first(self, scanning: Collection[str]) -> None:
        """Lets parts whose hooks read scans or depths make them first; in resets, those of the masked worlds."""
        everywhere, begun = map(self.sim.capture, self._everywhere_and_begun(self._scans))
        for name, hooks in PARTS.items():
            part = getattr(self, f"_{name}")
            if isinstance(part, Part) and not {*scanning}.isdisjoint(hooks):
                part.before = begun if name in ("begin", "observe_begun", "observe_restored") else everywhere

    def _everywhere_and_begun(self, what: Scans | Seen) -> list[Callable[[], None]]:
        """Returns launches of scans, or of what pixels need, in all worlds, and in those in which episodes begin."""
        return [what.launch, functools.partial(what.launch, self.mask.warp)]

    def _arrays(self, task: "LocoEnv") -> dict[str, torch.Tensor]:
        """Returns the arrays that hooks and draws of numbers read and write, by name."""
        sim, catalog, first = self.sim, task.hooks.catalog, task.world_offset or 0
        arrays = {"numbers": sim.numbers} if self._variation is not None else {}
        arrays |= {"qpos": sim.qpos, "seed": self._seed_of_hooks}
        arrays |= {"world": torch.arange(first, first + task.num_envs, device=task.device)}
        arrays |= {"episode": self.episode.torch, "mask": self.mask.torch}
        arrays |= {name: getattr(sim, name) for name in ("qvel", "ctrl", "xpos", "xmat")}
        arrays |= {name: getattr(sim, name) for name in ("cvel", "subtree_com") if name in catalog.arrays}
        if "warp" in catalog.arrays:
            observation, reward, _ = self._kept_alive
            arrays |= {"warp.observation": observation.torch, "warp.reward": reward.torch}
        if "sensordata" in catalog.arrays:
            arrays["sensordata"] = wp.to_torch(sim.data.sensordata)
        if catalog.contact_geoms:
            arrays |= {"contact_force": sim.contact_force, "in_contact": sim.in_contact}
            arrays |= {name: getattr(sim, name) for name in CONTACT_HISTORY if name in catalog.arrays}
        own = ("action", "elapsed_steps", "_moved", "non_finite", "ended", "cut_off", "reward", "terms")
        arrays |= {name.removeprefix("_"): getattr(self, name).torch for name in own}
        arrays |= {"metrics": self.metrics, "overflow": sim.overflow}
        arrays |= {f"shared.{name}": values for name, values in self.shared.items()}
        arrays |= {f"out.{name}": group for name, group in self.groups.items()}
        return {**arrays, **{f"memory.{name}": rows for name, rows in self.memory.items()}, **self._scans.arrays}

    def _keeping_what_was(self) -> Callable[[], None]:
        """Returns what follows a move; what belongs to the step stays: sensors of forces, a fused function's reward."""
        sim, m = self.sim, self.sim.mj_model
        move = sim.capture(self._launch_move)
        look = sim.capture(self._launch_look) if self._fused else _nothing
        rows = [self.reward.torch, self.terms.torch] if self._fused else []
        of_force = np.repeat([kind in FORCE_SENSORS for kind in m.sensor_type], m.sensor_dim)
        sensors = [wp.to_torch(sim.data.sensordata)] if of_force.any() else []
        is_force = torch.as_tensor(of_force, dtype=torch.bool, device=sim.qpos.device)

        def moved() -> None:
            felt, kept = [values.clone() for values in sensors], [values.clone() for values in rows]
            move()
            for values, value in zip(sensors, felt, strict=True):
                values.copy_(torch.where(is_force, value, values))
            look()
            for values, value in zip(rows, kept, strict=True):
                values.copy_(value)

        return moved

    def _as_graph(self, name: str, *, several: bool) -> Callable[[], None]:
        """Returns a method of this world as one CUDA graph, where it is several parts; else as it is."""
        this = weakref.ref(self)

        def work() -> None:
            world = this()
            assert world is not None
            getattr(world, name)()

        if not several or not self.sim.device.is_cuda or not self._records:
            return work
        graph, recorded = TorchGraph(work, self.sim.qpos.device, warmup=1), True

        def run() -> None:
            nonlocal recorded
            if not recorded:
                work()
                return
            try:
                graph()
            except RuntimeError as error:
                recorded = False
                message = str(error).strip().split("\n")[0]
                said = "a step or reset cannot be recorded as one CUDA graph, and takes longer: %s"
                logging.getLogger("torchrl_loco").warning(said, message)
                work()

        return run

    # What the environment calls. Nothing waits for the device but the first refresh, which is recorded then.

    def step(self, action: torch.Tensor, *, adapts: bool = True) -> None:
        """Steps all worlds under actions of shape ``(nworld, nu)``; ``adapts`` tells whether ``adapt`` is called."""
        action = action.detach()  # else the buffer would keep every past policy's autograd graph
        if torch_is_recording(self.sim.device):
            if self._own or self._guard:  # which read the buffer
                self.action.torch.copy_(action)
                self._take_step(adapts=adapts)
            else:
                self._take_step(wp.from_torch(action.float().contiguous()))
            return
        self.action.torch.copy_(action)
        if adapts:
            self._run_step()
        else:  # the recording adapts
            self._take_step(adapts=False)
        self.poll()

    def reset(self, mask: torch.Tensor | None, stagger: bool) -> None:
        """Begins the next episode in the worlds of ``mask`` ``(nworld,)``, in all for ``None``.

        With ``stagger`` each begins with a random number of elapsed steps.
        """
        self._set_mask(mask)
        if stagger:
            self._stagger.torch.fill_(True)
        self.reset_masked()
        if stagger:
            self._stagger.torch.fill_(False)

    def reset_masked(self) -> None:
        """Begins the next episode in the worlds of the mask: after a step, those that are done."""
        if torch_is_recording(self.sim.device):
            self._begin_masked()
        else:
            self._run_reset()

    def poll(self, steps: int = 1) -> None:
        """Tells the monitors that ``steps`` control steps have passed; they may report."""
        for monitor in self._monitors:
            monitor.poll(steps)

    def state(self) -> dict[str | tuple[str, str], torch.Tensor]:
        """Returns the buffers that make up the state of the worlds, by key of :class:`torchrl_loco.State`."""
        sim = self.sim
        held = [name for name in State.PHYSICS if name != "act" or sim.mj_model.na]
        physics: dict[str | tuple[str, str], torch.Tensor] = {name: getattr(sim, name) for name in held}
        physics |= {("memory", name): rows for name, rows in self.memory.items()}
        n = sim.num_envs
        physics |= {("shared", name): values.expand(n, *values.shape) for name, values in self.shared.items()}
        if self._variation is not None:
            columns = self._variation.varied.columns
            physics |= {("model", name): sim.numbers[:, which] for name, which in columns.items()}
        if self.seen and self.seen.stack is not None:
            physics["pictures"] = self.seen.stack
        return {**physics, "elapsed_steps": self.elapsed_steps.torch, "episode": self.episode.torch}

    def refresh(self, mask: torch.Tensor) -> None:
        """Updates everything else after :meth:`state` was written in the worlds of ``mask`` ``(nworld,)``."""
        self._set_mask(mask)
        for flag in (self.non_finite, self.done, self.terminated, self.truncated):
            flag.torch.masked_fill_(mask, False)
        time = self.sim.time
        time.copy_(torch.where(mask, self.elapsed_steps.torch * self._ctrl_dt, time))
        if torch_is_recording(self.sim.device):
            with joined_to_torch(self.sim.device):
                self._launch_refresh()
        else:
            self._refresh_graph.replay()
        self._observe_restored()
        self._place_begun()

    @functools.cached_property
    def _refresh_graph(self) -> Graph:
        """A recording of it: most environments never need one."""
        device = self.sim.device
        with torch.inference_mode(False), EXCLUSIVE, self.sim.qpos.device:
            wp.synchronize_device(device)  # the state was written on torch's stream; Warp's reads it while recording
            self.sim.compile(self._launch_refresh)
            graph = self.sim.capture(self._launch_refresh)
            wp.synchronize_device(device)
        return graph

    def _set_mask(self, mask: torch.Tensor | None) -> None:
        if mask is None:
            self.mask.torch.fill_(True)
        else:
            self.mask.torch.copy_(mask)

    def forget(self) -> None:
        """Lets memory, and what worlds share, be those of a new environment."""
        for rows in (*self.memory.values(), *self.shared.values()):
            rows.zero_()
        for name, start in self._starts.items():
            self.shared[name].copy_(start)

    def set_seed(self, seed: int) -> None:
        """Restarts all random streams at episode 0."""
        self.write_seed(seed)
        self.episode.torch.zero_()

    def write_seed(self, seed: int) -> None:
        """Changes the seed of all random streams, which go on."""
        self.seed.torch.fill_(seed)
        self._seed_of_hooks.fill_(seed)

    def renderer(self, make: Callable[..., Any], m: mujoco.MjModel, *size: Any) -> Any:
        """Returns what ``make`` makes of a model, the device, a camera, sizes and worlds: once for each of these."""
        if (m, *size) not in self._renderers:
            with self.sim.qpos.device:
                self._renderers[m, *size] = make(m, self.sim.device, *size)
        return self._renderers[m, *size]

    # Closing.

    def close(self) -> None:
        """Makes all monitors report, then drops everything on the device."""
        if self._closed or os.getpid() != self._pid:  # in a forked process: the parent reports
            return
        self._closed = True
        # A mode of torch may be active where this world is collected: what it does is not to be traced. If one monitor
        # raises, the others report all the same.
        with torch.utils._python_dispatch._disable_current_modes(), contextlib.ExitStack() as stack:
            stack.callback(self.__dict__.update, {"_closed": True})
            stack.callback(self.__dict__.clear)  # an exception may keep a reference to this world
            for monitor in self._monitors:
                stack.callback(monitor.check)

    def _close_quietly(self) -> None:
        """Closes it where errors can only be warnings: when it is collected, and when the process ends."""
        with contextlib.suppress(Warning):  # warnings may be configured as errors
            try:
                self.close()
            except Exception as error:
                warnings.warn(str(error), RuntimeWarning, stacklevel=2)

    __del__ = _close_quietly


OPEN: weakref.WeakSet[World] = weakref.WeakSet()  # worlds that are closed before torch is torn down


@atexit.register
def _close_all() -> None:
    for world in list(OPEN):
        world._close_quietly()


def _nothing(*args: Any) -> None:
    """What a part of the step is where no hook takes part in it."""
