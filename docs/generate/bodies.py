"""What each entry of an observation and an action is. A test computes every entry by C MuJoCo and compares."""

import dataclasses
from collections.abc import Callable, Iterator

import mujoco
import numpy as np

from generate.markdown import table
from generate.tasks import CLASSES
from torchrl_loco.config import PROTOCOLS
from torchrl_loco.sim import models
from torchrl_loco.tasks import humanoid

Value = Callable[[mujoco.MjData], float]


@dataclasses.dataclass(frozen=True)
class Entry:
    """One number of an observation.

    Args:
        name: what it is, in Markdown.
        unit: its unit, empty for pure numbers.
        value: computes it from a state of C MuJoCo; ``None`` for what does not follow from qpos and qvel: activations,
            and forces of the last physics step.
    """

    name: str
    unit: str
    value: Value | None


def observation(body: str, protocol: str) -> list[Entry]:
    """Returns the entries of a body's observation in order."""
    return list(BODIES[body](models.load(CLASSES[body].model), protocol))


def observation_table(body: str) -> str:
    """Returns the table of a body's observation; an entry that depends on the protocol says so."""
    first, second = (observation(body, protocol) for protocol in PROTOCOLS)
    rows = []
    for index, (one, other) in enumerate(zip(first, second, strict=True)):
        if one.name == other.name:
            rows.append((index, one.name, one.unit))
            continue
        names = [f"`{protocol}`: {entry.name}" for protocol, entry in zip(PROTOCOLS, (one, other), strict=True)]
        units = [f"`{p}`: {e.unit}" for p, e in zip(PROTOCOLS, (one, other), strict=True) if e.unit]
        rows.append((index, "; ".join(names), "; ".join(units)))
    return table(("index", "what", "unit"), rows)


def action_table(body: str) -> str:
    """Returns the table of a body's actuators."""
    model = models.load(CLASSES[body].model)
    if model.na:
        return _set_points(model)
    rows = []
    for index in range(model.nu):
        actuator = model.actuator(index)
        joint = model.joint(actuator.trnid[0])
        low, high = np.rad2deg(joint.range)
        control = "[{:g}, {:g}]".format(*actuator.ctrlrange)
        rows.append((index, f"`{joint.name}`", control, f"{actuator.gear[0]:g}", f"{low:.0f} to {high:.0f}"))
    return table(("index", "joint", "action", "gear: torque at 1 (Nm)", "range of the joint (degrees)"), rows)


def _set_points(model: mujoco.MjModel) -> str:
    """Returns the table of actuators that pull joints and tendons to a set point."""
    rows = []
    for index in range(model.nu):
        actuator = model.actuator(index)
        moved = int(actuator.trnid[0])
        if actuator.trntype[0] == mujoco.mjtTrn.mjTRN_JOINT:
            what = f"`{model.joint(moved).name}`"
        else:
            parts = range(model.tendon_adr[moved], model.tendon_adr[moved] + model.tendon_num[moved])
            what = " ".join(f"{model.wrap_prm[i]:+g} `{model.joint(model.wrap_objid[i]).name}`" for i in parts)
        control = "[{:g}, {:g}]".format(*actuator.ctrlrange)
        rows.append((index, f"`{actuator.name}`", what, control))
    return table(("index", "actuator", "what it moves", "control at an action of -1 and 1 (rad)"), rows)


def _walker(model: mujoco.MjModel, protocol: str) -> Iterator[Entry]:
    names = [model.body(i).name for i in range(1, model.nbody)]
    for name in names:
        for axis, column in (("x", 0), ("z", 2)):
            yield Entry(
                f"x component of the {axis} axis of `{name}`", "", lambda d, n=name, c=column: d.body(n).xmat[c]
            )
    if protocol == "dm_control":
        yield Entry("height of `torso`", "m", lambda d: d.body("torso").xpos[2])
    else:
        yield Entry("z component of the z axis of `torso`", "", lambda d: d.body("torso").xmat[8])
    yield from _velocities(model)


