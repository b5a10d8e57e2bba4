"""What cameras see in all worlds: of each pixel, the shapes that can be there are tried, and the nearest is shaded."""

import functools
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import torch
import warp as wp

from torchrl_loco.eyes.placing import Placed, Sight, origin_of, pose_of, turn_of
from torchrl_loco.eyes.scene import OWN, SPOT, Looks, looks_of, mounts_of, to_the_horizon
from torchrl_loco.eyes.shapes import MISS, normal_of, to_mesh, to_shape
from torchrl_loco.sim import EXCLUSIVE, Buffer, current_stream
from torchrl_loco.sim.compiled.collision.kinds import MESH, PLANE
from torchrl_loco.sim.simulation import check_memory
from torchrl_loco.sim.varied import Varied

BYTES = {"rgb": 3, "depth": 4, "geoms": 4}  # of what a camera tells of each pixel
KINDS = tuple(BYTES)
TILES = {"cuda": (8, 4, 16), "cpu": (1, 1, 16)}
"""Width and height of the tile that neighbouring threads draw at once, a pixel each, and how many tiles they draw, one
below the other. On CUDA they are a warp, which finds the shapes that can be in a tile together, a thread for each."""
Color = wp.types.vector(length=3, dtype=wp.uint8)


@wp.struct
class View:
    """A camera's picture: half its size and the side of a pixel, on the plane at distance 1; and its size in pixels."""

    half: wp.vec2
    pixel: float
    width: int
    height: int
    far: float


@wp.func_native("""
#ifdef __CUDA_ARCH__
const int shape = first + threadIdx.x % 32;
bool meets = false;
if (shape < bounds.shape[1]) {
  const float4 at = reinterpret_cast<const float4*>(bounds.data)[size_t(world) * bounds.shape[1] + shape];
  meets = x1 >= at.x && y1 >= at.y && x0 <= at.z && y0 <= at.w;
}
return __ballot_sync(0xffffffffu, meets);
#else
const wp::vec_t<4, float>* const at = bounds.data + size_t(world) * bounds.shape[1] + first;
unsigned found = 0;
for (int k = 0; k < 32 && first + k < bounds.shape[1]; ++k) {
  if (x1 >= at[k].c[0] && y1 >= at[k].c[1] && x0 <= at[k].c[2] && y0 <= at[k].c[3]) found |= 1u << k;
}
return found;
#endif
""")
def candidates(
    bounds: wp.array2d[wp.vec4], world: int, first: int, x0: float, y0: float, x1: float, y1: float
) -> wp.uint32:
    """Returns which of 32 shapes can be in a rectangle of the picture, a bit each; all threads of a warp must ask."""


@wp.func_native("""
#ifdef __CUDA_ARCH__
return __ffs(bits) - 1;
#else
return __builtin_ctz(bits);
#endif
""")
def lowest(bits: wp.uint32) -> wp.int32:
    """Returns the number of the lowest bit that is set."""


@wp.func
def texel(looks: Looks, texture: int, u: float, v: float, spread: float) -> wp.vec3:
    """Returns the color of a texture where a pixel spreads over a share of it, in its level of detail."""
    last = looks.levels.shape[1] - 1
    base = looks.levels[texture, 0]
    level = wp.clamp(int(wp.log2(wp.max(spread * float(base[1]), 1.0))), 0, last)
    at = looks.levels[texture, level]
    x = wp.clamp(int((u - wp.floor(u)) * float(at[1])), 0, at[1] - 1)  # from below, too: far away u is not finite
    y = wp.clamp(int((v - wp.floor(v)) * float(at[2])), 0, at[2] - 1)
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
    look = looks.geom[geom]
    color, repeat, offset = 1.0 * look.color, look.repeat, look.offset
    if look.texture >= 0:
        u, v = repeat[0] * at[0] + offset[0], offset[1] - repeat[1] * at[1]
        color = wp.cw_mul(color, texel(looks, look.texture, u, v, spread * repeat[0]))
    return color


@wp.func
def of_spot(fade: wp.vec3, cone: wp.vec2, distance: float, inner: float) -> float:
    """Returns how strong a light is that is so far, at an angle to its axis with such a cosine."""
    strength = 1.0 / (fade[0] + distance * (fade[1] + distance * fade[2]))
    return wp.where(inner >= cone[0], strength * wp.pow(wp.max(inner, 0.0), cone[1]), 0.0)


