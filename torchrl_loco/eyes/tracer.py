"""What cameras see in all worlds: a thread a pixel tries the shapes that can be there, and shades the nearest."""

import functools
import math
from typing import Any

import mujoco
import warp as wp

from torchrl_loco.eyes.placing import Placed
from torchrl_loco.eyes.scene import Looks, Shapes, looks_of, mounts_of, to_the_horizon
from torchrl_loco.eyes.shapes import MISS, normal_of, to_mesh, to_shape
from torchrl_loco.sim import EXCLUSIVE, Buffer, current_stream
from torchrl_loco.sim.compiled.collision.kinds import MESH, PLANE

KINDS = ("rgb", "depth", "geoms")  # what a camera tells of each pixel
Color = wp.types.vector(length=3, dtype=wp.uint8)


@wp.struct
class View:
    """A camera's picture: half its height and width on the plane at distance 1, in pixels its size, and its options."""

    half: wp.vec2
    width: int
    height: int
    samples: int
    far: float


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


@wp.func
def painted(looks: Looks, geom: int, at: wp.vec3, spread: float) -> wp.vec3:
    """Returns the color of a geom at a place in its own frame, over which a pixel spreads so far (m)."""
    color, texture = 1.0 * looks.color[geom], looks.texture[geom]
    if texture >= 0:
        repeat, offset = looks.repeat[geom], looks.offset[geom]
        u, v = repeat[0] * at[0] + offset[0], offset[1] - repeat[1] * at[1]
        color = wp.cw_mul(color, texel(looks, texture, u, v, spread * repeat[0]))
    return color


@wp.func
def of_spot(looks: Looks, light: int, distance: float, inner: float) -> float:
    """Returns how strong a light is that is so far, at an angle to its axis with such a cosine."""
    fade, cone = looks.attenuation[light], looks.cone[light]
    strength = 1.0 / (fade[0] + distance * (fade[1] + distance * fade[2]))
    return wp.where(inner >= cone[0], strength * wp.pow(wp.max(inner, 0.0), cone[1]), 0.0)


@functools.cache
def tracer(rgb: bool, depth: bool, geoms: bool, shadows: bool, meshes: bool) -> wp.Kernel:
    """Returns the kernel that traces the rays of a pixel, for what is asked for."""

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

    @wp.func
    def shaded(
        shapes: Shapes,
        looks: Looks,
        light_pos: wp.array[wp.vec3],
        light_axis: wp.array[wp.vec3],
        origin: wp.array[wp.vec3],
        turn: wp.array[wp.mat33],
        p: wp.vec3,
        n: wp.vec3,
        eye: wp.vec3,
        base: wp.vec3,
        shine: wp.vec3,
    ) -> wp.vec3:
        """Returns the color of a point that faces along ``n``, seen from ``eye``; the camera has the first light."""
        light, gloss = looks.ambient + wp.vec3(shine[0], shine[0], shine[0]), wp.vec3()
        for k in range(looks.diffuse.shape[0]):
            to, strength, most = eye, float(1.0), float(0.0)
            if k > 0:
                to, most = 1.0 * light_axis[k - 1], MISS
                if looks.light_kind[k - 1] == 0:
                    way = light_pos[k - 1] - p
                    most = wp.length(way)
                    strength = of_spot(looks, k - 1, most, wp.dot(way, to) / most)
                    to = way / most
            toward = wp.dot(n, to)
            if toward > 0.0 and strength > 0.0:
                if wp.static(shadows):
                    if k > 0 and looks.shadow[k - 1]:
                        if not lit(shapes, origin, turn, p + 1.0e-3 * n, to, most):
                            strength = 0.0
                light += strength * toward * looks.diffuse[k]
                mirrored = shine[1] * looks.specular[k]
                if wp.dot(mirrored, mirrored) > 0.0:  # the camera's own light has seldom any
                    half = wp.max(wp.dot(n, wp.normalize(to + eye)), 0.0)
                    gloss += strength * wp.pow(half, wp.max(shine[2], 1.0)) * mirrored
        return wp.cw_mul(base, light) + gloss

    # Divisions and roots that round as IEEE has it took a third of the time.
    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True})
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
                depth_out[world, row, column] = wp.min(nearest, view.far)
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
                    eye = -wp.normalize(d)
                    slant = wp.max(wp.abs(wp.dot(n, eye)), 0.02)
                    spread = 2.0 * view.half[1] / float(view.height * view.samples) * wp.length(p) / slant
                    base = painted(looks, geom, inside, spread)
                    color += shaded(
                        shapes,
                        looks,
                        light_pos[world],
                        light_axis[world],
                        origin[world],
                        turn[world],
                        p,
                        n,
                        eye,
                        base,
                        looks.shine[geom],
                    )
        if wp.static(rgb):
            scale = 255.0 * share * share
            rgb_out[world, row, column] = Color(
                wp.uint8(wp.clamp(scale * color[0] + 0.5, 0.0, 255.0)),
                wp.uint8(wp.clamp(scale * color[1] + 0.5, 0.0, 255.0)),
                wp.uint8(wp.clamp(scale * color[2] + 0.5, 0.0, 255.0)),
            )

    return trace


class Eye:
    """A camera, by its name or number, in each of several worlds of a model.

    Args:
        kinds: what it tells of each pixel, some of ``KINDS``.
        shadows: whether lights cast shadows.
        samples: rays along each side of a pixel, whose colors are averaged; depth and geoms are of the last.
        far: greatest depth (m).

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
    ) -> None:
        m, which = to_the_horizon(m), m.camera(camera).id
        self._device, half = device, math.tan(math.radians(m.cam_fovy[which] / 2.0))
        with EXCLUSIVE, wp.ScopedDevice(device):
            self._placed = Placed(m, device, mounts_of(m, which, device), worlds)
            self._looks, self._view = looks_of(m, device), View()
            self._view.half, self._view.far = wp.vec2(half * width / height, half), far
            self._view.width, self._view.height, self._view.samples = width, height, samples
            self._trace = tracer(*(kind in kinds for kind in KINDS), shadows, self._placed.has_meshes)

            def pixels(kind: str, dtype: Any) -> Buffer:
                return Buffer((worlds, height, width) if kind in kinds else (0, 0, 0), dtype, device)

            self._out = [pixels(*one) for one in zip(KINDS, (Color, float, int), strict=True)]
        self.rgb, self.depth, self.geoms = (one.torch for one in self._out)

    def launch(self, xpos: wp.array, xmat: wp.array, mask: wp.array | None = None) -> None:
        """Launches the kernels, on Warp's current stream; arguments as of :meth:`Placed.launch`."""
        placed, out = self._placed, [one.warp for one in self._out]
        placed.launch(xpos, xmat, mask)
        size = next(one.shape for one in out if one.size)
        where = [mask, placed.camera, *placed.lights, *placed.placed, placed.bounds]
        wp.launch(self._trace, size, [self._view, placed.shapes, self._looks, *where], out, device=self._device)

    def look(self, xpos: wp.array, xmat: wp.array) -> None:
        """Launches the kernels on torch's stream; arguments as of :meth:`launch`."""
        with EXCLUSIVE, wp.ScopedDevice(self._device), wp.ScopedStream(current_stream(self._device)):
            self.launch(xpos, xmat)
