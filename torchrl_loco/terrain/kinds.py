"""Kinds of ground: functions of a difficulty that return a patch."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

DEEP = 1.0
"""How far boxes reach below what lies deepest in a patch (m)."""


@dataclasses.dataclass(frozen=True)
class Patch:
    """A square of ground about its center; what is not told is level with the border, at height 0.

    Attributes:
        heights: of points that are equally far apart, from edge to edge (m), ``(rows along y, columns along
            x)``. Those at the edges become 0.
        boxes: centers and half sizes (m), ``(count, 6)``. Without ``heights`` they are all that there is.
    """

    heights: np.ndarray | None = None
    boxes: np.ndarray | None = None


Kind = Callable[[float, np.random.Generator, float, float], Patch]
"""Makes a patch from a difficulty, a generator, the length of a side and the distance of two points (m)."""


def between(bounds: tuple[float, float], difficulty: float) -> float:
    """Returns the number that lies between two as far as the difficulty says."""
    return bounds[0] + (bounds[1] - bounds[0]) * difficulty


def points(size: float, cell: float) -> np.ndarray:
    """Returns coordinates of points from edge to edge (m)."""
    return np.linspace(-size / 2, size / 2, round(size / cell) + 1)


def from_edge(size: float, cell: float) -> np.ndarray:
    """Returns how far each point of a patch is from the nearest edge (m), ``(points, points)``."""
    along = size / 2 - np.abs(points(size, cell))
    return np.minimum(along[:, None], along[None])


def ring(outer: float, width: float, top: float, bottom: float) -> list[list[float]]:
    """Returns four boxes that lie around a square.

    Args:
        outer: half a side, outside (m).
        width: of the ring (m).
        top: its height (m).
        bottom: where it begins (m).
    """
    middle, half, z = outer - width / 2, width / 2, [(top + bottom) / 2, (top - bottom) / 2]
    long = [[0.0, sign * middle, z[0], outer, half, z[1]] for sign in (-1, 1)]
    return long + [[sign * middle, 0.0, z[0], half, outer - width, z[1]] for sign in (-1, 1)]


def block(half: float, top: float, bottom: float) -> list[list[float]]:
    """Returns a square box about the center."""
    return [[0.0, 0.0, (top + bottom) / 2, half, half, (top - bottom) / 2]]


# Kinds. Each begins with what all of them take.


def flat(difficulty: float, rng: np.random.Generator, size: float, cell: float) -> Patch:
    """Returns level ground."""
    return Patch(heights=np.zeros((len(points(size, cell)),) * 2))


def slope(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    gradient: tuple[float, float] = (0.0, 0.6),
    platform: float = 2.0,
    down: bool = False,
) -> Patch:
    """Returns a pyramid, or a pit, with a level middle.

    Args:
        difficulty: from the least gradient to the greatest.
        rng: not used.
        size: a side (m).
        cell: distance of two points (m).
        gradient: the least and the greatest, rise over run.
        platform: a side of the middle (m).
        down: whether it goes down to the middle.
    """
    steep = between(gradient, difficulty) * (-1 if down else 1)
    heights = steep * np.minimum(from_edge(size, cell), size / 2 - platform / 2)
    return Patch(heights=heights)


def rough(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    height: tuple[float, float] = (0.02, 0.1),
    step: float = 0.01,
) -> Patch:
    """Returns points of random heights.

    Args:
        difficulty: from the least height to the greatest.
        rng: draws the heights.
        size: a side (m).
        cell: distance of two points (m).
        height: the largest, in the easiest patch and in the hardest (m).
        step: of which heights are multiples (m).
    """
    most = max(1, round(between(height, difficulty) / step))
    heights = step * rng.integers(0, most + 1, (len(points(size, cell)),) * 2)
    return Patch(heights=heights)


def wave(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    amplitude: tuple[float, float] = (0.0, 0.1),
    waves: float = 4.0,
) -> Patch:
    """Returns waves along both axes, from their middle height.

    Args:
        difficulty: from the least amplitude to the greatest.
        rng: not used.
        size: a side (m).
        cell: distance of two points (m).
        amplitude: of the waves along one axis (m).
        waves: along a side.
    """
    phase = 2 * math.pi * waves * points(size, cell) / size
    heights = between(amplitude, difficulty) * (np.sin(phase)[None] + np.sin(phase)[:, None])
    return Patch(heights=heights)


def stairs(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    height: tuple[float, float] = (0.02, 0.18),
    width: float = 0.3,
    platform: float = 3.0,
    frame: float = 1.0,
    down: bool = False,
) -> Patch:
    """Returns square rings of steps up to a platform, or down.

    Args:
        difficulty: from the least height to the greatest.
        rng: not used.
        size: a side (m).
        cell: not used.
        height: of a step (m).
        width: of a step (m).
        platform: the least length of its side (m).
        frame: width of the level ground around (m).
        down: whether they go down.
    """
    rise, steps = between(height, difficulty), int((size / 2 - frame - platform / 2) / width)
    sign, bottom = (-1 if down else 1), -(steps + 1) * rise - DEEP
    boxes = ring(size / 2, frame, 0.0, bottom)
    for k in range(steps):
        boxes += ring(size / 2 - frame - k * width, width, sign * (k + 1) * rise, bottom)
    boxes += block(size / 2 - frame - steps * width, sign * (steps + 1) * rise, bottom)
    return Patch(boxes=np.array(boxes))


def obstacles(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    height: tuple[float, float] = (0.03, 0.2),
    count: int = 40,
    length: tuple[float, float] = (0.3, 1.0),
    platform: float = 2.0,
) -> Patch:
    """Returns boxes that are strewn over level ground, but for its middle.

    Args:
        difficulty: from the least height to the greatest.
        rng: draws places, lengths and heights.
        size: a side (m).
        cell: distance of two points (m).
        height: the largest of a box; each has between half of it and all (m).
        count: boxes that are thrown; those that reach the middle or the edge are left out.
        length: of their sides (m).
        platform: a side of the middle (m).
    """
    top = between(height, difficulty) * rng.uniform(0.5, 1.0, count)
    half = rng.uniform(*length, (count, 2)) / 2
    center = rng.uniform(-1.0, 1.0, (count, 2)) * (size / 2 - half)
    clear = (np.abs(center) - half > platform / 2).any(axis=1)
    boxes = np.column_stack([center, (top - DEEP) / 2, half, (top + DEEP) / 2])
    return Patch(heights=flat(difficulty, rng, size, cell).heights, boxes=boxes[clear])


def stepping_stones(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    stone: tuple[float, float] = (0.8, 0.3),
    gap: tuple[float, float] = (0.05, 0.3),
    height: tuple[float, float] = (0.0, 0.1),
    platform: float = 2.0,
    depth: float = 1.0,
) -> Patch:
    """Returns stones in a pit, around a platform.

    Args:
        difficulty: from large stones close together to small ones apart.
        rng: draws the heights of the stones.
        size: a side (m).
        cell: not used.
        stone: length of their sides (m).
        gap: between two (m).
        height: by which they differ from the border's, either way (m).
        platform: a side of it (m).
        depth: of the pit (m).
    """
    side, apart, uneven = (between(bounds, difficulty) for bounds in (stone, gap, height))
    bottom = -depth - DEEP
    boxes = ring(size / 2, 0.25, 0.0, bottom) + block(size / 2 - 0.25, -depth, bottom)
    boxes += block(platform / 2, 0.0, bottom)
    places = np.arange(-size / 2 + 0.25 + apart + side / 2, size / 2 - 0.25 - side / 2 - apart, side + apart)
    for x in places:
        for y in places:
            if max(abs(x), abs(y)) - side / 2 > platform / 2:
                top = rng.uniform(-uneven, uneven)
                boxes.append([x, y, (top + bottom) / 2, side / 2, side / 2, (top - bottom) / 2])
    return Patch(boxes=np.array(boxes))


def gap(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    width: tuple[float, float] = (0.05, 0.6),
    platform: float = 2.0,
    depth: float = 1.0,
) -> Patch:
    """Returns a platform with a gap around it.

    Args:
        difficulty: from the narrowest gap to the widest.
        rng: not used.
        size: a side (m).
        cell: not used.
        width: of the gap (m).
        platform: a side of it (m).
        depth: of the gap (m).
    """
    far, bottom = platform / 2 + between(width, difficulty), -depth - DEEP
    boxes = ring(size / 2, size / 2 - far, 0.0, bottom) + block(platform / 2, 0.0, bottom)
    return Patch(boxes=np.array(boxes + block(far, -depth, bottom)))


def pit(
    difficulty: float,
    rng: np.random.Generator,
    size: float,
    cell: float,
    depth: tuple[float, float] = (0.05, 0.5),
    platform: float = 3.0,
) -> Patch:
    """Returns a pit with upright walls.

    Args:
        difficulty: from the shallowest to the deepest.
        rng: not used.
        size: a side (m).
        cell: not used.
        depth: of the pit (m).
        platform: a side of its floor (m).
    """
    deep = between(depth, difficulty)
    boxes = ring(size / 2, size / 2 - platform / 2, 0.0, -deep - DEEP) + block(platform / 2, -deep, -deep - DEEP)
    return Patch(boxes=np.array(boxes))
