"""Spheres in the corners of solids, which touch the ground in their place where it has a height field.

Where boxes, cylinders, ellipsoids and meshes meet a height field, C MuJoCo searches for a contact with each prism, and
what it finds jumps: a pose that is rounded to single precision moves a Go1 by 0.05 m/s. All engines agree on spheres.
Boxes of the same ground are touched by the spheres too.
"""

import mujoco
import numpy as np

MOST_RADIUS, SHARE = 0.02, 0.5  # of a sphere: at most (m), and as a fraction of the least half size of its solid
DIAGONALS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
LIKE = ("condim", "friction", "solref", "solimp", "solmix", "priority", "margin", "gap")
"""What a sphere has of its solid."""
GROUP = 3  # of the spheres: not seen
BITS = 31  # bits of a mask of contacts, but for its sign
TYPE = mujoco.mjtGeom
FIELD, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(TYPE, f"mjGEOM_{kind}")) for kind in ("HFIELD", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)


def stand_on_corners(spec: mujoco.MjSpec) -> list[str]:
    """Gives solids that may touch a height field of the world spheres in their place, for its fields and boxes.

    What moves they touch as before; and where there is no field, everything. The model is changed.

    Returns:
        The names of the solids, or their numbers.

    Raises:
        ValueError: the bits of contype and conaffinity do not suffice, or an explicit pair lets a solid touch the
            ground as it is.
    """
    m = spec.compile()
    of_world = m.body_weldid[m.geom_bodyid] == 0
    ground = np.flatnonzero(of_world & np.isin(m.geom_type, (FIELD, BOX)))
    if not (of_world & (m.geom_type == FIELD)).any():
        return []
    touched = {
        g: [f for f in ground if m.geom_contype[g] & m.geom_conaffinity[f] or m.geom_contype[f] & m.geom_conaffinity[g]]
        for g in np.flatnonzero(~of_world)
    }
    on_field = {g for g, on in touched.items() if (m.geom_type[on] == FIELD).any()}
    solids = [g for g in on_field if m.geom_type[g] in (ELLIPSOID, CYLINDER, BOX, MESH)]
    if not solids:
        return []
    for pair in np.column_stack([m.pair_geom1, m.pair_geom2]):
        if np.isin(pair, solids).any() and np.isin(pair, ground).any():
            first, second = (m.geom(g).name or g for g in pair)
            raise ValueError(
                f"solids_on_terrain='spheres': the pair of {first} and {second} would touch beside the spheres of the "
                "solid: leave it out, and set friction at the geoms"
            )
    # Each kind of them has a bit of its own, which what may touch it accepts.
    kinds = sorted({(int(m.geom_contype[f]), int(m.geom_conaffinity[f])) for f in ground})
    used = int(np.bitwise_or.reduce(m.geom_contype | m.geom_conaffinity))
    free = [1 << bit for bit in range(BITS) if not used >> bit & 1]
    if len(kinds) > len(free):
        raise ValueError(f"solids_on_terrain='spheres' needs {len(kinds)} free bits of contype and conaffinity")
    bits = {f: free[kinds.index((int(m.geom_contype[f]), int(m.geom_conaffinity[f])))] for f in ground}
    names = []
    for g, geom in [(geom.id, geom) for geom in spec.geoms]:  # ids as they are before anything is added
        if g in bits:
            geom.contype, geom.conaffinity = bits[g], 0
        elif touched.get(g):
            accepted = int(np.bitwise_or.reduce([bits[f] for f in touched[g]]))
            if g not in solids:
                geom.conaffinity |= accepted
                continue
            geom.name = geom.name or f"solid_{g}"  # by which its spheres are known
            names.append(geom.name)
            copied = {field: getattr(geom, field) for field in LIKE}
            copied |= {"type": TYPE.mjGEOM_SPHERE, "contype": 0, "conaffinity": accepted, "mass": 0.0, "group": GROUP}
            for k, (center, radius) in enumerate(spheres(m, g)):
                geom.parent.add_geom(name=f"{geom.name}_corner_{k}", pos=center, size=[radius, 0, 0], **copied)
    return names


def corners_of(m: mujoco.MjModel) -> dict[int, list[int]]:
    """Returns the spheres that touch the ground in place of solids, by the solid's number."""
    found: dict[int, list[int]] = {}
    if not (m.geom_type == FIELD).any():
        return found
    numbers = {m.geom(g).name: g for g in range(m.ngeom)}
    for name, g in numbers.items():
        solid = numbers.get(name.rpartition("_corner_")[0], -1) if "_corner_" in name else -1
        is_own = solid >= 0 and m.geom_type[solid] in (ELLIPSOID, CYLINDER, BOX, MESH)
        is_own = is_own and m.geom_bodyid[g] == m.geom_bodyid[solid] and m.geom_type[g] == int(TYPE.mjGEOM_SPHERE)
        if is_own and not m.geom_contype[g] and m.geom_group[g] == GROUP:
            found.setdefault(solid, []).append(g)
    return found


def spheres(m: mujoco.MjModel, geom: int) -> list[tuple[np.ndarray, float]]:
    """Returns the centers of spheres within a solid, in the frame of its body (m), and their radius (m)."""
    size = m.geom_aabb[geom, 3:]
    radius = min(MOST_RADIUS, SHARE * float(size.min()))
    kind = m.geom_type[geom]
    if kind == ELLIPSOID:
        places = [sign * (size[k] - radius) * np.eye(3)[k] for k in range(3) for sign in (-1, 1)]
    elif kind == CYLINDER:
        places = [(*((size[0] - radius) * d[:2] / np.sqrt(2)), d[2] * (size[2] - radius)) for d in DIAGONALS]
    elif kind == MESH:
        mesh = m.geom_dataid[geom]
        vertices = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]]
        corners = [vertices[np.argmax(vertices @ (d / size))] for d in DIAGONALS]
        places = [corner * max(0.0, 1.0 - radius / np.linalg.norm(corner)) for corner in np.unique(corners, axis=0)]
    else:
        places = list(DIAGONALS * (size - radius))
    axes = axes_of(m.geom_quat[geom])
    return [(m.geom_pos[geom] + axes @ place, radius) for place in places]


def axes_of(quaternion: np.ndarray) -> np.ndarray:
    """Returns the matrix ``(3, 3)`` of a rotation: the axes of a frame as columns."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, quaternion)
    return axes.reshape(3, 3)
