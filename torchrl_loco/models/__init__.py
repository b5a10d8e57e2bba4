"""The bodies as MJCF files of our own writing; model parameters are dm_control's (see NOTICE)."""

from pathlib import Path

import mujoco
import numpy as np

_FOLDER = Path(__file__).parent
PATHS = {name: _FOLDER / f"{name}.xml" for name in ("walker", "humanoid", "cheetah", "hopper", "quadruped")}
SCENE = _FOLDER / "scene.xml"
"""What all bodies can include by its name: light, materials, the look of the floor."""

VELOCITY_SENSORS = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in (
        *("JOINTVEL", "BALLANGVEL", "VELOCIMETER", "GYRO"),
        *("FRAMELINVEL", "FRAMEANGVEL", "SUBTREELINVEL", "SUBTREEANGMOM"),
    )
}
"""Sensors of velocities: they belong to the state after a step, and are zero at rest."""

FORCE_SENSORS = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}")) for name in ("TOUCH", "ACCELEROMETER", "FORCE", "TORQUE")
}
"""Sensors of forces and accelerations: those of the last physics step, or without control if none was taken yet."""


def load(path: Path | str) -> mujoco.MjModel:
    """Returns the model of an MJCF file. It may include ``scene.xml``, which is ours unless one lies beside it.

    Raises:
        ValueError: there is no such file, or it is no valid MJCF.
    """
    own = Path(path).with_name(SCENE.name).exists()
    return mujoco.MjModel.from_xml_path(str(path), {} if own else {SCENE.name: SCENE.read_bytes()})


def control(mj_model: mujoco.MjModel, action: np.ndarray) -> np.ndarray:
    """Returns the controls of actions in [-1, 1], which are scaled to the range of each actuator.

    Args:
        mj_model: the model.
        action: ``(..., nu)``, clipped beyond.
    """
    low, high = mj_model.actuator_ctrlrange.T
    return 0.5 * (low + high) + 0.5 * (high - low) * np.clip(action, -1.0, 1.0)


def check(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns the model if an environment supports it.

    Raises:
        ValueError: the model uses something unsupported; the message names it.
    """
    wrong = []
    low, high = mj_model.actuator_ctrlrange.T
    if not (low < high).all():
        wrong.append("every actuator needs a ctrlrange, to which actions in [-1, 1] are scaled")
    unclipped = mj_model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    if unclipped or not mj_model.actuator_ctrllimited.all():
        wrong.append("actions beyond [-1, 1] must be clipped: leave ctrllimited and the flag clampctrl on")
    if mj_model.actuator_delay.any():
        wrong.append("delays of actuators are not supported: they are not part of the state that is reset")
    disabled = {group for group in range(31) if mj_model.opt.disableactuator >> group & 1}
    if disabled.intersection(mj_model.actuator_group.tolist()):
        wrong.append("groups of actuators cannot be disabled (actuatorgroupdisable): leave the actuators out")
    for i in range(mj_model.nsensor):
        camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
        of_camera = camera in (mj_model.sensor_objtype[i], mj_model.sensor_reftype[i])
        if of_camera or mj_model.sensor_type[i] not in VELOCITY_SENSORS | FORCE_SENSORS:
            name = mj_model.sensor(i).name
            wrong.append(
                f"sensor {name!r} is not evaluated, only velocities, touch, accelerometers, forces and torques are: "
                "compute it from sim.data in a kernel"
            )
    if wrong:
        raise ValueError("; ".join(wrong))
    return mj_model
