"""Which numbers of a model a Vary changes."""

import mujoco
import numpy as np

from torchrl_loco.envs.names import Elements
from torchrl_loco.envs.vary import FIELDS, Vary
from torchrl_loco.sim.varied import field, why_not


class Change:
    """What a :class:`Vary` does to the numbers of a model. Its random stream depends on ``label``.

    Attributes:
        places: numbers that it changes, as fields and indices of their flattened arrays.
        which: of each of them, the index of its draw.
        signs: of each of them, what an offset or number is multiplied by: -1 for the bias of ``kp`` and ``kv``.
        group_of: of each draw, the group of numbers of an element that it is for.

    Raises:
        ValueError: a name is not in the model, an element does not have such a number, or all of them stay 0.
    """

    def __init__(self, vary: Vary, elements: Elements, label: str) -> None:
        m, groups = elements.mj_model, vary.groups
        per_element = [_places(vary.field, m, i) for i in _ids(vary, elements)]
        self.vary, self.label = vary, label
        self.group_of = list(range(len(groups))) * (1 if vary.shared else len(per_element))
        found = [
            ((name, index), group if vary.shared else rank * len(groups) + group, sign)
            for rank, numbers in enumerate(per_element)
            for group, components in enumerate(groups)
            for component in components
            for name, index, sign in numbers[component]
            if vary.how != "scale" or field(m, name).flat[index] != 0
        ]
        if not found:
            raise ValueError(f"{vary}: {vary.field} is 0 in the model, so nothing is scaled: use how='add' or 'set'")
        self.places, self.which, self.signs = map(list, zip(*found, strict=True))


def _ids(vary: Vary, elements: Elements) -> list[int]:
    """Returns the ids of the elements that a Vary names; of a field of the model, ``[0]``.

    Raises:
        ValueError: one is not there, or does not have such a number.
    """
    m, kind = elements.mj_model, FIELDS[vary.field].of
    if not kind:
        return [0]
    known = elements.names(kind)
    try:
        found = range(len(known)) if vary.of is None else sorted(set(elements.ids(kind, vary.of)[0]))
    except KeyError as error:
        raise ValueError(f"{vary}: {error.args[0]}") from None
    if vary.of is None and kind == "joint":
        found = [i for i in found if m.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
    able = [i for i in found if _why_not(vary.field, m, i) is None]
    unable = [i for i in found if i not in able]
    if unable and (vary.of is not None or not able):
        names = ", ".join(known[i] or f"{kind} {i}" for i in unable)
        others = ", ".join(known[i] for i in range(len(known)) if known[i] and not _why_not(vary.field, m, i))
        why = _why_not(vary.field, m, unable[0])
        raise ValueError(f"{vary}: {why}: {names}; those that can vary are {others or 'none'}")
    if not able:
        raise ValueError(f"{vary}: the model has no {kind}")
    return able


def _why_not(name: str, m: mujoco.MjModel, i: int) -> str | None:
    """Returns why an element cannot have a field that varies, if it cannot."""
    if FIELDS[name].of == "body" and i == 0:
        return "the world has neither mass nor inertia"
    if name == "kp" and not _is_position(m, i):
        return "kp is of position actuators"
    if name == "kv" and not (_is_position(m, i) or _is_velocity(m, i)):
        return "kv is of position and velocity actuators"
    return why_not(m, name, i)


def _is_affine(m: mujoco.MjModel, i: int) -> bool:
    fixed, affine = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    kinds = m.actuator_gaintype[i] == fixed and m.actuator_biastype[i] == affine
    return bool(kinds and m.actuator_gainprm[i, 0] != 0)


def _is_position(m: mujoco.MjModel, i: int) -> bool:
    return _is_affine(m, i) and bool(m.actuator_biasprm[i, 1] == -m.actuator_gainprm[i, 0])


def _is_velocity(m: mujoco.MjModel, i: int) -> bool:
    bias = m.actuator_biasprm[i]
    return _is_affine(m, i) and bool(bias[1] == 0 and bias[2] == -m.actuator_gainprm[i, 0])


def _places(name: str, m: mujoco.MjModel, i: int) -> list[list[tuple[str, int, float]]]:
    """Returns where each number of an element is: fields, indices of their flattened arrays, signs."""
    if name in ("kp", "kv"):
        gain, bias = ("actuator_gainprm", 10 * i, 1.0), ("actuator_biasprm", 10 * i + 1 + (name == "kv"), -1.0)
        return [[gain, bias] if name == "kp" or _is_velocity(m, i) else [bias]]
    if name.startswith("dof_"):
        return [[(name, int(dof), 1.0) for dof in np.flatnonzero(m.dof_jntid == i)]]
    size = FIELDS[name].size
    return [[(name, size * i + component, 1.0)] for component in range(size)]
