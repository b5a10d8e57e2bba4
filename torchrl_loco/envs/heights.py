"""Heights of the ground below points: of height fields, boxes and planes of the world, as a ray of MuJoCo finds them.

They are looked up in tables, so that a hook that asks for them becomes a kernel.
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import torch

PLANE, FIELD, BOX = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("PLANE", "HFIELD", "BOX"))
CELLS = (2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)
"""Lengths of the cells of the grid of boxes (m), of which the first is taken that has few enough boxes in each."""
FEW, MOST_CELLS, MOST_BOXES = 6, 4_000_000, 2**24
NOTHING = -1e30
"""Height where there is no ground."""


@dataclasses.dataclass(frozen=True)
class Ground:
    """What a ray from above can meet.

    Attributes:
        plane: height of the highest level plane (m).
        fields: of each field its points' heights over the world's origin (m), ``(along y, along x)``, its first corner
            and the distance of its points along x and y (m).
        boxes: centers along x and y, half sizes along both, and tops (m), ``(count + 1, 5)``; the last is none.
        corner: the first corner of the grid (m).
        cell: length of its cells (m).
        cells: the boxes over each cell, ``(along y, along x, most)``, the number of the last one where there are fewer.
    """

    plane: float
    fields: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    boxes: np.ndarray
    corner: np.ndarray
    cell: float
    cells: np.ndarray

    @classmethod
    def of(cls, m: mujoco.MjModel) -> "Ground":
        """Returns that of a model: what is fixed to the world and may be touched.

        Raises:
            ValueError: there is none, or a part of it is turned: a box or field about any axis, a plane that slopes.
        """
        data = mujoco.MjData(m)
        mujoco.mj_kinematics(m, data)
        of_world = (m.body_weldid[m.geom_bodyid] == 0) & ((m.geom_contype != 0) | (m.geom_conaffinity != 0))
        geoms = [g for g in np.flatnonzero(of_world).tolist() if m.geom_type[g] in (PLANE, FIELD, BOX)]
        if not geoms:
            raise ValueError("there is no ground below: no plane, height field or box is fixed to the world")
        axes = np.abs(data.geom_xmat[geoms].reshape(-1, 3, 3))
        for g, own in zip(geoms, axes, strict=True):
            is_level = (
                own[2, 2] > 1 - 1e-9 if m.geom_type[g] == PLANE else np.isclose(own, np.round(own), atol=1e-6).all()
            )
            if not is_level or (m.geom_type[g] == FIELD and data.geom_xmat[g, 0] < 0.5):
                raise ValueError(f"heights of the ground: geom {m.geom(g).name or g!r} is turned")
        planes = [g for g in geoms if m.geom_type[g] == PLANE]
        fields = [_field(m, data, g) for g in geoms if m.geom_type[g] == FIELD]
        chosen = [k for k, g in enumerate(geoms) if m.geom_type[g] == BOX]
        center = data.geom_xpos[[geoms[k] for k in chosen]].reshape(-1, 3)
        half = np.einsum("bij,bj->bi", axes[chosen], m.geom_size[[geoms[k] for k in chosen]]).reshape(-1, 3)
        boxes = np.column_stack([center[:, :2], half[:, :2], center[:, 2] + half[:, 2]])
        highest = max((float(data.geom_xpos[g, 2]) for g in planes), default=NOTHING)
        return cls(highest, fields, np.concatenate([boxes, [[0.0, 0.0, -1.0, -1.0, NOTHING]]]), *_grid(boxes))


def _field(m: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    field = m.geom_dataid[geom]
    rows, columns, start = int(m.hfield_nrow[field]), int(m.hfield_ncol[field]), m.hfield_adr[field]
    x, y, top, _ = m.hfield_size[field]
    heights = top * m.hfield_data[start : start + rows * columns].reshape(rows, columns)
    place = data.geom_xpos[geom]
    return heights + place[2], place[:2] - [x, y], np.array([2 * x / (columns - 1), 2 * y / (rows - 1)])


def _grid(boxes: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Returns corner, cell and cells of the grid of boxes ``(count, 5)``.

    Raises:
        ValueError: they are too many.
    """
    if not len(boxes):
        return np.zeros(2), 1.0, np.zeros((1, 1, 0), dtype=int)
    if len(boxes) >= MOST_BOXES:
        raise ValueError(f"heights of the ground: {len(boxes)} boxes are more than {MOST_BOXES}")
    low, high = boxes[:, :2] - boxes[:, 2:4], boxes[:, :2] + boxes[:, 2:4]
    corner, extent = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    for cell in CELLS:
        shape = np.maximum(1, np.ceil(extent / cell)).astype(int)
        first = np.clip(np.floor((low - corner) / cell - 1e-4).astype(int), 0, shape - 1)
        last = np.clip(np.floor((high - corner) / cell + 1e-4).astype(int), 0, shape - 1)
        counts = np.zeros(shape[::-1], dtype=int)
        for (x, y), (to_x, to_y) in zip(first, last, strict=True):
            counts[y : to_y + 1, x : to_x + 1] += 1
        if counts.max() <= FEW or shape.prod() > MOST_CELLS:
            break
    cells = np.full((*shape[::-1], counts.max()), len(boxes))
    counts[:] = 0
    for box, ((x, y), (to_x, to_y)) in enumerate(zip(first, last, strict=True)):
        for row in range(y, to_y + 1):
            for column in range(x, to_x + 1):
                cells[row, column, counts[row, column]] = box
                counts[row, column] += 1
    return corner, cell, cells


def below(catalog: Any, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Returns the height of the ground below points (m), NaN where there is none.

    Args:
        catalog: that of the hooks.
        x: of the points (m), ``(num_envs, ...)``.
        y: likewise.
    """
    if catalog.ground is None:
        catalog.ground = Ground.of(catalog.mj_model)
    ground: Ground = catalog.ground
    found = torch.full_like(x, ground.plane)
    for k, (heights, corner, cell) in enumerate(ground.fields):
        rows, columns = heights.shape[0] - 1, heights.shape[1] - 1
        table = catalog.derived(("heights", k), lambda values=heights: values.ravel())
        u, v = (x - float(corner[0])) / float(cell[0]), (y - float(corner[1])) / float(cell[1])
        i, j = u.floor().clamp(0, columns - 1), v.floor().clamp(0, rows - 1)
        at, s, t = j.int() * (columns + 1) + i.int(), u - i, v - j
        first, last, right, up = table[at], table[at + columns + 2], table[at + 1], table[at + columns + 1]
        over = torch.where(t > s, s * (last - up) + t * (up - first), s * (right - first) + t * (last - right))
        on = (u >= 0.0) & (u <= columns) & (v >= 0.0) & (v <= rows)
        found = torch.where(on, torch.maximum(found, first + over), found)
    rows, columns, most = ground.cells.shape
    if most:
        cells = catalog.derived("cells of boxes", lambda: ground.cells.ravel())  # whole numbers, which floats hold
        boxes = catalog.derived("boxes", lambda: ground.boxes.T.copy())
        column = ((x - float(ground.corner[0])) / ground.cell).floor().clamp(0, columns - 1).int()
        row = ((y - float(ground.corner[1])) / ground.cell).floor().clamp(0, rows - 1).int()
        for k in range(most):
            box = cells[(row * columns + column) * most + k].int()
            inside = ((x - boxes[0][box]).abs() <= boxes[2][box]) & ((y - boxes[1][box]).abs() <= boxes[3][box])
            found = torch.where(inside, torch.maximum(found, boxes[4][box]), found)
    return torch.where(found > 0.5 * NOTHING, found, float("nan"))
