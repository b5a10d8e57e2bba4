"""Many worlds of one model on one device, whichever engine steps them."""

import gc
import math
from collections.abc import Callable
from pathlib import Path

import mujoco
import torch
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.sim.compilation import compile_kernels
from torchrl_loco.sim.graph import Graph, ScratchPool
from torchrl_loco.sim.mujoco_warp import MujocoWarpEngine, data_bytes

SCRATCH = 1.4
"""Memory of a simulation as a multiple of its ``mjData``; the rest is scratch memory (measured: 1.3 to 1.4)."""

DETERMINISTIC_SCRATCH = 11.0
"""The same with ``deterministic=True`` on CUDA (measured: 6 to 8 times the memory of a world)."""


@wp.kernel(enable_backward=False)
def reset_worlds(
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
    """Puts worlds at rest in the default pose."""
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


class Simulation:
    """Owns the model, the state of all worlds and the engine that advances it.

    ``step``, ``reset``, ``forward`` and ``forward_at_rest`` launch kernels on Warp's current stream and return at once;
    :meth:`capture` records any sequence of them, with the caller's own kernels in between, to be replayed.

    The torch views share memory with the Warp arrays of ``data`` and never change their address. They always hold the
    current state: clone what you want to keep.

    ==================  =========================  ========================================================
    ``qpos``            ``(nworld, nq)``           positions (m, rad, unit quaternions)
    ``qvel``            ``(nworld, nv)``           velocities (m/s, rad/s)
    ``ctrl``            ``(nworld, nu)``           controls
    ``qacc_warmstart``  ``(nworld, nv)``           initial guess of the constraint solver
    ``xpos``            ``(nworld, nbody, 3)``     positions of the bodies (m)
    ``xmat``            ``(nworld, nbody, 3, 3)``  orientations of the bodies
    ``time``            ``(nworld,)``              time since the world's reset (s)
    ``overflow``        ``(nworld,)``              :class:`mujoco_warp.OverflowType` bits, kept until you zero them
    ==================  =========================  ========================================================

    Args:
        mj_model: the compiled model; its options are set from ``config``.
        config: settings of the simulation.
        num_envs: number of worlds.
        device: where they live.

    Raises:
        MemoryError: the device has no room for so many worlds.
    """

    def __init__(self, mj_model: mujoco.MjModel, config: SimConfig, num_envs: int, device: torch.device) -> None:
        set_options(mj_model, config)
        scratch = DETERMINISTIC_SCRATCH if config.deterministic and device.type == "cuda" else SCRATCH
        check_memory(int(scratch * data_bytes(mj_model, config, num_envs)), num_envs, device)
        self.mj_model = mj_model
        self.num_envs = num_envs
        self.device = wp.get_device(str(device))
        self.engine = MujocoWarpEngine(mj_model, config, num_envs, self.device)
        self.model, self.data = self.engine.model, self.engine.data
        self.graphs: list[Graph] = []
        self._scratch = ScratchPool(self.device) if self.device.is_cuda else None

        self.qpos = wp.to_torch(self.data.qpos)
        self.qvel = wp.to_torch(self.data.qvel)
        self.ctrl = wp.to_torch(self.data.ctrl)
        self.qacc_warmstart = wp.to_torch(self.data.qacc_warmstart)
        self.xpos = wp.to_torch(self.data.xpos)
        self.xmat = wp.to_torch(self.data.xmat)
        self.time = wp.to_torch(self.data.time)
        self.overflow = wp.to_torch(self.data.overflow)

    def step(self) -> None:
        """Advances every world by one control step under ``ctrl``; poses and sensors belong to the new state."""
        self.engine.step()

    def reset(self, mask: wp.array) -> None:
        """Puts the worlds where ``mask`` (bool, ``(nworld,)``) is set at rest in the default pose; others stay."""
        d = self.data
        wp.launch(
            reset_worlds,
            dim=self.num_envs,
            inputs=[self.model.qpos0, mask],
            outputs=[d.qpos, d.qvel, d.qacc_warmstart, d.ctrl, d.time, d.cvel, d.sensordata],
            device=self.device,
        )

    def forward(self, mask: wp.array) -> None:
        """Updates poses and sensors after ``qpos`` and ``qvel`` were changed where ``mask`` ``(nworld,)`` is set."""
        self.engine.clear_constraints(mask)
        self.engine.evaluate()

    def forward_at_rest(self, mask: wp.array) -> None:
        """As :meth:`forward`, but cheaper; valid after :meth:`reset` if only ``qpos`` changed since."""
        self.engine.clear_constraints(mask)
        self.engine.evaluate_at_rest()

    def compile(self, *launches: Callable[[], None]) -> None:
        """Compiles the kernels that ``launches`` would launch, in parallel and with a progress bar."""
        compile_kernels(launches, self.device)

    def capture(self, launch: Callable[[], None]) -> Graph:
        """Returns a recording of the launches that ``launch`` makes. It also runs them: reset before use."""
        graph = Graph(launch, self.device, self._scratch)
        self.graphs.append(graph)
        return graph


def set_options(mj_model: mujoco.MjModel, config: SimConfig) -> None:
    """Sets the options of a model from ``config``."""
    option = mj_model.opt
    option.timestep = config.sim_dt
    option.iterations = config.iterations
    option.ls_iterations = config.ls_iterations
    euler_damping = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    option.disableflags = (
        option.disableflags & ~euler_damping if config.euler_damping else option.disableflags | euler_damping
    )


def check_memory(needed: int, num_envs: int, device: torch.device) -> None:
    """Checks that the worlds fit into the memory that is free.

    Raises:
        MemoryError: they do not; the message names the figures and how many worlds would fit.
    """
    free = free_memory(device)
    if needed > free and device.type == "cuda":  # closed environments may have left memory to torch and Warp
        gc.collect()
        wp.synchronize_device(str(device))
        torch.cuda.empty_cache()
        free = free_memory(device)
    if needed > free:
        raise MemoryError(
            f"num_envs={num_envs} needs about {needed / 2**30:.1f} GiB on {device}, which has {free / 2**30:.1f} GiB "
            f"free: about {int(num_envs * free / needed)} worlds fit"
        )


def free_memory(device: torch.device) -> float:
    """Returns the memory that a device has free (bytes); infinity where the system does not say.

    On the CPU, the limit of the control group applies too; its page cache counts as free.
    """
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    meminfo, group = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
    if not meminfo.is_file():
        return math.inf
    free = 1024 * int(_entries(meminfo)["MemAvailable:"])
    limit = group / "memory.max"
    if limit.is_file() and limit.read_text().strip() != "max":
        used = int((group / "memory.current").read_text()) - int(_entries(group / "memory.stat")["inactive_file"])
        free = min(free, max(int(limit.read_text()) - used, 0))
    return free


def _entries(path: Path) -> dict[str, str]:
    """Returns the first two words of each line of a file of statistics."""
    return dict(line.split()[:2] for line in path.read_text().splitlines())
