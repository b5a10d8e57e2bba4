"""Everything of an environment that lives on its device, and the control step from top to bottom."""

import atexit
import contextlib
import os
import warnings
import weakref
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol

import mujoco
import torch
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.body_funcs import check_pair, check_rows
from torchrl_loco.envs.episode import (
    Control,
    EpisodeStart,
    FiniteCheck,
    Flags,
    Outputs,
    StepEnd,
    apply_action,
    begin_episode,
    finish_step,
    observer,
    poser,
    zero_non_finite,
)
from torchrl_loco.envs.monitors import Health, Monitor, NanGuard
from torchrl_loco.rendering import Renderer
from torchrl_loco.sim import (
    EXCLUSIVE,
    Buffer,
    Graph,
    PackedBuffers,
    Simulation,
    WorldFunc,
    fill,
    holds,
    joined_to_torch,
    torch_is_recording,
)


class Task(Protocol):
    """What :class:`World` needs of an environment: its model, its settings and its functions."""

    mj_model: mujoco.MjModel
    config: SimConfig
    num_envs: int
    device: torch.device
    seed: int
    world_offset: int | None
    observation_size: int
    term_names: tuple[str, ...]
    on_overflow: str
    nan_dump: Path | None

    def observation_func(self, world: "World") -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""

    def pose_func(self, world: "World") -> tuple[wp.Function, Any] | None:
        """Returns the function that draws initial states, and its inputs, if there is one."""

    def settings(self) -> dict[str, Any]:
        """Returns what a NaN dump records of the environment."""


