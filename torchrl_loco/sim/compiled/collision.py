"""Collision of spheres and capsules with planes and with each other, traced for one model.

What MuJoCo decides per contact (which pairs may touch, mixing of parameters, contact frames) is decided here per pair
of geoms, once, in Python. Source: MuJoCo's documentation, chapter Computation ("Collision detection"), and
mujoco_warp's ``collision_primitive``.
"""

import dataclasses

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.dynamics import MINVAL, Poses, constant_matrix
from torchrl_loco.sim.compiled.parameters import Number, largest, varies
from torchrl_loco.sim.compiled.symbols import Scalar, array, dot, select, sqrt
from torchrl_loco.sim.models import NEVER

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
ROUND, SOLID = (SPHERE, CAPSULE), (ELLIPSOID, CYLINDER, BOX, MESH)
"""Shapes that are a segment with a radius, which both schedules know; and those that only lanes know."""
SHAPES = (*ROUND, *SOLID)
"""In the order of ``enum Shape`` in ``laws.h``."""
MINMU = 1e-5
"""MuJoCo's mjMINMU."""
SLIPPERY, LEAST = 0.03, 1e-4
"""Up to this friction the regularisation of a contact is no less than this share of the bodies' inverse inertia."""
LEAST_ALIGNED = 1e-6
"""Sine of the angle to a plane's normal below which the direction of a capsule along the plane is rounding."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two geoms that may touch, and the parameters of their contacts.

    Attributes:
        geoms: their ids, the simpler shape first; the normal points from the first to the second.
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
    friction_ratio: Number = 1.0
    rolling_ratio: Number = 1.0


def pairs(m: mujoco.MjModel) -> list[Pair]:
    """Returns all pairs of geoms that may touch: explicit ones, then those of MuJoCo's filters.

    The filters are by type, body, parent and exclusion; explicit pairs pass them, but for geoms that cannot move
    relative to each other.
    """
    weld = m.body_weldid[m.geom_bodyid]
    parent_weld = m.body_weldid[m.body_parentid[weld]]
    filter_parent = not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
    excluded = set(m.exclude_signature.tolist())
    explicit = [tuple(sorted((int(m.pair_geom1[i]), int(m.pair_geom2[i])))) for i in range(m.npair)]
    found = [
        _explicit_pair(m, i) for i, (a, b) in enumerate(explicit) if weld[a] != weld[b] and m.pair_margin[i] > NEVER
    ]
    for a in range(m.ngeom):
        for b in range(a + 1, m.ngeom):
            if (a, b) in explicit:
                continue
            bodies = sorted((m.geom_bodyid[a], m.geom_bodyid[b]))
            masked = not (m.geom_contype[a] & m.geom_conaffinity[b] or m.geom_contype[b] & m.geom_conaffinity[a])
            related = weld[a] and weld[b] and (weld[a] == parent_weld[b] or weld[b] == parent_weld[a])
            if masked or weld[a] == weld[b] or (filter_parent and related):
                continue
            if (bodies[0] << 16) + bodies[1] in excluded:
                continue
            found.append(_pair(m, *sorted((a, b), key=lambda g: (m.geom_type[g], g))))
    return found


def is_elliptic(m: mujoco.MjModel) -> bool:
    """Returns whether friction of contacts is bounded by elliptic cones, not by pyramids."""
    return bool(m.opt.cone == int(mujoco.mjtCone.mjCONE_ELLIPTIC))


def needs_lanes(m: mujoco.MjModel) -> bool:
    """Returns whether a model has contacts that only lanes can do.

    These are contacts of solids and of explicit pairs, and those with elliptic cones or friction against turning.
    """
    slides = 1 if is_elliptic(m) else 3
    return bool(m.npair) or any(
        pair.condim > slides or any(m.geom_type[geom] in SOLID for geom in pair.geoms) for pair in pairs(m)
    )


def contact_weight(m: mujoco.MjModel, pair: Pair) -> Number:
    """Returns the approximate inverse inertia along a row of a contact; along the normal, if its cone is elliptic."""
    if pair.condim == 1 or is_elliptic(m):
        return pair.weight
    squared = pair.friction * pair.friction
    return pair.weight * (1 + squared) * 2 * squared / m.opt.impratio


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
    weight = m.body_invweight0[m.geom_bodyid[[a, b]], 0].sum()
    margin = m.geom_margin[a] + m.geom_margin[b]
    sliding, torsional, rolling = (
        largest(x, MINMU) if condim >= least else 0.0 for x, least in zip(friction, (3, 4, 6), strict=True)
    )
    return Pair(
        (a, b), int(condim), sliding, torsional, rolling, float(margin), tuple(solref), tuple(solimp), float(weight)
    )


def _explicit_pair(m: mujoco.MjModel, i: int) -> Pair:
    """Returns a pair with the parameters that the model gives it."""
    a, b = sorted((int(m.pair_geom1[i]), int(m.pair_geom2[i])), key=lambda g: m.geom_type[g])
    condim = int(m.pair_dim[i])
    sliding, second, torsional, rolling, second_rolling = (
        largest(x, MINMU) if condim >= least else 0.0
        for x, least in zip(m.pair_friction[i], (3, 3, 4, 6, 6), strict=True)
    )
    return Pair(
        geoms=(a, b),
        condim=condim,
        friction=sliding,
        torsional=torsional,
        rolling=rolling,
        margin=float(m.pair_margin[i]),
        solref=tuple(m.pair_solref[i]),
        solimp=tuple(m.pair_solimp[i]),
        weight=float(m.body_invweight0[m.geom_bodyid[[a, b]], 0].sum()),
        friction_ratio=_ratio(second, sliding),
        rolling_ratio=_ratio(second_rolling, rolling),
    )


def _ratio(a: Number, b: Number) -> Number:
    same = not varies(a) and not varies(b) and a == b
    return 1.0 if same else a / b


# Contacts with a plane of the world.


@dataclasses.dataclass(frozen=True)
class Corner:
    """A sphere, or an end of a capsule, that may touch a plane.

    Attributes:
        pair: the geoms and their parameters.
        end: 0 for a sphere, 1 and -1 for the ends of a capsule.
    """

    pair: Pair
    end: int


def corners(m: mujoco.MjModel, found: list[Pair]) -> list[Corner]:
    """Returns what may touch a plane, in the order of the pairs."""
    result = []
    for pair in found:
        plane, geom = pair.geoms
        if m.geom_type[plane] == PLANE:
            ends = (1, -1) if m.geom_type[geom] == CAPSULE else (0,)
            result += [Corner(pair, end) for end in ends]
    return result


def geom_pose(m: mujoco.MjModel, poses: Poses, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns center and z axis of a geom in the world's frame, ``(3,)`` each."""
    body = m.geom_bodyid[geom]
    center = poses.xpos[body] + poses.xmat[body] @ array(m.geom_pos[geom])
    return center, (poses.xmat[body] @ constant_matrix(m.geom_quat[geom]))[:, 2]


