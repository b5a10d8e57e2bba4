"""Where cameras, lights and shapes are in each world: shapes before the camera, and where in its picture."""

from typing import Any

import mujoco
import warp as wp

from torchrl_loco.eyes.scene import AT_BODY, AT_COM, OF_COM, TRACKS, Mounts, Shapes, geoms_seen, shapes_of
from torchrl_loco.sim import EXCLUSIVE, fill
from torchrl_loco.sim.compiled.collision.kinds import CAPSULE, CYLINDER, PLANE

WHOLE = wp.constant(wp.float32(1.0e6))  # bound of a picture on the plane in front of the camera
NEAR = wp.constant(wp.float32(1.0e-4))  # depth from which a sphere is wholly in front of the camera (m)
Pose: Any = wp.types.matrix(shape=(3, 4), dtype=float)
"""Axes of the camera in the frame of a shape, then its place there, as columns."""


@wp.struct
class Sight:
    """Shapes as they lie before the camera of each world, where it is, and the lights in its frame."""

    shapes: Shapes
    poses: wp.array2d[Pose]
    bounds: wp.array2d[wp.vec4]  # from where to where each can be in the picture
    camera_pos: wp.array[wp.vec3]
    camera_mat: wp.array[wp.mat33]
    light_pos: wp.array2d[wp.vec3]
    light_axis: wp.array2d[wp.vec3]  # against what each shines


@wp.func_native("""
#ifdef __CUDA_ARCH__
const float4* const from = reinterpret_cast<const float4*>(poses.data + size_t(world) * poses.shape[1] + shape);
wp::mat_t<3, 4, float> pose;
for (int i = 0; i < 3; ++i) {  // a read each
  const float4 row = from[i];
  pose.data[i][0] = row.x, pose.data[i][1] = row.y, pose.data[i][2] = row.z, pose.data[i][3] = row.w;
}
return pose;
#else
return poses.data[size_t(world) * poses.shape[1] + shape];
#endif
""")
def pose_of(poses: wp.array2d[Pose], world: int, shape: int) -> Pose:
    """Returns how a camera lies before a shape."""


@wp.func
def turn_of(pose: Pose) -> wp.mat33:
    """Returns the axes of the camera alone."""
    x, y, z = pose[0], pose[1], pose[2]
    return wp.mat33(x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])


@wp.func
def origin_of(pose: Pose) -> wp.vec3:
    """Returns where the camera is."""
    return wp.vec3(pose[0, 3], pose[1, 3], pose[2, 3])


@wp.func
def inertial(mounts: Mounts, numbers: wp.array[float], k: int) -> float:
    """Returns one of the masses and centers of mass of a world, whose ``numbers`` are those that are its own."""
    column = mounts.column[k]
    if column >= 0:
        return numbers[column]
    return mounts.inertial[k]


@wp.func
def center(
    mounts: Mounts, numbers: wp.array[float], xpos: wp.array[wp.vec3], xmat: wp.array[wp.mat33], body: int
) -> wp.vec3:
    """Returns the center of mass of a subtree."""
    whole, found, bodies = float(0.0), wp.vec3(), mounts.subtree.shape[0]
    for b in range(body, body + mounts.subtree[body]):
        mass, at = inertial(mounts, numbers, b), bodies + 3 * b
        x, y, z = inertial(mounts, numbers, at), inertial(mounts, numbers, at + 1), inertial(mounts, numbers, at + 2)
        whole += mass
        found += mass * (xpos[b] + xmat[b] @ wp.vec3(x, y, z))
    return wp.where(whole > 0.0, found / wp.max(whole, 1.0e-9), xpos[body])


@wp.kernel(enable_backward=False)
def mount(
    mounts: Mounts,
    numbers: wp.array2d[float],
    mask: wp.array[bool],
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
    sight: Sight,
):
    """Writes where the camera is, and in its frame where lights are, and against what each shines."""
    world = wp.tid()
    if mask and not mask[world]:
        return
    for k in range(mounts.mode.shape[0]):
        mode, body = mounts.mode[k], mounts.body[k]
        pos, mat = 1.0 * mounts.pos[k], 1.0 * mounts.mat[k]
        if mode == TRACKS:
            pos = xpos[world, body] + pos
        elif mode == OF_COM:
            pos = center(mounts, numbers[world], xpos[world], xmat[world], body) + pos
        else:
            pos = xpos[world, body] + xmat[world, body] @ pos
            mat = xmat[world, body] @ mat
            if mode >= AT_BODY and mounts.target[k] >= 0:
                target = 1.0 * xpos[world, mounts.target[k]]
                if mode == AT_COM:
                    target = center(mounts, numbers[world], xpos[world], xmat[world], mounts.target[k])
                z = wp.normalize(pos - target)
                x = wp.cross(wp.vec3(0.0, 0.0, 1.0), z)
                x = wp.where(wp.length(x) > 0.0, wp.normalize(x), wp.vec3(1.0, 0.0, 0.0))  # as MuJoCo's does
                mat = wp.matrix_from_cols(x, wp.cross(z, x), z)
        if k == 0:
            sight.camera_pos[world] = pos
            sight.camera_mat[world] = mat
        else:
            into = wp.transpose(sight.camera_mat[world])
            sight.light_pos[world, k - 1] = into @ (pos - sight.camera_pos[world])
            sight.light_axis[world, k - 1] = into @ wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])


