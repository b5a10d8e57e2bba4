"""Kinds of ground: functions of a difficulty that return a patch."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from torchrl_loco.checks import NOT_NEGATIVE, check_float

DEEP = 1.0  # how far boxes reach below what lies deepest in a patch (m)


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


Kind = Callable[[float, Generator, float, float], Patch]
"""Makes a patch from a difficulty, a generator, the length of a side and the distance of two points (m)."""

Bounds = tuple[float, float]  # a figure in the easiest patch, and in the hardest


def between(bounds: Bounds, difficulty: float) -> float:
    """Returns the number that lies between two as far as the difficulty says."""
    return bounds[0] + (bounds[1] - bounds[0]) * difficulty


def points(size: float, cell: float) -> np.ndarray:
    """Returns coordinates of points from edge to edge (m)."""
    return np.linspace(-size / 2, size / 2, round(size / cell) + 1)


def ring(outer: float, width: float, top: float, bottom: float) -> list[list[float]]:
    """Returns four boxes of a width, from bottom to top, within the edges of a square of half side ``outer`` (m).

    There are none of no width.
    """
    if abs(width) < 1e-9:
        return []
    middle, half, z = outer - width / 2, width / 2, [(top + bottom) / 2, (top - bottom) / 2]
    long = [[0.0, sign * middle, z[0], outer, half, z[1]] for sign in (-1, 1)]
    return long + [[sign * middle, 0.0, z[0], half, outer - width, z[1]] for sign in (-1, 1)]


def block(half: float, top: float, bottom: float) -> list[list[float]]:
    """Returns a square box about the center."""
    return [[0.0, 0.0, (top + bottom) / 2, half, half, (top - bottom) / 2]]


def check_room(needed: float, size: float, words: str) -> None:
    """Raises ValueError if what a kind puts side by side, in words, is longer than a patch."""
    if needed > size + 1e-9:
        raise ValueError(f"{words} ({needed:g} m) must fit into a patch of {size:g} m")


# Kinds. All begin with the same four arguments, which not each needs; what follows are its figures.


def flat(difficulty: float, rng: Generator, size: float, cell: float) -> Patch:
    """Returns level ground."""
    return Patch(heights=np.zeros((len(points(size, cell)),) * 2))


def slope(
    difficulty: float,
    rng: Generator,
    size: float,
    cell: float,
    gradient: Bounds = (0.0, 0.6),
    platform: float = 2.0,
    down: bool = False,
) -> Patch:
    """Returns a pyramid with a level middle, or a pit with ``down``.

    ``gradient`` is rise over run, ``platform`` a side of the middle (m).
    """
    check_room(platform, size, "the platform of a slope")
    from_edge = np.minimum(size / 2 - np.abs(points(size, cell)), size / 2 - platform / 2)
    steep = between(gradient, difficulty) * (-1 if down else 1)
    return Patch(heights=steep * np.minimum(from_edge[:, None], from_edge[None]))


def rough(
    difficulty: float, rng: Generator, size: float, cell: float, height: Bounds = (0.02, 0.1), step: float = 0.01
) -> Patch:
    """Returns points of random heights: multiples of ``step`` (m), the largest of ``height`` (m)."""
    most = round(check_float("height of rough", between(height, difficulty), NOT_NEGATIVE) / check_float("step", step))
    return Patch(heights=step * rng.integers(0, most + 1, (len(points(size, cell)),) * 2))


def wave(
    difficulty: float, rng: Generator, size: float, cell: float, amplitude: Bounds = (0.0, 0.1), waves: float = 4.0
) -> Patch:
    """Returns as many ``waves`` along each side, from their middle height; ``amplitude`` (m) is that along one axis."""
    phase = 2 * math.pi * waves * points(size, cell) / size
    return Patch(heights=between(amplitude, difficulty) * (np.sin(phase)[None] + np.sin(phase)[:, None]))


def stairs(
    difficulty: float,
    rng: Generator,
    size: float,
    cell: float,
    height: Bounds = (0.02, 0.18),
    width: float = 0.3,
    platform: float = 3.0,
    frame: float = 1.0,
    down: bool = False,
) -> Patch:
    """Returns square rings of steps up to a platform, or down to it.

    Steps have a ``height`` and a ``width`` (m), the platform has a side of ``platform`` (m) at least, the level ground
    around a width of ``frame`` (m).
    """
    width = check_float("width of stairs", width)
    check_room(2 * frame + 2 * width + platform, size, "twice frame and width of stairs, and their platform")
    rise, steps = between(height, difficulty), int((size / 2 - frame - platform / 2) / width + 1e-9)
    sign, bottom = (-1 if down else 1), -(steps + 1) * rise - DEEP
    boxes = ring(size / 2, frame, 0.0, bottom)
    for k in range(steps):
        boxes += ring(size / 2 - frame - k * width, width, sign * (k + 1) * rise, bottom)
    boxes += block(size / 2 - frame - steps * width, sign * (steps + 1) * rise, bottom)
    return Patch(boxes=np.array(boxes))


def obstacles(
    difficulty: float,
    rng: Generator,
    size: float,
    cell: float,
    height: Bounds = (0.03, 0.2),
    count: int = 40,
    length: tuple[float, float] = (0.3, 1.0),
    platform: float = 2.0,
) -> Patch:
    """Returns boxes that are strewn over level ground, but for a square of side ``platform`` (m) in its middle.

    Of ``count`` boxes that are thrown, those that reach the middle or the edge are left out. Each is between half of
    ``height`` (m) and all of it high; ``length`` has the least and the greatest of its sides (m).
    """
    check_room(platform, size, "the free middle between obstacles")
    top = between(height, difficulty) * rng.uniform(0.5, 1.0, count)
    half = rng.uniform(*length, (count, 2)) / 2
    center = rng.uniform(-1.0, 1.0, (count, 2)) * (size / 2 - half)
    clear = (np.abs(center) - half > platform / 2).any(axis=1)
    boxes = np.column_stack([center, (top - DEEP) / 2, half, (top + DEEP) / 2])
    return Patch(heights=flat(difficulty, rng, size, cell).heights, boxes=boxes[clear])


def stepping_stones(
    difficulty: float,
    rng: Generator,
    size: float,
    cell: float,
    stone: Bounds = (0.8, 0.3),
    gap: Bounds = (0.05, 0.3),
    height: Bounds = (0.0, 0.1),
    platform: float = 2.0,
    depth: float = 1.0,
) -> Patch:
    """Returns stones in a pit, around a platform: large ones close together to small ones apart.

    Stones have a side of ``stone`` (m), are ``gap`` (m) apart, as far from platform and edge, and differ by up to
    ``height`` (m) from the border's, either way. ``platform`` is the least side of the platform, ``depth`` that of the
    pit (m).
    """
    side, apart, uneven = (between(bounds, difficulty) for bounds in (stone, gap, height))
    bottom, pitch = -depth - DEEP, side + apart
    count = int((size - 0.5 - apart) / pitch + 1e-9)  # of stones across; the edge takes what is left
    within = math.ceil((platform + apart) / pitch - 1e-9)  # of them in whose place the platform is
    count -= (count - within) % 2
    words = "the platform, a stone, gaps and the edge on both sides"
    check_room((within + 2) * pitch + apart + 0.5, size, words)
    edge = (size - count * pitch - apart) / 2
    boxes = ring(size / 2, edge, 0.0, bottom) + block(size / 2 - edge, -depth, bottom)
    boxes += block((within * pitch - apart) / 2, 0.0, bottom)
    places = pitch * (np.arange(count) - (count - 1) / 2)
    for x in places:
        for y in places:
            if max(abs(x), abs(y)) > within * pitch / 2:
                top = rng.uniform(-uneven, uneven)
                boxes.append([x, y, (top + bottom) / 2, side / 2, side / 2, (top - bottom) / 2])
    return Patch(boxes=np.array(boxes))


def gap(
    difficulty: float,
    rng: Generator,
    size: float,
    cell: float,
    width: Bounds = (0.05, 0.6),
    platform: float = 2.0,
    depth: float = 1.0,
) -> Patch:
    """Returns a platform, of side ``platform`` (m), with a gap of a ``width`` and a ``depth`` (m) around it."""
    far, bottom = platform / 2 + between(width, difficulty), -depth - DEEP
    check_room(2 * far, size, "a platform and the gap around it")
    boxes = ring(size / 2, size / 2 - far, 0.0, bottom) + block(platform / 2, 0.0, bottom)
    return Patch(boxes=np.array(boxes + block(far, -depth, bottom)))


def pit(
    difficulty: float, rng: Generator, size: float, cell: float, depth: Bounds = (0.05, 0.5), platform: float = 3.0
) -> Patch:
    """Returns a pit of a ``depth`` (m) with upright walls; ``platform`` is a side of its floor (m)."""
    deep = between(depth, difficulty)
    check_room(platform, size, "the floor of a pit")
    boxes = ring(size / 2, size / 2 - platform / 2, 0.0, -deep - DEEP) + block(platform / 2, -deep, -deep - DEEP)
    return Patch(boxes=np.array(boxes))
