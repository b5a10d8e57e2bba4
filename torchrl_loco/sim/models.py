"""Models from MJCF files, and what a model must keep to."""

import contextlib
from collections.abc import Collection
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from torchrl_loco.config import read_mjcf
from torchrl_loco.sim.corners import BITS, stand_on_corners

FOLDERS = ("assetdir", "meshdir", "texturedir")  # attributes of MJCF's compiler that name folders of files

NEVER = -1e10  # margin (m) of an explicit pair of geoms that does not touch: nothing is so deep

ADDED = "torchrl_loco: added camera"  # a text of models whose camera ``side`` is not their own

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


def load(
    source: Path | str | mujoco.MjSpec,
    folder: Path | None = None,
    sensors: Collection[int] | None = None,
    solids_on_terrain: str = "exact",
) -> mujoco.MjModel:
    """Returns a model. MJCF may include ``scene.xml``, which is ours unless one lies beside it.

    A model without a camera ``side`` gets one that follows its first body, and a light if it has none: videos show it.

    Args:
        source: path of an MJCF file, MJCF text, or a ``mujoco.MjSpec``, which stays as it is.
        folder: where a relative path is looked for first.
        sensors: ids of the sensors that are kept; ``None`` keeps all.
        solids_on_terrain: that of :class:`torchrl_loco.SimConfig`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no valid MJCF.
    """
    spec = specification(source, folder)
    for i, sensor in enumerate(list(spec.sensors)):
        if sensors is not None and i not in sensors:
            spec.delete(sensor)
    if solids_on_terrain == "spheres":
        stand_on_corners(spec)
    model = spec.compile()
    if "side" in [camera.name for camera in spec.cameras] or model.nbody == 1:
        return model
    distance = 3.0 * max(np.linalg.norm(model.body_ipos, axis=1).max() + model.geom_rbound[1:].max(initial=0.1), 0.3)
    camera = spec.bodies[1].add_camera(name="side", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM)
    tilt = 0.5 * (0.5 * np.pi - np.arctan(0.25))  # it looks along y, and down to the body
    if len(spec.cameras) > 1:
        spec.add_text(name=ADDED, data="side")  # MuJoCo numbers cameras by body: it comes before those of later ones
    camera.pos, camera.quat = [0, -2 * distance, 0.5 * distance], [np.cos(tilt), np.sin(tilt), 0, 0]
    if model.nlight == 0:
        spec.worldbody.add_light(pos=[0, -distance, 4 * distance], dir=[0, 0.25, -1], diffuse=[0.8, 0.8, 0.8])
    return spec.compile()


def cameras(m: mujoco.MjModel) -> list[int]:
    """Returns the ids of a model's cameras in their order; one that :func:`load` added is the last."""
    added = [m.camera("side").id] if mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_TEXT, ADDED) >= 0 else []
    return [i for i in range(m.ncam) if i not in added] + added


