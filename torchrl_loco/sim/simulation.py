"""Many worlds of one model on one device, whichever engine steps them."""

import functools
import gc
import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import mujoco
import torch
import warp as wp

from torchrl_loco.checks import Interval, check_int
from torchrl_loco.config import CONVERGED, SimConfig
from torchrl_loco.sim import compiled, mjw, models, mujoco_warp
from torchrl_loco.sim import mujoco as c_mujoco
from torchrl_loco.sim.batched_model import BatchedModel, with_every_row
from torchrl_loco.sim.compilation import compile_kernels
from torchrl_loco.sim.engine import Engine, Setup
from torchrl_loco.sim.graph import Graph, ScratchPool
from torchrl_loco.sim.varied import Varied
from torchrl_loco.sim.warp_init import init_warp
from torchrl_loco.sim.world_func import ALONE, Around, WorldFunc, WorldKernels, copy_row, fill, zero_row

TOLERANCE = 1e-8  # MuJoCo's default tolerance of the solver

ENGINES: dict[str, type[Engine]] = {
    "compiled": compiled.CompiledEngine,
    "mujoco_warp": mujoco_warp.MujocoWarpEngine,
    "mujoco": c_mujoco.MujocoEngine,
}


@wp.struct
class Rest:
    """The default pose ``(1, nq)``, and what it is written to."""

    qpos0: wp.array2d[float]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    act: wp.array2d[float]
    ctrl: wp.array2d[float]
    time: wp.array[float]


@wp.func
def put_at_rest(world: int, args: Rest):
    """Puts a world at rest in the default pose."""
    copy_row(args.qpos0[0], args.qpos[world])
    zero_row(args.qvel[world])
    zero_row(args.qacc_warmstart[world])
    zero_row(args.act[world])
    zero_row(args.ctrl[world])
    args.time[world] = 0.0


