"""The ground: height fields and the many boxes of a world, which lie once on the device however many worlds there are.

Pairs of geoms are of moving ones with what the ground has of each kind: geoms of it whose contacts have the same
parameters share their pairs. A grid of cells names the boxes that a geom may touch.
"""

import dataclasses

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.kinds import BOX, FIELD
from torchrl_loco.sim.compiled.collision.pairs import stand_ins
from torchrl_loco.sim.compiled.ir.parameters import nominal

BOX_NUMBERS = 24
"""Of a box: its bounds (low, high), center, axes by rows, half sizes, number of its kind, and first column and row."""
CELLS_PER_BOX = 64  # cells of the grid, at most, as a multiple of the boxes
TOPS_CELL, NEAR_TOPS, MOST_TOPS = 0.25, 2, 4_000_000
"""Least length of a cell of the greatest heights (m), how many cells around it each knows of, most cells."""
NOTHING = -1e30  # height where there is no ground


@dataclasses.dataclass(frozen=True)
class Field:
    """A height field, in a frame of its own, whose z axis points up from it.

    Attributes:
        heights: of its points over the frame (m), ``(rows, columns)``: rows along y, columns along x.
        cell: distance of two points along x and y (m).
        base: how far its base lies below the frame (m).
        corner: where the first point lies, without its height, in the world's frame (m).
        orientation: of the frame.
        like: the geom whose pairs have the parameters of its contacts.
    """

    heights: np.ndarray
    cell: tuple[float, float]
    base: float
    corner: np.ndarray
    orientation: np.ndarray
    like: int

    @classmethod
    def of(cls, m: mujoco.MjModel, data: mujoco.MjData, geom: int, like: int) -> "Field":
        """Returns that of a geom."""
        field = m.geom_dataid[geom]
        shape = int(m.hfield_nrow[field]), int(m.hfield_ncol[field])
        x, y, top, base = m.hfield_size[field]
        start = m.hfield_adr[field]
        heights = top * m.hfield_data[start : start + shape[0] * shape[1]].reshape(shape)
        orientation = data.geom_xmat[geom].reshape(3, 3)
        corner = data.geom_xpos[geom] - orientation @ [x, y, 0.0]
        return cls(heights, (2 * x / (shape[1] - 1), 2 * y / (shape[0] - 1)), float(base), corner, orientation, like)

    @property
    def is_aligned(self) -> bool:
        """Whether its axes are those of the world."""
        return bool(np.abs(self.orientation - np.eye(3)).max() < 1e-9)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the least and greatest coordinates of its prisms in the world's frame (m), ``(3,)`` each."""
        rows, columns = self.heights.shape
        x, y = self.cell[0] * (columns - 1), self.cell[1] * (rows - 1)
        z = -self.base, float(self.heights.max())
        corners = (
            self.corner + np.array([(a, b, c) for a in (0.0, x) for b in (0.0, y) for c in z]) @ self.orientation.T
        )
        return corners.min(axis=0), corners.max(axis=0)