def specification(source: Path | str | mujoco.MjSpec, folder: Path | None = None) -> mujoco.MjSpec:
    """Returns what :func:`load` compiles, to be edited, or raises its errors; of a ``mujoco.MjSpec`` a copy."""
    if isinstance(source, mujoco.MjSpec):
        return source.copy()
    if not isinstance(source, Path | str):
        raise TypeError(f"model must be a path of an MJCF file, MJCF text or a mujoco.MjSpec, got {source!r}")
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return read_mjcf(source)
    path = _path(source, folder)
    try:
        return read_mjcf(path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _path(source: Path | str, folder: Path | None) -> Path:
    """Returns the path of an MJCF file."""
    tried = [Path(source) if folder is None else folder / source, Path(source)]
    path = next((path for path in tried if path.is_file()), None)
    if path is None:
        where = " and ".join(dict.fromkeys(str(path.absolute()) for path in tried))
        raise FileNotFoundError(f"there is no model {str(source)!r}: looked for {where}")
    return path


def files(source: Path | str | mujoco.MjSpec, folder: Path | None = None) -> list[Path]:
    """Returns the files of what :func:`load` takes, included ones and meshes too; none for MJCF text and specs."""
    if isinstance(source, mujoco.MjSpec) or (isinstance(source, str) and source.lstrip().startswith("<")):
        return []
    path = _path(source, folder).resolve()
    found, places, names = [path], [path.parent], list[str]()
    for file in found:  # which grows by what is included
        with contextlib.suppress(ElementTree.ParseError):
            for node in ElementTree.parse(file).iter():
                places += [path.parent / node.attrib[name] for name in FOLDERS if name in node.attrib]
                mentioned = [value for name, value in node.items() if name.startswith("file")]
                names += mentioned
                included = [(path.parent / name).resolve() for name in mentioned if node.tag == "include"]
                found += [each for each in included if each.is_file() and each not in found]
    others = [file for name in names for place in places if (file := (place / name).resolve()).is_file()]
    return list(dict.fromkeys([*found, *others]))


def has_home(mj_model: mujoco.MjModel) -> bool:
    """Returns whether a model has a keyframe named ``home``."""
    return "home" in [mj_model.key(i).name for i in range(mj_model.nkey)]


def home_pose(mj_model: mujoco.MjModel) -> np.ndarray:
    """Returns the pose of the keyframe ``home`` of a model, or else its ``qpos0``, ``(nq,)``."""
    return mj_model.key("home").qpos if has_home(mj_model) else mj_model.qpos0


def control(mj_model: mujoco.MjModel, action: np.ndarray) -> np.ndarray:
    """Returns the controls of actions ``(..., nu)``, which are clipped to [-1, 1] and scaled to actuators' ranges."""
    low, high = mj_model.actuator_ctrlrange.T
    return 0.5 * (low + high) + 0.5 * (high - low) * np.clip(action, -1.0, 1.0)


def touch_ground_only(mj_model: mujoco.MjModel) -> None:
    """Takes the contacts of moving bodies with each other out of a model; those with what is fixed stay as they are."""
    m = mj_model
    fixed = m.body_weldid[m.geom_bodyid] == 0
    # Each kind of fixed geoms has a bit of its own, which the moving geoms that touch it accept.
    kinds = sorted({(int(m.geom_contype[g]), int(m.geom_conaffinity[g])) for g in np.flatnonzero(fixed)} - {(0, 0)})
    if len(kinds) > BITS:
        raise ValueError(f"contacts='ground' can do {BITS} kinds of contype and conaffinity of fixed geoms at most")
    for g in range(m.ngeom):
        masks = int(m.geom_contype[g]), int(m.geom_conaffinity[g])
        if fixed[g]:
            bit = 1 << kinds.index(masks) if masks in kinds else 0
            m.geom_contype[g], m.geom_conaffinity[g] = bit, 0
        else:
            touched = (k for k, other in enumerate(kinds) if masks[0] & other[1] or masks[1] & other[0])
            m.geom_contype[g], m.geom_conaffinity[g] = 0, sum(1 << k for k in touched)
    for body in range(m.nbody):
        geoms = m.geom_bodyid == body
        m.body_contype[body] = np.bitwise_or.reduce(m.geom_contype[geoms])
        m.body_conaffinity[body] = np.bitwise_or.reduce(m.geom_conaffinity[geoms])
    moving = ~fixed[m.pair_geom1] & ~fixed[m.pair_geom2]
    m.pair_margin[moving] = NEVER


def check(mj_model: mujoco.MjModel, *, own_control: bool = False) -> mujoco.MjModel:
    """Returns a model, or raises ValueError if it is not supported; with ``own_control`` it needs no ranges."""
    wrong = []
    low, high = mj_model.actuator_ctrlrange.T
    if not own_control and not (low < high).all():
        wrong.append(
            "every actuator needs a ctrlrange, to which actions in [-1, 1] are scaled, or the task a control()"
        )
    unclipped = mj_model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    if not own_control and (unclipped or not mj_model.actuator_ctrllimited.all()):
        wrong.append("actions beyond [-1, 1] must be clipped: leave ctrllimited and the flag clampctrl on")
    if mj_model.actuator_delay.any():
        wrong.append("delays of actuators are not supported: they are not part of the state that is reset")
    if mj_model.sensor_delay.any() or mj_model.sensor_interval.any():
        wrong.append("delays and intervals of sensors are not supported: they are not part of the state that is reset")
    if mj_model.nplastic:
        wrong.append("plastic joints are not supported: their deformation is not part of the state that is reset")
    if (mj_model.dof_frictionloss < 0).any() or (mj_model.tendon_frictionloss < 0).any():
        wrong.append("frictionloss must not be negative: C MuJoCo would drive the joint by it, other engines ignore it")
    disabled = {group for group in range(31) if mj_model.opt.disableactuator >> group & 1}
    if disabled.intersection(mj_model.actuator_group.tolist()):
        wrong.append("groups of actuators cannot be disabled (actuatorgroupdisable): leave the actuators out")
    camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
    for i in range(mj_model.nsensor):
        of_camera = camera in (mj_model.sensor_objtype[i], mj_model.sensor_reftype[i])
        if of_camera or mj_model.sensor_type[i] not in VELOCITY_SENSORS | FORCE_SENSORS:
            name = mj_model.sensor(i).name
            wrong.append(
                f"sensor {name!r} is not evaluated, only velocities, touch, accelerometers, forces and torques are: "
                "hooks have s.actuator_force for what actuators do"
            )
    if wrong:
        raise ValueError("; ".join(wrong))
    return mj_model
