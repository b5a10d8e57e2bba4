"""Everything of an environment that lives on its device, and the control step from top to bottom."""

import atexit
import contextlib
import os
import warnings
import weakref
from pathlib import Path
from typing import Any, Protocol

import mujoco
import torch
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.kernels import any_world, apply_action, begin_episode, finish_step, zero_non_finite
from torchrl_loco.envs.monitors import Health, Monitor, NanGuard
from torchrl_loco.rendering import Renderer
from torchrl_loco.sim import (
    BLOCK_DIM,
    EXCLUSIVE,
    Buffer,
    Graph,
    PackedBuffers,
    Simulation,
    joined_to_torch,
    torch_is_recording,
)


class Task(Protocol):
    """What :class:`World` needs of an environment: its model, its settings and its kernels."""

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

    def observation_kernel(self, world: "World") -> tuple[wp.Kernel, list]:
        """Returns the kernel that writes observation and reward, and its inputs."""

    def pose_kernel(self, world: "World") -> tuple[wp.Kernel, list, list] | None:
        """Returns the kernel that draws initial states, its inputs and its outputs, if there is one."""

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
        action: actions of the control step, ``(nworld, nu)``.
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
            self._any = Buffer(1, int, device)
            self._all = wp.ones(n, dtype=bool, device=device)
            self.mask.warp.fill_(True)

            self.health = Health(self.sim, task.on_overflow)
            self._monitors: list[Monitor] = [self.health]
            if task.nan_dump is not None:
                inputs = self.action, self.episode, self.elapsed_steps
                guard = NanGuard(task.nan_dump, self.sim, inputs, self.non_finite, self.seed, task.settings())
                self._monitors.append(guard)

            self._observation_kernel = task.observation_kernel(self)
            self._pose_kernel = task.pose_kernel(self)
            outputs = [] if self._pose_kernel is None else self._pose_kernel[2]
            self._begins_in_motion = any(array is self.sim.data.qvel for array in outputs)
            self.sim.compile(self._launch_step, self._launch_reset, self._launch_refresh)
            self._step_graph = self.sim.capture(self._launch_step)
            self._reset_graph = self.sim.capture(self._launch_reset)
            self._reset_done_graph = self.sim.capture(self._launch_reset_done)
            self._refresh_graph = self.sim.capture(self._launch_refresh)
            wp.synchronize_device(device)  # made on Warp's stream, used on torch's
            self.set_seed(task.seed)  # recording ran resets, which advanced the episodes
            for monitor in self._monitors:
                monitor.restart()
        self._renderers: dict[tuple[str, int, int], Renderer] = {}
        self._pid, self._closed = os.getpid(), False
        _WORLDS.add(self)

    # What the graphs record.

    def _launch_step(self, action: wp.array | None = None) -> None:
        """The control step, under actions ``(nworld, nu)`` or those in the buffer."""
        action = self.action.warp if action is None else action
        outputs = [self.action.warp, self.sim.data.ctrl, self.non_finite.warp, self._any.warp]
        self._launch(apply_action, [self.sim.model.actuator_ctrlrange, action], outputs)
        for monitor in self._monitors:
            monitor.launch_before_step()
        self.sim.step()
        self._launch_observation(self._all)
        data, health = self.sim.data, self.health
        self._launch(
            finish_step,
            [self._episode_length, health.counter_bits, data.qpos, data.qvel],
            [
                *(data.overflow, self.non_finite.warp),
                *(self.observation.warp, self.reward.warp, self.terms.warp),
                *(self.elapsed_steps.warp, self.done.warp, self.terminated.warp, self.truncated.warp),
                *(self.mask.warp, self._any.warp, health.counts.warp),
            ],
        )
        for monitor in self._monitors:
            monitor.launch_after_step()

    def _launch_reset(self) -> None:
        """A new episode in the worlds of the mask. It costs almost nothing if the mask is empty."""
        self._any.warp.zero_()
        self._launch(any_world, [self.mask.warp], [self._any.warp])
        self._launch_reset_done()

    def _launch_reset_done(self) -> None:
        """The same after a step, which has set the mask."""
        wp.capture_if(self._any.warp, self._launch_masked_reset)

    def _launch_masked_reset(self) -> None:
        mask = self.mask.warp
        flags = [self.non_finite.warp, self.done.warp, self.terminated.warp, self.truncated.warp]
        inputs = [mask, self._stagger.warp, self.seed.warp, self._world_offset, self._episode_length]
        self._launch(
            begin_episode,
            [self.sim.model.qpos0, *inputs],
            [self.episode.warp, self.stream.warp, self.elapsed_steps.warp, *flags, *self.sim.rest_state()],
        )
        self.sim.engine.reset(mask)
        if self._pose_kernel is not None:
            kernel, inputs, outputs = self._pose_kernel
            self._launch(kernel, [*inputs, mask, self.stream.warp], outputs)
        self.sim.forward(mask) if self._begins_in_motion else self.sim.forward_at_rest(mask)
        self._launch_observation(mask)

    def _launch_refresh(self) -> None:
        """Computes the outputs after the state of the masked worlds was written."""
        mask, data = self.mask.warp, self.sim.data
        self.sim.forward(mask)
        self._launch_observation(mask)
        outputs = [self.observation.warp, self.reward.warp, self.terms.warp]
        self._launch(zero_non_finite, [mask, data.qpos, data.qvel], [self.non_finite.warp, *outputs])

    def _launch_observation(self, mask: wp.array) -> None:
        kernel, inputs = self._observation_kernel
        self._launch(kernel, [*inputs, mask], [self.observation.warp, self.reward.warp, self.terms.warp])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        n, device = self.sim.num_envs, self.sim.device
        wp.launch(kernel, dim=n, inputs=inputs, outputs=outputs, device=device, block_dim=BLOCK_DIM)

    # What the environment calls. Nothing waits for the device.

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
        self._replay_reset(self._reset_graph)
        if stagger:
            self._stagger.torch.fill_(False)

    def reset_done(self) -> None:
        """Begins the next episode in the worlds that are done, right after a step."""
        self._replay_reset(self._reset_done_graph)

    def _replay_reset(self, graph: Graph) -> None:
        """Replays the graph of a reset; into a graph that torch records the reset goes without its condition."""
        if torch_is_recording(self.sim.device):
            with joined_to_torch(self.sim.device):
                self._launch_masked_reset()
        else:
            graph.replay()

    def poll(self, steps: int = 1) -> None:
        """Lets the monitors report after so many control steps."""
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
        self._refresh_graph.replay()

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
