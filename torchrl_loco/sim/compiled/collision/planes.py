"""Spheres and capsules on planes of the world, as they are traced: corners, and the frames of their contacts."""

import dataclasses

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.kinds import CAPSULE, PLANE
from torchrl_loco.sim.compiled.collision.pairs import Pair
from torchrl_loco.sim.compiled.ir.symbols import Scalar, array, dot, select, sqrt
from torchrl_loco.sim.compiled.physics.dynamics import Dynamics, Poses, constant_matrix

LEAST_ALIGNED = 1e-6
"""Sine of the angle to a plane's normal below which the direction of a capsule along the plane is rounding."""


@dataclasses.dataclass(frozen=True)
class Corner:
    """A sphere, or an end of a capsule, that may touch a plane.

    Attributes:
        pair: the geoms and their parameters.
        body: that of the sphere or capsule.
        distance: from the plane (m).
        point: of the contact, from the center of mass of the body's tree, ``(3,)`` (m).
        normal: that of the plane, ``(3,)``.
        tangent: the first tangent times the friction coefficient, ``(3,)``.
    """

    pair: Pair
    body: int
    distance: Scalar
    point: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray


def corners(tree: Dynamics, found: list[Pair]) -> list[Corner]:
    """Returns what may touch a plane, in the order of the pairs; of a capsule, the end of its axis comes first."""
    m, result = tree.m, []
    for pair in found:
        plane, geom = pair.geoms
        if m.geom_type[plane] != PLANE:
            continue
        body, (radius, half, _) = int(m.geom_bodyid[geom]), m.geom_size[geom]
        (position, normal), (center, axis) = (geom_pose(m, tree.poses, g) for g in pair.geoms)
        is_capsule = m.geom_type[geom] == CAPSULE
        tangent = frame(normal, axis if is_capsule else None) * pair.friction
        for tip in (center + axis * half, center + axis * -half) if is_capsule else (center,):
            distance = dot(normal, tip - position) - radius
            point = tip - tree.com[body] - normal * (radius + 0.5 * distance)
            result.append(Corner(pair, body, distance, point, normal, tangent))
    return result


def geom_pose(m: mujoco.MjModel, poses: Poses, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns center and z axis of a geom in the world's frame, ``(3,)`` each."""
    body = m.geom_bodyid[geom]
    center = poses.xpos[body] + poses.xmat[body] @ array(m.geom_pos[geom])
    return center, (poses.xmat[body] @ constant_matrix(m.geom_quat[geom]))[:, 2]


def frame(normal: np.ndarray, axis: np.ndarray | None) -> np.ndarray:
    """Returns the first tangent of a contact with a plane, ``(3,)``; the second is normal x first.

    C MuJoCo aligns the first with the axis of a capsule, which a sphere has not, unless that is normal to the plane.
    Tangents that are exchanged or reversed give the same pyramid: where the axis of the capsule stays in one plane with
    the normal, one constant direction serves for all cases.
    """
    n = np.array([x.constant for x in normal])
    fallback = np.eye(3)[1] if -0.5 < n[1] < 0.5 else np.eye(3)[2]
    level = fallback - n * (n @ fallback)
    level /= np.linalg.norm(level)
    sideways = np.cross(level, n)
    if axis is None:
        return array(sideways)
    if np.allclose(level, fallback, atol=1e-12):
        for direction, other in ((sideways, level), (level, sideways)):
            if dot(other, axis).constant == 0:
                return array(direction)
    along = axis - normal * dot(normal, axis)
    length = sqrt(dot(along, along))
    return np.array([select(length, "<", LEAST_ALIGNED, level[i], along[i] / length) for i in range(3)], dtype=object)
