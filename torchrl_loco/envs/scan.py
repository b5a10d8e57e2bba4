"""Scans of the ground below a body, and what cameras see, as arrays: made before the part of hooks that reads them."""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
import torch
import warp as wp

from torchrl_loco.envs.heights import Ground
from torchrl_loco.eyes.rays import Rays
from torchrl_loco.eyes.tracer import Eye
from torchrl_loco.sim import Buffer, Simulation, fill_from_numbers
from torchrl_loco.sim.compiled.collision.ground import NOTHING

UPRIGHT = 0.1  # length of the body's x axis, laid flat, below which its y axis tells the yaw
NONE = wp.constant(wp.float32(NOTHING))


@dataclasses.dataclass(frozen=True)
class ScanRequest:
    """A scan that hooks have asked for."""

    body: int
    points: tuple[tuple[float, float], ...]  # ahead of the body and to its left (m)


@dataclasses.dataclass(frozen=True)
class DepthRequest:
    """What a camera sees, for which hooks have asked."""

    camera: int
    width: int
    height: int
    far: float  # greatest depth (m)


@dataclasses.dataclass(frozen=True)
class RayRequest:
    """Rays from a site, for which hooks have asked."""

    site: int
    directions: tuple[tuple[float, float, float], ...]  # in its frame, of length 1
    far: float  # greatest distance (m)


Request = ScanRequest | DepthRequest | RayRequest


@wp.struct
class Tables:
    """The ground as tables; of a field its first point, cells along both axes, and their lengths (m)."""

    plane: float
    corners: wp.array[wp.vec3]
    lengths: wp.array[wp.vec2]
    counts: wp.array[wp.vec3i]  # columns, rows, number of its first height
    heights: wp.array[float]
    grid: wp.vec3  # its first corner, and the length of a cell (m)
    columns: int
    rows: int
    first: wp.array[int]
    named: wp.array[int]
    places: wp.array[wp.vec4]  # of the boxes: center and half size along both axes (m)
    tops: wp.array[float]


@wp.func
def below(ground: Tables, x: float, y: float):
    """Returns the height of the ground below a point (m); see :func:`.heights.below`."""
    found = ground.plane
    for k in range(ground.corners.shape[0]):
        corner, length, count = ground.corners[k], ground.lengths[k], ground.counts[k]
        u, v = (x - corner[0]) / length[0], (y - corner[1]) / length[1]
        columns, rows = float(count[0]), float(count[1])
        if u >= 0.0 and u <= columns and v >= 0.0 and v <= rows:
            i, j = wp.min(wp.floor(u), columns - 1.0), wp.min(wp.floor(v), rows - 1.0)
            s, t = u - i, v - j
            at = count[2] + int(j) * (count[0] + 1) + int(i)
            first, last = ground.heights[at], ground.heights[at + count[0] + 2]
            right, up = ground.heights[at + 1], ground.heights[at + count[0] + 1]
            over = s * (right - first) + t * (last - right)
            if t > s:
                over = s * (last - up) + t * (up - first)
            found = wp.max(found, first + over)
    if ground.columns > 0 and x == x and y == y:  # of what is not finite there is no cell
        column = int(wp.clamp(wp.floor((x - ground.grid[0]) / ground.grid[2]), 0.0, float(ground.columns - 1)))
        row = int(wp.clamp(wp.floor((y - ground.grid[1]) / ground.grid[2]), 0.0, float(ground.rows - 1)))
        cell = row * ground.columns + column
        for k in range(ground.first[cell], ground.first[cell + 1]):
            box = ground.named[k]
            place = ground.places[box]
            if wp.abs(x - place[0]) <= place[2] and wp.abs(y - place[1]) <= place[3]:
                found = wp.max(found, ground.tops[box])
    return found