def frame(normal: np.ndarray, axis: np.ndarray | None) -> np.ndarray:
    """Returns the first tangent of a contact with a plane, ``(3,)``; the second is normal x first.

    C MuJoCo aligns the first with the axis of a capsule, unless that is normal to the plane. Tangents that are
    exchanged or reversed give the same pyramid: where the axis of the capsule stays in one plane with the normal, one
    constant direction serves for all cases.

    Args:
        normal: the plane's normal, constants.
        axis: axis of the capsule; ``None`` for a sphere.
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


# Meshes on planes.


@dataclasses.dataclass
class Mesh:
    """The convex hull of a mesh, as a plane meets it.

    Attributes:
        vertices: those of the hull, ``(n, 3)`` (m).
        corners: for each vertex its corners: the normal of a face, and those of its other vertices that are in contact
            with a plane where this one is the lowest, up to three.
    """

    vertices: np.ndarray
    corners: list[list[tuple[np.ndarray, list[int]]]]

    @classmethod
    def of(cls, m: mujoco.MjModel, mesh: int) -> "Mesh":
        """Returns a mesh of a model, without the vertices that lie inside of its hull."""
        first = int(m.mesh_vertadr[mesh])
        outside = np.flatnonzero(m.mesh_polymapnum[first : first + m.mesh_vertnum[mesh]])
        vertices = m.mesh_vert[first + outside].astype(float)
        place = {int(vertex): i for i, vertex in enumerate(outside)}
        corners: list[list[tuple[np.ndarray, list[int]]]] = []
        for vertex in outside:
            start = m.mesh_polymapadr[first + vertex]
            faces = m.mesh_polyadr[mesh] + m.mesh_polymap[start : start + m.mesh_polymapnum[first + vertex]]
            corners.append([])
            for face in faces:
                start = m.mesh_polyvertadr[face]
                around = [place[int(i)] for i in m.mesh_polyvert[start : start + m.mesh_polyvertnum[face]]]
                at = around.index(place[int(vertex)])
                corners[-1].append((m.mesh_polynormal[face], _widest(vertices, around[at:] + around[:at])[1:]))
        return cls(vertices, corners)


def _widest(vertices: np.ndarray, around: list[int]) -> list[int]:
    """Returns up to four vertices of a convex polygon, the first and those that make the quadrilateral large.

    As MuJoCo does, the other three move on in turn for as long as the area grows.
    """
    count = len(around)
    if count <= 4:
        return around

    def area(corners: list[int]) -> float:
        a, b, c, d = (vertices[around[i % count]] for i in corners)
        return float(np.linalg.norm(np.cross(a - c, b - d)))

    best, largest_area = [0, 1, 2, 3], area([0, 1, 2, 3])

    def grows(which: int) -> bool:
        nonlocal best, largest_area
        moved = [(i + (k == which)) % count for k, i in enumerate(best)]
        if area(moved) <= largest_area:
            return False
        best, largest_area = moved, area(moved)
        return True

    while grows(3):
        while grows(2):
            pass
        while grows(1):
            pass
    return [around[i] for i in best]
