"""What went wrong in the physics without stopping it, counted on the device: nothing is dropped in silence."""

import math
import warnings
from typing import Any

import torch
import warp as wp
from mujoco_warp import OverflowType
from tensordict import TensorDict

from torchrl_loco.envs.watcher import Watcher
from torchrl_loco.sim import Simulation

KINDS = {
    "constraint_overflow": OverflowType.NEFC | OverflowType.NJMAX_NNZ,
    "contact_overflow": OverflowType.BROADPHASE | OverflowType.NARROWPHASE | OverflowType.CCD,
    "iteration_limit": OverflowType.ITERATIONS,
    "line_search_limit": OverflowType.LS_ITERATIONS,
}
"""Name of a counter and the bits of ``Data.overflow`` that it counts."""
LOSSES = {"constraint_overflow": "njmax", "contact_overflow": "naconmax"}
"""Counters of what was lost for want of room, and the setting that gives room."""
ON_OVERFLOW = ("warn", "raise", "ignore")
MARGIN = 1.25
"""Factor on what was needed at most, in the value that is advised."""


@wp.kernel(enable_backward=False)
def count_health(
    # In:
    kind_bits: wp.array[int],
    bad_in: wp.array[bool],
    # Data out:
    overflow_out: wp.array[int],
    # Out:
    counts_out: wp.array2d[int],
):
    """Adds a control step to the counters of what happened in it, and clears the bits."""
    world = wp.tid()
    bits = overflow_out[world]
    kinds = kind_bits.shape[0]
    for kind in range(kinds):
        if bits & kind_bits[kind] != 0:
            counts_out[world, kind] += 1
    if bad_in[world]:
        counts_out[world, kinds] += 1
    overflow_out[world] = 0


class PhysicsOverflowWarning(UserWarning):
    """Contacts or constraints found no room and were left out of the physics."""


class PhysicsOverflowError(RuntimeError):
    """Contacts or constraints found no room and were left out of the physics."""


class Health(Watcher):
    """Counters of the worlds of a simulation, and what to do when something is lost.

    Args:
        sim: the simulation.
        bad: flags of worlds that are no longer finite, ``(nworld,)``.
        on_overflow: "warn", "raise" or "ignore".

    Raises:
        ValueError: ``on_overflow`` is none of these.
    """

    def __init__(self, sim: Simulation, bad: wp.array, on_overflow: str) -> None:
        if on_overflow not in ON_OVERFLOW:
            raise ValueError(f"unknown on_overflow {on_overflow!r}: choose one of {', '.join(ON_OVERFLOW)}")
        self._sim, self._bad, self.on_overflow = sim, bad, on_overflow
        self._bits = wp.array([int(bits) for bits in KINDS.values()], dtype=int, device=sim.device)
        self._counts = wp.zeros((sim.num_envs, len(KINDS) + 1), dtype=int, device=sim.device)
        self.counts = wp.to_torch(self._counts)
        super().__init__(len(LOSSES) + 2, self.counts.device)
        self._reported = 0

    def launch_after_step(self) -> None:
        """Launches the kernel that counts a control step."""
        wp.launch(
            count_health,
            dim=self._sim.num_envs,
            inputs=[self._bits, self._bad],
            outputs=[self._sim.data.overflow, self._counts],
            device=self._sim.device,
        )

    def look(self) -> torch.Tensor:
        """Returns the steps in which something was lost, by kind, and the most rows and contacts needed, ``(4,)``."""
        losses = self.counts[:, : len(LOSSES)].sum(dim=0)
        peaks = torch.stack([self._sim.peak_rows.max(), self._sim.peak_contacts.max()])
        return torch.cat([losses, peaks])

    def act(self, numbers: list[int]) -> None:
        """Warns, or raises, if something was lost since the last time.

        Raises:
            PhysicsOverflowError: something was, and ``on_overflow`` is "raise".
        """
        *losses, rows, contacts = numbers
        if self.on_overflow == "ignore" or sum(losses) <= self._reported:
            return
        self._reported = sum(losses)
        needed = {"njmax": rows, "naconmax": contacts}
        messages = [
            f"{count} control steps of a world had more {what} than found room: pass {field}={advise(needed[field])} "
            f"(at most {needed[field]} were needed)"
            for count, field, what in zip(losses, LOSSES.values(), ("constraints", "contacts"), strict=True)
            if count
        ]
        message = "; ".join(messages) + "; or on_overflow='ignore'"
        if self.on_overflow == "raise":
            raise PhysicsOverflowError(message)
        warnings.warn(message, PhysicsOverflowWarning, stacklevel=2)

    def restart(self) -> None:
        """Starts all counters anew."""
        super().restart()
        for counter in (self.counts, self._sim.overflow, self._sim.peak_rows, self._sim.peak_contacts):
            counter.zero_()
        self._reported = 0

    def report(self) -> TensorDict:
        """Returns the counters, without waiting for the device; see :meth:`LocoEnv.health`."""
        names = [*KINDS, "non_finite"]
        counts = self.counts.clone()
        worlds: dict[str, Any] = dict(zip(names, counts.unbind(1), strict=True))
        total = dict(zip(names, counts.sum(dim=0).unbind(), strict=True))
        peak = {"constraints": self._sim.peak_rows.max(), "contacts": self._sim.peak_contacts.max()}
        device = self.counts.device
        return TensorDict(
            {
                "worlds": TensorDict(worlds, batch_size=[len(counts)], device=device),
                "total": TensorDict(total, batch_size=[], device=device),
                "peak": TensorDict(peak, batch_size=[], device=device),
            },
            batch_size=[],
            device=device,
        )


def advise(needed: int) -> int:
    """Returns a setting with some room above what was needed."""
    return math.ceil(needed * MARGIN)
