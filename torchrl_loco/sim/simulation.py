"""Many worlds of one model, stepped together by MuJoCo-Warp."""

import contextlib
from collections.abc import Callable, Iterator

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.sim.graph import Graph
from torchrl_loco.sim.kernels import compile_kernels
from torchrl_loco.sim.order import RowOrder
from torchrl_loco.sim.scratch import ScratchPool

UNROLLED_ITERATIONS = 10
"""Solver iterations up to which a recorded step holds them all, without a condition between them."""

LANES = wp.constant(32)
"""Threads that share the constraint rows of a world."""


@wp.kernel(enable_backward=False)
def clear_worlds(
    # Model:
    qpos0: wp.array2d[float],
    # In:
    mask_in: wp.array[bool],
    # Data out:
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    qacc_warmstart_out: wp.array2d[float],
    ctrl_out: wp.array2d[float],
    time_out: wp.array[float],
    cvel_out: wp.array2d[wp.spatial_vector],
    sensordata_out: wp.array2d[float],
):
    world = wp.tid()
    if not mask_in[world]:
        return
    for i in range(qpos_out.shape[1]):
        qpos_out[world, i] = qpos0[0, i]
    for i in range(qvel_out.shape[1]):
        qvel_out[world, i] = 0.0
        qacc_warmstart_out[world, i] = 0.0
    for i in range(ctrl_out.shape[1]):
        ctrl_out[world, i] = 0.0
    time_out[world] = 0.0
    for i in range(cvel_out.shape[1]):
        cvel_out[world, i] = wp.spatial_vector()
    for i in range(sensordata_out.shape[1]):
        sensordata_out[world, i] = 0.0


@wp.kernel(enable_backward=False)
def clear_constraints(
    # In:
    mask_in: wp.array[bool],
    # Data out:
    efc_J_out: wp.array3d[float],  # noqa: N803
    efc_D_out: wp.array2d[float],  # noqa: N803
):
    """Zeroes the constraint rows: the solver multiplies unused ones by zero, which leaves a NaN a NaN for ever."""
    world, lane = wp.tid()
    if not mask_in[world]:
        return
    for row in range(lane, efc_J_out.shape[1], LANES):
        for i in range(efc_J_out.shape[2]):
            efc_J_out[world, row, i] = 0.0
        if row < efc_D_out.shape[1]:
            efc_D_out[world, row] = 0.0


@wp.kernel(enable_backward=False)
def note_demand(
    # Data in:
    nefc_in: wp.array[int],
    nacon_in: wp.array[int],
    ncollision_in: wp.array[int],
    # Out:
    rows_out: wp.array[int],
    contacts_out: wp.array[int],
):
    """Keeps the largest numbers of constraint rows and contacts that were asked for, also where there was no room."""
    world = wp.tid()
    rows_out[world] = wp.max(rows_out[world], nefc_in[world])
    if world == 0:
        contacts_out[0] = wp.max(contacts_out[0], wp.max(nacon_in[0], ncollision_in[0]))


