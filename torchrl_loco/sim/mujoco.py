"""C MuJoCo in float64 as an engine: the oracle. A thread for each core steps worlds one by one."""

import concurrent.futures
import copy
import os
import threading
from collections.abc import Callable, Collection, Mapping
from typing import Any

import mujoco
import numpy as np
import warp as wp
from typing_extensions import override

from torchrl_loco.sim import mjw
from torchrl_loco.sim.batched_model import nominal_numbers
from torchrl_loco.sim.compiled.engine import Model
from torchrl_loco.sim.engine import Engine, Setup
from torchrl_loco.sim.overflow import Overflow
from torchrl_loco.sim.world_func import ALONE, Around

STATE = ("qpos", "qvel", "act", "qacc_warmstart", "time", "mocap_pos", "mocap_quat")
"""What hooks, states and resets may change between two steps; all else follows from it."""

LOST = [int(getattr(mujoco.mjtWarning, f"mjWARN_{name}")) for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")]
"""MuJoCo's warnings after which a world is not finite: MuJoCo has reset it, or left out what it was told."""

FULL = {
    int(mujoco.mjtWarning.mjWARN_CONTACTFULL): Overflow.NARROWPHASE,
    int(mujoco.mjtWarning.mjWARN_CNSTRFULL): Overflow.NEFC,
}
"""MuJoCo's warnings that something was dropped, and how that is flagged."""


class Data:
    """The state of all worlds in float32, as the other engines have it, and what follows from it.

    Arrays are those of MuJoCo-Warp's ``mjData``. Those that were read as attributes once are kept up to date.
    """

    def __init__(self, m: mujoco.MjModel, num_envs: int) -> None:
        self._arrays: dict[str, wp.array] = {}
        with wp.ScopedDevice("cpu"):
            self._all = mjw.make_data(m, nworld=num_envs, naconmax=1, njmax=1)

    def __getattr__(self, name: str) -> wp.array:
        """Returns an array, which follows from then on, if both MuJoCo-Warp and C MuJoCo have it."""
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._arrays:
            array = getattr(self._all, name)
            if not isinstance(array, wp.array) or (
                name not in ("overflow", "ctrl") and not hasattr(mujoco.MjData, name)
            ):
                raise AttributeError(f"the engine 'mujoco' has no data.{name}")
            self._arrays[name] = array
        return self._arrays[name]

    def shown(self) -> dict[str, np.ndarray]:
        """Returns what was asked for of what follows from a step, by name: views ``(num_envs, ...)``."""
        kept = (*STATE, "overflow", "ctrl")
        return {name: array.numpy() for name, array in self._arrays.items() if name not in kept}


class World:
    """A world of C MuJoCo: its ``mjData``, and NumPy's views of what is copied to and from it at every step."""

    def __init__(self, m: mujoco.MjModel, state: Collection[str]) -> None:
        self.model, self.data = m, mujoco.MjData(m)
        self._views: dict[str, np.ndarray] = {}
        self.state = {name: self.view(name) for name in state if name != "time"}
        self.ctrl, self.warned, self.iterations = self.data.ctrl, self.data.warning.number, self.data.solver_niter

    def view(self, name: str) -> np.ndarray:
        """Returns an array of the ``mjData``, which shows its present numbers."""
        if name not in self._views:
            self._views[name] = getattr(self.data, name)
        return self._views[name]


class MujocoEngine(Engine):
    """Steps all worlds with C MuJoCo, each in an ``mjData`` of its own.

    Time step, integrator and contacts are those of ``config``, all else the options of the model; the solver has at
    least MuJoCo's default limits, which many models lower for speed.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._nominal = m = setup.mj_model
        self._varied, self._rows = setup.varied, setup.contact_rows
        num_envs, device, contact_geoms = setup.num_envs, setup.device, setup.contact_geoms
        self.model, self.data = Model(m, device), Data(m, num_envs)
        self._passive = _without_actuation(m)
        home: Any = mujoco.MjData(m)
        names = [name for name in STATE if np.size(getattr(home, name))]
        self._worlds = [World(m, names) for _ in range(num_envs)]
        self.numbers = nominal_numbers(self._varied, num_envs, device)
        self._state = {name: getattr(self.data, name).numpy() for name in names}
        for name, rows in self._state.items():
            rows[:] = np.reshape(getattr(home, name), rows.shape[1:])
        self._written = {name: rows.copy() for name, rows in self._state.items()}
        self._ctrl, self._overflow = self.data.ctrl.numpy(), self.data.overflow.numpy()
        self._geoms, self._column = len(contact_geoms), np.full(m.ngeom + 1, -1)  # a part of a flex is geom -1
        self._column[list(contact_geoms)] = np.arange(self._geoms)
        shape = num_envs, self._rows * len(contact_geoms)
        self.contact_arrays = wp.zeros(shape, wp.vec3, device=device), wp.zeros(shape, bool, device=device)
        self._forces, self._touches = (array.numpy() for array in self.contact_arrays)
        self._most = self.peak_constraints.torch.numpy(), self.peak_contacts.torch.numpy()
        self._of_all = threading.Lock()  # of what the threads of all worlds write
        self._threads = concurrent.futures.ThreadPoolExecutor(os.cpu_count(), "mujoco")

    @property
    def worlds(self) -> list[mujoco.MjData]:
        """The ``mjData`` of each world."""
        return [world.data for world in self._worlds]

    @override
    @staticmethod
    def memory(setup: Setup) -> int:
        data: Any = mujoco.MjData(setup.mj_model)
        return setup.num_envs * (2 * int(data.nbuffer) + 65_536)  # about: an mjData uses a small part of its arena

    @override
    def remedy(self, dropped: str, most: int) -> str:
        return f'C MuJoCo had no memory for more {dropped} than {most}: raise <size memory="..."/> in the model'

    @override
    def step(self, around: Around = ALONE) -> None:
        self._kernels.launch(around.before, self._all)
        shown, substeps, rows = self.data.shown(), self._substeps, self._rows
        changed = {
            name: (rows != self._written[name]).reshape(len(rows), -1).any(1) for name, rows in self._state.items()
        }  # worlds, by what of their state
        anything = np.any(list(changed.values()), axis=0)

        def advance(i: int) -> None:
            world = self._worlds[i]
            d, m, iterations, most = world.data, world.model, world.iterations, world.model.opt.iterations
            if anything[i]:
                self._load(i, [name for name, worlds in changed.items() if worlds[i]])
            world.warned[:] = 0
            world.ctrl[:] = self._ctrl[i]
            limited = False
            for k in range(substeps):
                mujoco.mj_step(m, d)
                limited |= iterations[0] >= most or (d.nisland > 1 and iterations[: d.nisland].max() >= most)
                if self._geoms and k >= substeps - rows:
                    self._add_up_forces(i, k - substeps + rows)
            self._flag(i, limited=limited)
            mujoco.mj_step1(m, d)
            self._write(i, shown)

        self._each(np.arange(len(self._worlds)), advance)
        self._keep_written(np.arange(len(self._worlds)))
        self._kernels.launch(around.after, self._all)

    @override
    def forward(self, mask: wp.array, around: Around, *, contacts: bool = True) -> None:
        self._kernels.launch(around.before, mask)
        shown = self.data.shown()

        def evaluate(i: int) -> None:
            world = self._worlds[i]
            if self._varied is not None:
                world.model = self._varied.edited(self.numbers.numpy()[i], self._nominal)
            d, m = world.data, world.model
            mujoco.mj_resetData(m, d)
            self._load(i, self._state)
            mujoco.mj_forward(self._passive if self._varied is None else _without_actuation(m), d)
            if m.nv:
                d.qacc_warmstart[:] = self._state["qacc_warmstart"][i]
            if contacts and self._geoms:
                for row in range(self._rows):
                    self._add_up_forces(i, row)
            self._write(i, shown)

        worlds = np.flatnonzero(mask.numpy())
        self._each(worlds, evaluate)
        self._keep_written(worlds)
        self._kernels.launch(around.after, mask)

    def _each(self, worlds: np.ndarray, work: Callable[[int], None]) -> None:
        """Does something in worlds, a share of them in each thread; MuJoCo computes without Python's lock."""

        def work_through(share: np.ndarray) -> None:
            for world in share.tolist():
                work(world)

        threads = min(len(worlds), os.cpu_count() or 1)
        if threads < 2:
            work_through(worlds)
        else:
            list(self._threads.map(work_through, np.array_split(worlds, threads)))  # which waits, and raises errors

    def _load(self, i: int, names: Collection[str]) -> None:
        """Writes parts of a world's state into its ``mjData``."""
        world = self._worlds[i]
        for name in names:
            if name == "time":
                world.data.time = float(self._state[name][i])
            else:
                view = world.state[name]
                view[:] = self._state[name][i].reshape(view.shape)

    def _write(self, i: int, shown: Mapping[str, np.ndarray]) -> None:
        """Writes a world into the arrays; one that MuJoCo has lost has no numbers."""
        world = self._worlds[i]
        for name, view in world.state.items():
            rows = self._state[name]
            rows[i] = view.reshape(rows.shape[1:])
        self._state["time"][i] = world.data.time
        if world.warned[LOST].any():
            self._state["qpos"][i] = np.nan
        for name, rows in shown.items():
            rows[i] = world.view(name).reshape(rows.shape[1:])

    def _keep_written(self, worlds: np.ndarray) -> None:
        """Notes the state of worlds that was written, to see later what was changed."""
        for name, rows in self._state.items():
            self._written[name][worlds] = rows[worlds]

    def _flag(self, i: int, *, limited: bool) -> None:
        """Flags what the substeps of a world have dropped or not finished."""
        world = self._worlds[i]
        bits = int(Overflow.ITERATIONS) if limited else 0
        bits |= sum(int(flag) for kind, flag in FULL.items() if world.warned[kind])
        self._overflow[i] |= bits
        constraints, contacts = self._most
        constraints[i] = max(constraints[i], world.data.maxuse_efc)
        with self._of_all:
            contacts[0] = max(contacts[0], world.data.maxuse_con)

    def _add_up_forces(self, i: int, row: int) -> None:
        """Adds up the forces of a world's contacts on each geom that was asked for, in the world's frame (N)."""
        d, m, count = self._worlds[i].data, self._worlds[i].model, self._geoms
        columns = slice(row * count, (row + 1) * count)
        forces, touches = np.zeros((count, 3)), np.zeros(count, dtype=bool)
        contacts = d.contact
        pairs = self._column[contacts.geom]
        chosen = np.flatnonzero((contacts.efc_address >= 0) & (pairs >= 0).any(-1))
        if len(chosen):
            force, pairs = _contact_forces(m, d, chosen), pairs[chosen]
            for side, sign in ((0, -1.0), (1, 1.0)):
                asked = pairs[:, side] >= 0
                np.add.at(forces, pairs[asked, side], sign * force[asked])
                touches[pairs[asked, side]] = True
        self._forces[i, columns] = forces
        self._touches[i, columns] = touches


def _contact_forces(m: mujoco.MjModel, d: mujoco.MjData, chosen: np.ndarray) -> np.ndarray:
    """Returns the forces of contacts on their second geom in the world's frame (N), ``(contacts, 3)``.

    They are those of ``mj_contactForce``, of all contacts at once.
    """
    contacts = d.contact
    first, dims = contacts.efc_address[chosen, None], contacts.dim[chosen, None]
    pyramids = m.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    counts, row = np.where(pyramids & (dims > 1), 2 * (dims - 1), dims), np.arange(10)
    rows = np.where(row < counts, d.efc_force[np.minimum(first + row, d.nefc - 1)], 0.0)
    parts = rows[:, :3]  # normal and two tangents
    if pyramids:
        slopes = contacts.friction[chosen, :2] * (rows[:, [0, 2]] - rows[:, [1, 3]])
        parts = np.concatenate([rows.sum(1, keepdims=True), np.where(dims > 1, slopes, 0.0)], axis=1)
    return (parts[:, None] @ contacts.frame[chosen].reshape(-1, 3, 3))[:, 0]


def _without_actuation(m: mujoco.MjModel) -> mujoco.MjModel:
    passive = copy.copy(m)
    passive.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return passive
