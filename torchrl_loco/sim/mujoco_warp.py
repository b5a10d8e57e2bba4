"""The engine that calls MuJoCo-Warp: its tuning, the order of a control step, and what it needs in memory."""

import contextlib
import copy
import dataclasses
import logging
import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import warp as wp
from typing_extensions import override

from torchrl_loco.sim import mjw
from torchrl_loco.sim.batched_model import BatchedModel, batched_bytes, nominal_numbers, with_every_row
from torchrl_loco.sim.contact_forces import ContactForces
from torchrl_loco.sim.engine import Engine, Setup
from torchrl_loco.sim.graph import torch_is_recording
from torchrl_loco.sim.models import FORCE_SENSORS
from torchrl_loco.sim.row_order import RowOrder
from torchrl_loco.sim.world_func import ALONE, Around

SCRATCH, DETERMINISTIC_SCRATCH = 1.4, 11.0
"""Memory of a simulation as a multiple of its ``mjData``; the rest is scratch memory (measured: 1.3 to 1.4). The second
is that with ``deterministic=True`` on CUDA (measured: 6 to 8 times the memory of a world)."""

UNROLLED_ITERATIONS = 10
"""Up to this many solver iterations, the recorded step contains all of them, without an early exit."""

LANES = wp.constant(32)  # threads that share the constraint rows of a world


@wp.kernel(enable_backward=False)
def clear_constraints(
    mask_in: wp.array[bool],
    efc_J_out: wp.array3d[float],  # noqa: N803
    efc_D_out: wp.array2d[float],  # noqa: N803
):
    """Zeroes the constraint rows: the solver multiplies unused ones by zero, which would keep a NaN forever."""
    world, lane = wp.tid()
    if not mask_in[world]:
        return
    for row in range(lane, efc_J_out.shape[1], LANES):
        for i in range(efc_J_out.shape[2]):
            efc_J_out[world, row, i] = 0.0
        if row < efc_D_out.shape[1]:
            efc_D_out[world, row] = 0.0


@wp.kernel(enable_backward=False)
def any_world(mask_in: wp.array[bool], any_out: wp.array[int]):
    if mask_in[wp.tid()]:
        any_out[0] = 1


@wp.kernel(enable_backward=False)
def restore_others(
    mask_in: wp.array[bool],
    sensordata_in: wp.array2d[float],
    overflow_in: wp.array[int],
    sensordata_out: wp.array2d[float],
    overflow_out: wp.array[int],
):
    """Restores the sensors of the worlds where the mask is not set, and the overflow of all."""
    world = wp.tid()
    overflow_out[world] = overflow_in[world]
    if mask_in[world]:
        return
    for i in range(sensordata_out.shape[1]):
        sensordata_out[world, i] = sensordata_in[world, i]


@wp.kernel(enable_backward=False)
def record_peaks(
    nefc_in: wp.array[int],
    nacon_in: wp.array[int],
    ncollision_in: wp.array[int],
    constraints_out: wp.array[int],
    contacts_out: wp.array[int],
):
    """Records the largest numbers of constraint rows and contacts that were needed, dropped ones included."""
    world = wp.tid()
    constraints_out[world] = wp.max(constraints_out[world], nefc_in[world])
    if world == 0:
        contacts_out[0] = wp.max(contacts_out[0], wp.max(nacon_in[0], ncollision_in[0]))


ROOM = {"constraints": "njmax", "contacts": "naconmax"}  # the settings that make room for constraint rows and contacts
MARGIN = 1.25  # advised setting divided by the largest need


def with_margin(needed: int) -> int:
    """Returns a setting with some room above what was needed."""
    return math.ceil(needed * MARGIN)