class World:
    """The worlds of an environment on their device: simulation, buffers, monitors and graphs.

    It is made when the environment opens and dropped when it closes. Buffers hold one row per world and always show the
    current values.

    Args:
        task: the environment. No reference to it is kept.

    Attributes:
        sim: the physics.
        action: actions of the last control step, ``(nworld, nu)``, unless torch recorded it; ``sim.ctrl`` holds the
            controls that they became.
        outputs: the memory of what a step returns: observation, reward, terms; done, terminated and truncated.
        observation: observations, ``(nworld, observation_size)``.
        reward: rewards, ``(nworld,)``.
        terms: factors of the rewards, ``(nworld, len(term_names))``.
        mask: worlds to reset, ``(nworld,)``.
        stream: start of the random stream of the current episode, ``(nworld,)`` uint32.
        episode: episodes drawn so far, ``(nworld,)``.
        elapsed_steps: control steps since the world's reset, ``(nworld,)``.
        non_finite: whether the world is non-finite, ``(nworld,)``.
        done: terminated or truncated, ``(nworld,)``.
        terminated: whether the episode ended because the world is not finite, ``(nworld,)``.
        truncated: whether the episode reached the time limit, ``(nworld,)``.
        seed: seed of all random streams, ``(1,)``.
        health: counts what went wrong in the physics.
    """

    def __init__(self, task: Task) -> None:
        self._closed = True  # until it is made in full
        n, nu = task.num_envs, task.mj_model.nu
        self._episode_length, self._ctrl_dt = task.config.episode_length, task.config.ctrl_dt
        self._world_offset = task.world_offset or 0
        # Buffers made in inference mode could not be written outside it; without the device, torch's views would be on
        # the caller's default device.
        with torch.inference_mode(False), EXCLUSIVE, task.device:
            self.sim = Simulation(task.mj_model, task.config, n, task.device)
            device = self.sim.device
            self.action = Buffer((n, nu), float, device)
            sizes = [task.observation_size, 1, len(task.term_names)]
            self.outputs = PackedBuffers([n * size for size in sizes], 3 * n, task.device)
            observation, reward, terms, flags = self.outputs.parts(self.outputs.memory)
            self.observation, self.terms = (Buffer.around(part.view(n, -1)) for part in (observation, terms))
            self.reward = Buffer.around(reward)
            self.done, self.terminated, self.truncated = map(Buffer.around, flags.view(3, n))
            self.mask = Buffer(n, bool, device)
            self.stream = Buffer(n, wp.uint32, device)
            self.episode = Buffer(n, int, device)
            self.elapsed_steps = Buffer(n, int, device)
            self.non_finite = Buffer(n, bool, device)
            self.seed = Buffer(1, wp.uint32, device)
            self._stagger = Buffer(1, bool, device)
            self.mask.warp.fill_(True)

            self.health = Health(self.sim, task.on_overflow)
            self._monitors: list[Monitor] = [self.health]
            if task.nan_dump is not None:
                inputs = self.episode, self.elapsed_steps
                guard = NanGuard(task.nan_dump, self.sim, inputs, self.non_finite, self.seed, task.settings())
                self._monitors.append(guard)

            self._make_funcs(task)
            self.sim.compile(self._launch_step, self._launch_reset)
            self._step_graph = self.sim.capture(self._launch_step)
            self._reset_graph = self.sim.capture(self._launch_reset)
            self._refresh_graph: Graph | None = None  # most environments never need it
            wp.synchronize_device(device)  # made on Warp's stream, used on torch's
            self.set_seed(task.seed)  # recording ran resets, which advanced the episodes
            for monitor in self._monitors:
                monitor.restart()
        self._renderers: dict[tuple[str, int, int], Renderer] = {}
        self._pid, self._closed = os.getpid(), False
        _WORLDS.add(self)

    # What each world does besides the physics.

    def _make_funcs(self, task: Task) -> None:
        data = self.sim.data
        buffers = {name: value.warp for name, value in vars(self).items() if isinstance(value, Buffer)}
        mine = SimpleNamespace(**buffers, episode_length=self._episode_length, world_offset=self._world_offset)
        mine.outputs, mine.flags = fill(Outputs, mine), fill(Flags, mine)
        counters = {"counter_bits": self.health.counter_bits, "counts": self.health.counts.warp}
        size, coalesced = task.observation_size, self.sim.engine.coalesced
        func, inputs = check_pair("observation_func", task.observation_func(self))
        if not type(task).__module__.startswith("torchrl_loco."):  # the tests check those of the package
            check_rows(func, inputs, task.num_envs - 1, size, len(task.term_names), self.sim.device)
        self._observe = observer(func, inputs, mine.outputs, mine.non_finite, size, coalesced=coalesced)
        self._check_finite = WorldFunc(zero_non_finite, fill(FiniteCheck, mine, qpos=data.qpos, qvel=data.qvel))
        self._finish = WorldFunc(finish_step, fill(StepEnd, mine, overflow=data.overflow, **counters))
        self._begin = [WorldFunc(begin_episode, fill(EpisodeStart, mine, stagger=self._stagger.warp))]
        self._begins_at_rest = True
        pose = task.pose_func(self)
        if pose is not None:
            func, inputs = check_pair("pose_func", pose)
            self._begin.append(poser(func, inputs, self.stream.warp))
            self._begins_at_rest = not holds(inputs, data.qvel)

    # What the graphs record.

    def _launch_step(self, action: wp.array | None = None) -> None:
        """The control step, under actions ``(nworld, nu)`` or those in the buffer."""
        sim, action = self.sim, self.action.warp if action is None else action
        control = {"ctrlrange": sim.model.actuator_ctrlrange, "ctrl": sim.data.ctrl, "non_finite": self.non_finite.warp}
        apply = WorldFunc(apply_action, fill(Control, action=action, **control))
        sim.step(
            before=[apply],
            after=[self._observe, self._check_finite, self._finish],
            first=[func for monitor in self._monitors for func in monitor.first_of_step(action)],
            last=[func for monitor in self._monitors for func in monitor.last_of_step()],
        )

    def _launch_reset(self) -> None:
        """A new episode in the worlds of the mask."""
        self.sim.reset(self.mask.warp, before=self._begin, after=[self._observe], at_rest=self._begins_at_rest)

    def _launch_refresh(self) -> None:
        """The outputs after the state of the masked worlds was written."""
        self.sim.forward(self.mask.warp, after=[self._observe, self._check_finite])

    # What the environment calls. Nothing waits for the device but the first refresh, which is recorded then.

    def step(self, action: torch.Tensor) -> None:
        """Steps all worlds under actions of shape ``(nworld, nu)``."""
        action = action.detach()  # else the buffer would keep every past policy's autograd graph
        if torch_is_recording(self.sim.device):
            action = action.float().contiguous()
            with joined_to_torch(self.sim.device):
                self._launch_step(wp.from_torch(action))
            return
        self.action.torch.copy_(action)
        self._step_graph.replay()
        self.poll()

    def reset(self, mask: torch.Tensor | None, stagger: bool) -> None:
        """Begins the next episode in the worlds of ``mask`` ``(nworld,)``, in all for ``None``.

        Args:
            mask: the worlds.
            stagger: whether they begin with a random number of elapsed steps.
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
            with joined_to_torch(self.sim.device):
                self._launch_reset()
        else:
            self._reset_graph.replay()

    def poll(self, steps: int = 1) -> None:
        """Tells the monitors that ``steps`` control steps have passed; they may report."""
        for monitor in self._monitors:
            monitor.poll(steps)

    def state(self) -> dict[str, torch.Tensor]:
        """Returns the buffers that make up the state of the worlds, by key of :class:`torchrl_loco.State`."""
        sim = self.sim
        physics = {"qpos": sim.qpos, "qvel": sim.qvel, "qacc_warmstart": sim.qacc_warmstart}
        if sim.mj_model.na:
            physics["act"] = sim.act
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
            return
        if self._refresh_graph is None:
            self._refresh_graph = self._record_refresh()
        self._refresh_graph.replay()

    def _record_refresh(self) -> Graph:
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

    def set_seed(self, seed: int) -> None:
        """Restarts all random streams at episode 0."""
        self.seed.torch.fill_(seed)
        self.episode.torch.zero_()

    def render(self, camera: str, width: int, height: int) -> torch.Tensor:
        """Returns pixels of all worlds, uint8 of shape ``(nworld, height, width, 3)``."""
        key = (camera, width, height)
        if key not in self._renderers:
            with self.sim.qpos.device:
                self._renderers[key] = Renderer(self.sim, *key)
        return self._renderers[key].render()

    # Closing.

    def close(self) -> None:
        """Makes all monitors report, then drops everything on the device."""
        if self._closed or os.getpid() != self._pid:  # in a forked process: the parent reports
            return
        self._closed = True
        with contextlib.ExitStack() as stack:  # if one monitor raises, the others report all the same
            stack.callback(self.__dict__.update, {"_closed": True})
            stack.callback(self.__dict__.clear)  # an exception may keep a reference to this world
            for monitor in self._monitors:
                stack.callback(monitor.check)

    def __del__(self) -> None:
        _close_quietly(self)


def _close_quietly(world: World) -> None:
    """Closes a world in a finalizer, where errors can only be warnings."""
    with contextlib.suppress(Warning):  # warnings may be configured as errors
        try:
            world.close()
        except Exception as error:
            warnings.warn(str(error), RuntimeWarning, stacklevel=2)


_WORLDS: "weakref.WeakSet[World]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Closes all worlds before torch is torn down."""
    for world in list(_WORLDS):
        _close_quietly(world)