class Simulation:
    """Owns the model, the state of all worlds and the engine that advances it.

    ``step``, ``reset`` and ``forward`` launch kernels on Warp's current stream; MuJoCo-Warp's ``reset`` and ``forward``
    wait for CUDA unless they are recorded. :meth:`capture` records any sequence of them to be replayed. Each takes what
    the caller does in each world before and after the physics; under ``compiled`` that is one kernel, or three.

    The torch views share memory with the Warp arrays of ``data`` and never change their address. They always hold the
    current state: clone what you want to keep. On CUDA, those of bodies with up to 16 degrees of freedom under
    ``compiled`` are not contiguous.

    ==================  =========================  ========================================================
    ``qpos``            ``(nworld, nq)``           positions (m, rad, unit quaternions)
    ``qvel``            ``(nworld, nv)``           velocities (m/s, rad/s)
    ``ctrl``            ``(nworld, nu)``           controls
    ``qacc_warmstart``  ``(nworld, nv)``           initial guess of the constraint solver
    ``act``             ``(nworld, na)``           activations of the actuators
    ``xpos``            ``(nworld, nbody, 3)``     positions of the bodies (m)
    ``xmat``            ``(nworld, nbody, 3, 3)``  orientations of the bodies
    ``time``            ``(nworld,)``              time since the world's reset (s)
    ``overflow``        ``(nworld,)``              ``Overflow`` bits, kept until you zero them
    ``contact_force``   ``(nworld, geoms, 3)``     net force of all contacts on each of ``contact_geoms``, in the
                                                   world's frame (N)
    ``in_contact``      ``(nworld, geoms)``        whether it has any contact, bool
    ``..._history``     ``(nworld, rows, ...)``    both with a row for each substep if ``contact_history``, else for the
                                                   last
    ``cvel``            ``(nworld, nbody, 6)``     velocities of the bodies about their tree's center of mass (rad/s,
                                                   m/s); ask for them before the first step
    ``subtree_com``     ``(nworld, nbody, 3)``     that center of mass (m), in the row of each tree's root; likewise
    ``numbers``         ``(nworld, count)``        numbers of the model that differ from world to world: ``varied``
    ==================  =========================  ========================================================

    Contact forces are those of the last substep, which is one behind the pose, as with touch sensors; after ``reset``
    and ``forward`` those of the present state without control. MuJoCo's ``mj_contactForce`` has them by contact.

    ``numbers`` are those of the model at first. Write rows of them in place, and call :meth:`forward` or :meth:`reset`
    for these worlds before they step again: only then do they count in full. They are not contiguous under
    ``compiled``.

    Args:
        mj_model: the compiled model; its options, and what it leaves out of contacts, are set from ``config``.
        config: settings of the simulation.
        num_envs: number of worlds.
        device: where they live.
        contact_geoms: ids of the geoms whose contact forces are computed.
        varied: which numbers of this model differ from world to world.
        contact_history: whether contact forces of all substeps of a control step are kept, and not of the last alone;
            after ``reset`` and ``forward`` all rows are those of the present state.

    Attributes:
        engine: what advances the worlds.
        engine_choice: its name, and why it is not another one.

    Raises:
        ValueError: ``config.engine`` is "compiled", and the model needs something that it does not have; or an id of a
            geom is out of range or named twice.
        MemoryError: the device has no room for so many worlds.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        config: SimConfig,
        num_envs: int,
        device: torch.device,
        *,
        contact_geoms: Sequence[int] = (),
        varied: Varied | None = None,
        contact_history: bool = False,
    ) -> None:
        warn_of_integrator(mj_model, config)
        set_options(mj_model, config)
        say_what_is_only_seen(mj_model)
        geoms = tuple(check_int("each of contact_geoms", geom, Interval(0, mj_model.ngeom)) for geom in contact_geoms)
        if len({*geoms}) < len(geoms):
            raise ValueError(f"contact_geoms must name each geom once, got {geoms}")
        differing = varied if varied is not None and varied.count else None
        if config.engine == "mujoco" and device.type != "cpu":
            raise ValueError(f"engine='mujoco' is C MuJoCo, which computes on the CPU: pass device='cpu', got {device}")
        self.engine_choice = name, _ = choose_engine(mj_model, config, differing)
        rows = config.substeps if contact_history else 1
        self.mj_model, self.config, self.varied = mj_model, config, varied
        self.num_envs = num_envs
        init_warp()
        self.device = wp.get_device(str(device))
        setup = Setup(mj_model, config, num_envs, self.device, geoms, differing, rows)
        of_all = compiled.ground_bytes(mj_model) if name == "compiled" else 0
        check_memory(ENGINES[name].memory(setup) + of_all, num_envs, device, of_all)
        self.engine = ENGINES[name](setup)
        self.model, self.data = self.engine.model, self.engine.data
        self._every = wp.ones(num_envs, dtype=bool, device=self.device)
        self._kernels = WorldKernels()
        self._scratch = ScratchPool(self.device) if self.device.is_cuda else None

        d, none = self.data, torch.empty((num_envs, 0), device=device)
        self.qpos, self.qvel, self.qacc_warmstart = map(wp.to_torch, (d.qpos, d.qvel, d.qacc_warmstart))
        self.act, self.ctrl = wp.to_torch(d.act) if mj_model.na else none, wp.to_torch(d.ctrl)
        self.xpos, self.xmat, self.time, self.overflow = map(wp.to_torch, (d.xpos, d.xmat, d.time, d.overflow))
        self.numbers = none if differing is None else wp.to_torch(self.engine.numbers)
        self.contact_force_history = torch.empty((num_envs, rows, 0, 3), device=device)
        self.in_contact_history = torch.empty((num_envs, rows, 0), dtype=torch.bool, device=device)
        if geoms:
            kept = [wp.to_torch(array).unflatten(1, (rows, len(geoms))) for array in self.engine.contact_arrays]
            self.contact_force_history, self.in_contact_history = kept
        self.contact_force, self.in_contact = self.contact_force_history[:, -1], self.in_contact_history[:, -1]

    @property
    def cvel(self) -> torch.Tensor:
        """Velocities of the bodies, angular then linear, ``(nworld, nbody, 6)``; see the table above."""
        return wp.to_torch(self.data.cvel)

    @property
    def subtree_com(self) -> torch.Tensor:
        """What :attr:`cvel` is about, ``(nworld, nbody, 3)``; see the table above.

        A point ``p`` of a body whose tree has the root ``mj_model.body_rootid[body]`` moves with
        ``cvel[:, body, 3:] + cross(cvel[:, body, :3], p - subtree_com[:, root])``.
        """
        return wp.to_torch(self.data.subtree_com)

    def step(self, around: Around = ALONE) -> None:
        """Advances every world by one control step under ``ctrl``, with what it does around the physics.

        Poses and sensors belong to the new state.

        Raises:
            TypeError: it is something else.
        """
        if not isinstance(around, Around):
            raise TypeError(f"around must be a torchrl_loco.sim.Around, got {type(around).__name__}")
        self.engine.step(around)

    def reset(self, mask: wp.array, before: Sequence[WorldFunc] = (), after: Sequence[WorldFunc] = ()) -> None:
        """Puts worlds at rest in the default pose, and updates their poses and sensors; the others stay.

        Args:
            mask: the worlds, bool ``(nworld,)``.
            before: what each of them does once it is at rest; it may write ``qpos`` and ``qvel``.
            after: what it does at the end.
        """
        self.engine.forward(mask, Around([self._at_rest(), *before], after))

    def rest(self, mask: wp.array, then: Sequence[WorldFunc]) -> None:
        """Puts worlds of a mask, bool ``(nworld,)``, at rest in the default pose, without updating poses and sensors.

        After that each of them does what ``then`` says.
        """
        self._kernels.launch([self._at_rest(), *then], mask)

    def _at_rest(self) -> WorldFunc:
        return WorldFunc(put_at_rest, fill(Rest, self.data, qpos0=self.model.qpos0))

    def apart(self, funcs: Sequence[WorldFunc], mask: wp.array | None = None) -> None:
        """Calls functions in every world, or where ``mask`` ``(nworld,)`` is set, in a kernel of their own."""
        self._kernels.launch(funcs, self._every if mask is None else mask)

    def forward(self, mask: wp.array, after: Sequence[WorldFunc] = (), *, contacts: bool = True) -> None:
        """Updates poses and sensors after ``qpos``, ``qvel`` or ``numbers`` were changed.

        Args:
            mask: the worlds, bool ``(nworld,)``.
            after: what each of them does at the end.
            contacts: whether the forces of ``contact_geoms`` are found, too, which takes a part of a physics step;
                else they stay as they are.
        """
        self.engine.forward(mask, Around(after=after), contacts=contacts)

    @property
    def varied_numbers(self) -> tuple[Varied, wp.array] | None:
        """Which numbers of the model differ from world to world, and these ``(nworld, count)``; ``None`` for none."""
        return None if self.varied is None or not self.varied.count else (self.varied, self.engine.numbers)

    def mujoco_data(self, *, contacts: bool = False) -> "mjw.Data":
        """Returns the present state as ``mjData`` of MuJoCo-Warp, with poses of geoms, sites and cameras.

        Under the engine ``compiled`` it is made at the first call, and takes the memory of the other engine: several
        KiB a world, and ``njmax`` rows of constraints. It is not updated by later steps.

        Args:
            contacts: whether contacts and constraints are found too; that takes a part of a physics step.
        """
        with wp.ScopedDevice(self.device):  # not that on which the caller makes arrays
            data, model = self.data, self.model
            if not isinstance(data, mjw.Data):
                data, model, batched = self._of_mujoco_warp
                if batched is not None:
                    batched.update(self._every)
                names = ["qpos", "qvel", "qacc_warmstart", "ctrl", "time"]
                names += ["mocap_pos", "mocap_quat"] if self.mj_model.nmocap else []
                names += ["act"] if self.mj_model.na else []
                for name in names:
                    wp.copy(getattr(data, name), getattr(self.data, name))
                mjw.kinematics(model, data)
                mjw.com_pos(model, data)
            if contacts:
                mjw.fwd_position(model, data)
        return data

    @functools.cached_property
    def _of_mujoco_warp(self) -> "tuple[mjw.Data, mjw.Model, BatchedModel | None]":
        """Data and model of MuJoCo-Warp, and what gives the model the numbers of each world, if they differ."""
        m, room = with_every_row(self.mj_model, self.varied), self.config
        data = mjw.make_data(m, self.num_envs, naconmax=room.naconmax, njmax=room.njmax)
        if self.varied is None:
            return data, self.model, None
        batched = BatchedModel(mjw.put_model(self.mj_model), self.varied, self.engine.numbers)
        return data, batched.model, batched

    def compile(self, *launches: Callable[[], None]) -> None:
        """Compiles the kernels that ``launches`` would launch, in parallel and with a progress bar."""
        compile_kernels(launches, self.device)

    def capture(self, launch: Callable[..., None]) -> Graph:
        """Returns a recording of the launches that ``launch`` makes. It also runs them: reset before use."""
        return Graph(launch, self.device, self._scratch, anew=isinstance(self.engine, c_mujoco.MujocoEngine))


def set_options(mj_model: mujoco.MjModel, config: SimConfig) -> None:
    """Sets the options of a model from ``config``, and takes contacts out of it that ``config`` does not want.

    Under C MuJoCo these are the time step and the integrator; its solver has MuJoCo's default limits at least.
    """
    if config.contacts == "ground":
        models.touch_ground_only(mj_model)
    option = mj_model.opt
    option.integrator = integrator(config)
    option.timestep = config.sim_dt
    if config.engine == "mujoco":  # all else is the model's own, but the solver converges
        option.iterations = max(option.iterations, CONVERGED["iterations"])
        option.ls_iterations = max(option.ls_iterations, CONVERGED["ls_iterations"])
        option.tolerance = min(option.tolerance, TOLERANCE)
        return
    option.iterations = config.iterations
    option.ls_iterations = config.ls_iterations
    euler_damping = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    option.disableflags &= ~euler_damping
    option.disableflags |= 0 if config.euler_damping else euler_damping


def integrator(config: SimConfig) -> int:
    """Returns MuJoCo's number of the integrator that ``config`` names."""
    return int(getattr(mujoco.mjtIntegrator, f"mjINT_{config.integrator.upper()}"))


