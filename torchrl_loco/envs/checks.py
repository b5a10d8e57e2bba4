"""Checks of what a new body brings."""

from typing import Any

import mujoco
import numpy as np

VELOCITY_SENSORS = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in (
        *("JOINTVEL", "BALLANGVEL", "VELOCIMETER", "GYRO"),
        *("FRAMELINVEL", "FRAMEANGVEL", "SUBTREELINVEL", "SUBTREEANGMOM"),
    )
}
"""Sensors that follow from what is computed after a step, and that are zero at rest."""


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
