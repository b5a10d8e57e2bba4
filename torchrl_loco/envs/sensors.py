"""Velocities of bodies, poses of what is attached to them, and the sensors that are functions of both."""

from typing import Any

import mujoco
import torch

from torchrl_loco.sim.corners import axes_of

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
Sensor, Object = mujoco.mjtSensor, mujoco.mjtObj


class Frames:
    """Frames of bodies, or of what is attached to them: a kind of ``"body"``, ``"site"``, ``"geom"`` or ``"inertia"``.

    The ids of centers of inertia are those of the bodies. ``one`` that is named alone has no dimension of its own.
    """

    def __init__(self, s: Any, kind: str, ids: list[int], one: bool) -> None:
        self._s, self._kind, self._ids, self._one, m = s, kind, ids, one, s._catalog.mj_model
        self._bodies = [int(b) for b in getattr(m, f"{kind}_bodyid")[ids]] if kind in ("site", "geom") else ids

    def _pick(self, name: str) -> torch.Tensor:
        return self._s._catalog.pick(self._s._array(name), self._bodies, self._one)

    def _there(self, what: str) -> torch.Tensor:
        """Returns where they are in the frames of their bodies, their ``"pos"`` or their axes by ``"quat"``."""
        catalog, name = self._s._catalog, f"{'body_i' if self._kind == 'inertia' else f'{self._kind}_'}{what}"
        if what == "pos" and catalog.variation is not None and name in catalog.variation.varied.places:
            return catalog.pick(self._s.model(name), self._ids, self._one)
        field = getattr(catalog.mj_model, name)

        def numbers() -> Any:
            return field[self._ids] if what == "pos" else [axes_of(field[i]) for i in self._ids]

        there = catalog.derived((self._kind, what, tuple(self._ids)), numbers)
        return there[0] if self._one else there

    def _lever(self) -> torch.Tensor:
        """Returns vectors from the origins of their bodies to them, world frame (m)."""
        return (self._pick("xmat") * self._there("pos").unsqueeze(-2)).sum(-1)

    @property
    def position(self) -> torch.Tensor:
        """Positions (m), ``(num_envs, 3)`` or ``(num_envs, count, 3)``."""
        return self._pick("xpos") if self._kind == "body" else self._pick("xpos") + self._lever()

    @property
    def axes(self) -> torch.Tensor:
        """Orientations, ``(num_envs, 3, 3)`` or ``(num_envs, count, 3, 3)``."""
        if self._kind == "body":
            return self._pick("xmat")
        return (self._pick("xmat").unsqueeze(-1) * self._there("quat").unsqueeze(-3)).sum(-2)

    @property
    def velocity(self) -> torch.Tensor:
        """Velocities, world frame (m/s), shaped as their positions."""
        if (dof := self._free_joint()) >= 0:
            velocity = self._s.qvel[:, dof : dof + 3]
        else:  # MuJoCo's cvel is that of the point at the center of mass of the body's tree
            catalog, cvel = self._s._catalog, self._pick("cvel")
            roots = [int(catalog.mj_model.body_rootid[body]) for body in self._bodies]
            center = catalog.pick(self._s._array("subtree_com"), roots, self._one)
            velocity = cvel[..., 3:] + torch.linalg.cross(cvel[..., :3], self._pick("xpos") - center)
        return velocity if self._kind == "body" else velocity + torch.linalg.cross(self.rotation, self._lever())

    @property
    def rotation(self) -> torch.Tensor:
        """Angular velocities, world frame (rad/s), shaped as their positions."""
        if (dof := self._free_joint()) >= 0:  # that of a free joint is in the body's frame
            return (self._pick("xmat") * self._s.qvel[:, None, dof + 3 : dof + 6]).sum(-1)
        return self._pick("cvel")[..., :3]

    def _free_joint(self) -> int:
        """Returns the first dof of one body that floats, else -1."""
        m, body = self._s._catalog.mj_model, self._bodies[0]
        floats = m.body_parentid[body] == 0 and m.body_jntnum[body] == 1 and m.jnt_type[m.body_jntadr[body]] == FREE
        return int(m.body_dofadr[body]) if self._one and body and floats else -1


