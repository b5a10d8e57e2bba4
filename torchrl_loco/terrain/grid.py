"""Patches of ground on a grid, and the model that lies under a robot."""

import copy
import dataclasses
import inspect
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from torchrl_loco.checks import SEED, check_float, check_int, check_multiple, check_packages
from torchrl_loco.config import read_mjcf
from torchrl_loco.terrain.kinds import DEEP, Kind, Patch

OF_PLANE = (
    *("contype", "conaffinity", "condim", "priority", "friction", "solref", "solimp", "solmix", "margin", "gap"),
    *("material", "rgba", "group"),
)
"""What the ground has of the plane that it replaces."""
CLEAR = 0.8  # half a side of the square about the middle of a patch over which a robot may begin (m)
SEAM = 1e-5  # by how much boxes are wider, so that points between two that meet are on one of them (m)
LEAST = 1e-3  # range of a height field that is flat (m), which MuJoCo needs to be positive


class Terrain:
    """Patches on a grid: rows along x by difficulty, from 0 to 1, columns along y by kind; level ground around them.

    It is a function of its arguments and the seed.

    Args:
        kinds: functions by name, or a function and its share of the columns, 1 by default.
        rows: difficulties.
        columns: how many; each kind has one at least.
        size: a side of a patch (m).
        cell: distance of two points of its height field (m), of which a side is a multiple.
        border: width of the ground around the grid (m).
        seed: of what is drawn.

    Attributes:
        origins: where robots begin (m), ``(rows, columns, 3)``: the middle of each patch, as high as the highest ground
            within 0.8 m of it.
        kinds: the kind of each column.
        difficulties: those of the rows.
        heights: of the points of the field (m), ``(along y, along x)``.
        boxes: centers and half sizes of all boxes (m), ``(count, 6)``.

    Raises:
        ValueError: an argument is out of range, or a kind returns a patch that is none; the message says which.
        TypeError: an argument has the wrong type, or a kind is no function.
    """

    def __init__(
        self,
        kinds: Mapping[str, Kind | tuple[Kind, float]],
        rows: int = 10,
        columns: int = 20,
        *,
        size: float = 8.0,
        cell: float = 0.1,
        border: float = 20.0,
        seed: int = 0,
    ) -> None:
        self.rows, self.columns = check_int("rows", rows), check_int("columns", columns)
        self.size, self.cell = check_float("size", size), check_float("cell", cell)
        self.border, seed = check_float("border", border), check_int("seed", seed, SEED)
        if not isinstance(kinds, Mapping):
            raise TypeError(f"kinds must be a dict of functions by name, got {kinds!r}")
        if wrong := [name for name, kind in kinds.items() if isinstance(kind, tuple) and len(kind) != 2]:
            raise TypeError(f"kind {wrong[0]} must be a function, or a function and its share")
        if size / 2 + border < CLEAR:
            words = f"size / 2 + border ({size:g} / 2 + {border:g}) must be at least {CLEAR:g} m"
            raise ValueError(f"{words}, as robots begin so far from the middle of a patch")
        if not kinds or len(kinds) > columns:
            raise ValueError(f"kinds must be 1 to {columns}, the number of columns, got {len(kinds)}")
        side = check_multiple("size", self.size, "cell", self.cell)
        functions = {name: kind if isinstance(kind, tuple) else (kind, 1.0) for name, kind in kinds.items()}
        self.kinds = self._of_columns({name: check_float(f"share of {name}", s) for name, (_, s) in functions.items()})
        self.difficulties = np.linspace(0.0, 1.0, rows) if rows > 1 else np.ones(1)
        self.heights = np.zeros((columns * side + 1, rows * side + 1))
        boxes = []
        for row, difficulty in enumerate(self.difficulties):
            for column, kind in enumerate(self.kinds):
                rng = np.random.default_rng((seed, row, column))
                patch = self._checked(kind, functions[kind][0], float(difficulty), rng)
                center = self.center(row, column)
                part = self.heights[column * side : (column + 1) * side + 1, row * side : (row + 1) * side + 1]
                inner = part[1:-1, 1:-1]
                if patch.heights is not None:
                    inner[:] = patch.heights[1:-1, 1:-1]
                elif patch.boxes is not None:  # the field lies below them
                    inner[:] = (patch.boxes[:, 2] - patch.boxes[:, 5]).min(initial=0.0)
                if patch.boxes is not None:
                    boxes.append(patch.boxes + np.array((*center, 0.0, 0.0, 0.0, 0.0)))
        self.boxes = np.concatenate([*boxes, self._border()])
        self.origins = self._origins()

    def _of_columns(self, shares: dict[str, float]) -> list[str]:
        """Returns the kind of each column: one for each kind, and the others as the shares say."""
        whole = sum(shares.values())
        counts = dict.fromkeys(shares, 1)
        while sum(counts.values()) < self.columns:
            name = max(shares, key=lambda n: shares[n] / whole * self.columns - counts[n])
            counts[name] += 1
        return [name for name, count in counts.items() for _ in range(count)]

    def _checked(self, name: str, kind: Kind, difficulty: float, rng: np.random.Generator) -> Patch:
        if not callable(kind):
            raise TypeError(f"kind {name} must be a function of difficulty, generator, size and cell, got {kind!r}")
        try:
            inspect.signature(kind).bind(difficulty, rng, self.size, self.cell)
        except TypeError as error:
            raise TypeError(f"kind {name} must take difficulty, generator, size and cell: {error}") from None
        patch = kind(difficulty, rng, self.size, self.cell)
        side = round(self.size / self.cell) + 1
        if not isinstance(patch, Patch):
            raise TypeError(f"kind {name} must return a Patch, got {type(patch).__name__}")
        if patch.heights is not None:
            heights: np.ndarray = np.ma.filled(np.ma.asarray(patch.heights, dtype=float), np.nan)
            if heights.shape != (side, side) or not np.isfinite(heights).all():
                raise ValueError(f"heights of {name} must be {side} x {side} finite numbers, got {heights.shape}")
            patch = dataclasses.replace(patch, heights=heights)
        if patch.boxes is not None:
            boxes = np.asarray(patch.boxes, dtype=float)
            if boxes.ndim != 2 or boxes.shape[1] != 6:
                raise ValueError(f"boxes of {name} must be rows of 6, a center and half sizes, got {boxes.shape}")
            if (wrong := ~np.isfinite(boxes).all(axis=1) | (boxes[:, 3:] <= 0).any(axis=1)).any():
                raise ValueError(f"boxes of {name} must be finite, with positive half sizes, got {boxes[wrong][0]}")
            if (np.abs(boxes[:, :2]) + boxes[:, 3:5] > self.size / 2 + 1e-6).any():
                raise ValueError(f"boxes of {name} reach beyond their patch of {self.size:g} m")
            patch = dataclasses.replace(patch, boxes=boxes)
        return patch

    def center(self, row: int, column: int) -> tuple[float, float]:
        """Returns where the middle of a patch is (m)."""
        return (row - (self.rows - 1) / 2) * self.size, (column - (self.columns - 1) / 2) * self.size

    @property
    def half(self) -> tuple[float, float]:
        """Half sides of the grid, along x and y (m)."""
        return self.rows * self.size / 2, self.columns * self.size / 2

    def _origins(self) -> np.ndarray:
        count = int(CLEAR / (self.cell / 2) + 1e-9)  # so that points of the field are among them
        about = np.unique([-CLEAR, *(self.cell / 2 * np.arange(-count, count + 1)), CLEAR])
        square = np.stack(np.meshgrid(about, about), axis=-1).reshape(-1, 2)
        centers = np.array([[self.center(row, column) for column in range(self.columns)] for row in range(self.rows)])
        highest = self.height(centers[:, :, None] + square).max(axis=-1)
        for a, b, z, half_x, half_y, half_z in self.boxes:  # also those between these points
            rows, columns = (
                np.abs(middles - middle) < CLEAR + half
                for middles, middle, half in ((centers[:, 0, 0], a, half_x), (centers[0, :, 1], b, half_y))
            )
            over = np.ix_(rows, columns)
            highest[over] = np.maximum(highest[over], z + half_z)
        return np.concatenate([centers, highest[..., None]], axis=-1)

    def _border(self) -> np.ndarray:
        (x, y), w = self.half, self.border / 2
        sides = [[sign * (x + w), 0.0, w, y + self.border] for sign in (-1, 1)]
        sides += [[0.0, sign * (y + w), x, w] for sign in (-1, 1)]
        return np.array([[a, b, -DEEP / 2, c, d, DEEP / 2] for a, b, c, d in sides])

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Returns the height of the ground below points (m), as a ray from above finds it.

        Args:
            xy: points ``(..., 2)`` (m). Those beyond the border have none: the result is NaN.
        """
        x, y = np.asarray(xy, dtype=float).reshape(-1, 2).T
        rows, columns = self.heights.shape[0] - 1, self.heights.shape[1] - 1
        u, v = (x + self.half[0]) / self.cell, (y + self.half[1]) / self.cell
        i, j = np.clip(np.floor(u).astype(int), 0, columns - 1), np.clip(np.floor(v).astype(int), 0, rows - 1)
        s, t = u - i, v - j
        h = self.heights
        first, last = h[j, i], h[j + 1, i + 1]
        upper, lower = h[j + 1, i], h[j, i + 1]  # of the two triangles of a cell
        found = np.where(
            t > s, first + s * (last - upper) + t * (upper - first), first + s * (lower - first) + t * (last - lower)
        )
        on = (u >= 0) & (u <= columns) & (v >= 0) & (v <= rows)
        found = np.where(on, found, -np.inf)
        order = np.argsort(x)  # a box is compared with the points that may be over it
        x, y, found = x[order], y[order], found[order]
        for a, b, z, half_x, half_y, half_z in self.boxes:
            near = slice(*np.searchsorted(x, (a - half_x - SEAM, a + half_x + SEAM), side="left"))
            inside = np.abs(y[near] - b) <= half_y + SEAM
            found[near][inside] = np.maximum(found[near][inside], z + half_z)
        found[order] = found.copy()
        return np.where(np.isfinite(found), found, np.nan).reshape(np.shape(xy)[:-1])

    def under(self, source: Path | str | mujoco.MjSpec, floor: str = "floor") -> mujoco.MjSpec:
        """Returns a model with this ground in place of a plane, whose properties of contacts it has.

        Geoms are ``terrain``, the height field, and ``terrain_0``, ``terrain_1`` ..., the boxes.

        Args:
            source: path of an MJCF file, its text, or a ``mujoco.MjSpec``, which stays as it is.
            floor: name of the plane.

        Raises:
            ValueError: there is no such plane, or it is not level at height 0.
        """
        spec = source.copy() if isinstance(source, mujoco.MjSpec) else read_mjcf(source)
        plane = spec.geom(floor)
        if plane is None or plane.type != mujoco.mjtGeom.mjGEOM_PLANE:
            planes = [geom.name for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_PLANE]
            choices = f"choose one of {', '.join(map(repr, planes))}" if planes else "the model has no planes"
            raise ValueError(f"there is no plane {floor!r} to replace: {choices}")
        if any(floor in (pair.geomname1, pair.geomname2) for pair in spec.pairs):
            raise ValueError(f"an explicit pair names the plane {floor!r}, which the ground replaces: leave it out")
        _check_level(spec, floor)
        like = {name: copy.copy(getattr(plane, name)) for name in OF_PLANE}
        spec.delete(plane)
        low, extent = float(self.heights.min()), float(np.ptp(self.heights)) or LEAST  # to which MuJoCo stretches them
        field = spec.add_hfield(name="terrain", nrow=self.heights.shape[0], ncol=self.heights.shape[1])
        field.size = [*self.half, extent, DEEP]
        field.userdata = ((self.heights - low) / extent).astype(np.float32).ravel().tolist()
        kinds, world = mujoco.mjtGeom, spec.worldbody
        world.add_geom(name="terrain", type=kinds.mjGEOM_HFIELD, hfieldname="terrain", pos=[0, 0, low], **like)
        for k, box in enumerate(self.boxes):
            world.add_geom(name=f"terrain_{k}", type=kinds.mjGEOM_BOX, pos=box[:3], size=box[3:], **like)
        return spec

    def picture(self, path: Path | str) -> None:
        """Writes a picture of the ground from above into an image file, with the kinds and where robots begin.

        Raises:
            ImportError: matplotlib is missing.
        """
        check_packages("a picture", ["matplotlib"], "train")
        from matplotlib.figure import Figure

        x, y = self.half
        step = max(self.cell / 2, max(x, y) / 700)
        across, along = np.arange(-x, x, step) + step / 2, np.arange(-y, y, step) + step / 2
        seen = self.height(np.stack(np.meshgrid(across, along), axis=-1))
        figure = Figure(figsize=(10.0, min(max(3.0, 9.0 * y / x), 60.0)), layout="constrained")
        axes = figure.add_subplot()
        shown = axes.imshow(seen, origin="lower", extent=(-x, x, -y, y), cmap="terrain")
        axes.plot(*self.origins[..., :2].reshape(-1, 2).T, "k.", ms=2)
        axes.set_yticks([self.center(0, column)[1] for column in range(self.columns)], self.kinds, fontsize=7)
        axes.set_xlabel("x (m), harder to the right")
        figure.colorbar(shown, label="height (m)", shrink=0.7)
        figure.savefig(path)


def _check_level(spec: mujoco.MjSpec, floor: str) -> None:
    """Raises ValueError if a plane is not where the ground of a terrain will be."""
    m = spec.copy().compile()
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    z, up = data.geom(floor).xpos[2], data.geom(floor).xmat[8]
    if abs(z) > 1e-6 or up < 1 - 1e-6:
        raise ValueError(
            f"the plane {floor!r} must be level at height 0, where the ground will be: it is at {z:g} m, and the z of "
            f"its normal is {up:g}"
        )
