"""Rigid links: bodies that are welded together."""

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.ir.parameters import Number, present, varies
from torchrl_loco.sim.corners import axes_of


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a body is: in a link, or in the world if ``link`` is -1.

    Attributes:
        link: index of the link.
        position: of the body in the frame of the link, ``(3,)`` (m).
        quaternion: the same for its orientation, ``(4,)``.
    """

    link: int
    position: np.ndarray
    quaternion: np.ndarray

    def point(self, offset: np.ndarray) -> np.ndarray:
        """Returns a point of the body in the frame of the link."""
        return self.position + matrix(self.quaternion) @ offset

    def turn(self, quaternion: np.ndarray) -> np.ndarray:
        """Returns an orientation in the body as one in the link."""
        result = np.empty(4)
        mujoco.mju_mulQuat(result, self.quaternion, quaternion)
        return result


@dataclasses.dataclass
class Mass:
    """Mass, center and moments of inertia of a part of a link, in its frame: constants, or scalars where they vary."""

    mass: Number
    center: np.ndarray
    moments: np.ndarray

    @classmethod
    def join(cls, m: mujoco.MjModel, places: Sequence[Place], bodies: Sequence[int]) -> "Mass":
        """Returns several bodies of one link as one."""
        masses = m.body_mass[bodies]
        centers = np.array([places[b].point(m.body_ipos[b]) for b in bodies])
        mass = masses.sum()
        center = masses @ centers / mass if len(bodies) > 1 and present(masses) else centers[0]
        moments = np.zeros((3, 3))
        for b, d in zip(bodies, centers - center, strict=True):
            axes = matrix(places[b].turn(m.body_iquat[b]))
            moments = moments + axes @ np.diag(m.body_inertia[b]) @ axes.T
            moments = moments + m.body_mass[b] * (d @ d * np.eye(3) - np.outer(d, d))
        return cls(mass if varies(mass) else float(mass), center, moments)


def matrix(quaternion: np.ndarray) -> np.ndarray:
    """Returns the matrix of a quaternion, exact zeros where rounding left something else."""
    result = axes_of(np.asarray(quaternion, float))
    result[np.abs(result) < 1e-12] = 0
    return result


def moved_by(m: mujoco.MjModel) -> list[int]:
    """Returns for each body a bit for each degree of freedom that moves it."""
    found = [0]
    for body in range(1, m.nbody):
        first = m.body_dofadr[body]
        own = sum(1 << dof for dof in range(first, first + m.body_dofnum[body]))
        found.append(found[m.body_parentid[body]] | own)
    return found


def moving_bodies(m: mujoco.MjModel) -> list[int]:
    """Returns the bodies that have joints, each the first body of a link."""
    return [b for b in range(1, m.nbody) if m.body_dofnum[b]]


def places(m: mujoco.MjModel) -> list[Place]:
    """Returns where each body is."""
    links = {b: i for i, b in enumerate(moving_bodies(m))}
    found = [Place(-1, np.zeros(3), np.array([1.0, 0, 0, 0]))]
    for b in range(1, m.nbody):
        parent = found[m.body_parentid[b]]
        if b in links:
            found.append(Place(links[b], np.zeros(3), np.array([1.0, 0, 0, 0])))
        else:
            found.append(Place(parent.link, parent.point(m.body_pos[b]), parent.turn(m.body_quat[b])))
    return found
