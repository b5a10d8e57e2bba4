"""Velocities of bodies, poses of what is attached to them, and the sensors that are functions of both."""

from typing import Any

import mujoco
import torch

from torchrl_loco.sim.corners import axes_of

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
Sensor, Object = mujoco.mjtSensor, mujoco.mjtObj

# Velocities of bodies: MuJoCo's cvel is that of the point at the center of mass of the body's tree.


def _free_joint(m: mujoco.MjModel, body: int) -> int:
    """Returns the first dof of a body that floats, and -1 for any other."""
    floats = m.body_parentid[body] == 0 and m.body_jntnum[body] == 1 and m.jnt_type[m.body_jntadr[body]] == FREE
    return int(m.body_dofadr[body]) if body and floats else -1


def linear_velocity(s: Any, bodies: list[int], one: bool) -> torch.Tensor:
    """Returns velocities of the origins of bodies, world frame (m/s), ``(num_envs, 3)`` or ``(num_envs, count, 3)``."""
    m, pick = s._catalog.mj_model, s._catalog.pick
    if one and (dof := _free_joint(m, bodies[0])) >= 0:
        return s.qvel[:, dof : dof + 3]
    velocity = pick(s._array("cvel"), bodies, one)
    center = pick(s._array("subtree_com"), [int(m.body_rootid[body]) for body in bodies], one)
    lever = pick(s._array("xpos"), bodies, one) - center
    return velocity[..., 3:] + torch.linalg.cross(velocity[..., :3], lever)


def angular_velocity(s: Any, bodies: list[int], one: bool) -> torch.Tensor:
    """Returns angular velocities of bodies, world frame (rad/s), shaped as :func:`linear_velocity`."""
    m = s._catalog.mj_model
    if one and (dof := _free_joint(m, bodies[0])) >= 0:  # that of a free joint is in the body's frame
        xmat = s._catalog.pick(s._array("xmat"), bodies, one)
        return (xmat * s.qvel[:, None, dof + 3 : dof + 6]).sum(-1)
    return s._catalog.pick(s._array("cvel"), bodies, one)[..., :3]


# What is attached to a body: sites, geoms, its inertial frame.


def _offset(s: Any, kind: str, ids: list[int]) -> tuple[list[int], torch.Tensor, torch.Tensor]:
    """Returns bodies of attached elements, and their positions ``(count, 3)`` and axes ``(count, 3, 3)`` there."""
    m, key = s._catalog.mj_model, tuple(ids)
    if kind == "inertia":
        bodies, position, quaternion = list(ids), m.body_ipos, m.body_iquat
    else:
        bodies = [int(body) for body in getattr(m, f"{kind}_bodyid")[ids]]
        position, quaternion = getattr(m, f"{kind}_pos"), getattr(m, f"{kind}_quat")
    axes = s._catalog.derived((kind, "axes", key), lambda: [axes_of(quaternion[i]) for i in ids])
    return bodies, s._catalog.derived((kind, "position", key), lambda: position[ids]), axes


def _lever(s: Any, kind: str, ids: list[int], one: bool) -> tuple[list[int], torch.Tensor]:
    """Returns bodies, and vectors from their origins to what is attached, world frame (m)."""
    bodies, position, _ = _offset(s, kind, ids)
    xmat = s._catalog.pick(s._array("xmat"), bodies, one)
    return bodies, (xmat * (position[0] if one else position).unsqueeze(-2)).sum(-1)


def attached_position(s: Any, kind: str, ids: list[int], one: bool) -> torch.Tensor:
    """Returns positions of sites, geoms or centers of inertia (m), ``(num_envs, 3)`` or ``(num_envs, count, 3)``."""
    bodies, lever = _lever(s, kind, ids, one)
    return s._catalog.pick(s._array("xpos"), bodies, one) + lever


def attached_orientation(s: Any, kind: str, ids: list[int], one: bool) -> torch.Tensor:
    """Returns orientations of the same, ``(num_envs, 3, 3)`` or ``(num_envs, count, 3, 3)``."""
    bodies, _, axes = _offset(s, kind, ids)
    xmat = s._catalog.pick(s._array("xmat"), bodies, one)
    return (xmat.unsqueeze(-1) * (axes[0] if one else axes).unsqueeze(-3)).sum(-2)


def attached_velocity(s: Any, kind: str, ids: list[int], one: bool) -> torch.Tensor:
    """Returns velocities of the same, world frame (m/s), shaped as their positions."""
    bodies, lever = _lever(s, kind, ids, one)
    return linear_velocity(s, bodies, one) + torch.linalg.cross(angular_velocity(s, bodies, one), lever)


# Sensors.


class Frame:
    """What a sensor is attached to: pose and velocity of a body, site, geom or center of inertia; or of the world.

    Args:
        s: the worlds.
        kind: MuJoCo's kind of object.
        index: its id.
    """

    def __init__(self, s: Any, kind: int, index: int) -> None:
        kinds = {Object.mjOBJ_SITE: "site", Object.mjOBJ_GEOM: "geom", Object.mjOBJ_BODY: "inertia"}
        self.s, self.kind, self.index = s, {int(key): name for key, name in kinds.items()}.get(kind, ""), index
        m = s._catalog.mj_model
        self.body = int(getattr(m, f"{self.kind}_bodyid")[index]) if self.kind in ("site", "geom") else index

    @property
    def position(self) -> torch.Tensor:
        """Position (m), ``(num_envs, 3)``."""
        s = self.s
        return attached_position(s, self.kind, [self.index], True) if self.kind else s._array("xpos")[:, self.index]

    @property
    def axes(self) -> torch.Tensor:
        """Orientation, ``(num_envs, 3, 3)``."""
        s = self.s
        return attached_orientation(s, self.kind, [self.index], True) if self.kind else s._array("xmat")[:, self.index]

    @property
    def velocity(self) -> torch.Tensor:
        """Velocity, world frame (m/s), ``(num_envs, 3)``."""
        if not self.kind:
            return linear_velocity(self.s, [self.index], True)
        return attached_velocity(self.s, self.kind, [self.index], True)

    @property
    def rotation(self) -> torch.Tensor:
        """Angular velocity, world frame (rad/s), ``(num_envs, 3)``."""
        return angular_velocity(self.s, [self.body], True)