@functools.cache
def tracer(
    rgb: bool, depth: bool, geoms: bool, shadows: bool, meshes: bool, samples: int, tiles: tuple[int, int, int]
) -> wp.Kernel:
    """Returns the kernel that draws what is asked for; ``tiles`` are some of ``TILES``."""
    across, down, times = tiles
    share = 1.0 / samples

    @wp.func
    def met(sight: Sight, world: int, tile: wp.vec4, d: wp.vec3):
        """Returns how far the nearest shape in a direction is, and which; of a mesh, its normal there and the triangle.

        ``tile`` is the part of the picture that the threads draw at once: least x and y, greatest x and y.
        """
        shapes, nearest, found, n, owner = sight.shapes, float(MISS), int(-1), wp.vec3(), int(-1)
        for first in range(0, sight.bounds.shape[1], 32):
            bits = candidates(sight.bounds, world, first, tile[0], tile[1], tile[2], tile[3])
            while bits != wp.uint32(0):
                k = first + lowest(bits)
                bits = bits & (bits - wp.uint32(1))
                pose, kind = pose_of(sight.poses, world, k), shapes.kind[k]
                o, own = origin_of(pose), turn_of(pose) @ d
                t = to_shape(kind, o, own, shapes.size[k])
                if wp.static(meshes):
                    if kind == MESH:
                        normal, face = wp.vec3(), int(0)
                        t, normal, face = to_mesh(shapes.mesh[k], o, own, nearest)
                        if t < nearest:
                            n, owner = normal, face
                if t < nearest:
                    nearest, found = t, k
        return nearest, found, n, owner

    @wp.func
    def lit(sight: Sight, world: int, p: wp.vec3, to: wp.vec3, most: float) -> bool:
        """Returns whether nothing lies between a point and a light."""
        shapes = sight.shapes
        for k in range(shapes.kind.shape[0]):
            kind, pose = shapes.kind[k], pose_of(sight.poses, world, k)
            o, d = origin_of(pose) + turn_of(pose) @ p, turn_of(pose) @ to
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
        sight: Sight, looks: Looks, world: int, p: wp.vec3, n: wp.vec3, eye: wp.vec3, base: wp.vec3, shine: wp.vec3
    ) -> wp.vec3:
        """Returns the color of a point that faces along ``n``, seen from ``eye``."""
        light, gloss = looks.ambient + wp.vec3(shine[0], shine[0], shine[0]), wp.vec3()
        for k in range(looks.light.shape[0]):
            one = looks.light[k]
            to, strength, most = eye, float(1.0), float(0.0)
            if one.kind != OWN:
                to, most = 1.0 * sight.light_axis[world, k - 1], MISS
                if one.kind == SPOT:
                    way = sight.light_pos[world, k - 1] - p
                    most = wp.length(way)
                    strength = of_spot(one.attenuation, one.cone, most, wp.dot(way, to) / most)
                    light += strength * one.ambient
                    to = way / most
            toward = wp.dot(n, to)
            if toward > 0.0 and strength > 0.0:
                if wp.static(shadows):
                    if one.shadow and not lit(sight, world, p + 1.0e-3 * n, to, most):
                        strength = 0.0
                light += strength * toward * one.diffuse
                mirrored = shine[1] * one.specular
                if wp.dot(mirrored, mirrored) > 0.0:  # the camera's own light has seldom any
                    half = wp.max(wp.dot(n, wp.normalize(to + eye)), 0.0)
                    gloss += strength * wp.pow(half, wp.max(shine[2], 1.0)) * mirrored
        return wp.cw_mul(base, light) + gloss

    # Divisions and roots that round as IEEE has it took a third of the time.
    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": True})
    def trace(
        view: View,
        sight: Sight,
        looks: Looks,
        mask: wp.array[bool],
        rgb_out: wp.array3d[Color],
        depth_out: wp.array3d[float],
        geoms_out: wp.array3d[int],
    ):
        world, thread = wp.tid()
        if mask and not mask[world]:
            return
        shapes, tile, lane = sight.shapes, thread // (across * down), thread % (across * down)
        per_row = (view.width + across - 1) // across
        left, top = (tile % per_row) * across, (tile // per_row) * (down * times)
        column, x0 = left + lane % across, view.pixel * float(left) - view.half[0]
        for upper in range(top, wp.min(top + down * times, view.height), down):
            row, y1 = upper + lane // across, view.half[1] - view.pixel * float(upper)
            corners = wp.vec4(x0, y1 - view.pixel * float(down), x0 + view.pixel * float(across), y1)
            color, nearest, geom = wp.vec3(), float(MISS), int(-1)
            for sample in range(int(wp.static(samples * samples))):
                x = view.pixel * (float(column) + (float(sample % samples) + 0.5) * share) - view.half[0]
                y = view.half[1] - view.pixel * (float(row) + (float(sample // samples) + 0.5) * share)
                d = wp.vec3(x, y, -1.0)
                nearest, found, n, owner = met(sight, world, corners, d)
                geom = int(-1)
                if found >= 0:
                    geom = shapes.geom[found]
                    if geom < 0:
                        geom = shapes.owner[owner]
                if wp.static(rgb):
                    if found < 0:
                        color += sky(looks, sight.camera_mat[world] @ d)
                    else:
                        p, pose = nearest * d, pose_of(sight.poses, world, found)
                        inside = origin_of(pose) + turn_of(pose) @ p
                        if shapes.kind[found] != MESH:
                            n = normal_of(shapes.kind[found], inside, shapes.size[found])
                        n = wp.transpose(turn_of(pose)) @ n
                        n = wp.where(wp.dot(n, d) > 0.0, -n, n)
                        length = wp.length(d)
                        eye = d / -length
                        slant = wp.max(wp.abs(wp.dot(n, eye)), 0.02)
                        spread = share * view.pixel * nearest * length / slant
                        base = painted(looks, geom, inside, spread)
                        color += shaded(sight, looks, world, p, n, eye, base, looks.geom[geom].shine)
            if row < view.height and column < view.width:
                if wp.static(depth):
                    depth_out[world, row, column] = wp.min(nearest, view.far)
                if wp.static(geoms):
                    geoms_out[world, row, column] = geom
                if wp.static(rgb):
                    color *= 255.0 * share * share
                    rgb_out[world, row, column] = Color(
                        wp.uint8(wp.clamp(color[0] + 0.5, 0.0, 255.0)),
                        wp.uint8(wp.clamp(color[1] + 0.5, 0.0, 255.0)),
                        wp.uint8(wp.clamp(color[2] + 0.5, 0.0, 255.0)),
                    )

    return trace


class Eye:
    """A camera, by its name or number, in each of several worlds of a model.

    Args:
        kinds: what it tells of each pixel, some of ``KINDS``.
        shadows: whether lights cast shadows.
        samples: rays along each side of a pixel, whose colors are averaged; depth and geoms are of the last.
        far: greatest depth (m).
        keeps: whether it has memory for what :meth:`launch` and :meth:`look` draw; :meth:`draw` needs none.
        varied: which numbers of the model vary, and their rows ``(worlds or more, count)``.

    Attributes:
        rgb: colors, uint8 ``(worlds, height, width, 3)``.
        depth: distance of what is seen (m), ``(worlds, height, width)``; ``far`` where nothing is nearer.
        geoms: number of the geom that is seen, -1 for none, int32 ``(worlds, height, width)``.

    Raises:
        ValueError: the camera has no perspective that ``fovy`` tells.
        MemoryError: the device has no room for what it tells.
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
        keeps: bool = True,
        varied: tuple[Varied, wp.array] | None = None,
    ) -> None:
        given, m, which = m, to_the_horizon(m), m.camera(camera).id
        self._device, half = device, math.tan(math.radians(m.cam_fovy[which] / 2.0))
        if keeps:
            needed = worlds * width * height * sum(BYTES[kind] for kind in kinds)
            check_memory(needed, worlds, torch.device(wp.device_to_torch(device)))
        with EXCLUSIVE, wp.ScopedDevice(device):
            differing, numbers = varied or (None, None)
            self.placed = Placed(m, device, mounts_of(m, which, device, differing), worlds, numbers)
            self._looks, self._view = looks_of(given, device), View()  # textures have the sizes of planes with an end
            self._view.half, self._view.pixel = wp.vec2(half * width / height, half), 2.0 * half / height
            self._view.width, self._view.height, self._view.far = width, height, far
            tiles = across, down, times = TILES["cuda" if device.is_cuda else "cpu"]
            self._threads = worlds, math.ceil(width / across) * across * math.ceil(height / (down * times)) * down
            asked = [kind in kinds for kind in KINDS]
            self._trace = tracer(*asked, shadows, self.placed.has_meshes, samples, tiles)
            shapes = [(worlds, height, width) if keeps and told else (0, 0, 0) for told in asked]
            self._out = [Buffer(shape, kind, device) for shape, kind in zip(shapes, (Color, float, int), strict=True)]
        self.rgb, self.depth, self.geoms = (one.torch for one in self._out)

    def launch(self, xpos: wp.array, xmat: wp.array, mask: wp.array | None = None) -> None:
        """Launches the kernels, on Warp's current stream; arguments as of :meth:`Placed.launch`."""
        self.placed.launch(xpos, xmat, mask)
        self.draw([one.warp for one in self._out], mask)

    def draw(self, out: Sequence[Any], mask: wp.array | None = None, stream: wp.Stream | None = None) -> None:
        """Launches what draws the shapes as ``placed`` has them, on a stream, ``None`` for Warp's current one.

        ``out`` are arrays of all ``KINDS``, ``(worlds, height, width)``, ``None`` for those that are not told.
        """
        inputs = [self._view, self.placed.sight, self._looks, mask]
        wp.launch(self._trace, self._threads, inputs, out, device=self._device, stream=stream)

    def look(self, xpos: wp.array, xmat: wp.array) -> None:
        """Launches the kernels on torch's stream; arguments as of :meth:`launch`."""
        with EXCLUSIVE, wp.ScopedDevice(self._device), wp.ScopedStream(current_stream(self._device)):
            self.launch(xpos, xmat)