# Sensors.

FRAMES = {
    int(Object.mjOBJ_BODY): "inertia",
    int(Object.mjOBJ_XBODY): "body",
    int(Object.mjOBJ_SITE): "site",
    int(Object.mjOBJ_GEOM): "geom",
}
"""Kinds of objects that a sensor can be attached to here."""

AXES = {int(Sensor.mjSENS_FRAMEXAXIS): 0, int(Sensor.mjSENS_FRAMEYAXIS): 1, int(Sensor.mjSENS_FRAMEZAXIS): 2}


def evaluate(s: Any, sensor: int) -> torch.Tensor | None:
    """Returns a sensor that is a function of pose and velocity, ``(num_envs, size)``; ``None`` for any other."""
    m = s._catalog.mj_model
    values = _evaluate(s, int(m.sensor_type[sensor]), sensor)
    cutoff = float(m.sensor_cutoff[sensor])
    return values.clamp(-cutoff, cutoff) if values is not None and cutoff > 0 else values


def _evaluate(s: Any, kind: int, sensor: int) -> torch.Tensor | None:
    m = s._catalog.mj_model
    index, of = int(m.sensor_objid[sensor]), int(m.sensor_objtype[sensor])
    reference, of_reference = int(m.sensor_refid[sensor]), int(m.sensor_reftype[sensor])
    if kind == Sensor.mjSENS_JOINTPOS:
        return s.qpos[:, int(m.jnt_qposadr[index])].unsqueeze(-1)
    if kind == Sensor.mjSENS_JOINTVEL:
        return s.qvel[:, int(m.jnt_dofadr[index])].unsqueeze(-1)
    if of not in FRAMES or (reference >= 0 and of_reference not in FRAMES):
        return None
    frame = Frames(s, FRAMES[of], [index], True)
    if kind == Sensor.mjSENS_GYRO:
        return into_frame(frame.axes, frame.rotation)
    if kind == Sensor.mjSENS_VELOCIMETER:
        return into_frame(frame.axes, frame.velocity)
    base = Frames(s, FRAMES[of_reference], [reference], True) if reference >= 0 else None

    def seen(vector: torch.Tensor) -> torch.Tensor:
        return vector if base is None else into_frame(base.axes, vector)

    if kind == Sensor.mjSENS_FRAMEPOS:
        return seen(frame.position if base is None else frame.position - base.position)
    if kind in AXES:
        return seen(frame.axes[..., AXES[kind]])
    if kind == Sensor.mjSENS_FRAMEQUAT:
        return to_quaternion(frame.axes if base is None else base.axes.transpose(-1, -2) @ frame.axes)
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


def out_of_frame(xmat: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Returns vectors ``(num_envs, 3)`` in frames with the axes ``xmat`` ``(num_envs, 3, 3)`` in the world's."""
    return (xmat * vectors.unsqueeze(-2)).sum(-1)


def to_quaternion(axes: torch.Tensor) -> torch.Tensor:
    """Returns the quaternions (w, x, y, z), w >= 0, of orientations ``(num_envs, 3, 3)``.

    MuJoCo's framequat may have the other sign, which is the same orientation.
    """
    x, y, z = (axes[..., i, i] for i in range(3))
    squares = 0.25 * torch.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], dim=-1)
    a, b, c = (axes[..., i, j] - axes[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    d, e, f = (axes[..., i, j] + axes[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    w2, x2, y2, z2 = (4 * squares).unbind(-1)
    rows = torch.stack([w2, a, b, c, a, x2, d, e, b, d, y2, f, c, e, f, z2], dim=-1).unflatten(-1, (4, 4))
    largest = squares.argmax(dim=-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    found: Any = rows.gather(-2, largest).squeeze(-2)
    found = found / found.norm(dim=-1, keepdim=True)
    return torch.where(found[..., :1] < 0, -found, found)
