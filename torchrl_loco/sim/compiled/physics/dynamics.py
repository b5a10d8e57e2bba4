"""Rigid-body dynamics of a kinematic tree, traced for one model.

Spatial vectors are those of ``spatial``, about the center of mass of their tree. Bodies come in the order of the model:
parents before children.
"""

import dataclasses
import itertools

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.ir.parameters import nominal, present, varies
from torchrl_loco.sim.compiled.ir.symbols import Block, Scalar, array, dot, identity, scalar, sincos, sqrt, total, zeros
from torchrl_loco.sim.compiled.physics.actuators import Actuator, acting
from torchrl_loco.sim.compiled.physics.links import matrix
from torchrl_loco.sim.compiled.physics.spatial import Inertia, cross_force, cross_motion, turning

FREE, BALL, SLIDE, HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE")
)
MINVAL = 1e-15  # MuJoCo's mjMINVAL
SAME = 1e-9  # relative difference below which two numbers of a model count as equal


# Rotations.


def rotation(axis: np.ndarray, angle: Scalar) -> np.ndarray:
    """Returns the matrix of a rotation about a constant axis, a unit vector (Rodrigues' formula)."""
    sine, cosine = sincos(angle)
    along = np.flatnonzero(np.abs(axis) > SAME)
    if len(along) == 1:  # a coordinate axis
        k = int(along[0])
        i, j, sine = (k + 1) % 3, (k + 2) % 3, sine * np.sign(axis[k])
        turn = zeros(3, 3)
        turn[k, k], turn[i, i], turn[j, j] = scalar(1), cosine, cosine
        turn[i, j], turn[j, i] = -sine, sine
        return turn
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return identity(3) + skew * sine + (skew @ skew) * (1 - cosine)


def quaternion_matrix(q: list[Scalar]) -> np.ndarray:
    """Returns the matrix of a quaternion (w, x, y, z), which is normalised first."""
    scale = 1 / sqrt(dot(q, q))
    w, x, y, z = (component * scale for component in q)
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ],
        dtype=object,
    )


def constant_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Returns the matrix of a constant quaternion (w, x, y, z), as scalars."""
    return array(matrix(quaternion))


# The tree.


@dataclasses.dataclass(frozen=True)
class Poses:
    """Where everything is, in the world's frame.

    Attributes:
        xpos: positions of the bodies, ``(3,)`` each (m).
        xmat: orientations of the bodies, ``(3, 3)`` each.
        anchor: anchors of the joints, ``(3,)`` each (m).
        axis: axes of the hinges and slides, ``(3,)`` each; zero for others.
    """

    xpos: list[np.ndarray]
    xmat: list[np.ndarray]
    anchor: list[np.ndarray]
    axis: list[np.ndarray]


def kinematics(m: mujoco.MjModel, qpos: list[Scalar]) -> Poses:
    """Returns the poses of bodies and joints (forward kinematics, MuJoCo's ``mj_kinematics``)."""
    xpos, xmat = [zeros(3)] * m.nbody, [identity(3)] * m.nbody
    anchor, axis = [zeros(3)] * m.njnt, [zeros(3)] * m.njnt
    for body in range(1, m.nbody):
        parent = m.body_parentid[body]
        joints = range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body])
        position = xpos[parent] + xmat[parent] @ array(m.body_pos[body])
        orientation = xmat[parent] @ constant_matrix(m.body_quat[body])
        for j in joints:
            q, kind, offset = m.jnt_qposadr[j], m.jnt_type[j], array(m.jnt_pos[j])
            if kind == FREE:
                position, orientation = np.array(qpos[q : q + 3], dtype=object), quaternion_matrix(qpos[q + 3 : q + 7])
                anchor[j] = position
                continue
            anchor[j] = position + orientation @ offset
            if kind == BALL:
                orientation = orientation @ quaternion_matrix(qpos[q : q + 4])
            else:
                axis[j] = orientation @ array(m.jnt_axis[j])
                displacement = qpos[q] - m.qpos0[q]
                if kind == SLIDE:
                    position = position + axis[j] * displacement
                    continue
                orientation = orientation @ rotation(m.jnt_axis[j], displacement)
            position = anchor[j] - orientation @ offset
        xpos[body], xmat[body] = position, orientation
    return Poses(xpos, xmat, anchor, axis)


