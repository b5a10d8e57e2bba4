"""Heights of the ground below points: of height fields, boxes and planes of the world, as a ray of MuJoCo finds them.

They are looked up in tables, so that a hook that asks for them becomes a kernel.
"""

import dataclasses
import logging
from typing import Any

import mujoco
import numpy as np
import torch

from torchrl_loco.sim.compiled.collision.ground import NOTHING, Field, Grid
from torchrl_loco.sim.compiled.collision.kinds import BOX, FIELD, PLANE
from torchrl_loco.sim.compiled.collision.pairs import of_ground
from torchrl_loco.terrain.grid import SEAM

CELLS = (2.0, 1.0, 0.5, 0.25, 0.125, 0.0625)
"""Lengths of the cells of the grid of boxes (m), of which the first is taken that has few enough boxes in each."""
FEW, MOST_CELLS, MOST_BOXES = 6, 4_000_000, 2**24


@dataclasses.dataclass(frozen=True)
class Ground:
    """What a ray from above can meet."""

    plane: float  # height of the highest level plane (m)
    fields: list[Field]
    boxes: np.ndarray  # centers along x and y, half sizes along both, tops (m), (count + 1, 5); the last is none
    grid: Grid | None  # the cells that name the boxes, if there are any
    cells: np.ndarray  # the boxes over each cell, (cells, most), the number of the last one where there are fewer

    @classmethod
    def of(cls, m: mujoco.MjModel) -> "Ground":
        """Returns that of a model: what is fixed to the world and may be touched."""
        data = mujoco.MjData(m)
        mujoco.mj_kinematics(m, data)
        ceiling = (m.geom_type == PLANE) & (data.geom_xmat[:, 8] < 1e-9 - 1)
        ground = np.flatnonzero(of_ground(m) & ~ceiling).tolist()
        geoms = [g for g in ground if m.geom_type[g] in (PLANE, FIELD, BOX)]
        if not geoms:
            raise ValueError("there is no ground below: no plane, height field or box is fixed to the world")
        if others := [m.geom(g).name or str(g) for g in ground if g not in geoms]:
            logging.getLogger("torchrl_loco").warning(
                "heights of the ground are those of planes, height fields and boxes, without geoms %s: rays of "
                "s.ray meet them",
                ", ".join(others[:8]),
            )
        axes = np.abs(data.geom_xmat[geoms].reshape(-1, 3, 3))
        for g, own in zip(geoms, axes, strict=True):
            is_level = (
                own[2, 2] > 1 - 1e-9 if m.geom_type[g] == PLANE else np.isclose(own, np.round(own), atol=1e-6).all()
            )
            is_field = m.geom_type[g] == FIELD
            if not is_level or (is_field and not np.isclose(data.geom_xmat[g], np.eye(3).ravel(), atol=1e-6).all()):
                raise ValueError(f"heights of the ground: geom {m.geom(g).name or g!r} is turned")
        planes = [g for g in geoms if m.geom_type[g] == PLANE]
        fields = [Field.of(m, data, g, g) for g in geoms if m.geom_type[g] == FIELD]
        chosen = [k for k, g in enumerate(geoms) if m.geom_type[g] == BOX]
        center = data.geom_xpos[[geoms[k] for k in chosen]].reshape(-1, 3)
        half = np.einsum("bij,bj->bi", axes[chosen], m.geom_size[[geoms[k] for k in chosen]]).reshape(-1, 3)
        boxes = np.column_stack([center[:, :2], half[:, :2] + SEAM, center[:, 2] + half[:, 2]])
        highest = max((float(data.geom_xpos[g, 2]) for g in planes), default=NOTHING)
        return cls(highest, fields, np.concatenate([boxes, [[0.0, 0.0, -1.0, -1.0, NOTHING]]]), *_grid(boxes))


def _grid(boxes: np.ndarray) -> tuple[Grid | None, np.ndarray]:
    """Returns the grid of boxes ``(count, 5)``, and the boxes over each cell."""
    if not len(boxes):
        return None, np.zeros((1, 0), dtype=int)
    if len(boxes) >= MOST_BOXES:
        raise ValueError(f"heights of the ground: {len(boxes)} boxes are more than {MOST_BOXES}")
    for cell in CELLS:
        grid = Grid.of(boxes[:, :2] - boxes[:, 2:4], boxes[:, :2] + boxes[:, 2:4], cell)
        counts = np.diff(grid.first)
        if counts.max() <= FEW or len(counts) > MOST_CELLS:
            break
    cells, of = np.full((len(counts), counts.max()), len(boxes)), np.repeat(np.arange(len(counts)), counts)
    cells[of, np.arange(len(of)) - grid.first[of]] = grid.named
    return grid, cells


def below(catalog: Any, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Returns the height of the ground below points ``(num_envs, ...)`` (m), NaN where there is none."""
    ground = catalog.ground
    found = torch.full_like(x, ground.plane)
    for k, field in enumerate(ground.fields):
        rows, columns = field.heights.shape[0] - 1, field.heights.shape[1] - 1
        table = catalog.table(("heights", k), lambda field=field: field.heights.ravel() + field.corner[2])
        u, v = ((a - float(field.corner[i])) / field.cell[i] for i, a in enumerate((x, y)))
        i, j = u.floor().nan_to_num(0.0).clamp(0, columns - 1), v.floor().nan_to_num(0.0).clamp(0, rows - 1)
        at, s, t = j.int() * (columns + 1) + i.int(), u - i, v - j
        first, last, right, up = table[at], table[at + columns + 2], table[at + 1], table[at + columns + 1]
        over = torch.where(t > s, s * (last - up) + t * (up - first), s * (right - first) + t * (last - right))
        on = (u >= 0.0) & (u <= columns) & (v >= 0.0) & (v <= rows)
        found = torch.where(on, torch.maximum(found, first + over), found)
    if ground.grid is not None:
        grid, most = ground.grid, ground.cells.shape[1]
        columns, rows = grid.shape
        cells = catalog.table("cells of boxes", lambda: ground.cells.ravel())  # whole numbers, which floats hold
        boxes = catalog.table("boxes", lambda: ground.boxes.T.copy())
        column = ((x - float(grid.corner[0])) / grid.cell).floor().nan_to_num(0.0).clamp(0, columns - 1).int()
        row = ((y - float(grid.corner[1])) / grid.cell).floor().nan_to_num(0.0).clamp(0, rows - 1).int()
        for k in range(most):
            box = cells[(row * columns + column) * most + k].int()
            inside = ((x - boxes[0][box]).abs() <= boxes[2][box]) & ((y - boxes[1][box]).abs() <= boxes[3][box])
            found = torch.where(inside, torch.maximum(found, boxes[4][box]), found)
    return torch.where(found > 0.5 * NOTHING, found, float("nan"))
