"""A control step of one model as one function of C++: all substeps of a world, then what an observation reads."""

import hashlib
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.sim.compiled.collision.pairs import needs_lanes
from torchrl_loco.sim.compiled.ir.parameters import VariedModel, nominal
from torchrl_loco.sim.compiled.physics.sensors import AT_SITES
from torchrl_loco.sim.compiled.schedules import lanes, traced
from torchrl_loco.sim.compiled.schedules.shared import NO_MORE, Asked

TRACED_DOFS = 16
"""Most degrees of freedom of a body that is traced. A thread holds its state; for the humanoid that would be 12 KiB and
340 KB of code, which takes twice as long on a GPU as a warp of lanes. For the walker lanes take 3 times as long."""

WARP = wp.constant(32)  # threads of a CUDA warp, which wait for each other wherever they diverge
WARPS = 2
"""Warps that each multiprocessor gets before warps are filled with worlds: a warp takes as long as its slowest world,
and more warps wait for each other's instructions (measured)."""

MANY = 2
"""Above this multiple of the worlds that fill those warps, observation and bookkeeping run in kernels of their own:
they wait for memory, and the registers of the physics leave too few warps to hide that."""

MOST_KEPT = 64  # texts of steps that a process keeps, and rows of nominal numbers

texts: dict[tuple, str] = {}  # those that were made last, by all that they depend on but the constants of this package
rows: dict[tuple, np.ndarray] = {}  # likewise


def is_traced(m: mujoco.MjModel) -> bool:
    """Returns whether one thread steps a world, in straight-line code; else a group of lanes does, in loops.

    Lanes alone have integrators other than Euler, joints that limit the forces of their actuators, tendons, equalities,
    activations, sensors at sites, and contacts that are more than friction that slides on spheres and capsules.
    """
    euler = m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_EULER)
    plain = not (m.jnt_actfrclimited.any() or m.na or m.neq or m.ntendon or np.isin(m.sensor_type, AT_SITES).any())
    return m.nv <= TRACED_DOFS and euler and plain and not needs_lanes(m)


def structure_of_arrays(m: mujoco.MjModel, device: wp.Device) -> bool:
    """Returns whether the world is the fastest index of the arrays, instead of the slowest.

    The threads of a warp step neighbouring worlds, if there are more worlds than warps: this coalesces their accesses.
    """
    return device.is_cuda and is_traced(m)


def check_worlds(m: mujoco.MjModel, num_envs: int, device: wp.Device) -> None:
    """Raises ValueError if 32 bits, with which Warp counts threads and bytes from a row to the next, are too few."""
    if not device.is_cuda:
        return
    most = (2**31 - 1) // (wp.types.type_size_in_bytes(wp.mat33) if structure_of_arrays(m, device) else WARP)
    if num_envs > most:
        raise ValueError(f"num_envs={num_envs} is too large: Warp addresses {most} worlds with its 32 bits")


def source(m: mujoco.MjModel, substeps: int, **asked: Any) -> str:
    """Returns the C++ of a control step of one world, the body of a function of its arrays.

    Args:
        m: the model, or a ``VariedModel``.
        substeps: physics steps; 0 evaluates the state without stepping.
        asked: what it writes beside the state, as :class:`.shared.Asked` has it.
    """
    return (traced if is_traced(m) else lanes).source(m, substeps, Asked(**asked))


def kept_source(m: mujoco.MjModel, substeps: int, asked: Asked = NO_MORE) -> str:
    """Returns :func:`source`, which is written once for environments of the same model: it takes up to half a second.

    What is asked for must be hashable.
    """
    key = is_traced(m), _fingerprint(m), substeps, asked
    return _kept(texts, key, lambda: source(m, substeps, **asked._asdict()))


def _kept(kept: dict[tuple, Any], key: tuple, make: Callable[[], Any]) -> Any:
    """Returns what is kept under a key, made if it is not; the oldest is dropped where there are too many."""
    if key not in kept:
        kept[key] = make()
        if len(kept) > MOST_KEPT:
            del kept[next(iter(kept))]
    return kept[key]


def _fingerprint(m: mujoco.MjModel) -> bytes:
    """Returns a hash of all numbers of a model, and of which of them vary."""
    whole = np.empty(mujoco.mj_sizeModel(nominal(m)), dtype=np.uint8)
    mujoco.mj_saveModel(nominal(m), None, whole)
    digest = hashlib.sha256(whole.tobytes())
    if isinstance(m, VariedModel):
        digest.update(repr([(name, places.tolist()) for name, places in m.varied.places.items()]).encode())
    return digest.digest()


def nominal_row(m: VariedModel) -> np.ndarray:
    """Returns what the step reads of the model itself: the numbers that vary, then what follows from them.

    It is found once for environments of the same model: for a robot it takes a tenth of a second.
    """
    key = is_traced(m), _fingerprint(m)
    row = _kept(rows, key, lambda: m.varied.nominal() if is_traced(m) else lanes.nominal_row(m))
    row.flags.writeable = False
    return row


class LaunchSize(NamedTuple):
    """The threads of a launch.

    Attributes:
        threads: all of them.
        block: those of a block.
        worlds_per_warp: worlds that share a warp.
        lanes: threads that share a world.
        one_kernel: whether the functions of a world run in the kernel of the physics, and not as kernels of their own.
        registers: of a thread, at most, or ``None``.
    """

    threads: int
    block: int
    worlds_per_warp: int
    lanes: int
    one_kernel: bool
    registers: int | None = None


def launch_size(m: mujoco.MjModel, num_envs: int, device: wp.Device) -> LaunchSize:
    """Returns how the worlds are spread over threads."""
    if device.is_cuda and not is_traced(m):
        description = lanes.Description(m)
        block = description.worlds_per_block()
        threads, registers = WARP * block * math.ceil(num_envs / block), description.registers()
        # One lane would do what is not physics, while 31 wait.
        return LaunchSize(threads, WARP * block, 1, WARP, one_kernel=False, registers=registers)
    worlds, one_kernel = WARP, True
    if device.is_cuda:
        share = num_envs / (WARPS * device.sm_count)
        worlds = min(WARP, 2 ** math.ceil(math.log2(max(share, 1))))
        one_kernel = share <= MANY * WARP
    return LaunchSize(WARP * math.ceil(num_envs / worlds), WARP, worlds, 1, one_kernel)