def warn_of_integrator(mj_model: mujoco.MjModel, config: SimConfig) -> None:
    """Says so if the integrator of ``config`` replaces another one that the model names."""
    if mj_model.opt.integrator != integrator(config):
        named = mujoco.mjtIntegrator(mj_model.opt.integrator).name.removeprefix("mjINT_")
        logging.getLogger("torchrl_loco").warning(
            "the model's integrator %s is replaced by %s, which config names: pass integrator=... to choose another",
            named,
            config.integrator,
        )


def say_what_is_only_seen(mj_model: mujoco.MjModel) -> None:
    """Says in the log which meshes touch nothing: robots have them for their looks, or lack primitives."""
    m = mj_model
    mesh, masks = int(mujoco.mjtGeom.mjGEOM_MESH), m.geom_contype | m.geom_conaffinity
    seen = [g for g in range(m.ngeom) if m.geom_type[g] == mesh and not masks[g]]
    seen = [g for g in seen if g not in m.pair_geom1 and g not in m.pair_geom2]
    if seen:
        names = [m.geom(g).name or m.mesh(int(m.geom_dataid[g])).name for g in seen]
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        logging.getLogger("torchrl_loco").warning(
            "geoms that are meshes without contacts are drawn and touch nothing: %s%s", ", ".join(names[:3]), more
        )


