"""What cameras see of a model, as tables on a device: shapes, what they look like, lights, textures and the sky."""

import copy
import logging
from typing import Any

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.sim import fill_from_numbers
from torchrl_loco.sim.compiled.collision.kinds import BOX, CAPSULE, CYLINDER, ELLIPSOID, FIELD, MESH, PLANE, SPHERE
from torchrl_loco.sim.corners import DIAGONALS, axes_of
from torchrl_loco.sim.varied import Varied, subtree_masses

KINDS = (PLANE, FIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH)  # types of geoms that are seen
GROUPS = 3  # groups of geoms that pictures show, from 0 on, as in MuJoCo's viewer
FULL_SHINE = 128.0  # exponent of a highlight where a material's shininess is 1
HIDDEN = 1e-3  # opacity up to which a geom is not seen
TRACKS = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK))
OF_COM = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
AT_BODY = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY))
AT_COM = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM))  # modes of cameras and lights
SPOT, DIRECTIONAL, OWN = wp.constant(0), wp.constant(1), wp.constant(2)  # kinds of lights: the last is the camera's
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
"""Corners of a box, in the order of DIAGONALS, of each of its sides, seen from outside."""


@wp.struct
class Mounts:
    """The camera, then the lights: what holds each, and where it is and looks (along -z) from there."""

    mode: wp.array[int]
    body: wp.array[int]
    target: wp.array[int]
    pos: wp.array[wp.vec3]
    mat: wp.array[wp.mat33]
    subtree: wp.array[int]  # how many bodies are in that of each
    inertial: wp.array[float]  # masses of the bodies, then where the center of mass of each is
    column: wp.array[int]  # of these: where a world's numbers have its own, or -1


@wp.struct
class Shapes:
    """What rays are tried against; the number of a look is that of its geom."""

    geom: wp.array[int]  # the geom, or -1: the triangles of all fields and boxes that are fixed to the world
    kind: wp.array[int]
    body: wp.array[int]
    pos: wp.array[wp.vec3]
    mat: wp.array[wp.mat33]
    size: wp.array[wp.vec3]
    radius: wp.array[float]  # of a sphere around it
    mesh: wp.array[wp.uint64]
    owner: wp.array[int]  # of the triangles of the ground: the geom


@wp.struct
class Look:
    """What a geom looks like."""

    color: wp.vec3
    shine: wp.vec3  # emission, specular, exponent
    texture: int
    repeat: wp.vec2
    offset: wp.vec2


@wp.struct
class Light:
    """What lights geoms."""

    kind: int  # SPOT, DIRECTIONAL or OWN
    shadow: bool
    ambient: wp.vec3  # of a spot; that of the others is the same everywhere
    diffuse: wp.vec3
    specular: wp.vec3
    attenuation: wp.vec3
    cone: wp.vec2  # cosine of the cutoff, exponent


@wp.struct
class Looks:
    """Of geoms, of the camera's own light and the others, of textures by level of detail, and of the sky."""

    geom: wp.array[Look]
    light: wp.array[Light]
    ambient: wp.vec3
    levels: wp.array2d[wp.vec3i]  # first texel, width, height
    texels: wp.array[wp.vec3]
    sky: wp.vec2i  # first texel, width of a side; width 0 is none


