"""Equalities: rows that hold on both sides, along the lengths of ``lengths``, or between two bodies."""

import dataclasses

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.physics.lengths import Length

JOINT, TENDON, CONNECT, WELD = (
    int(getattr(mujoco.mjtEq, f"mjEQ_{kind}")) for kind in ("JOINT", "TENDON", "CONNECT", "WELD")
)
KINDS = JOINT, TENDON, CONNECT, WELD
OF_SITES = int(mujoco.mjtObj.mjOBJ_SITE)


@dataclasses.dataclass(frozen=True)
class Equality:
    """One length is a polynomial of another one, both counted from the reference pose, or a constant.

    Attributes:
        first: the length.
        second: the other one, or ``None``.
        polynomial: coefficients, ``(5,)``, the constant first.
        solref: reference parameters of the constraint, ``(2,)``.
        solimp: impedance parameters, ``(5,)``.
    """

    first: Length
    second: Length | None
    polynomial: tuple[float, ...]
    solref: tuple[float, ...]
    solimp: tuple[float, ...]

    @classmethod
    def of(cls, m: mujoco.MjModel, i: int) -> "Equality":
        """Returns an equality of a model, of joints or of tendons."""
        length = Length.of_tendon if m.eq_type[i] == TENDON else Length.of_joint
        other = int(m.eq_obj2id[i])
        second = length(m, other) if other >= 0 else None
        polynomial = (*m.eq_data[i, :1], *(m.eq_data[i, 1:5] if second else [0.0] * 4))
        return cls(length(m, int(m.eq_obj1id[i])), second, polynomial, tuple(m.eq_solref[i]), tuple(m.eq_solimp[i]))

    @property
    def weight(self) -> float:
        """Approximate inverse inertia along its row."""
        return self.first.weight + (self.second.weight if self.second else 0.0)

    @property
    def shares(self) -> list[tuple[int, float]]:
        """Degrees of freedom and coefficients: of the first length, then of the second."""
        return [*self.first.shares, *(self.second.shares if self.second else ())]


@dataclasses.dataclass(frozen=True)
class Weld:
    """Points of two bodies are the same; of a weld, their frames too, of a connection they are not.

    Attributes:
        bodies: the bodies.
        points: in the frames of these, ``(2, 3)``.
        turns: quaternions from the frames that are to be the same to those of the bodies, ``(2, 4)``; ``None`` of a
            connection.
        scale: of half a turn's sine: how far apart frames are (m).
        weights: approximate inverse inertia of both bodies, against pushing and turning.
        solref: reference parameters of the constraint, ``(2,)``.
        solimp: impedance parameters, ``(5,)``.
    """

    bodies: tuple[int, int]
    points: np.ndarray
    turns: np.ndarray | None
    scale: float
    weights: np.ndarray
    solref: tuple[float, ...]
    solimp: tuple[float, ...]

    @classmethod
    def of(cls, m: mujoco.MjModel, i: int) -> "Weld":
        """Returns a weld or connection of a model, of two bodies or of two sites."""
        welds, objects, data = m.eq_type[i] == WELD, [int(m.eq_obj1id[i]), int(m.eq_obj2id[i])], m.eq_data[i]
        if m.eq_objtype[i] == OF_SITES:
            bodies, points, turns = m.site_bodyid[objects], m.site_pos[objects], m.site_quat[objects]
        else:
            bodies, points = np.array(objects), data[:6].reshape(2, 3)[:: -1 if welds else 1]
            turns = np.array([data[6:10], [1.0, 0.0, 0.0, 0.0]])
        return cls(
            (int(bodies[0]), int(bodies[1])),
            points.copy(),
            turns.copy() if welds else None,
            float(data[10]),
            m.body_invweight0[bodies].sum(axis=0),
            tuple(m.eq_solref[i]),
            tuple(m.eq_solimp[i]),
        )

    @property
    def rows(self) -> int:
        """Three along the axes of the world; of a weld, three more about the axes of the second frame."""
        return 3 if self.turns is None else 6


def active(m: mujoco.MjModel, kinds: tuple[int, ...]) -> list[int]:
    """Returns the equalities of some kinds that hold from the start."""
    return [i for i in range(m.neq) if m.eq_active0[i] and m.eq_type[i] in kinds]
