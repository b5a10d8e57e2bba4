"""Which geoms may touch, and with which parameters.

What MuJoCo decides per contact (which pairs may touch, mixing of parameters) is decided here per pair of geoms, once.
Source: MuJoCo's documentation, chapter Computation ("Collision detection").
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.kinds import BOX, CAPSULE, FIELD, KINDS, NOT_COMPILED, Kind
from torchrl_loco.sim.compiled.ir.parameters import Number, largest
from torchrl_loco.sim.compiled.ir.symbols import Scalar, select
from torchrl_loco.sim.compiled.physics.dynamics import MINVAL
from torchrl_loco.sim.models import NEVER

SLIPPERY, LEAST = 0.03, 1e-4
"""Up to this friction the regularisation of a contact is no less than this share of the bodies' inverse inertia."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two geoms that may touch, and the parameters of their contacts.

    Attributes:
        geoms: their ids, by MuJoCo's number of their shapes; the normal points from the first to the second.
        condim: 1 (no friction), 3 (sliding), 4 (torsional friction too) or 6 (rolling friction too).
        friction: sliding friction coefficient, along the first tangent of the contact, 0 without friction.
        friction_ratio: that along the second tangent over the first; 1 unless an explicit pair says otherwise.
        torsional: torsional friction coefficient (m), 0 without.
        rolling: rolling friction coefficient (m), about the first tangent, 0 without.
        rolling_ratio: that about the second tangent over the first; 1 unless an explicit pair says otherwise.
        margin: distance below which a contact is active (m).
        solref: reference parameters of the constraint, ``(2,)``.
        solimp: impedance parameters, ``(5,)``.
        weight: approximate inverse inertia of the two bodies (1/kg).
    """

    geoms: tuple[int, int]
    condim: int
    friction: Number
    torsional: Number
    rolling: Number
    margin: float
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    weight: Number
    friction_ratio: Number
    rolling_ratio: Number


def pairs(m: mujoco.MjModel) -> list[Pair]:
    """Returns all pairs of geoms that may touch: explicit ones, then those of MuJoCo's filters.

    The filters are by type, body, parent and exclusion; explicit pairs pass them, but for geoms that cannot move
    relative to each other. Of geoms of the ground that are alike, one stands for all.
    """
    like = stand_ins(m)
    # As lists: there are thousands of candidates, and a number of an array takes ten times as long.
    of_geoms = m.geom_bodyid, m.geom_contype, m.geom_conaffinity, m.body_weldid[m.geom_bodyid]
    body, contype, conaffinity, weld = (array.tolist() for array in of_geoms)
    parent_weld = m.body_weldid[m.body_parentid[weld]].tolist()
    filter_parent = not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    excluded = set(m.exclude_signature.tolist())
    explicit = [tuple(sorted((int(m.pair_geom1[i]), int(m.pair_geom2[i])))) for i in range(m.npair)]
    found = [
        _explicit_pair(m, i) for i, (a, b) in enumerate(explicit) if weld[a] != weld[b] and m.pair_margin[i] > NEVER
    ]
    shown = [g for g in range(m.ngeom) if like.get(g, g) == g]
    moving = [g for g in shown if weld[g]]
    for a in shown:
        for b in shown if weld[a] else moving:
            if b <= a or (a, b) in explicit:
                continue
            bodies = sorted((body[a], body[b]))
            masked = not (contype[a] & conaffinity[b] or contype[b] & conaffinity[a])
            related = weld[a] and weld[b] and (weld[a] == parent_weld[b] or weld[b] == parent_weld[a])
            if masked or weld[a] == weld[b] or (filter_parent and related):
                continue
            if (bodies[0] << 16) + bodies[1] in excluded:
                continue
            found.append(_pair(m, *sorted((a, b), key=lambda g: (m.geom_type[g], g not in like, g))))
    return found


ALIKE = ("type", "bodyid", "contype", "conaffinity", "condim", "priority")
ALIKE_NUMBERS = ("solmix", "solref", "solimp", "friction", "margin", "gap")
"""Of geoms whose contacts have the same parameters."""
AT_ONCE = 8  # contacts of a geom with many boxes, as far as a world has room for all pairs
MOST_LISTED = 8  # boxes of the world up to which each has pairs of its own; more of them are looked up


def of_ground(m: mujoco.MjModel) -> np.ndarray:
    """Returns which geoms are fixed to the world and may be touched, ``(ngeom,)``."""
    paired = np.isin(np.arange(m.ngeom), [*m.pair_geom1, *m.pair_geom2])
    return (m.body_weldid[m.geom_bodyid] == 0) & ((m.geom_contype != 0) | (m.geom_conaffinity != 0) | paired)


def looked_up(m: mujoco.MjModel) -> np.ndarray:
    """Returns which geoms are looked up, ``(ngeom,)``: height fields of the world, and its boxes if they are many."""
    boxes, fields = (of_ground(m) & (m.geom_type == shape) for shape in (BOX, FIELD))
    return boxes | fields if boxes.sum() > MOST_LISTED else fields


def stand_ins(m: mujoco.MjModel) -> dict[int, int]:
    """Returns the geoms that are looked up, each with the first of those that are as it is."""
    named = {*m.pair_geom1.tolist(), *m.pair_geom2.tolist()}
    first: dict[str, int] = {}
    found = {}
    for geom in np.flatnonzero(looked_up(m)).tolist():
        own = [getattr(m, f"geom_{name}")[geom].tolist() for name in (*ALIKE, *ALIKE_NUMBERS)]
        found[geom] = first.setdefault(repr([own, geom if geom in named else -1]), geom)
    return found


def half_length(m: mujoco.MjModel, geom: int) -> float:
    """Returns the half length of a capsule, 0 for any other geom."""
    return float(m.geom_size[geom, 1]) if m.geom_type[geom] == CAPSULE else 0.0


def is_elliptic(m: mujoco.MjModel) -> bool:
    """Returns whether friction of contacts is bounded by elliptic cones, not by pyramids."""
    return bool(m.opt.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC))


def kind(m: mujoco.MjModel, pair: Pair) -> Kind:
    """Returns how the shapes of a pair touch: that of no contacts, if it is not compiled."""
    first, second = m.geom_type[list(pair.geoms)].tolist()
    found = KINDS.get((first, second), NOT_COMPILED)
    if BOX not in (first, second) or not looked_up(m)[list(pair.geoms)].any():
        return found
    return dataclasses.replace(found, function=found.on_boxes, points=AT_ONCE if found.on_boxes else 0)


def needs_lanes(m: mujoco.MjModel) -> bool:
    """Returns whether a model has contacts that only lanes can do.

    These are those of shapes that are not traced and of explicit pairs, and those with elliptic cones or friction
    against turning.
    """
    slides = 1 if is_elliptic(m) else 3
    return bool(m.npair) or any(pair.condim > slides or not kind(m, pair).traced for pair in pairs(m))


def contact_weight(m: mujoco.MjModel, pair: Pair) -> Number:
    """Returns the approximate inverse inertia along a row of a contact; along the normal, if its cone is elliptic."""
    if pair.condim == 1 or is_elliptic(m):
        return pair.weight
    squared = pair.friction * pair.friction
    return pair.weight * (1 + squared) * 2 * squared / impratio(m)


def impratio(m: mujoco.MjModel) -> float:
    """Returns the ratio of frictional to normal impedance, bounded from below as in C MuJoCo."""
    return max(MINVAL, m.opt.impratio)


def least_regularisation(pair: Pair) -> Number:
    """Returns what the regularisation of a row of a contact is at least.

    MuJoCo makes a pyramid of little friction stiffer than its bodies by the inverse square of the friction, 5e5 at
    0.001: in single precision nothing would be left of the bodies beside it. There it ends where the acceleration
    along the normal is off by some 1e-4 of itself.
    """
    least = largest(MINVAL, LEAST * pair.weight)
    if pair.condim == 1:
        return MINVAL
    if isinstance(pair.friction, Scalar):
        return select(pair.friction, "<=", SLIPPERY, least, MINVAL)
    return least if pair.friction <= SLIPPERY else MINVAL


def _pair(m: mujoco.MjModel, a: int, b: int) -> Pair:
    """Returns a pair with its mixed parameters (MuJoCo's ``mj_contactParam``)."""
    one_decides = m.geom_priority[a] != m.geom_priority[b]
    if one_decides:
        first = 1.0 if m.geom_priority[a] > m.geom_priority[b] else 0.0
        condim = m.geom_condim[a if first else b]
        friction = m.geom_friction[a if first else b]
    else:
        mix = m.geom_solmix[[a, b]]
        large = mix >= MINVAL
        first = mix[0] / mix.sum() if large.all() else (0.5 if not large.any() else float(large[0]))
        condim = max(m.geom_condim[a], m.geom_condim[b])
        friction = [largest(m.geom_friction[a, k], m.geom_friction[b, k]) for k in range(3)]
    solref = m.geom_solref[[a, b]]
    if one_decides or (solref[:, 0] > 0).all():
        solref = first * solref[0] + (1 - first) * solref[1]
    else:
        solref = solref.min(axis=0)
    solimp = first * m.geom_solimp[a] + (1 - first) * m.geom_solimp[b]
    margin = m.geom_margin[a] + m.geom_margin[b]
    return _with_parameters(m, (a, b), condim, np.asarray(friction)[[0, 0, 1, 2, 2]], margin, solref, solimp)


def _explicit_pair(m: mujoco.MjModel, i: int) -> Pair:
    """Returns a pair with the parameters that the model gives it."""
    a, b = sorted((int(m.pair_geom1[i]), int(m.pair_geom2[i])), key=lambda g: m.geom_type[g])
    numbers = m.pair_dim[i], m.pair_friction[i], m.pair_margin[i], m.pair_solref[i], m.pair_solimp[i]
    return _with_parameters(m, (a, b), *numbers)


def _with_parameters(
    m: mujoco.MjModel, geoms: tuple[int, int], condim: int, frictions: Any, margin: float, solref: Any, solimp: Any
) -> Pair:
    """Returns a pair with coefficients of friction ``(5,)``: of two tangents, and about all axes of the contact."""
    sliding, second, torsional, rolling, second_rolling = (
        largest(x, mujoco.mjMINMU) if condim >= least else 0.0
        for x, least in zip(frictions, (3, 3, 4, 6, 6), strict=True)
    )
    weight = m.body_invweight0[m.geom_bodyid[list(geoms)], 0].sum()
    ratios = (1.0 if x == y else x / y for x, y in ((second, sliding), (second_rolling, rolling)))
    of_constraint = float(margin), tuple(solref), tuple(solimp), float(weight)
    return Pair(geoms, int(condim), sliding, torsional, rolling, *of_constraint, *ratios)