def _humanoid(model: mujoco.MjModel, protocol: str) -> Iterator[Entry]:
    yield from _positions(model, 1)
    yield Entry("height of `head`", "m", lambda d: d.body("head").xpos[2])
    for name in humanoid.EXTREMITIES:
        for k, axis in enumerate("xyz"):
            yield Entry(f"{axis} of `{name}` from `torso`, in its frame", "m", lambda d, n=name, k=k: _seen(d, n)[k])
    for k, axis in enumerate("xyz"):
        yield Entry(f"z component of the {axis} axis of `torso`", "", lambda d, k=k: d.body("torso").xmat[6 + k])
    for k, axis in enumerate("xyz"):
        yield Entry(f"{axis} velocity of the center of mass", "m/s", lambda d, k=k: d.sensordata[k])
    for k, axis in enumerate("xyz"):
        yield Entry(f"{axis} velocity of `torso`", "m/s", lambda d, k=k: d.qvel[k])
    for k, axis in enumerate("xyz"):
        name = f"angular velocity of `torso` about its own {axis} axis"
        yield Entry(name, "rad/s", lambda d, k=k: d.qvel[3 + k])
    yield from _velocities(model)


def _cheetah(model: mujoco.MjModel, protocol: str) -> Iterator[Entry]:
    yield from _positions(model, 1)
    yield from _velocities(model)


def _hopper(model: mujoco.MjModel, protocol: str) -> Iterator[Entry]:
    yield from _positions(model, 1)
    yield from _velocities(model)
    for part in ("toe", "heel"):
        yield Entry(f"touch of the {part}", "log(1 + N)", None)


def _quadruped(model: mujoco.MjModel, protocol: str) -> Iterator[Entry]:
    yield from _positions(model, 1)
    yield from _velocities(model)
    for i in range(model.na):
        yield Entry(f"activation of `{model.actuator(i).name}`", "rad", None)
    for k, axis in enumerate("xyz"):
        yield Entry(
            f"velocity of `torso` along its own {axis} axis", "m/s", lambda d, k=k: d.sensor("velocimeter").data[k]
        )
    yield Entry("z component of the z axis of `torso`", "", lambda d: d.body("torso").xmat[8])
    for axis in "xyz":
        yield Entry(f"acceleration of `torso` along its own {axis} axis", "m/s^2", None)
    for k, axis in enumerate("xyz"):
        name = f"angular velocity of `torso` about its own {axis} axis"
        yield Entry(name, "rad/s", lambda d, k=k: d.sensor("imu_gyro").data[k])
    toes = [model.site(i).name for i in range(model.nsite) if model.site(i).name.startswith("toe")]
    for quantity, unit in (("force", "arcsinh(N)"), ("torque", "arcsinh(Nm)")):
        for toe in toes:
            for axis in "xyz":
                yield Entry(f"{quantity} on `{toe}` along its {axis} axis", unit, None)


def _positions(model: mujoco.MjModel, first: int) -> Iterator[Entry]:
    """Yields the positions of slides and hinges, from a joint on."""
    for i in range(first, model.njnt):
        joint = model.joint(i)
        slide = joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE
        name = f"{'position' if slide else 'angle'} of `{joint.name}`"
        yield Entry(name, "m" if slide else "rad", lambda d, k=joint.qposadr[0]: d.qpos[k])


def _velocities(model: mujoco.MjModel) -> Iterator[Entry]:
    """Yields the velocities of slides and hinges."""
    for i in range(model.njnt):
        joint = model.joint(i)
        if joint.type[0] != mujoco.mjtJoint.mjJNT_FREE:
            unit = "m/s" if joint.type[0] == mujoco.mjtJoint.mjJNT_SLIDE else "rad/s"
            yield Entry(f"velocity of `{joint.name}`", unit, lambda d, k=joint.dofadr[0]: d.qvel[k])


def _seen(data: mujoco.MjData, name: str) -> np.ndarray:
    """Returns where a body is in the frame of the torso."""
    torso = data.body("torso")
    return torso.xmat.reshape(3, 3).T @ (data.body(name).xpos - torso.xpos)


BODIES = {"walker": _walker, "humanoid": _humanoid, "cheetah": _cheetah, "hopper": _hopper, "quadruped": _quadruped}
"""What yields the entries of a body's observation from its model and the protocol."""