FRAMES = {int(kind) for kind in (Object.mjOBJ_BODY, Object.mjOBJ_XBODY, Object.mjOBJ_SITE, Object.mjOBJ_GEOM)}
"""Kinds of objects that a sensor can be attached to here."""

AXES = {int(Sensor.mjSENS_FRAMEXAXIS): 0, int(Sensor.mjSENS_FRAMEYAXIS): 1, int(Sensor.mjSENS_FRAMEZAXIS): 2}


def evaluate(s: Any, sensor: int) -> torch.Tensor | None:
    """Returns a sensor that is a function of pose and velocity, ``(num_envs, size)``; ``None`` for any other."""
    m = s._catalog.mj_model
    if m.sensor_interval[sensor].any() or m.sensor_delay[sensor]:
        return None
    values = _evaluate(s, int(m.sensor_type[sensor]), sensor)
    cutoff = float(m.sensor_cutoff[sensor])
    return values.clamp(-cutoff, cutoff) if values is not None and cutoff > 0 else values


def _evaluate(s: Any, kind: int, sensor: int) -> torch.Tensor | None:
    m = s._catalog.mj_model
    index, of = int(m.sensor_objid[sensor]), int(m.sensor_objtype[sensor])
    if kind in (Sensor.mjSENS_JOINTPOS, Sensor.mjSENS_JOINTVEL):
        address = m.jnt_qposadr if kind == Sensor.mjSENS_JOINTPOS else m.jnt_dofadr
        values = s.qpos if kind == Sensor.mjSENS_JOINTPOS else s.qvel
        return values[:, int(address[index])].unsqueeze(-1)
    if of not in FRAMES:
        return None
    frame = Frame(s, of, index)
    if kind == Sensor.mjSENS_GYRO:
        return into_frame(frame.axes, frame.rotation)
    if kind == Sensor.mjSENS_VELOCIMETER:
        return into_frame(frame.axes, frame.velocity)
    reference = int(m.sensor_refid[sensor])
    if reference >= 0 and int(m.sensor_reftype[sensor]) not in FRAMES:
        return None
    base = Frame(s, int(m.sensor_reftype[sensor]), reference) if reference >= 0 else None
    return _of_frames(kind, frame, base)


def _of_frames(kind: int, frame: Frame, base: Frame | None) -> torch.Tensor | None:
    def seen(vector: torch.Tensor) -> torch.Tensor:
        return vector if base is None else into_frame(base.axes, vector)

    if kind == Sensor.mjSENS_FRAMEPOS:
        return seen(frame.position if base is None else frame.position - base.position)
    if kind in AXES:
        return seen(frame.axes[..., AXES[kind]])
    if kind == Sensor.mjSENS_FRAMEQUAT:
        axes = frame.axes if base is None else base.axes.transpose(-1, -2) @ frame.axes
        return to_quaternion(axes)
    if kind == Sensor.mjSENS_FRAMEANGVEL:
        return seen(frame.rotation if base is None else frame.rotation - base.rotation)
    if kind == Sensor.mjSENS_FRAMELINVEL:
        if base is None:
            return frame.velocity
        carried = torch.linalg.cross(base.rotation, frame.position - base.position)
        return seen(frame.velocity - base.velocity - carried)
    return None


def into_frame(xmat: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Returns vectors of the world ``(num_envs, ..., 3)`` in frames with the axes ``xmat`` ``(num_envs, 3, 3)``."""
    between = vectors.ndim - 2
    axes = xmat.view(xmat.shape[0], *[1] * between, 3, 3)
    return (axes * vectors.unsqueeze(-1)).sum(-2)


def to_quaternion(axes: torch.Tensor) -> torch.Tensor:
    """Returns the quaternions (w, x, y, z), w >= 0, of orientations ``(num_envs, 3, 3)``.

    MuJoCo's framequat may have the other sign, which is the same orientation.
    """
    x, y, z = (axes[..., i, i] for i in range(3))
    squares = 0.25 * torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], dim=-1)
    a, b, c = (axes[..., i, j] - axes[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (axes[..., i, j] + axes[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    w2, x2, y2, z2 = (4 * squares).unbind(-1)
    rows = torch.stack(
        [
            torch.stack([w2, a, b, c], dim=-1),
            torch.stack([a, x2, d, e], dim=-1),
            torch.stack([b, d, y2, f], dim=-1),
            torch.stack([c, e, f, z2], dim=-1),
        ],
        dim=-2,
    )
    largest = squares.argmax(dim=-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    found: Any = rows.gather(-2, largest).squeeze(-2)
    found = found / found.norm(dim=-1, keepdim=True)
    return torch.where(found[..., :1] < 0, -found, found)