def to_the_horizon(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of a model for pictures: planes that may be touched have no end, as in the physics."""
    seen = copy.copy(mj_model)
    touched = (seen.geom_contype | seen.geom_conaffinity) != 0
    touched[[*seen.pair_geom1, *seen.pair_geom2]] = True
    seen.geom_size[touched & (seen.geom_type == mujoco.mjtGeom.mjGEOM_PLANE), :2] = 0.0
    return seen


def for_rays(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of a model for rays, as ``mj_ray`` meets geoms: of all groups, unless their opacity is 0.

    Of one with a material the material's counts. Planes that may be touched have no end.
    """
    met = to_the_horizon(mj_model)
    met.geom_group[:] = 0
    has_material = met.geom_matid >= 0
    met.geom_rgba[has_material] = met.mat_rgba[met.geom_matid[has_material]]
    met.geom_rgba[:, 3] = met.geom_rgba[:, 3] != 0.0
    met.geom_matid[:] = -1
    return met


def mounts_of(m: mujoco.MjModel, camera: int, device: wp.Device, varied: Varied | None = None) -> Mounts:
    """Returns what holds a camera and the lights that are on; ``varied`` are the numbers of which worlds have rows."""
    name = m.camera(camera).name or camera
    if m.cam_projection[camera] != int(mujoco.mjtProjection.mjPROJ_PERSPECTIVE) or m.cam_sensorsize[camera].any():
        raise ValueError(f"camera {name!r} must have a perspective that fovy alone tells, to be drawn from")
    lights = np.flatnonzero(m.light_active)

    def of(cameras: np.ndarray, of_lights: np.ndarray) -> np.ndarray:
        return np.concatenate([cameras[[camera]], of_lights[lights]])

    mode = of(m.cam_mode, m.light_mode)
    fixed = [axes_of(m.cam_quat[camera]), *(facing(m.light_dir[light]) for light in lights)]
    whole = [m.cam_mat0[camera].reshape(3, 3), *(facing(m.light_dir0[light]) for light in lights)]
    tracks, of_com = mode == TRACKS, mode == OF_COM
    pos = np.where(tracks[:, None], of(m.cam_pos0, m.light_pos0), of(m.cam_pos, m.light_pos))
    pos = np.where(of_com[:, None], of(m.cam_poscom0, m.light_poscom0), pos)
    mat = np.where((tracks | of_com)[:, None, None], np.array(whole), np.array(fixed))
    bodies, targets = of(m.cam_bodyid, m.light_bodyid), of(m.cam_targetbodyid, m.light_targetbodyid)
    return mounts_at(m, device, varied, mode=mode, body=bodies, target=targets, pos=pos, mat=mat)


def mounts_at(m: mujoco.MjModel, device: wp.Device, varied: Varied | None = None, **mounted: np.ndarray) -> Mounts:
    """Returns what holds what is mounted, of which the fields of :class:`Mounts` are given up to ``mat``."""
    count = subtree_masses(m, np.ones(m.nbody))  # bodies in each, which are numbered one after the other
    column = np.full(4 * m.nbody, -1)
    for first, name in ((0, "body_mass"), (m.nbody, "body_ipos")):
        if varied is not None and name in varied.places:
            column[first + varied.places[name]] = np.arange(varied.count)[varied.columns[name]]
    inertial = np.concatenate([m.body_mass, m.body_ipos.ravel()])
    return fill_from_numbers(Mounts, device, m, **mounted, subtree=count, inertial=inertial, column=column)


def facing(direction: np.ndarray) -> np.ndarray:
    """Returns a frame whose -z axis is a direction."""
    z = -direction / max(np.linalg.norm(direction), 1e-12)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def geoms_seen(m: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Returns which geoms are seen: those that are shapes of their own, and those that are one shape, the ground."""
    seen = [g for g in range(m.ngeom) if m.geom_group[g] < GROUPS and color_of(m, g)[3] > HIDDEN]
    of_ground = [g for g in seen if m.geom_bodyid[g] == 0 and m.geom_type[g] in (BOX, FIELD)]
    return [g for g in seen if g not in set(of_ground)], of_ground


def shapes_of(m: mujoco.MjModel, device: wp.Device) -> tuple[Shapes, list[wp.Mesh]]:
    """Returns the shapes of a model that are seen, and the meshes among them, which must be kept."""
    alone, of_ground = geoms_seen(m)
    kinds = [int(m.geom_type[g]) for g in alone]
    meshes: dict[tuple[int, int], wp.Mesh] = {}
    ids = []
    for g, kind in zip(alone, kinds, strict=True):
        key = kind, int(m.geom_dataid[g])
        if kind in (MESH, FIELD) and key not in meshes:
            meshes[key] = mesh(*(of_mesh if kind == MESH else of_field)(m, key[1]), device)
        ids.append(meshes[key].id if key in meshes else 0)
    kinds = [MESH if kind == FIELD else kind for kind in kinds]
    owner = np.zeros(0)
    rows = {
        "geom": [*alone],
        "kind": kinds,
        "body": [*m.geom_bodyid[alone]],
        "pos": [*m.geom_pos[alone]],
        "mat": [axes_of(m.geom_quat[g]) for g in alone],
        "size": [*m.geom_size[alone]],
        "radius": [*m.geom_rbound[alone]],
        "mesh": ids,
    }
    kept = [*meshes.values()]
    if of_ground:
        points, faces, owner = triangles(m, of_ground)
        kept.append(mesh(points, faces, device))
        for name, value in zip(rows, (-1, MESH, 0, np.zeros(3), np.eye(3), np.ones(3), 0.0, kept[-1].id), strict=True):
            rows[name].append(value)
    return fill_from_numbers(Shapes, device, **rows, owner=owner), kept


def triangles(m: mujoco.MjModel, geoms: list[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns points and triangles of height fields and boxes of the world, and of each triangle its geom."""
    points, faces, owner, count = [], [], [], 0
    for g in geoms:
        if m.geom_type[g] == BOX:
            own, of_own = DIAGONALS * m.geom_size[g], np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
        else:
            own, of_own = of_field(m, int(m.geom_dataid[g]))
        points.append(own @ axes_of(m.geom_quat[g]).T + m.geom_pos[g])
        faces.append(of_own + count)
        owner.append(np.full(len(of_own), g))
        count += len(own)
    return np.concatenate(points), np.concatenate(faces), np.concatenate(owner)


def of_mesh(m: mujoco.MjModel, which: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points and triangles of a mesh."""
    points = m.mesh_vert[m.mesh_vertadr[which] :][: m.mesh_vertnum[which]]
    return points, m.mesh_face[m.mesh_faceadr[which] :][: m.mesh_facenum[which]]


def of_field(m: mujoco.MjModel, field: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns points and triangles of a height field: its surface, cut from low x and y to high, walls and bottom."""
    rows, columns = int(m.hfield_nrow[field]), int(m.hfield_ncol[field])
    half_x, half_y, height, base = m.hfield_size[field]
    heights = m.hfield_data[m.hfield_adr[field] :][: rows * columns] * height
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    top = np.stack([x.ravel(), y.ravel(), heights], axis=1)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    below, after = len(top) + np.arange(len(rim)), np.roll(np.arange(len(rim)), -1)
    faces += [np.stack([rim, below, below[after]], -1), np.stack([rim, below[after], rim[after]], -1)]
    first, second, third, fourth = below[np.cumsum([0, columns - 1, rows - 1, columns - 1])]
    faces.append(np.array([[first, third, second], [first, fourth, third]]))
    return np.concatenate([top, np.column_stack([top[rim, :2], np.full(len(rim), -base)])]), np.concatenate(faces)


def mesh(points: np.ndarray, faces: np.ndarray, device: wp.Device) -> wp.Mesh:
    """Returns triangles as what Warp traces rays through."""
    return wp.Mesh(wp.array(points, wp.vec3, device=device), wp.array(faces.ravel(), int, device=device))


def color_of(m: mujoco.MjModel, geom: int) -> np.ndarray:
    """Returns red, green, blue and opacity of a geom: those of its material, unless it has its own."""
    own = m.geom_rgba[geom]
    has_own = m.geom_matid[geom] < 0 or not np.array_equal(own, [0.5, 0.5, 0.5, 1.0])
    return own if has_own else m.mat_rgba[m.geom_matid[geom]]


def looks_of(m: mujoco.MjModel, device: wp.Device) -> Looks:
    """Returns what geoms look like, and what lights them. What is not drawn is said in the log."""
    head, lights = m.vis.headlight, np.flatnonzero(m.light_active)
    is_spot = m.light_type != int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    ambient = m.light_ambient[lights][~is_spot[lights]].sum(0) + (head.ambient if head.active else 0.0)
    look, light = rows_of(Look, m.ngeom), rows_of(Light, 1 + len(lights))
    look["color"] = np.reshape([color_of(m, g)[:3] for g in range(m.ngeom)], (-1, 3))
    look["shine"], look["texture"], left_out = (0.0, 0.5, 0.5 * FULL_SHINE), -1, []
    role = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
    flat = [t for t in range(m.ntex) if m.tex_type[t] == int(mujoco.mjtTexture.mjTEXTURE_2D)]
    for g in range(m.ngeom):
        if (material := int(m.geom_matid[g])) < 0:
            continue
        look["shine"][g] = m.mat_emission[material], m.mat_specular[material], FULL_SHINE * m.mat_shininess[material]
        used = int(m.mat_texid[material, role])
        is_ground = m.geom_bodyid[g] == 0 and m.geom_type[g] in (PLANE, BOX, FIELD)
        if used >= 0 and (not is_ground or used not in flat):
            left_out.append(g)
        elif used >= 0:  # texels are counted from a corner, or from the middle of ground without an end
            size, times = m.geom_size[g, :2], m.mat_texrepeat[material]
            size = m.hfield_size[m.geom_dataid[g], :2] if m.geom_type[g] == FIELD else size
            ends = size > 0.0
            whole = ends & (not m.mat_texuniform[material])
            repeat = np.where(whole, times / np.where(whole, 2 * size, 1), 0.5 * times)
            look["texture"][g], look["repeat"][g] = flat.index(used), repeat
            look["offset"][g] = np.where(ends.all(), repeat * size, -0.5)
    unseen = {
        "textures but those of the ground": left_out,
        "transparency": [g for g in range(m.ngeom) if HIDDEN < color_of(m, g)[3] < 1.0],
        "shapes of such a type": [g for g in range(m.ngeom) if m.geom_type[g] not in KINDS],
    }
    for what, geoms in unseen.items():
        if names := [m.geom(g).name or str(g) for g in geoms]:
            logging.getLogger("torchrl_loco").info("cameras do not see %s: geoms %s", what, ", ".join(names[:8]))
    light["kind"][0] = OWN
    if head.active:
        light["diffuse"][0], light["specular"][0] = head.diffuse, head.specular
    for name, of in (
        ("kind", np.where(is_spot, SPOT, DIRECTIONAL)),
        ("ambient", m.light_ambient * is_spot[:, None]),
        ("shadow", m.light_castshadow),
        ("diffuse", m.light_diffuse),
        ("specular", m.light_specular),
        ("attenuation", m.light_attenuation),
        ("cone", np.column_stack([np.cos(np.deg2rad(m.light_cutoff)), m.light_exponent])),
    ):
        light[name][1:] = of[lights]
    levels, texels, sky = textures(m, flat)
    numbers = {"geom": look, "light": light, "levels": levels, "texels": texels}
    return fill_from_numbers(Looks, device, **numbers, ambient=wp.vec3(*map(float, ambient)), sky=wp.vec2i(*sky))


def rows_of(struct: Any, count: int) -> Any:
    """Returns so many structs of zeros, whose fields are columns."""
    return np.zeros(count, dtype=struct.numpy_dtype())


def textures(m: mujoco.MjModel, flat: list[int]) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Returns where each level of detail of each texture is, half as large each, their texels, and where the sky is."""
    texels: list[np.ndarray] = [np.zeros((1, 3))]
    levels, count = [], 1

    def image(t: int) -> np.ndarray:
        shape = int(m.tex_height[t]), int(m.tex_width[t]), int(m.tex_nchannel[t])
        return m.tex_data[m.tex_adr[t] :][: np.prod(shape)].reshape(shape)[..., :3] / 255.0

    for t in flat:
        now, rows = image(t), []
        while True:
            rows.append((count, now.shape[1], now.shape[0]))
            texels.append(np.broadcast_to(now, (*now.shape[:2], 3)).reshape(-1, 3))
            count += len(texels[-1])
            if now.shape[0] == now.shape[1] == 1:
                break
            now = np.pad(now, ((0, now.shape[0] % 2), (0, now.shape[1] % 2), (0, 0)), mode="edge")
            now = now.reshape(now.shape[0] // 2, 2, now.shape[1] // 2, 2, -1).mean((1, 3))
        levels.append(rows)
    most = max(map(len, levels), default=1)
    table = np.zeros((max(len(levels), 1), most, 3))
    for row, own in zip(table, levels, strict=False):
        row[:] = [*own, *[own[-1]] * (most - len(own))]
    skies = [t for t in range(m.ntex) if m.tex_type[t] == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)]
    if not skies:
        return table, np.concatenate(texels), (0, 0)
    sky = image(skies[0])
    sky = np.tile(sky, (1 if len(sky) > sky.shape[1] else 6, 1, 1))  # one side stands for all
    return table, np.concatenate([*texels, sky.reshape(-1, 3)]), (count, sky.shape[1])
