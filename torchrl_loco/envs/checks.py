"""Checks of what a user passes to an environment, and of what a new body brings."""

import operator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

VELOCITY_SENSORS = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in (
        *("JOINTVEL", "BALLANGVEL", "VELOCIMETER", "GYRO"),
        *("FRAMELINVEL", "FRAMEANGVEL", "SUBTREELINVEL", "SUBTREEANGMOM"),
    )
}
"""Sensors that follow from what is computed after a step, and that are zero at rest."""


def check_count(name: str, value: Any) -> int:
    """Returns ``value`` as an int of at least 1.

    Raises:
        TypeError: it is no integer; the message calls it ``name``.
        ValueError: it is less than 1.
    """
    try:
        count = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {value!r}") from None
    if isinstance(value, bool) or count < 1:
        raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
    return count


def check_flag(name: str, value: Any) -> bool:
    """Returns ``value``, or raises an error that names it if it is neither True nor False.

    Raises:
        TypeError: it is something else.
    """
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def check_seed(value: Any) -> int:
    """Returns ``value`` as an int in [0, 2**32).

    Raises:
        TypeError: it is no integer.
        ValueError: it is out of range.
    """
    try:
        seed = operator.index(value)
    except TypeError:
        raise TypeError(f"seed must be an integer or None, got {value!r}") from None
    if isinstance(value, bool) or not 0 <= seed < 2**32:
        raise ValueError(f"seed must lie in [0, 2**32), got {value!r}")
    return seed


def check_device(device: torch.device | str | None) -> torch.device:
    """Returns the device with its index, CUDA before CPU for ``None``.

    Raises:
        ValueError: it is not here; the message names those that are.
    """
    cuda = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if device is None:
        device = "cuda" if cuda else "cpu"
    name = str(device)
    if name == "cuda" and cuda:
        name = f"cuda:{torch.cuda.current_device()}"
    if name not in ("cpu", *cuda):
        raise ValueError(f"no device {str(device)!r} here: choose one of {', '.join(['cpu', *cuda])}")
    return torch.device(name)


def check_new_file(name: str, value: Any) -> Path:
    """Returns ``value`` as the path of a file that is not there yet, but whose folder is.

    Raises:
        TypeError: it is no path.
        ValueError: it cannot be written, or would be overwritten.
    """
    path = check_folder(name, value)
    if path.exists():
        raise ValueError(f"{name} {path} is already there: move it away, or choose another name")
    return path


def check_folder(name: str, value: Any) -> Path:
    """Returns ``value`` as the path of a file whose folder is there.

    Raises:
        TypeError: it is no path.
        ValueError: there is no such folder.
    """
    path = Path(value).absolute()  # where it is now, should the working directory change
    if not path.parent.is_dir():
        raise ValueError(f"{name} {path} cannot be written: there is no folder {path.parent}")
    return path


def check_subclass(cls: type) -> None:
    """Checks that a subclass of ``LocoEnv`` has set all class attributes that it must.

    Raises:
        TypeError: some are missing; the message names them.
    """
    names = ("body", "mjcf", "defaults", "observation_size", "term_names")
    missing = [name for name in names if not hasattr(cls, name)]
    if missing:
        raise TypeError(f"{cls.__name__} must set {', '.join(missing)}: see help(torchrl_loco.LocoEnv)")


def check_poses(poses: Any, nq: int) -> np.ndarray:
    """Returns a table of initial poses as an array of float32.

    Raises:
        ValueError: it is not of shape ``(count, nq)``, or has no rows.
    """
    table = np.asarray(poses, dtype=np.float32)
    if table.ndim != 2 or table.shape[1] != nq or len(table) == 0:
        raise ValueError(f"_initial_poses must return an array of shape (count, {nq}), count > 0; got {table.shape}")
    return table


def check_model(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns the model.

    Raises:
        ValueError: something in it would go wrong in silence; the message names it.
    """
    wrong = []
    if not np.array_equal(mj_model.actuator_ctrlrange, np.tile([-1.0, 1.0], (mj_model.nu, 1))):
        wrong.append("every actuator needs ctrlrange -1 1, which actions lie in: scale by gear or gainprm")
    unclipped = mj_model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    if unclipped or not mj_model.actuator_ctrllimited.all():
        wrong.append("actions beyond -1 1 must be clipped: leave ctrllimited and the flag clampctrl on")
    if mj_model.actuator_delay.any():
        wrong.append("delays of actuators are not supported: they are not part of the state that is reset")
    if mj_model.na:
        wrong.append("actuators with activations are not supported: they are not part of the state that is reset")
    for i in range(mj_model.nsensor):
        camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
        of_camera = camera in (mj_model.sensor_objtype[i], mj_model.sensor_reftype[i])
        if of_camera or mj_model.sensor_type[i] not in VELOCITY_SENSORS:
            name = mj_model.sensor(i).name
            wrong.append(f"sensor {name!r} is not evaluated, only velocities are: compute it from sim.data in a kernel")
    if wrong:
        raise ValueError("; ".join(wrong))
    return mj_model
