"""What cameras see in all worlds: a thread a pixel, after one a shape has said where in the picture it can be."""

import functools
from typing import Any

import mujoco
import torch
import warp as wp

from torchrl_loco.eyes.scene import Looks, Mounts, Shapes, looks_of, mounts_of, shapes_of, to_the_horizon
from torchrl_loco.eyes.shapes import CAPSULE, CYLINDER, FIELD, MESH, MISS, PLANE, normal_of, to_shape
from torchrl_loco.sim import EXCLUSIVE, Buffer, current_stream

KINDS = ("rgb", "depth", "geoms")
"""What a camera tells of each pixel."""
WHOLE = wp.constant(wp.float32(1.0e6))
"""Bound of a picture on the plane in front of the camera."""
NEAR = wp.constant(wp.float32(1.0e-4))
"""Depth from which a sphere is wholly in front of the camera (m)."""
TRACKS = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TRACK))
OF_COM = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM))
AT_BODY = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY))
AT_COM = wp.constant(int(mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODYCOM))

Color = wp.types.vector(length=3, dtype=wp.uint8)


@wp.struct
class View:
    """A camera's picture: half its height and width on the plane at distance 1, in pixels its size, and its options."""

    half: wp.vec2
    width: int
    height: int
    samples: int
    far: float
    along_ray: bool


@wp.func
def center(mounts: Mounts, xpos: wp.array[wp.vec3], xmat: wp.array[wp.mat33], body: int) -> wp.vec3:
    """Returns the center of mass of a subtree."""
    whole, found = float(0.0), wp.vec3()
    for b in range(body, body + mounts.subtree[body]):
        whole += mounts.mass[b]
        found += mounts.mass[b] * (xpos[b] + xmat[b] @ mounts.ipos[b])
    return wp.where(whole > 0.0, found / wp.max(whole, 1.0e-9), xpos[body])