@wp.kernel(enable_backward=False)
def scan(
    ground: Tables,
    body: int,
    points: wp.array[wp.vec2],
    mask: wp.array[bool],
    xpos: wp.array2d[wp.vec3],
    xmat: wp.array2d[wp.mat33],
    heights_out: wp.array2d[float],
):
    world, point = wp.tid()
    if mask and not mask[world]:
        return
    place, mat, grid = xpos[world, body], xmat[world, body], points[point]
    x, y = mat[0, 0], mat[1, 0]
    if wp.sqrt(x * x + y * y) < UPRIGHT:
        x, y = mat[1, 1], -mat[0, 1]
    length = wp.sqrt(x * x + y * y)
    x, y = x / length, y / length
    height = below(ground, place[0] + x * grid[0] - y * grid[1], place[1] + y * grid[0] + x * grid[1])
    heights_out[world, point] = wp.where(height > 0.5 * NONE, place[2] - height, wp.nan)


class Scans:
    """The scans, depths and rays that hooks ask for, by name. The ground is asked for only if one scans it.

    Attributes:
        arrays: of scans, heights of the body above the ground at each point (m), NaN where there is none, ``(nworld,
            points)``; of cameras, depths (m), ``(nworld, height, width)``; of rays, distances (m), ``(nworld, rays)``.
    """

    def __init__(self, sim: Simulation, asked: Mapping[str, Request], ground: Callable[[], Ground]) -> None:
        self._eyes = {name: eye_of(sim, one) for name, one in asked.items() if not isinstance(one, ScanRequest)}
        self._asked = {name: one for name, one in asked.items() if isinstance(one, ScanRequest)}
        self._sim = sim
        self._ground = tables(ground(), sim.device) if self._asked else None
        kept = {name: np.array(one.points, dtype=np.float32) for name, one in self._asked.items()}
        self._points = {name: wp.array(points, dtype=wp.vec2, device=sim.device) for name, points in kept.items()}
        self._out = {name: Buffer((sim.num_envs, len(points)), float, sim.device) for name, points in kept.items()}
        self.arrays: dict[str, torch.Tensor] = {name: out.torch for name, out in self._out.items()}
        for name, eye in self._eyes.items():
            self.arrays[name] = eye.depth if isinstance(eye, Eye) else eye.distance

    def launch(self, mask: wp.array | None = None) -> None:
        """Launches them in the worlds of a mask, in all of them for ``None``."""
        data = self._sim.data
        for name, one in self._asked.items():
            inputs = [self._ground, one.body, self._points[name], mask, data.xpos, data.xmat]
            out = self._out[name].warp
            wp.launch(scan, dim=out.shape, inputs=inputs, outputs=[out], device=self._sim.device)
        for eye in self._eyes.values():
            eye.launch(data.xpos, data.xmat, mask)


def eye_of(sim: Simulation, asked: DepthRequest | RayRequest) -> Eye | Rays:
    """Returns what sees for hooks."""
    m, n = sim.mj_model, sim.num_envs
    if isinstance(asked, DepthRequest):
        size = asked.width, asked.height
        return Eye(m, sim.device, asked.camera, *size, n, ("depth",), far=asked.far, varied=sim.varied_numbers)
    return Rays(m, sim.device, asked.site, np.array(asked.directions), n, asked.far)


def tables(ground: Ground, device: wp.Device) -> Tables:
    """Returns the ground as tables on a device."""
    shapes = [field.heights.shape for field in ground.fields]
    starts = np.cumsum([0, *(rows * columns for rows, columns in shapes)])
    heights = [field.heights.ravel() + field.corner[2] for field in ground.fields]
    grid, boxes = ground.grid, ground.boxes
    return fill_from_numbers(
        Tables,
        device,
        plane=ground.plane,
        corners=[field.corner for field in ground.fields],
        lengths=[field.cell for field in ground.fields],
        counts=[(columns - 1, rows - 1, start) for (rows, columns), start in zip(shapes, starts, strict=False)],
        heights=np.concatenate(heights) if heights else [],
        grid=wp.vec3(*grid.corner, grid.cell) if grid else wp.vec3(),
        columns=grid.shape[0] if grid else 0,
        rows=grid.shape[1] if grid else 0,
        first=grid.first if grid else [],
        named=grid.named if grid else [],
        places=boxes[:, :4],
        tops=boxes[:, 4],
    )
