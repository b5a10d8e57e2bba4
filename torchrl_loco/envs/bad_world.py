"""The first world that is no longer finite: caught on the device, kept in a file that can be replayed."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import warp as wp

from torchrl_loco import storage
from torchrl_loco.envs.watcher import Watcher
from torchrl_loco.sim import Simulation

KIND = "bad world"
"""What the file calls itself."""


@wp.kernel(enable_backward=False)
def keep_worlds(
    # In:
    caught_in: wp.array[bool],
    action_in: wp.array2d[float],
    episode_in: wp.array[int],
    elapsed_steps_in: wp.array[int],
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    qacc_warmstart_in: wp.array2d[float],
    # Out:
    action_out: wp.array2d[float],
    episode_out: wp.array[int],
    elapsed_steps_out: wp.array[int],
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    qacc_warmstart_out: wp.array2d[float],
):
    """Copies what a control step begins with, until a world is caught."""
    world = wp.tid()
    if caught_in[0]:
        return
    for i in range(action_in.shape[1]):
        action_out[world, i] = action_in[world, i]
    episode_out[world] = episode_in[world]
    elapsed_steps_out[world] = elapsed_steps_in[world]
    for i in range(qpos_in.shape[1]):
        qpos_out[world, i] = qpos_in[world, i]
    for i in range(qvel_in.shape[1]):
        qvel_out[world, i] = qvel_in[world, i]
        qacc_warmstart_out[world, i] = qacc_warmstart_in[world, i]


@wp.kernel(enable_backward=False)
def find_first(
    # In:
    caught_in: wp.array[bool],
    bad_in: wp.array[bool],
    # Out:
    first_out: wp.array[int],
):
    world = wp.tid()
    if bad_in[world] and not caught_in[0]:
        wp.atomic_min(first_out, 0, world)


@wp.kernel(enable_backward=False)
def close_trap(
    # In:
    first_in: wp.array[int],
    num_envs: int,
    # Out:
    caught_out: wp.array[bool],
):
    caught_out[0] = first_in[0] < num_envs


class NonFiniteWarning(UserWarning):
    """A world was no longer finite; what led to it was written to a file."""


class BadWorldTrap(Watcher):
    """Keeps what each control step began with until a world comes out of one that is not finite.

    Args:
        path: the file that is written then, unless it is there.
        sim: the simulation.
        inputs: actions ``(nworld, nu)``, episodes and elapsed steps ``(nworld,)`` of all worlds.
        bad: flags of worlds that are not finite, ``(nworld,)``.
        describe: returns what else belongs into the file.
    """

    def __init__(
        self,
        path: Path,
        sim: Simulation,
        inputs: tuple[wp.array, wp.array, wp.array],
        bad: wp.array,
        describe: Callable[[], dict[str, Any]],
    ) -> None:
        self.path = path
        self._sim, self._bad, self._describe = sim, bad, describe
        data, device = sim.data, sim.device
        self._inputs = [*inputs, data.qpos, data.qvel, data.qacc_warmstart]
        self._kept = [wp.zeros_like(array) for array in self._inputs]
        self._first = wp.full(1, sim.num_envs, dtype=int, device=device)
        self._caught = wp.zeros(1, dtype=bool, device=device)
        self._first_view = wp.to_torch(self._first)
        super().__init__(1, self._first_view.device)
        self._written = False

    def launch_before_step(self) -> None:
        """Launches the kernel that keeps what a control step begins with."""
        self._launch(keep_worlds, self._sim.num_envs, [self._caught, *self._inputs], self._kept)

    def launch_after_step(self) -> None:
        """Launches the kernels that look for a bad world after a control step."""
        self._launch(find_first, self._sim.num_envs, [self._caught, self._bad], [self._first])
        self._launch(close_trap, 1, [self._first, self._sim.num_envs], [self._caught])

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._sim.device)

    def look(self) -> torch.Tensor:
        """Returns the index of the world that was caught, or the number of worlds if none was, shape ``(1,)``."""
        return self._first_view.long()

    def restart(self) -> None:
        """Opens the trap anew."""
        super().restart()
        self._first_view.fill_(self._sim.num_envs)
        self._caught.zero_()

    def act(self, numbers: list[int]) -> None:
        """Writes the file and warns, once, if a world was caught."""
        (world,) = numbers
        if self._written or world == self._sim.num_envs:
            return
        self._written = True
        names = ("action", "episode", "elapsed_steps", "qpos", "qvel", "qacc_warmstart")
        kept = {name: wp.to_torch(array)[world].clone() for name, array in zip(names, self._kept, strict=True)}
        counters = {name: int(kept.pop(name)) for name in ("episode", "elapsed_steps")}
        try:
            self.path.open("x").close()  # nothing is overwritten
        except FileExistsError:
            told = f"{self.path} is already there and was left as it is"
        else:
            try:
                storage.save(self.path, KIND, kept, {**self._describe(), "world": world, **counters})
            except BaseException:
                self.path.unlink()  # an empty file would keep a later one from being written
                raise
            told = f"what led to it is in {self.path}: see torchrl-loco replay"
        step = counters["elapsed_steps"] + 1
        warnings.warn(
            f"world {world} was no longer finite at step {step} of its episode; {told}", NonFiniteWarning, stacklevel=2
        )