@wp.func
def bounds(c: wp.vec3, radius: float) -> wp.vec4:
    """Returns from where to where in the picture a sphere can be, x and y, of the camera's own frame."""
    far, near = radius - c[2], -radius - c[2]
    if far <= 0.0:
        return wp.vec4(WHOLE, WHOLE, -WHOLE, -WHOLE)
    if near <= NEAR:
        return wp.vec4(-WHOLE, -WHOLE, WHOLE, WHOLE)
    left, right, low, high = c[0] - radius, c[0] + radius, c[1] - radius, c[1] + radius
    return wp.vec4(
        wp.min(left / near, left / far),
        wp.min(low / near, low / far),
        wp.max(right / near, right / far),
        wp.max(high / near, high / far),
    )


@wp.kernel(enable_backward=False)
def place(mask: wp.array[bool], xpos: wp.array2d[wp.vec3], xmat: wp.array2d[wp.mat33], sight: Sight):
    """Writes how the camera lies before the shapes, and where these can be in its picture."""
    world, k = wp.tid()
    if mask and not mask[world]:
        return
    shapes = sight.shapes
    body, kind, size = shapes.body[k], shapes.kind[k], shapes.size[k]
    pos = xpos[world, body] + xmat[world, body] @ shapes.pos[k]
    mat = xmat[world, body] @ shapes.mat[k]
    camera = sight.camera_mat[world]
    origin = wp.transpose(mat) @ (sight.camera_pos[world] - pos)
    turn = wp.transpose(mat) @ camera
    pose = Pose()
    for i in range(3):
        for j in range(3):
            pose[i, j] = turn[i, j]
        pose[i, 3] = origin[i]
    sight.poses[world, k] = pose
    at = wp.transpose(camera) @ (pos - sight.camera_pos[world])
    found = wp.vec4(-WHOLE, -WHOLE, WHOLE, WHOLE)
    if kind == CAPSULE or kind == CYLINDER:  # noqa: SIM109 (Warp has no "in")
        axis = size[1] * (wp.transpose(camera) @ wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2]))
        one, other = bounds(at - axis, size[0]), bounds(at + axis, size[0])
        behind = one[0] > one[2] or other[0] > other[2]  # a part of it may pass the camera
        if behind and wp.min(one[0], other[0]) < WHOLE:
            one = wp.vec4(-WHOLE, -WHOLE, WHOLE, WHOLE)
        found = wp.vec4(
            wp.min(one[0], other[0]), wp.min(one[1], other[1]), wp.max(one[2], other[2]), wp.max(one[3], other[3])
        )
    elif kind != PLANE and shapes.geom[k] >= 0:
        found = bounds(at, shapes.radius[k])
    sight.bounds[world, k] = found


def bytes_placed(m: mujoco.MjModel) -> int:
    """Returns the memory that :class:`Placed` takes in a world (bytes), but for a few of the camera and lights."""
    alone, of_ground = geoms_seen(m)
    return (len(alone) + bool(of_ground)) * 4 * (12 + 4)


class Placed:
    """The shapes of a model as they lie before a camera, or before where rays begin, in each of several worlds.

    ``mounts`` tells what holds the camera and the lights, ``numbers`` are rows of what varies of the model.
    """

    def __init__(
        self, m: mujoco.MjModel, device: wp.Device, mounts: Mounts, worlds: int, numbers: wp.array | None = None
    ) -> None:
        self._mounts, self._device = mounts, device
        with EXCLUSIVE, wp.ScopedDevice(device):
            shapes, self._meshes = shapes_of(m, device)
            self.has_meshes = bool(self._meshes)
            self._numbers = wp.empty((worlds, 0), dtype=float) if numbers is None else numbers
            size, lights = (worlds, shapes.kind.shape[0]), (worlds, mounts.mode.shape[0] - 1)
            self.sight = fill(
                Sight,
                shapes=shapes,
                poses=wp.empty(size, dtype=Pose),
                bounds=wp.empty(size, dtype=wp.vec4),
                camera_pos=wp.empty(worlds, dtype=wp.vec3),
                camera_mat=wp.empty(worlds, dtype=wp.mat33),
                light_pos=wp.empty(lights, dtype=wp.vec3),
                light_axis=wp.empty(lights, dtype=wp.vec3),
            )

    def launch(self, xpos: wp.array, xmat: wp.array, mask: wp.array | None) -> None:
        """Launches what places them in the worlds of a mask, ``None`` for all, on Warp's current stream.

        ``xpos`` and ``xmat`` are positions (m) and orientations of the bodies, ``(worlds or more, nbody)``.
        """
        sight, device = self.sight, self._device
        inputs = [mask, xpos, xmat, sight]
        wp.launch(mount, sight.camera_mat.shape, [self._mounts, self._numbers, *inputs], device=device)
        wp.launch(place, sight.bounds.shape, inputs, device=device)
