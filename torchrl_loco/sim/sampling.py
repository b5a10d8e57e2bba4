"""What a world draws at its reset: a random stream of its own, a state of a table, or a pose free of contact."""

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.sim.world_func import fill_from_numbers

MAX_TRIES = 64
"""Poses drawn before one in contact is kept. Three of four humanoid poses are free, so this does not happen."""


@wp.func
def world_stream(seed: wp.uint32, world: int, episode: int) -> wp.uint32:
    """Start of the random stream of one episode: a function of (seed, world, episode) alone.

    It has 32 bits: of n episodes, about n^2 / 2^33 pairs start alike.
    """
    return wp.rand_init(int(wp.rand_init(int(seed), world)), episode)


@wp.struct
class Table:
    """States, ``(count, nq)`` or ``(count, nq + nv)``, and what one of them is written to."""

    states: wp.array2d[float]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]


@wp.func
def draw_from_table(world: int, table: Table, stream: wp.uint32):
    """Draws a row of a table uniformly: ``qpos``, then ``qvel`` if the table has columns for it."""
    row = wp.randi(stream, 0, table.states.shape[0])
    nq = table.qpos.shape[1]
    for i in range(nq):
        table.qpos[world, i] = table.states[row, i]
    for i in range(table.states.shape[1] - nq):
        table.qvel[world, i] = table.states[row, nq + i]


@wp.struct
class PlanarBody:
    """The joints of a planar body: their ranges ``(1, njnt)``, and which of qpos is the pitch."""

    jnt_range: wp.array2d[wp.vec2]
    pitch: int
    qpos: wp.array2d[float]


@wp.func
def draw_pitch_and_hinges(world: int, body: PlanarBody, stream: wp.uint32):
    """Draws the pitch of a planar body in (-pi, pi), and the hinges that follow it uniformly in their ranges."""
    body.qpos[world, body.pitch] = wp.randf(stream, -wp.pi, wp.pi)
    for i in range(body.pitch + 1, body.qpos.shape[1]):  # the hinges, all with limits
        limits = body.jnt_range[0, i]
        body.qpos[world, i] = wp.randf(stream, limits[0], limits[1])


@wp.func
def positive_quaternion(stream: wp.uint32):
    """Draws four numbers from U(0, 1) and normalises them; returns (w, x, y, z) and the advanced stream.

    dm_control orients free joints so. It favours some orientations, and is kept for comparable returns.
    """
    w = wp.randf(stream)
    x = wp.randf(stream)
    y = wp.randf(stream)
    z = wp.randf(stream)
    return wp.normalize(wp.vec4(w, x, y, z)), stream


@wp.func
def segment_distance(p: wp.vec3, u: wp.vec3, q: wp.vec3, v: wp.vec3) -> float:
    """Distance of the segments ``p + s u`` and ``q + t v``, s and t in [-1, 1]; points have ``u`` or ``v`` zero."""
    return wp.closest_point_edge_edge(p - u, p + u, q - v, q + v, 1.0e-12)[2]


@wp.struct
class Skeleton:
    """What forward kinematics and the contact test of one world need of a model. Geom 0 is the floor, z = 0.

    Names, shapes and units are those of ``MjModel``, but for these.

    Attributes:
        body_jnt: first joint and number of joints, ``(nbody, 2)``.
        jnt_free: whether it is a free joint, else a hinge, ``(njnt,)``.
        geom_axis: from the center to the end of the capsule's segment (m), zero for a sphere, ``(ngeom,)``.
        geom_radius: radius (m), ``(ngeom,)``.
        pair: geoms that may touch, ``(npair,)``.
    """

    body_parentid: wp.array[int]
    body_jnt: wp.array[wp.vec2i]
    body_pos: wp.array[wp.vec3]
    body_quat: wp.array[wp.quat]
    jnt_qposadr: wp.array[int]
    jnt_free: wp.array[bool]
    jnt_pos: wp.array[wp.vec3]
    jnt_axis: wp.array[wp.vec3]
    jnt_range: wp.array[wp.vec2]
    geom_bodyid: wp.array[int]
    geom_pos: wp.array[wp.vec3]
    geom_axis: wp.array[wp.vec3]
    geom_radius: wp.array[float]
    pair: wp.array[wp.vec2i]


