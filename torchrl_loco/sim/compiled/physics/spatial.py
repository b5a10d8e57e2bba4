"""Spatial algebra: traced as it stands here; what lanes need of it, it also writes as C++.

Spatial vectors are (angular, linear), as in R. Featherstone, "Rigid Body Dynamics Algorithms" (2008), in world axes
about the center of mass of their tree, as in MuJoCo.
"""

import dataclasses
from collections.abc import Iterable

import numpy as np

from torchrl_loco.sim.compiled.ir.symbols import Scalar, cpp_function, cross, identity, name, vec


@dataclasses.dataclass(frozen=True)
class Inertia:
    """Spatial inertia of a rigid body about the origin.

    Attributes:
        rotational: moments about the origin, ``(3, 3)`` (kg m^2).
        first: mass times the offset of the center of mass, ``(3,)`` (kg m).
        mass: mass (kg).
    """

    rotational: np.ndarray
    first: np.ndarray
    mass: Scalar

    @classmethod
    def moved(cls, rotational: np.ndarray, mass: Scalar, offset: np.ndarray) -> "Inertia":
        """Returns that of a body whose center of mass, about which it has these moments, is at ``offset``."""
        first, moments = mass * offset, rotational.copy()
        for i in range(3):
            j, k = sorted({0, 1, 2} - {i})
            moments[i, i] = moments[i, i] + first[j] * offset[j] + first[k] * offset[k]
            moments[j, k] = moments[k, j] = moments[j, k] - first[j] * offset[k]
        return cls(moments, first, mass)

    def __matmul__(self, motion: np.ndarray) -> np.ndarray:
        """Returns the momentum, or force, of a motion."""
        angular, linear = motion[:3], motion[3:]
        return np.concatenate(
            [self.rotational @ angular + cross(self.first, linear), self.mass * linear - cross(self.first, angular)]
        )

    def matrix(self) -> np.ndarray:
        """Returns the same as a ``(6, 6)`` matrix."""
        x, y, z = self.first
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=object)
        return np.block([[self.rotational, skew], [skew.T, identity(3) * self.mass]])


def turning(axis: np.ndarray, lever: np.ndarray) -> np.ndarray:
    """Returns the motion of a rotation about an axis; the lever leads from a point of the axis to the origin."""
    return np.concatenate([axis, cross(axis, lever)])


def cross_motion(v: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Returns the rate of change of a motion vector that moves with velocity ``v`` (Featherstone's crm)."""
    return np.concatenate([cross(v[:3], motion[:3]), cross(v[:3], motion[3:]) + cross(v[3:], motion[:3])])


def cross_force(v: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Returns the rate of change of a force vector that moves with velocity ``v`` (Featherstone's crf)."""
    return np.concatenate([cross(v[:3], force[:3]) + cross(v[3:], force[3:]), cross(v[:3], force[3:])])


def as_cpp() -> str:
    """Returns a C++ struct of these functions, on structs of ``world.h`` and ``arithmetic.h``."""
    inertia = Inertia(_symmetric("i.rotational"), vec("i.first"), name("i.mass"))
    moved = Inertia.moved(_symmetric("s"), name("mass"), vec("offset"))
    six = [moved.rotational[i, j] for i in range(3) for j in range(i, 3)]
    functions: dict[str, Iterable[Scalar]] = {
        "Motion turning(Vec axis, Vec lever)": turning(vec("axis"), vec("lever")),
        "Motion cross_motion(Motion v, Motion m)": cross_motion(_motion("v"), _motion("m")),
        "Motion cross_force(Motion v, Motion f)": cross_force(_motion("v"), _motion("f")),
        "Motion product(Inertia i, Motion m)": inertia @ _motion("m"),
        "Inertia moved(Symmetric s, float mass, Vec offset)": [*six, *moved.first, moved.mass],
    }
    written = [cpp_function(f"static INLINE {head}", *results) for head, results in functions.items()]
    return "\n".join(["struct Spatial {", *written, "};"])


def _motion(text: str) -> np.ndarray:
    return np.concatenate([vec(f"{text}.angular"), vec(f"{text}.linear")])


def _symmetric(text: str) -> np.ndarray:
    return np.array([[name(f"{text}.{min(i, j)}{max(i, j)}") for j in "xyz"] for i in "xyz"], dtype=object)
