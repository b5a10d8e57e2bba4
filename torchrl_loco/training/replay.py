"""The last batches of an algorithm that learns a model: whole states, of which it draws windows and starts."""

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import torch
from tensordict import TensorDictBase

from torchrl_loco.envs.imagined import STATE
from torchrl_loco.sim.simulation import check_memory
from torchrl_loco.training.config import SVGConfig


class Window(NamedTuple):
    """Consecutive steps; the first dimension is the step, but of ``state``, and the second the sample."""

    state: torch.Tensor
    """Before the first step, ``(n, size)``."""
    ctrl: torch.Tensor
    """Controls, ``(steps, n, nu)``."""
    after: torch.Tensor
    """Positions and velocities that physics made of it, ``(steps, n, nq + nv)``."""
    event: torch.Tensor
    """How events changed the velocities then, ``(steps, n, nv)``."""
    valid: torch.Tensor
    """1 up to the end of an episode or a leap that events made, 0 behind it and where a world was not finite,
    ``(steps, n)``."""


LEAP = 1e-4  # change of a position by events (m, rad) behind which a window does not go on


class Replay:
    """A ring of the last steps of all worlds, on their device; windows go across batches.

    What is drawn lies at addresses that stay, so that what learns from it can be recorded. ``sizes`` are those of a
    state, without what events found, and of an observation.
    """

    def __init__(
        self, config: SVGConfig, m: mujoco.MjModel, sizes: Mapping[str, int], generator: torch.Generator
    ) -> None:
        self._parts, self._sizes, self._generator = [int(m.nq), int(m.nv), int(m.nu)], dict(sizes), generator
        self._size, self._at, self._filled = config.replay * config.num_steps, 0, 0
        self._kept: dict[str, torch.Tensor] = {}
        n, steps, device = config.minibatch_size, config.window, generator.device
        row = sum(sizes.values()) + m.nu + m.nq + 2 * m.nv + 1
        steps_kept = self._size + config.num_steps  # with a batch that is collected ahead
        check_memory(4 * row * steps_kept * config.num_envs, config.num_envs, device)
        rows = (n, sizes["state"]), (steps, n, m.nu), (steps, n, m.nq + m.nv), (steps, n, m.nv), (steps, n)
        self.window = Window(*(torch.zeros(shape, device=device) for shape in rows))
        self.starts = tuple(torch.zeros(n, size, device=device) for size in sizes.values())

    @property
    def has_window(self) -> bool:
        """Whether there are steps for a whole window."""
        return self._filled >= len(self.window.ctrl)

    @torch.no_grad()
    def keep(self, batch: TensorDictBase) -> tuple[torch.Tensor, ...]:
        """Remembers a batch ``(num_envs, num_steps)`` in place of the oldest.

        Returns:
            Positions, velocities, controls, and what came after them, of all its steps; nobody moves where a world was
            not finite.
        """
        nq, nv, nu = self._parts
        before, later = batch[STATE], batch["next", STATE]
        found = later[..., -nq - nv - nu :]
        lost = ~later[..., :nq].any(-1)  # the observation of a world that is not finite is zero
        still = torch.cat([before[..., :nq], torch.zeros_like(before[..., :nv])], dim=-1)
        leaps = (later[..., :nq] - found[..., :nq]).abs().amax(-1) > LEAP
        new = {
            "state": before[..., : self._sizes["state"]],
            "observation": batch["observation"],
            "ctrl": found[..., nq + nv :],
            "after": torch.where(lost.unsqueeze(-1), still, found[..., : nq + nv]),
            "event": later[..., nq : nq + nv] - found[..., nq : nq + nv],
            "end": batch["next", "done"].squeeze(-1) | leaps | lost,
            "lost": lost,
        }
        steps = batch.shape[1]
        for name, rows in new.items():
            by_time = rows.transpose(0, 1)
            if name not in self._kept:
                self._kept[name] = by_time.new_zeros(self._size, *by_time.shape[1:])
            self._kept[name][self._at : self._at + steps].copy_(by_time)
        self._at, self._filled = (self._at + steps) % self._size, min(self._filled + steps, self._size)
        ctrl, after = (new[name].flatten(0, 1) for name in ("ctrl", "after"))
        state = torch.where(lost.unsqueeze(-1), still, before[..., : nq + nv]).flatten(0, 1)
        return state[:, :nq], state[:, nq:], ctrl, after

    def _drawn(self, steps: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns where so many consecutive steps begin: at which times, and of which worlds, ``(n,)``."""
        n, worlds = len(self.window.state), self._kept["end"].shape[1]
        age, world = (
            torch.randint(0, most, (n,), device=self._generator.device, generator=self._generator)
            for most in (self._filled - steps + 1, worlds)
        )
        return (self._at - self._filled + age) % self._size, world

    @torch.no_grad()
    def draw_window(self) -> None:
        """Draws :attr:`window` anew."""
        steps = len(self.window.ctrl)
        first, world = self._drawn(steps)
        self.window.state.copy_(self._kept["state"][first, world])
        times = (first + torch.arange(steps, device=first.device).unsqueeze(1)) % self._size
        for name in ("ctrl", "after", "event"):
            getattr(self.window, name).copy_(self._kept[name][times, world])
        self.window.valid.copy_(~self._kept["lost"][times, world])
        self.window.valid[1:] *= (~self._kept["end"][times[:-1], world]).float().cumprod(0)

    @torch.no_grad()
    def draw_starts(self) -> None:
        """Draws :attr:`starts` anew, states and observations."""
        at = self._drawn(1)
        for target, name in zip(self.starts, self._sizes, strict=True):
            target.copy_(self._kept[name][at])