@dataclasses.dataclass(frozen=True)
class Grid:
    """Cells over the ground, each of which names the boxes that reach over it.

    Attributes:
        corner: the first corner (m), ``(2,)``.
        cell: the length of a cell (m).
        shape: cells along x and y.
        first: where the boxes of each cell begin, ``(cells + 1,)``; cells along x are next to each other.
        named: the boxes, cell by cell.
        begin: first column and row of each box, ``(boxes, 2)``.
    """

    corner: np.ndarray
    cell: float
    shape: tuple[int, int]
    first: np.ndarray
    named: np.ndarray
    begin: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray, cell: float) -> "Grid":
        """Returns that of boxes with bounds ``(boxes, 2)`` (m)."""
        corner = low.min(axis=0)
        columns, rows = np.maximum(1, np.ceil((high.max(axis=0) - corner) / cell)).astype(int).tolist()
        # Bounds grow by what single precision may round away.
        spans = (np.floor((x - corner) / cell + e).astype(int) for x, e in ((low, -1e-4), (high, 1e-4)))
        begin, end = (np.clip(span, 0, [columns - 1, rows - 1]) for span in spans)
        wide, deep = (end - begin + 1).T
        box = np.repeat(np.arange(len(begin)), wide * deep)
        k = np.arange(len(box)) - np.repeat(np.cumsum(wide * deep) - wide * deep, wide * deep)
        cells = (begin[box, 1] + k // wide[box]) * columns + begin[box, 0] + k % wide[box]
        order = np.lexsort((box, cells))
        first = np.searchsorted(cells[order], np.arange(columns * rows + 1))
        return cls(corner, cell, (columns, rows), first, box[order], begin)


@dataclasses.dataclass(frozen=True)
class Boxes:
    """Boxes of the world, and the grid that names them.

    Attributes:
        numbers: :data:`BOX_NUMBERS` of each, ``(boxes, 24)``.
        kinds: the geoms whose pairs have the parameters of their contacts.
        grid: the grid.
    """

    numbers: np.ndarray
    kinds: list[int]
    grid: Grid

    @classmethod
    def of(cls, m: mujoco.MjModel, data: mujoco.MjData, like: dict[int, int]) -> "Boxes":
        """Returns those of geoms, each of which is as another of them."""
        geoms, kinds = list(like), sorted(set(like.values()))
        axes, size, center = data.geom_xmat[geoms].reshape(-1, 3, 3), m.geom_size[geoms], data.geom_xpos[geoms]
        reach = np.einsum("bij,bj->bi", np.abs(axes), size)
        low, high = center - reach, center + reach
        area = np.prod(high[:, :2].max(axis=0) - low[:, :2].min(axis=0))
        cell = max(float(np.median(2 * reach[:, :2].min(axis=1))), float(np.sqrt(area / (CELLS_PER_BOX * len(geoms)))))
        grid = Grid.of(low[:, :2], high[:, :2], cell)
        of_kind = [kinds.index(like[geom]) for geom in geoms]
        numbers = np.column_stack([low, high, center, axes.reshape(-1, 9), size, of_kind, grid.begin])
        return cls(numbers, kinds, grid)


@dataclasses.dataclass(frozen=True)
class Tops:
    """The greatest heights of the ground around each cell of a grid: what is higher touches nothing.

    Attributes:
        corner: the first corner (m), ``(2,)``.
        cell: the length of a cell (m); what reaches no farther from its center looks at the cell of the center alone.
        heights: in the world's frame (m), ``(along y, along x)``; nothing lies over those at the rim.
    """

    corner: np.ndarray
    cell: float
    heights: np.ndarray

    @classmethod
    def of(cls, fields: list[Field], boxes: Boxes | None) -> "Tops":
        """Returns those of fields and boxes."""
        bounds = [field.bounds() for field in fields]
        if boxes is not None:
            bounds += list(zip(boxes.numbers[:, :3], boxes.numbers[:, 3:6], strict=True))
        cell = max([TOPS_CELL, *(length for field in fields for length in field.cell)])
        low, high = (pick([each[i][:2] for each in bounds], axis=0) for i, pick in ((0, np.min), (1, np.max)))
        cell = max(cell, float(np.sqrt(np.prod(high - low) / MOST_TOPS)))
        corner = low - 2 * NEAR_TOPS * cell
        columns, rows = np.ceil((high - corner) / cell).astype(int) + 2 * NEAR_TOPS
        heights = np.full((rows, columns), NOTHING)
        for k, (low, high) in enumerate(bounds):
            if k < len(fields) and fields[k].is_aligned:
                _raise_to_points(heights, corner, cell, fields[k])
            else:
                _raise(heights, corner, cell, low, high)
        heights, around = np.pad(heights, NEAR_TOPS, constant_values=NOTHING), 2 * NEAR_TOPS + 1
        for axis in (0, 1):
            heights = np.lib.stride_tricks.sliding_window_view(heights, around, axis=axis).max(axis=-1)
        return cls(corner, cell, heights)


def _raise_to_points(heights: np.ndarray, corner: np.ndarray, cell: float, field: Field) -> None:
    """Raises the greatest heights to those of the points of a field, whose axes are the world's."""
    x, y = (field.corner[k] + field.cell[k] * np.arange(n) - corner[k] for k, n in enumerate(field.heights.shape[::-1]))
    (columns, at_x), (rows, at_y) = (np.unique((each // cell).astype(int), return_index=True) for each in (x, y))
    most = np.maximum.reduceat(np.maximum.reduceat(field.heights, at_x, axis=1), at_y, axis=0)
    part = np.ix_(rows, columns)
    heights[part] = np.maximum(heights[part], field.corner[2] + most)


def _raise(heights: np.ndarray, corner: np.ndarray, cell: float, low: np.ndarray, high: np.ndarray) -> None:
    """Raises the greatest heights to those of what has these bounds (m), ``(3,)`` each."""
    (left, first), (right, last) = (np.floor((each[:2] - corner) / cell).astype(int) for each in (low, high))
    part = heights[first : last + 1, left : right + 1]
    np.maximum(part, high[2], out=part)


@dataclasses.dataclass(frozen=True)
class Ground:
    """The height fields and the boxes of a model that are looked up; ``boxes`` is ``None`` where they are few."""

    fields: list[Field]
    boxes: Boxes | None
    tops: Tops | None

    @classmethod
    def of(cls, m: mujoco.MjModel) -> "Ground":
        """Returns that of a model, or of a ``VariedModel``."""
        like, plain = stand_ins(m), nominal(m)
        data = mujoco.MjData(plain)
        mujoco.mj_kinematics(plain, data)
        boxes = {geom: other for geom, other in like.items() if plain.geom_type[geom] == BOX}
        fields = [Field.of(plain, data, geom, other) for geom, other in like.items() if plain.geom_type[geom] == FIELD]
        many = Boxes.of(plain, data, boxes) if boxes else None
        return cls(fields, many, Tops.of(fields, many) if fields or boxes else None)

    def numbers(self) -> np.ndarray:
        """Returns all of it as the compiled step reads it.

        Heights, then boxes, then cells of the grid as integers, then the greatest heights.
        """
        parts = [np.zeros(0, dtype=np.float32), *(field.heights.ravel().astype(np.float32) for field in self.fields)]
        if self.boxes is not None:
            parts.append(self.boxes.numbers.ravel().astype(np.float32))
            parts += [
                cells.astype(np.int32).view(np.float32) for cells in (self.boxes.grid.first, self.boxes.grid.named)
            ]
        if self.tops is not None:
            parts.append(self.tops.heights.ravel().astype(np.float32) + 1e-4)  # which rounding does not exceed
        return np.concatenate(parts)