class Dynamics:
    """Inertias, motion subspaces and smooth forces of a model at a state; without controls there is no actuation.

    Attributes:
        poses: where everything is.
        com: center of mass of each body's tree, the origin of its spatial vectors, ``(3,)`` each (m).
        inertia: spatial inertia of each body.
        cdof: motion subspace of each degree of freedom, ``(6,)`` each.
        force: smooth generalised force: passive, actuation, minus bias, ``(nv,)``.
    """

    def __init__(self, m: mujoco.MjModel, qpos: list[Scalar], qvel: list[Scalar], ctrl: list[Scalar] | None) -> None:
        self.m = m
        self.poses = kinematics(m, qpos)
        self.com = self._centers_of_mass()
        self.inertia = [self._inertia(body) for body in range(m.nbody)]
        self.cdof = self._motion_subspaces()
        bias = self._bias_force(qvel)
        passive = self._passive_force(qpos, qvel)
        actuation = [scalar(0)] * m.nv if ctrl is None else self._actuator_force(qpos, qvel, ctrl)
        self.force = [passive[i] + actuation[i] - bias[i] for i in range(m.nv)]

    def keep(self, block: Block) -> None:
        """Computes inertias and motion subspaces in ``block``, so that inner blocks share them."""
        inertias = [part for inertia in self.inertia[1:] for part in (*inertia.rotational, inertia.first)]
        for x in itertools.chain(*self.cdof, *inertias):
            block.value(x)

    def dofs(self, body: int) -> range:
        """Returns the degrees of freedom between a body and its parent."""
        first = self.m.body_dofadr[body]
        return range(first, first + self.m.body_dofnum[body])

    def _centers_of_mass(self) -> list[np.ndarray]:
        m, poses = self.m, self.poses
        centers = [poses.xpos[b] + poses.xmat[b] @ array(m.body_ipos[b]) for b in range(m.nbody)]
        self.xipos = centers
        trees = {root: np.flatnonzero(m.body_rootid == root) for root in set(m.body_rootid)}
        com = {
            root: total(m.body_mass[b] * centers[b] for b in bodies) / m.body_mass[bodies].sum()
            if present(m.body_mass[bodies])
            else poses.xpos[root]
            for root, bodies in trees.items()
        }
        return [com[root] for root in m.body_rootid]

    def _inertia(self, body: int) -> Inertia:
        """Returns the spatial inertia of a body (MuJoCo's ``cinert``)."""
        m = self.m
        axes = self.poses.xmat[body] @ constant_matrix(m.body_iquat[body])
        moments, mass, d = m.body_inertia[body], m.body_mass[body], self.xipos[body] - self.com[body]
        # R diag(I) R' = I_k 1 + sum over the axes whose moment differs from I_k: a body of revolution needs one.
        same = _same_moments(moments, nominal(m).body_inertia[body])
        k = max(range(3), key=lambda i: sum(same[i]))
        rotational = identity(3) * moments[k]
        for i in range(3):
            if not same[i][k]:
                rotational = rotational + (moments[i] - moments[k]) * outer(axes[:, i])
        return Inertia.moved(rotational, scalar(mass), d)

    def _motion_subspaces(self) -> list[np.ndarray]:
        """Returns the motion of the tree for a unit velocity of each degree of freedom (MuJoCo's ``cdof``)."""
        m, cdof = self.m, []
        for j in range(m.njnt):
            body, anchor = m.jnt_bodyid[j], self.poses.anchor[j]
            lever = self.com[body] - anchor
            if m.jnt_type[j] == FREE:
                cdof += [np.concatenate([zeros(3), unit]) for unit in identity(3)]
            if m.jnt_type[j] in (FREE, BALL):
                cdof += [turning(axis, lever) for axis in self.poses.xmat[body].T]
            elif m.jnt_type[j] == SLIDE:
                cdof.append(np.concatenate([zeros(3), self.poses.axis[j]]))
            elif m.jnt_type[j] == HINGE:
                cdof.append(turning(self.poses.axis[j], lever))
        return cdof

    def _bias_force(self, qvel: list[Scalar]) -> list[Scalar]:
        """Returns Coriolis, centrifugal and gravitational forces (recursive Newton-Euler, Featherstone chapter 5)."""
        m = self.m
        velocity, acceleration, force = [zeros(6)] * m.nbody, [zeros(6)] * m.nbody, [zeros(6)] * m.nbody
        acceleration[0] = np.concatenate([zeros(3), -array(m.opt.gravity)])
        for body in range(1, m.nbody):
            v, a = velocity[m.body_parentid[body]], acceleration[m.body_parentid[body]]
            for j in range(m.body_jntadr[body], m.body_jntadr[body] + m.body_jntnum[body]):
                first = m.jnt_dofadr[j]
                if m.jnt_type[j] == FREE:  # translation, whose axes do not move
                    v = v + total(self.cdof[d] * qvel[d] for d in range(first, first + 3))
                    first += 3
                rotating = range(first, first + (3 if m.jnt_type[j] in (FREE, BALL) else 1))
                a = a + total(cross_motion(v, self.cdof[d]) * qvel[d] for d in rotating)
                v = v + total(self.cdof[d] * qvel[d] for d in rotating)
            velocity[body], acceleration[body] = v, a
            force[body] = self.inertia[body] @ a + cross_force(v, self.inertia[body] @ v)
        self.cvel = velocity
        for body in reversed(range(1, m.nbody)):
            force[m.body_parentid[body]] = force[m.body_parentid[body]] + force[body]
        return [dot(self.cdof[d], force[m.dof_bodyid[d]]) for d in range(m.nv)]

    def _passive_force(self, qpos: list[Scalar], qvel: list[Scalar]) -> list[Scalar]:
        """Returns the forces of springs and dampers in the joints (MuJoCo's ``qfrc_passive``)."""
        m = self.m
        force = [-m.dof_damping[d] * qvel[d] for d in range(m.nv)]
        for j in range(m.njnt):
            if m.jnt_stiffness[j]:
                q, d = m.jnt_qposadr[j], m.jnt_dofadr[j]
                force[d] = force[d] - m.jnt_stiffness[j] * (qpos[q] - m.qpos_spring[q])
        return force

    def _actuator_force(self, qpos: list[Scalar], qvel: list[Scalar], ctrl: list[Scalar]) -> list[Scalar]:
        """Returns the forces of the actuators at the joints (MuJoCo's ``qfrc_actuator``)."""
        m, force = self.m, [scalar(0)] * self.m.nv
        for i in acting(m):
            j, actuator = m.actuator_trnid[i, 0], Actuator.of(m, i)
            q, d = m.jnt_qposadr[j], m.jnt_dofadr[j]
            force[d] = force[d] + actuator.gear * actuator.force(ctrl[i], qpos[q], qvel[d])
        return force

    def twists(self, x: list[Scalar]) -> list[np.ndarray]:
        """Returns the velocity of each body, ``(6,)`` each, for velocities ``x`` of the joints."""
        twist = [zeros(6)] * self.m.nbody
        for body in range(1, self.m.nbody):
            twist[body] = twist[self.m.body_parentid[body]] + total(self.cdof[d] * x[d] for d in self.dofs(body))
        return twist

    def mass_times(self, x: list[Scalar]) -> list[Scalar]:
        """Returns M x without M: the forces that accelerate the tree from rest (Newton-Euler without velocities)."""
        m, twist, force = self.m, self.twists(x), [zeros(6)] * self.m.nbody
        for body in reversed(range(1, m.nbody)):
            force[body] = force[body] + self.inertia[body] @ twist[body]
            force[m.body_parentid[body]] = force[m.body_parentid[body]] + force[body]
        return [dot(self.cdof[d], force[m.dof_bodyid[d]]) + m.dof_armature[d] * x[d] for d in range(m.nv)]

    def diagonal(self, stiffness: list[np.ndarray], added: list[Scalar]) -> list[Scalar]:
        """Returns the diagonal of M + K, of which :class:`ArticulatedFactor` takes the same."""
        m = self.m
        composite = [zeros(6, 6), *(self.inertia[b].matrix() + stiffness[b] for b in range(1, m.nbody))]
        for body in reversed(range(1, m.nbody)):
            if parent := m.body_parentid[body]:
                composite[parent] = composite[parent] + composite[body]
        along = [dot(self.cdof[d], composite[m.dof_bodyid[d]] @ self.cdof[d]) for d in range(m.nv)]
        return [x + m.dof_armature[d] + added[d] for d, x in enumerate(along)]