def choose_engine(mj_model: mujoco.MjModel, config: SimConfig, varied: Varied | None = None) -> tuple[str, str]:
    """Returns the name of the engine that steps a model, and why; raises ValueError if that of ``config`` cannot."""
    if config.engine in ("mujoco_warp", "mujoco"):
        return config.engine, "as asked"
    missing = compiled.unsupported(mj_model, varied)
    if not missing:
        return "compiled", "it has all that the model needs"
    if config.engine == "compiled":
        raise ValueError(f"engine='compiled' does not have: {'; '.join(missing)}. Pass engine='auto' or 'mujoco_warp'")
    if mj_model.nflex:  # MuJoCo-Warp 4.0 ends in an error of its sorting
        raise ValueError("flexes are stepped by C MuJoCo alone: pass engine='mujoco'")
    more = f" and {len(missing) - 1} more: see env.engine_reason" if len(missing) > 1 else ""
    logging.getLogger("torchrl_loco").warning(
        "stepping with MuJoCo-Warp: engine 'compiled' does not have: %s%s", missing[0], more
    )
    return "mujoco_warp", f"engine 'compiled' does not have: {'; '.join(missing)}"


def check_memory(needed: int, num_envs: int, device: torch.device, of_all: int = 0) -> None:
    """Checks that memory is free (bytes), of which ``of_all`` does not depend on the number of worlds.

    Raises:
        MemoryError: more is needed; the message has the figures, and how many worlds would fit.
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
            f"free: about {int(num_envs * max(free - of_all, 0) / (needed - of_all))} worlds fit"
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