@wp.kernel(enable_backward=False)
def mount(
    # In:
    mounts: Mounts,
    mask: wp.array[bool],
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
    # Out:
    camera_pos_out: wp.array[wp.vec3],
    camera_mat_out: wp.array[wp.mat33],
    light_pos_out: wp.array2d[wp.vec3],
    light_axis_out: wp.array2d[wp.vec3],
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
            pos = center(mounts, xpos[world], xmat[world], body) + pos
        else:
            pos = xpos[world, body] + xmat[world, body] @ pos
            mat = xmat[world, body] @ mat
            if mode >= AT_BODY and mounts.target[k] >= 0:
                target = 1.0 * xpos[world, mounts.target[k]]
                if mode == AT_COM:
                    target = center(mounts, xpos[world], xmat[world], mounts.target[k])
                z = wp.normalize(pos - target)
                x = wp.normalize(wp.cross(wp.vec3(0.0, 0.0, 1.0), z))
                mat = wp.matrix_from_cols(x, wp.cross(z, x), z)
        if k == 0:
            camera_pos_out[world] = pos
            camera_mat_out[world] = mat
        else:
            into = wp.transpose(camera_mat_out[world])
            light_pos_out[world, k - 1] = into @ (pos - camera_pos_out[world])
            light_axis_out[world, k - 1] = into @ wp.vec3(mat[0, 2], mat[1, 2], mat[2, 2])


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
def place(
    # In:
    shapes: Shapes,
    mask: wp.array[bool],
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
    camera_pos: wp.array[wp.vec3],
    camera_mat: wp.array[wp.mat33],
    # Out:
    origin_out: wp.array2d[wp.vec3],
    turn_out: wp.array2d[wp.mat33],
    bounds_out: wp.array2d[wp.vec4],
):
    world, k = wp.tid()
    if mask and not mask[world]:
        return
    body, kind, size = shapes.body[k], shapes.kind[k], shapes.size[k]
    pos = xpos[world, body] + xmat[world, body] @ shapes.pos[k]
    mat = xmat[world, body] @ shapes.mat[k]
    camera = camera_mat[world]
    origin_out[world, k] = wp.transpose(mat) @ (camera_pos[world] - pos)
    turn_out[world, k] = wp.transpose(mat) @ camera
    at = wp.transpose(camera) @ (pos - camera_pos[world])
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
    elif kind != PLANE and kind != FIELD and shapes.geom[k] >= 0:
        found = bounds(at, shapes.radius[k])
    bounds_out[world, k] = found


@wp.func
def texel(looks: Looks, texture: int, u: float, v: float, spread: float) -> wp.vec3:
    """Returns the color of a texture where a pixel spreads over a share of it, in its level of detail."""
    last = looks.levels.shape[1] - 1
    base = looks.levels[texture, 0]
    level = wp.clamp(int(wp.log2(wp.max(spread * float(base[1]), 1.0))), 0, last)
    at = looks.levels[texture, level]
    x = wp.min(int((u - wp.floor(u)) * float(at[1])), at[1] - 1)
    y = wp.min(int((v - wp.floor(v)) * float(at[2])), at[2] - 1)
    return looks.texels[at[0] + y * at[1] + x]


@wp.func
def sky(looks: Looks, d: wp.vec3) -> wp.vec3:
    """Returns the color of the sky in a direction: of the side of a cube, in the order of OpenGL, whose y is up."""
    width = looks.sky[1]
    if width == 0:
        return wp.vec3()
    x, y, z = d[0], d[2], -d[1]
    ax, ay, az = wp.abs(x), wp.abs(y), wp.abs(z)
    side, s, t, most = int(0), -z, -y, ax
    if ax >= ay and ax >= az:
        if x < 0.0:
            side, s = 1, z
    elif ay >= az:
        side, s, t, most = 2, x, z, ay
        if y < 0.0:
            side, t = 3, -z
    else:
        side, s, most = 4, x, az
        if z < 0.0:
            side, s = 5, -x
    column = wp.clamp(int(0.5 * (s / most + 1.0) * float(width)), 0, width - 1)
    row = wp.clamp(int(0.5 * (t / most + 1.0) * float(width)), 0, width - 1)
    return looks.texels[looks.sky[0] + (side * width + row) * width + column]


@functools.cache
def tracer(rgb: bool, depth: bool, geoms: bool, shadows: bool, meshes: bool) -> wp.Kernel:
    """Returns the kernel that traces the rays of a pixel, for what is asked for."""

    @wp.func
    def to_mesh(mesh: wp.uint64, o: wp.vec3, d: wp.vec3, most: float):
        """Returns distance, normal and triangle; a miss is far away."""
        length = wp.length(d)
        met = wp.mesh_query_ray(mesh, o, d / length, most * length)
        return wp.where(met.result, met.t / length, MISS), met.normal, met.face

    @wp.func
    def lit(
        shapes: Shapes, origin: wp.array[wp.vec3], turn: wp.array[wp.mat33], p: wp.vec3, to: wp.vec3, most: float
    ) -> bool:
        """Returns whether nothing lies between a point and a light."""
        for k in range(shapes.kind.shape[0]):
            kind, o, d = shapes.kind[k], origin[k] + turn[k] @ p, turn[k] @ to
            if kind != PLANE:
                # The nearest that it comes to the shape's middle is within the sphere around it.
                along = -wp.dot(o, d) / wp.dot(d, d)
                aside, radius = o + wp.max(along, 0.0) * d, shapes.radius[k]
                if shapes.geom[k] < 0 or wp.dot(aside, aside) <= radius * radius:
                    t = to_shape(kind, o, d, shapes.size[k])
                    if wp.static(meshes):
                        if kind == MESH:
                            t, _n, _f = to_mesh(shapes.mesh[k], o, d, most)
                    if t < most:
                        return False
        return True

    @wp.kernel(enable_backward=False, module="unique")
    def trace(
        # In:
        view: View,
        shapes: Shapes,
        looks: Looks,
        mask: wp.array[bool],
        camera_mat: wp.array[wp.mat33],
        light_pos: wp.array2d[wp.vec3],
        light_axis: wp.array2d[wp.vec3],
        origin: wp.array2d[wp.vec3],
        turn: wp.array2d[wp.mat33],
        bound: wp.array2d[wp.vec4],
        # Out:
        rgb_out: wp.array3d[Color],
        depth_out: wp.array3d[float],
        geoms_out: wp.array3d[int],
    ):
        world, row, column = wp.tid()
        if mask and not mask[world]:
            return
        color, share = wp.vec3(), 1.0 / float(view.samples)
        for sample in range(view.samples * view.samples):
            i, j = float(sample // view.samples), float(sample % view.samples)
            x = view.half[0] * (2.0 * (float(column) + (j + 0.5) * share) / float(view.width) - 1.0)
            y = view.half[1] * (1.0 - 2.0 * (float(row) + (i + 0.5) * share) / float(view.height))
            d = wp.vec3(x, y, -1.0)
            nearest, found, n, owner = float(MISS), int(-1), wp.vec3(), int(-1)
            for k in range(shapes.kind.shape[0]):
                at = bound[world, k]
                if x >= at[0] and y >= at[1] and x <= at[2] and y <= at[3]:
                    o, own, kind = origin[world, k], turn[world, k] @ d, shapes.kind[k]
                    t = to_shape(kind, o, own, shapes.size[k])
                    if wp.static(meshes):
                        if kind == MESH:
                            normal, face = wp.vec3(), int(0)
                            t, normal, face = to_mesh(shapes.mesh[k], o, own, nearest)
                            if t < nearest:
                                n, owner = normal, face
                    if t < nearest:
                        nearest, found = t, k
            geom = int(-1)
            if found >= 0:
                geom = shapes.geom[found]
                if geom < 0:
                    geom = shapes.owner[owner]
            if wp.static(depth):
                long = wp.where(view.along_ray, wp.length(d), 1.0)
                depth_out[world, row, column] = wp.min(nearest * long, view.far)
            if wp.static(geoms):
                geoms_out[world, row, column] = geom
            if wp.static(rgb):
                if found < 0:
                    color += sky(looks, camera_mat[world] @ d)
                else:
                    p, back = nearest * d, turn[world, found]
                    inside = origin[world, found] + back @ p
                    if shapes.kind[found] != MESH:
                        n = normal_of(shapes.kind[found], inside, shapes.size[found])
                    n = wp.transpose(back) @ n
                    n = wp.where(wp.dot(n, d) > 0.0, -n, n)
                    base, shine, eye = 1.0 * looks.color[geom], looks.shine[geom], -wp.normalize(d)
                    texture = looks.texture[geom]
                    if texture >= 0:
                        repeat, offset = looks.repeat[geom], looks.offset[geom]
                        spread = 2.0 * view.half[1] / float(view.height * view.samples) * nearest
                        spread = spread * wp.length(d) / wp.max(wp.abs(wp.dot(n, eye)), 0.02) * repeat[0]
                        u, v = repeat[0] * inside[0] + offset[0], offset[1] - repeat[1] * inside[1]
                        base = wp.cw_mul(base, texel(looks, texture, u, v, spread))
                    light = looks.ambient + wp.vec3(shine[0], shine[0], shine[0])
                    gloss = wp.vec3()
                    for k in range(looks.diffuse.shape[0]):
                        to, strength, most = eye, float(1.0), float(0.0)
                        if k > 0:  # the first is the camera's own
                            to, most = 1.0 * light_axis[world, k - 1], MISS
                            if looks.light_kind[k - 1] == 0:
                                way = light_pos[world, k - 1] - p
                                most = wp.length(way)
                                inner = wp.dot(way, to) / most
                                to = way / most
                                fade, cone = looks.attenuation[k - 1], looks.cone[k - 1]
                                strength = 1.0 / (fade[0] + most * (fade[1] + most * fade[2]))
                                strength *= wp.where(inner >= cone[0], wp.pow(wp.max(inner, 0.0), cone[1]), 0.0)
                        toward = wp.dot(n, to)
                        if toward > 0.0 and strength > 0.0:
                            if wp.static(shadows):
                                if most > 0.0 and looks.shadow[k - 1]:
                                    start = p + 1.0e-3 * n
                                    if not lit(shapes, origin[world], turn[world], start, to, most):
                                        strength = 0.0
                            light += strength * toward * looks.diffuse[k]
                            half = wp.max(wp.dot(n, wp.normalize(to + eye)), 0.0)
                            gloss += strength * shine[1] * wp.pow(half, wp.max(shine[2], 1.0)) * looks.specular[k]
                    color += wp.cw_mul(base, light) + gloss
        if wp.static(rgb):
            scale = 255.0 * share * share
            rgb_out[world, row, column] = Color(
                wp.uint8(wp.clamp(scale * color[0] + 0.5, 0.0, 255.0)),
                wp.uint8(wp.clamp(scale * color[1] + 0.5, 0.0, 255.0)),
                wp.uint8(wp.clamp(scale * color[2] + 0.5, 0.0, 255.0)),
            )

    return trace


class Eye:
    """A camera in each of several worlds of a model.

    Args:
        m: the model.
        device: where.
        camera: name or number of a camera of the model.
        width: pixels in a row, at least 1.
        height: rows, at least 1.
        worlds: how many worlds.
        kinds: what it tells of each pixel, some of ``KINDS``.
        shadows: whether lights cast shadows.
        samples: rays along each side of a pixel, whose colors are averaged; depth and geoms are of the last.
        far: greatest depth (m).
        along_ray: whether depth is along the ray instead of the camera's axis.

    Attributes:
        rgb: colors, uint8 ``(worlds, height, width, 3)``.
        depth: distance of what is seen (m), ``(worlds, height, width)``; ``far`` where nothing is nearer.
        geoms: number of the geom that is seen, -1 for none, int32 ``(worlds, height, width)``.

    Raises:
        ValueError: the camera has no perspective that ``fovy`` tells.
    """

    def __init__(
        self,
        m: mujoco.MjModel,
        device: wp.Device,
        camera: str | int,
        width: int,
        height: int,
        worlds: int,
        kinds: tuple[str, ...] = ("rgb",),
        *,
        shadows: bool = False,
        samples: int = 1,
        far: float = 1.0e10,
        along_ray: bool = False,
    ) -> None:
        m, which = to_the_horizon(m), m.camera(camera).id
        self._device, half = device, float(torch.tan(torch.deg2rad(torch.tensor(m.cam_fovy[which] / 2.0))))
        with EXCLUSIVE, wp.ScopedDevice(device):
            self._mounts, self._looks = mounts_of(m, which, device), looks_of(m, device)
            self._shapes, self._meshes = shapes_of(m, device)
            self._view = View()
            self._view.half, self._view.far = wp.vec2(half * width / height, half), far
            self._view.width, self._view.height = width, height
            self._view.samples, self._view.along_ray = samples, along_ray
            self._trace = tracer(*(kind in kinds for kind in KINDS), shadows, bool(self._meshes))
            lights, shapes = (worlds, self._mounts.mode.shape[0] - 1), (worlds, self._shapes.kind.shape[0])
            self._camera = [wp.empty(worlds, dtype=kind) for kind in (wp.vec3, wp.mat33)]
            self._lights = [wp.empty(lights, dtype=wp.vec3) for _ in range(2)]
            self._placed = [wp.empty(shapes, dtype=kind) for kind in (wp.vec3, wp.mat33, wp.vec4)]
            self._everywhere = wp.empty(0, dtype=bool)

            def pixels(kind: str, dtype: Any) -> Buffer:
                return Buffer((worlds, height, width) if kind in kinds else (0, 0, 0), dtype, device)

            self._out = [pixels(*one) for one in zip(KINDS, (Color, float, int), strict=True)]
        self.rgb, self.depth, self.geoms = (one.torch for one in self._out)

    def launch(self, xpos: wp.array, xmat: wp.array, mask: wp.array | None = None) -> None:
        """Launches the kernels, on Warp's current stream.

        Args:
            xpos: positions of the bodies (m), ``(worlds or more, nbody)``.
            xmat: their orientations.
            mask: the worlds that look; ``None`` is all.
        """
        mask = self._everywhere if mask is None else mask
        out = [one.warp for one in self._out]
        (worlds, shapes), size = self._placed[0].shape, next(one.shape for one in out if one.size)
        here, where = [mask, xpos, xmat], [mask, self._camera[1], *self._lights, *self._placed]
        for kernel, dim, inputs, outputs in (
            (mount, worlds, [self._mounts, *here], [*self._camera, *self._lights]),
            (place, (worlds, shapes), [self._shapes, *here, *self._camera], self._placed),
            (self._trace, size, [self._view, self._shapes, self._looks, *where], out),
        ):
            wp.launch(kernel, dim, inputs, outputs, device=self._device)

    def look(self, xpos: wp.array, xmat: wp.array) -> None:
        """Launches the kernels on torch's stream; arguments as of :meth:`launch`."""
        with EXCLUSIVE, wp.ScopedDevice(self._device), wp.ScopedStream(current_stream(self._device)):
            self.launch(xpos, xmat)


def bytes_of(worlds: int, width: int, height: int, kinds: tuple[str, ...]) -> int:
    """Returns the memory that the pixels of a camera take (bytes)."""
    return worlds * width * height * sum({"rgb": 3, "depth": 4, "geoms": 4}[kind] for kind in kinds)