class ArticulatedFactor:
    """Factor of M + K by articulated-body inertias (Featherstone chapter 7), from the leaves to the root.

    A force of stiffness A at a body acts in H = M + J'AJ as if it added A to the inertia of the body, so contacts with
    the world cost no more than inertia does, and neither M nor H is formed. K is a ``stiffness``, symmetric ``(6, 6)``,
    at each body, and what is added to the ``diagonal``.

    Attributes:
        projected: articulated inertia times the motion subspace of each degree of freedom, ``(6,)`` each.
        inverse: one over the articulated inertia along each degree of freedom.
    """

    def __init__(self, tree: Dynamics, stiffness: list[np.ndarray], diagonal: list[Scalar]) -> None:
        m, self.tree = tree.m, tree
        self.projected: list = [None] * m.nv
        self.inverse: list = [None] * m.nv
        articulated = [zeros(6, 6), *(tree.inertia[b].matrix() + stiffness[b] for b in range(1, m.nbody))]
        for body in reversed(range(1, m.nbody)):
            inertia = articulated[body]
            for d in reversed(tree.dofs(body)):
                projected = inertia @ tree.cdof[d]
                pivot = dot(tree.cdof[d], projected) + m.dof_armature[d] + diagonal[d]
                if pivot.constant is not None:  # of joints that do the same: MuJoCo divides by mjMINVAL too
                    pivot = scalar(max(pivot.constant, MINVAL))
                inverse = 1 / pivot
                inertia = inertia - outer(projected, projected * inverse)
                self.projected[d], self.inverse[d] = projected, inverse
            parent = m.body_parentid[body]
            articulated[parent] = articulated[parent] + inertia if parent else articulated[parent]

    def keep(self, block: Block) -> None:
        """Computes the factor in ``block``, so that inner blocks can solve with it."""
        self.inverse = [block.keep(inverse) for inverse in self.inverse]
        self.projected = [block.keep(projected) for projected in self.projected]

    def solve(self, x: list[Scalar]) -> list[Scalar]:
        """Returns (M + K)^-1 x: forces from the leaves to the root, then accelerations back."""
        m, tree = self.tree.m, self.tree
        force, acceleration = [zeros(6)] * m.nbody, [zeros(6)] * m.nbody
        reduced, result = [scalar(0)] * m.nv, [scalar(0)] * m.nv
        for body in reversed(range(1, m.nbody)):
            for d in reversed(tree.dofs(body)):
                reduced[d] = (x[d] - dot(tree.cdof[d], force[body])) * self.inverse[d]
                force[body] = force[body] + self.projected[d] * reduced[d]
            force[m.body_parentid[body]] = force[m.body_parentid[body]] + force[body]
        for body in range(1, m.nbody):
            acceleration[body] = acceleration[m.body_parentid[body]]
            for d in tree.dofs(body):
                result[d] = reduced[d] - dot(self.projected[d], acceleration[body]) * self.inverse[d]
                acceleration[body] = acceleration[body] + tree.cdof[d] * result[d]
        return result


def _same_moments(moments: np.ndarray, at_nominal: np.ndarray) -> np.ndarray:
    """Returns which moments of inertia equal each other, ``(3, 3)``; one that varies equals itself alone."""
    same = np.array([np.isclose(at_nominal, moment, rtol=SAME, atol=0) for moment in at_nominal])
    varying = np.array([varies(moment) for moment in moments])
    return np.where(varying[:, None] | varying, np.eye(3, dtype=bool), same)


def outer(a: np.ndarray, b: np.ndarray | None = None) -> np.ndarray:
    """Returns a symmetric outer product, each entry computed once."""
    b, n = a if b is None else b, len(a)
    return np.array([[a[max(i, j)] * b[min(i, j)] for j in range(n)] for i in range(n)], dtype=object)
