"""What advances the worlds of a simulation: the contract of the three engines."""

import abc
import dataclasses
from typing import Any

import mujoco
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.sim.buffer import Buffer
from torchrl_loco.sim.varied import Varied
from torchrl_loco.sim.world_func import ALONE, Around, WorldKernels


@dataclasses.dataclass(frozen=True)
class Setup:
    """What an engine is made of: what a ``Simulation`` is given, its model with the options of ``config``.

    Attributes:
        contact_rows: of how many substeps contact forces are kept: of the last, or of all.
    """

    mj_model: mujoco.MjModel
    config: SimConfig
    num_envs: int
    device: wp.Device
    contact_geoms: tuple[int, ...] = ()
    varied: Varied | None = None
    contact_rows: int = 1


class Engine(abc.ABC):
    """Steps all worlds of a model.

    Attributes:
        model: the model on the device, with nominal numbers, to be read only.
        data: the state of all worlds, and what follows from it.
        numbers: the numbers that differ, ``(nworld, varied.count)``; none without ``varied``.
        contact_arrays: net contact forces vec3 and whether there is a contact, ``(nworld, contact_rows * geoms)`` each.
        peak_constraints: most constraint rows that a substep needed since the last reset, by world, ``(nworld,)``; zero
            where no row needs room.
        peak_contacts: most contacts that a substep needed, ``(1,)``: of all worlds together under MuJoCo-Warp, where
            they share a pool, else of any one; zero likewise.
        coalesced: whether functions of a world have kernels of their own, in which the threads of a warp take
            neighbouring worlds whose numbers are neighbours in memory.
    """

    model: Any
    data: Any
    numbers: wp.array
    contact_arrays: tuple[wp.array, wp.array]
    coalesced = False

    def __init__(self, setup: Setup) -> None:
        self._substeps, self._device = setup.config.substeps, setup.device
        self._all = wp.ones(setup.num_envs, dtype=bool, device=setup.device)
        self._kernels = WorldKernels()
        self.peak_constraints = Buffer(setup.num_envs, int, setup.device)
        self.peak_contacts = Buffer(1, int, setup.device)

    @staticmethod
    @abc.abstractmethod
    def memory(setup: Setup) -> int:
        """Returns the memory that the engine takes (bytes), without allocating it."""

    @abc.abstractmethod
    def remedy(self, dropped: str, most: int) -> str:
        """Returns advice for the warning about dropped constraints or contacts, of which a substep needed ``most``."""

    @abc.abstractmethod
    def step(self, around: Around = ALONE) -> None:
        """Advances every world by one control step under ``ctrl``, with what it does around the physics.

        Poses and sensors belong to the new state; forces, contacts and the sensors of forces to the last substep.
        """

    @abc.abstractmethod
    def forward(self, mask: wp.array, around: Around, *, contacts: bool = True) -> None:
        """Updates poses and sensors where ``mask`` ``(nworld,)`` is set, those of forces without control.

        Numbers of the model that were changed there count from now on. Without ``contacts`` the forces of the geoms
        that were asked for stay as they are.
        """