@wp.func
def draw_joints(skeleton: Skeleton, stream: wp.uint32, qpos: wp.array[float]) -> wp.uint32:
    """Draws the orientation of free joints and every hinge uniformly in its range; root positions stay."""
    for joint in range(skeleton.jnt_qposadr.shape[0]):
        address = skeleton.jnt_qposadr[joint]
        if skeleton.jnt_free[joint]:
            quat, stream = positive_quaternion(stream)
            for i in range(4):
                qpos[address + 3 + i] = quat[i]
        else:
            limits = skeleton.jnt_range[joint]
            qpos[address] = wp.randf(stream, limits[0], limits[1])
    return stream


@wp.func
def pose_bodies(skeleton: Skeleton, qpos: wp.array[float], xpos: wp.array[wp.vec3], xquat: wp.array[wp.quat]):
    """Forward kinematics of one world; ``xquat`` is (x, y, z, w), Warp's order."""
    xpos[0] = wp.vec3(0.0)
    xquat[0] = wp.quat_identity()
    for body in range(1, skeleton.body_parentid.shape[0]):
        parent = skeleton.body_parentid[body]
        pos = xpos[parent] + wp.quat_rotate(xquat[parent], skeleton.body_pos[body])
        quat = xquat[parent] * skeleton.body_quat[body]
        first = skeleton.body_jnt[body][0]
        for joint in range(first, first + skeleton.body_jnt[body][1]):
            q = skeleton.jnt_qposadr[joint]
            if skeleton.jnt_free[joint]:
                pos = wp.vec3(qpos[q], qpos[q + 1], qpos[q + 2])
                quat = wp.quat(qpos[q + 4], qpos[q + 5], qpos[q + 6], qpos[q + 3])
            else:
                anchor = pos + wp.quat_rotate(quat, skeleton.jnt_pos[joint])
                quat = quat * wp.quat_from_axis_angle(skeleton.jnt_axis[joint], qpos[q])
                pos = anchor - wp.quat_rotate(quat, skeleton.jnt_pos[joint])
        xpos[body] = pos
        xquat[body] = quat


@wp.func
def in_contact(skeleton: Skeleton, xpos: wp.array[wp.vec3], xquat: wp.array[wp.quat]) -> bool:
    """Whether any pair of geoms of one world overlaps."""
    for i in range(skeleton.pair.shape[0]):
        a = skeleton.pair[i][0]
        b = skeleton.pair[i][1]
        body = skeleton.geom_bodyid[b]
        q = xpos[body] + wp.quat_rotate(xquat[body], skeleton.geom_pos[b])
        v = wp.quat_rotate(xquat[body], skeleton.geom_axis[b])
        if a == 0:  # the floor
            if q[2] - wp.abs(v[2]) < skeleton.geom_radius[b]:
                return True
        else:
            body = skeleton.geom_bodyid[a]
            p = xpos[body] + wp.quat_rotate(xquat[body], skeleton.geom_pos[a])
            u = wp.quat_rotate(xquat[body], skeleton.geom_axis[a])
            if segment_distance(p, u, q, v) < skeleton.geom_radius[a] + skeleton.geom_radius[b]:
                return True
    return False


@wp.struct
class FreePose:
    """A skeleton, what its pose is written to, and room for the poses of its bodies."""

    skeleton: Skeleton
    qpos: wp.array2d[float]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]


@wp.func
def draw_free_pose(world: int, args: FreePose, stream: wp.uint32):
    """Draws orientations of free joints and hinges until no geoms touch."""
    touching = bool(True)
    tries = int(0)
    while touching and tries < MAX_TRIES:
        stream = draw_joints(args.skeleton, stream, args.qpos[world])
        pose_bodies(args.skeleton, args.qpos[world], args.xpos[world], args.xquat[world])
        touching = in_contact(args.skeleton, args.xpos[world], args.xquat[world])
        tries += 1


@wp.struct
class Outline:
    """How far a rigid body reaches in any direction: a sum of sphere, segment and ellipsoid for each geom.

    Attributes:
        center: center of the geom in the body's frame (m), ``(ngeom,)``.
        radius: radius of the sphere (m), ``(ngeom,)``.
        segment: half of the segment (m), ``(ngeom,)``.
        axes: semi-axes of the ellipsoid as columns (m), ``(ngeom,)``.
    """

    center: wp.array[wp.vec3]
    radius: wp.array[float]
    segment: wp.array[wp.vec3]
    axes: wp.array[wp.mat33]


