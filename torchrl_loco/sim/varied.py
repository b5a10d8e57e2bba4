"""Which numbers of a model differ from world to world."""

import copy
import math
from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from torchrl_loco.sim.corners import axes_of

FIELDS = (
    *("geom_friction", "pair_friction", "body_mass", "body_inertia", "body_ipos"),
    *("dof_damping", "dof_armature", "dof_frictionloss", "jnt_stiffness"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "gravity"),
)
"""Fields of ``mujoco.MjModel`` whose numbers can vary; ``gravity`` is that of its options."""


class Varied:
    """Which numbers of a model differ from world to world.

    A world has a row of them, ``(count,)``: field by field, each in the order of its flattened array.

    Args:
        mj_model: the model; its own numbers are the nominal ones.
        places: by field, which of its numbers vary: indices of the flattened array.

    Attributes:
        places: the same, sorted.
        columns: by field, where its numbers are in a row.
        count: length of a row.

    Raises:
        ValueError: there is no such field, or no such number in it; or the model cannot follow it: limits of a force
            that is not limited, or the center of mass of a body whose mass matrix is diagonal.
    """

    def __init__(self, mj_model: mujoco.MjModel, places: Mapping[str, ArrayLike]) -> None:
        self._mj_model = mj_model
        self.places: dict[str, np.ndarray] = {}
        self.columns: dict[str, slice] = {}
        self.count = 0
        for name, given in places.items():
            if name not in FIELDS:
                raise ValueError(f"{name!r} cannot vary: choose of {', '.join(FIELDS)}")
            indices, shape = np.unique(np.asarray(given, dtype=int)), field(mj_model, name).shape
            size = math.prod(shape)
            if indices.size and not 0 <= indices[0] <= indices[-1] < size:
                raise ValueError(f"{name} has {size} numbers, but the number {indices[-1]} was to vary")
            for element in indices // math.prod(shape[1:]):
                if why := why_not(mj_model, name, element):
                    kind = name.partition("_")[0]
                    raise ValueError(f"{name} of {kind} {getattr(mj_model, kind)(element).name!r} cannot vary: {why}")
            self.places[name] = indices
            self.columns[name] = slice(self.count, self.count + indices.size)
            self.count += indices.size

    def nominal(self) -> np.ndarray:
        """Returns the row of the model itself, ``(count,)``."""
        rows = [field(self._mj_model, name).ravel()[places] for name, places in self.places.items()]
        return np.concatenate([np.zeros(0), *rows])

    def full(self, name: str, row: np.ndarray) -> np.ndarray:
        """Returns a field of a world with this row, in MjModel's shape."""
        nominal = field(self._mj_model, name)
        values = nominal.ravel().copy()
        if name in self.places:
            values[self.places[name]] = row[self.columns[name]]
        return values.reshape(nominal.shape)

    def edited(self, row: ArrayLike, model: mujoco.MjModel | None = None) -> mujoco.MjModel:
        """Returns a copy of the model, or of another that differs in its sensors, with the numbers of a world's row.

        ``body_subtreemass`` follows the masses. ``body_invweight0``, ``dof_invweight0`` and ``stat.meaninertia`` stay
        nominal, as they do in both engines.
        """
        m, numbers = copy.copy(self._mj_model if model is None else model), np.asarray(row, dtype=float)
        for name in self.places:
            field(m, name)[...] = self.full(name, numbers)
        if m.dof_simplenum.any() and {"body_mass", "body_inertia", "dof_armature"} & self.places.keys():
            again = copy.copy(m)  # for what MuJoCo takes the mass matrix of bodies to be where that is diagonal
            mujoco.mj_setConst(again, mujoco.MjData(again))
            m.dof_M0[:] = again.dof_M0
        if "body_ipos" in self.places:
            self._move_inertial_frames(m)
        if "body_mass" in self.places:
            m.body_subtreemass[:] = subtree_masses(m, m.body_mass)
        return m

    def _move_inertial_frames(self, m: mujoco.MjModel) -> None:
        """Updates what a model has in the inertial frames of its bodies."""
        for frames in (m.body_sameframe, m.geom_sameframe, m.site_sameframe):
            frames[:] = 0  # some were the same, which MuJoCo would go by
        for body in range(1, m.nbody):
            offset = self._mj_model.body_ipos[body] - m.body_ipos[body]
            boxes = slice(m.body_bvhadr[body], m.body_bvhadr[body] + m.body_bvhnum[body])
            m.bvh_aabb[boxes, :3] += offset @ axes_of(m.body_iquat[body])


def why_not(mj_model: mujoco.MjModel, name: str, element: int) -> str | None:
    """Returns why a model cannot follow numbers of an element, if it cannot, and what to do."""
    if name == "actuator_forcerange" and not mj_model.actuator_forcelimited[element]:
        return "no force range limits the actuator, so give it a forcerange in the model"
    if name == "body_ipos" and mj_model.body_simple[element] == 1:
        return "MuJoCo takes the body's mass matrix for diagonal, so move its center of mass a little in the model"
    return None


def subtree_masses(mj_model: mujoco.MjModel, masses: np.ndarray) -> np.ndarray:
    """Returns the mass of each body with all below it, ``(nbody,)``, from those of the bodies: numbers, or symbols."""
    sums = masses.copy()
    for body in reversed(range(1, mj_model.nbody)):  # children before parents
        sums[mj_model.body_parentid[body]] = sums[mj_model.body_parentid[body]] + sums[body]
    return sums


def field(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns a field of :data:`FIELDS`, a view of the model's own array."""
    return mj_model.opt.gravity if name == "gravity" else getattr(mj_model, name)