class MujocoWarpEngine(Engine):
    """Steps all worlds with MuJoCo-Warp.

    Attributes:
        contact_forces: what is computed of them, if any were asked for.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        mj_model, config, varied, device = setup.mj_model, setup.config, setup.varied, setup.device
        self._num_envs = num_envs = setup.num_envs
        if mujoco.mjtGeom.mjGEOM_HFIELD in mj_model.geom_type:
            logging.getLogger("torchrl_loco").warning(
                "MuJoCo-Warp has at most 4 contacts of a geom with a height field, where MuJoCo has one for each prism "
                "that it touches: what lies on uneven ground moves otherwise"
            )
        if wrong := stepped_wrongly(mj_model):
            raise ValueError(f"MuJoCo-Warp steps {', '.join(wrong)} wrongly: pass engine='mujoco'")
        with wp.ScopedDevice(device):
            slippery = copy.copy(mj_model)  # as C MuJoCo has it: without any friction it divides by 0
            for friction in (slippery.geom_friction, slippery.pair_friction):
                np.maximum(friction, mujoco.mjMINMU, out=friction)
            try:
                self.model = mjw.put_model(slippery)
            except NotImplementedError as error:
                is_pgs = mj_model.opt.solver == mujoco.mjtSolver.mjSOL_PGS
                instead = 'Write <option solver="Newton"/>, or leave solver out' if is_pgs else "pass engine='mujoco'"
                raise ValueError(f"MuJoCo-Warp cannot step this model: {error}. {instead}") from error
            self.data = mjw.make_data(
                with_every_row(mj_model, varied), nworld=num_envs, naconmax=config.naconmax, njmax=config.njmax
            )
        self.numbers = nominal_numbers(varied, num_envs, device)
        self._batched = None if varied is None else BatchedModel(self.model, varied, self.numbers)
        option = self.model.opt
        # Printing from kernels costs more than the physics; ``data.overflow`` holds the same information.
        option.warn_overflow = 0
        # A few iterations in a row are cheaper than a loop that may stop early.
        option.graph_conditional = config.iterations > UNROLLED_ITERATIONS
        # The solver starts from the warm start; comparing it with a second start costs a factorization.
        option.run_qacc_smooth = False
        # Threads per small matrix of a world: measured in benchmarks/README.md.
        self.model.block_dim.update_gradient_cholesky = 32
        self.model.block_dim.update_gradient_JTDAJ_dense = 64
        self.contact_forces: ContactForces | None = None
        if setup.contact_geoms:
            self.contact_forces = forces = ContactForces(mj_model, setup.contact_geoms, self.data, setup.contact_rows)
            self.contact_arrays = forces.force, forces.in_contact
        self._has_force_sensors = not FORCE_SENSORS.isdisjoint(mj_model.sensor_type)
        self._kept_sensors: tuple[wp.array, wp.array] | None = None
        if self._has_force_sensors or self.contact_forces is not None:
            self._kept_sensors = wp.clone(self.data.sensordata), wp.clone(self.data.overflow)
        self._row_order = RowOrder(self.model, self.data) if config.deterministic else None
        self._any = wp.zeros(1, dtype=int, device=device)

    @override
    @staticmethod
    def memory(setup: Setup) -> int:
        deterministic = setup.config.deterministic and setup.device.is_cuda
        return int((DETERMINISTIC_SCRATCH if deterministic else SCRATCH) * data_bytes(setup))

    @override
    def remedy(self, dropped: str, most: int) -> str:
        return f"a physics step needed up to {most}: pass {ROOM[dropped]}={with_margin(most)}"

    @override
    def step(self, around: Around = ALONE) -> None:
        # dm_control updates poses, velocities and sensors by the first half of the next step. Here only what an
        # observation can read is computed, so a reset has nothing else to update.
        d = self.data
        self._kernels.launch(around.before, self._all)
        for i in range(self._substeps):
            with self._substep_only(sensors=self._has_force_sensors and i == self._substeps - 1):
                self._substep()
                needed, peaks = [d.nefc, d.nacon, d.ncollision], [self.peak_constraints.warp, self.peak_contacts.warp]
                self._launch(record_peaks, needed, peaks)
            if self.contact_forces is not None and i >= self._substeps - self.contact_forces.rows:
                row = i - self._substeps + self.contact_forces.rows
                self.contact_forces.update(self.model, self.data, self._all, row)
        self._evaluate()
        self._kernels.launch(around.after, self._all)

    def _substep(self) -> None:
        if self._row_order is None:
            mjw.step(self.model, self.data)
            return
        mjw.step1(self.model, self.data)
        self._row_order.apply()
        # Only the solver sums in an order that varies; deterministic atomics elsewhere would be a waste.
        self.model.opt.deterministic = mjw.DeterminismType.ATOMICS
        mjw.step2(self.model, self.data)
        self.model.opt.deterministic = mjw.DeterminismType.NONE

    def _launch(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any], lanes: int = 1) -> None:
        """Launches a kernel of a thread, or of several lanes, for each world."""
        dim = self._num_envs if lanes == 1 else (self._num_envs, lanes)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self._device)

    @contextlib.contextmanager
    def _substep_only(self, *, sensors: bool) -> Iterator[None]:
        """Skips cameras and lights in a substep, and sensors unless asked for: most are evaluated after it."""
        model = self.model
        kept = model.opt.disableflags, model.ncam, model.nlight
        model.ncam = model.nlight = 0
        if not sensors:
            model.opt.disableflags |= mjw.DisableBit.SENSOR
        try:
            yield
        finally:
            model.opt.disableflags, model.ncam, model.nlight = kept

    @override
    def forward(self, mask: wp.array, around: Around, *, contacts: bool = True) -> None:
        data = self.data
        forces = self._kept_sensors if contacts or self._has_force_sensors else None

        def evaluate() -> None:
            self._kernels.launch(around.before, mask)
            if self._batched is not None:
                self._batched.update(mask)
            self._launch(clear_constraints, [mask], [data.efc.J, data.efc.D], LANES)
            if forces is not None:
                self._evaluate_forces(mask, *forces, contacts=contacts)
            else:
                self._evaluate()
            self._kernels.launch(around.after, mask)

        if torch_is_recording(self._device):
            evaluate()
            return
        self._any.zero_()
        self._launch(any_world, [mask], [self._any])
        wp.capture_if(self._any, evaluate)

    def _evaluate(self) -> None:
        """Evaluates what an observation can read: poses and velocities of bodies, and velocity sensors."""
        mjw.kinematics(self.model, self.data)
        mjw.com_pos(self.model, self.data)
        mjw.com_vel(self.model, self.data)
        mjw.sensor_vel(self.model, self.data)

    def _evaluate_forces(self, mask: wp.array, sensordata: wp.array, overflow: wp.array, *, contacts: bool) -> None:
        """Evaluates all sensors, those of forces without control, where ``mask`` ``(nworld,)`` is set.

        That takes the first half of a physics step of all worlds. ``sensordata`` and ``overflow`` are room for what the
        other worlds, and all worlds, have of them.
        """
        model, data = self.model, self.data
        wp.copy(sensordata, data.sensordata)
        wp.copy(overflow, data.overflow)
        flags = model.opt.disableflags
        model.opt.disableflags |= mjw.DisableBit.ACTUATION
        mjw.forward(model, data)
        model.opt.disableflags = flags
        if contacts and self.contact_forces is not None:
            self.contact_forces.update(model, data, mask)
        self._launch(restore_others, [mask, sensordata, overflow], [data.sensordata, data.overflow])


def stepped_wrongly(m: mujoco.MjModel) -> list[str]:
    """Returns what a model has that MuJoCo-Warp takes, but steps otherwise than MuJoCo from reset to reset."""
    exact = (m.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_FILTEREXACT)).any()
    found = {
        "bodies that sleep (<flag sleep>)": m.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP),
        "sensors with a delay or an interval": m.sensor_delay.any() or m.sensor_interval.any(),
        "filterexact activations by RK4": exact and m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_RK4),
    }
    return [what for what, is_there in found.items() if is_there]


def data_bytes(setup: Setup) -> int:
    """Returns the memory that ``mjData`` takes (bytes), without allocating it.

    Its size is linear in the number of worlds and in ``naconmax``; three small instances give the coefficients. The
    forces of geoms, and numbers that differ from world to world, are counted too.
    """
    mj_model, config, num_envs = setup.mj_model, setup.config, setup.num_envs
    with_rows = with_every_row(mj_model, setup.varied)

    def size(worlds: int, contacts: int) -> int:
        with wp.ScopedDevice("cpu"):
            data = mjw.make_data(with_rows, nworld=worlds, naconmax=contacts, njmax=config.njmax)
            geoms = setup.contact_geoms
            forces = vars(ContactForces(mj_model, geoms, data, setup.contact_rows)).values() if geoms else ()
            return sum(map(_array_bytes, (data, *forces)))

    base = size(1, 1)
    data = base + (num_envs - 1) * (size(2, 1) - base) + (config.naconmax - 1) * (size(1, 2) - base)
    return data + batched_bytes(mj_model, setup.varied, num_envs)


def _array_bytes(thing: Any) -> int:
    """Returns the memory of all arrays in a dataclass, nested ones included (bytes)."""
    if isinstance(thing, wp.array):
        return thing.capacity
    if dataclasses.is_dataclass(thing):
        return sum(_array_bytes(getattr(thing, field.name)) for field in dataclasses.fields(thing))
    return 0