class Simulation:
    """Owns the models, the state of all worlds, and the graphs that advance it.

    ``step``, ``reset``, ``place`` and ``forward`` launch kernels on Warp's current stream and return at once;
    :meth:`capture` records any sequence of them, with kernels of the caller's in between, to be replayed.

    The torch views share memory with the Warp arrays and keep their address for life. They always hold the current
    state: clone what you want to keep.

    ==================  =========================  ========================================================
    ``qpos``            ``(nworld, nq)``           positions (m, rad, unit quaternions)
    ``qvel``            ``(nworld, nv)``           velocities (m/s, rad/s)
    ``ctrl``            ``(nworld, nu)``           actions, clipped by the physics to the ctrlrange
    ``qacc_warmstart``  ``(nworld, nv)``           where the constraint solver starts
    ``xpos``            ``(nworld, nbody, 3)``     positions of the bodies (m)
    ``xmat``            ``(nworld, nbody, 3, 3)``  orientations of the bodies
    ``time``            ``(nworld,)``              time since the world's reset (s)
    ``overflow``        ``(nworld,)``              :class:`mujoco_warp.OverflowType` bits, kept until you zero them
    ``peak_rows``       ``(nworld,)``              most constraint rows that a substep asked for
    ``peak_contacts``   ``(1,)``                   most contacts that a substep asked for, over all worlds
    ==================  =========================  ========================================================

    Args:
        mj_model: the compiled model; its options are set from ``config``.
        config: settings of the simulation.
        num_envs: number of worlds.
        device: where they live.
    """

    def __init__(self, mj_model: mujoco.MjModel, config: SimConfig, num_envs: int, device: torch.device) -> None:
        self.mj_model = mj_model
        self.num_envs = num_envs
        self.substeps = config.substeps
        self.device = wp.get_device(str(device))
        self.graphs: list[Graph] = []
        self._scratch = ScratchPool(self.device) if self.device.is_cuda else None

        set_options(mj_model, config)
        with wp.ScopedDevice(self.device):
            self.model = mjw.put_model(mj_model)
            self.data = mjw.make_data(mj_model, nworld=num_envs, naconmax=config.naconmax, njmax=config.njmax)
        option = self.model.opt
        # Printing from kernels costs more than the physics; the same facts stay readable in ``overflow``.
        option.warn_overflow = 0
        # A few iterations are cheaper in a row than in a loop that may stop early.
        option.graph_conditional = config.iterations > UNROLLED_ITERATIONS
        # The solver starts from the warm start; a second start that it would compare with costs a factorization.
        option.run_qacc_smooth = False
        # Threads to a world's matrices, which are small: measured in benchmarks/README.md.
        self.model.block_dim.update_gradient_cholesky = 32
        self.model.block_dim.update_gradient_JTDAJ_dense = 64

        self._order = RowOrder(self.model, self.data) if config.deterministic else None

        self.qpos = wp.to_torch(self.data.qpos)
        self.qvel = wp.to_torch(self.data.qvel)
        self.ctrl = wp.to_torch(self.data.ctrl)
        self.qacc_warmstart = wp.to_torch(self.data.qacc_warmstart)
        self.xpos = wp.to_torch(self.data.xpos)
        self.xmat = wp.to_torch(self.data.xmat)
        self.time = wp.to_torch(self.data.time)
        self.overflow = wp.to_torch(self.data.overflow)
        self._peak_rows = wp.zeros(num_envs, dtype=int, device=self.device)
        self._peak_contacts = wp.zeros(1, dtype=int, device=self.device)
        self.peak_rows = wp.to_torch(self._peak_rows)
        self.peak_contacts = wp.to_torch(self._peak_contacts)

    def step(self) -> None:
        """Advances every world by one control step under ``ctrl``.

        Afterwards poses, velocities of bodies and sensors belong to the new state, as in dm_control. dm_control gets
        there by a whole first half of the next step; here it is only what an observation can ask for, which leaves
        nothing else to bring up to date when a world is reset. Forces, contacts and constraints are those of the last
        substep.
        """
        with self._lean():
            for _ in range(self.substeps):
                self._substep()
                self._note_demand()
        self._pose()

    def _substep(self) -> None:
        if self._order is None:
            mjw.step(self.model, self.data)
            return
        mjw.step1(self.model, self.data)
        self._order.apply()
        # In the solver alone, where it costs the least: nothing before it adds up in any order.
        self.model.opt.deterministic = mjw.DeterminismType.ATOMICS
        mjw.step2(self.model, self.data)
        self.model.opt.deterministic = mjw.DeterminismType.NONE

    def _note_demand(self) -> None:
        d = self.data
        wp.launch(
            note_demand,
            dim=self.num_envs,
            inputs=[d.nefc, d.nacon, d.ncollision],
            outputs=[self._peak_rows, self._peak_contacts],
            device=self.device,
        )

    def forward(self, mask: wp.array) -> None:
        """Brings poses and sensors up to ``qpos`` and ``qvel``, changed where ``mask`` ``(nworld,)`` is set."""
        self._clear_constraints(mask)
        self._pose()

    def place(self, mask: wp.array) -> None:
        """As :meth:`forward`, for less: after a :meth:`reset`, and ``qpos`` alone was changed where ``mask`` is set."""
        self._clear_constraints(mask)
        mjw.kinematics(self.model, self.data)

    def _clear_constraints(self, mask: wp.array) -> None:
        efc = self.data.efc
        wp.launch(
            clear_constraints,
            dim=(self.num_envs, LANES),
            inputs=[mask],
            outputs=[efc.J, efc.D],
            device=self.device,
        )

    def _pose(self) -> None:
        """Evaluates what an observation can ask for: poses and velocities of bodies, and sensors of them."""
        mjw.kinematics(self.model, self.data)
        mjw.com_pos(self.model, self.data)
        mjw.com_vel(self.model, self.data)
        mjw.sensor_vel(self.model, self.data)

    @contextlib.contextmanager
    def _lean(self) -> Iterator[None]:
        """Launches nothing for sensors, cameras and lights: they are evaluated once they are asked for."""
        model = self.model
        kept = model.opt.disableflags, model.ncam, model.nlight
        model.ncam = model.nlight = 0
        model.opt.disableflags |= mjw.DisableBit.SENSOR
        try:
            yield
        finally:
            model.opt.disableflags, model.ncam, model.nlight = kept

    def reset(self, mask: wp.array) -> None:
        """Puts the worlds where ``mask`` (bool, ``(nworld,)``) is set at rest in the default pose; others stay."""
        d = self.data
        wp.launch(
            clear_worlds,
            dim=self.num_envs,
            inputs=[self.model.qpos0, mask],
            outputs=[d.qpos, d.qvel, d.qacc_warmstart, d.ctrl, d.time, d.cvel, d.sensordata],
            device=self.device,
        )

    def compile(self, *launches: Callable[[], None]) -> None:
        """Compiles the kernels that ``launches`` would launch, in parallel and under a progress bar."""
        compile_kernels(launches, self.device)

    def capture(self, launch: Callable[[], None]) -> Graph:
        """Returns a recording of the launches that ``launch`` makes. The state is arbitrary then: reset before use."""
        graph = Graph(launch, self.device, self._scratch)
        self.graphs.append(graph)
        return graph

    @property
    def num_captures(self) -> int:
        """How many graphs were ever recorded."""
        return len(self.graphs)


def set_options(mj_model: mujoco.MjModel, config: SimConfig) -> None:
    """Sets the options of a model as the settings say."""
    option = mj_model.opt
    option.timestep = config.sim_dt
    option.iterations = config.iterations
    option.ls_iterations = config.ls_iterations
    euler_damping = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    option.disableflags = (
        option.disableflags & ~euler_damping if config.euler_damping else option.disableflags | euler_damping
    )