@wp.func
def depth_below(outline: Outline, down: wp.vec3) -> float:
    """How far the body reaches beyond its origin in the direction ``down`` of its frame (m)."""
    depth = float(-wp.inf)
    for i in range(outline.radius.shape[0]):
        reach = wp.length(wp.transpose(outline.axes[i]) * down) + wp.abs(wp.dot(outline.segment[i], down))
        depth = wp.max(depth, wp.dot(outline.center[i], down) + outline.radius[i] + reach)
    return depth


@wp.struct
class RootAboveFloor:
    """A rigid body on a free joint, the height of an increment (m), and what its pose is written to."""

    outline: Outline
    increment: float
    qpos: wp.array2d[float]


@wp.func
def draw_orientation_above_floor(world: int, args: RootAboveFloor, stream: wp.uint32):
    """Draws the orientation of a free root uniformly, and raises it in increments until it is off the floor."""
    w = wp.randn(stream)
    x = wp.randn(stream)
    y = wp.randn(stream)
    z = wp.randn(stream)
    quat = wp.normalize(wp.quat(x, y, z, w))
    down = wp.quat_rotate_inv(quat, wp.vec3(0.0, 0.0, -1.0))
    args.qpos[world, 0] = 0.0
    args.qpos[world, 1] = 0.0
    args.qpos[world, 2] = wp.ceil(depth_below(args.outline, down) / args.increment) * args.increment
    args.qpos[world, 3] = quat[3]
    for i in range(3):
        args.qpos[world, 4 + i] = quat[i]


def make_outline(mj_model: mujoco.MjModel, device: wp.Device) -> Outline:
    """Returns the outline of a tree on a free joint, in its default pose and the root's frame; geom 0 is the floor."""
    m, data, kinds = mj_model, mujoco.MjData(mj_model), mujoco.mjtGeom
    mujoco.mj_kinematics(m, data)
    root, size = data.xmat[1].reshape(3, 3), m.geom_size[1:]
    sphere, capsule, cylinder, ellipsoid = (
        (m.geom_type[1:] == kind)[:, None]
        for kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER, kinds.mjGEOM_ELLIPSOID)
    )
    if not (sphere | capsule | cylinder | ellipsoid).all():
        raise ValueError("an outline consists of spheres, capsules, cylinders and ellipsoids")
    frames = root.T @ data.geom_xmat[1:].reshape(-1, 3, 3)
    disks = size[:, [0, 0, 0]] * (cylinder * (1.0, 1.0, 0.0))
    return fill_from_numbers(
        Outline,
        device,
        center=(data.geom_xpos[1:] - data.xpos[1]) @ root,
        radius=size[:, 0] * (sphere | capsule)[:, 0],
        segment=frames[:, :, 2] * size[:, 1:2] * (capsule | cylinder),
        axes=frames * (size * ellipsoid + disks)[:, None],
    )


def make_skeleton(mj_model: mujoco.MjModel, pairs: np.ndarray, device: wp.Device) -> Skeleton:
    """Returns the skeleton of a model; ``pairs`` are the geoms that may touch, lower id first, ``(npair, 2)``."""
    m, joint, geom = mj_model, mujoco.mjtJoint, mujoco.mjtGeom
    if (
        m.geom_type[0] != geom.mjGEOM_PLANE
        or not np.isin(m.geom_type[1:], (geom.mjGEOM_CAPSULE, geom.mjGEOM_SPHERE)).all()
    ):
        raise ValueError("contact-free poses need a floor as geom 0 and only capsules and spheres after it")
    if not np.isin(m.jnt_type, (joint.mjJNT_FREE, joint.mjJNT_HINGE)).all():
        raise ValueError("contact-free poses need a model of free joints and hinges only")

    half_length = np.where(m.geom_type == geom.mjGEOM_CAPSULE, m.geom_size[:, 1], 0.0)
    geom_axis = np.zeros((m.ngeom, 3))
    for i in range(m.ngeom):
        mujoco.mju_rotVecQuat(geom_axis[i], np.array([0.0, 0.0, half_length[i]]), m.geom_quat[i])
    return fill_from_numbers(
        Skeleton,
        device,
        m,
        body_jnt=np.stack([m.body_jntadr, m.body_jntnum], axis=1),
        body_quat=m.body_quat[:, [1, 2, 3, 0]],
        jnt_free=m.jnt_type == joint.mjJNT_FREE,
        geom_axis=geom_axis,
        geom_radius=m.geom_size[:, 0],
        pair=pairs,
    )
