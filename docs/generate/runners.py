"""The moving picture of README and home page: ``make runners``. It is kept in the repository for GitHub and PyPI."""

from collections.abc import Sequence
from pathlib import Path

import torch

from generate.tasks import frames, joined, save_moving

PICTURE = Path(__file__).parent.parent / "_static" / "runners.webp"
SHOWN = (
    ("humanoid_run", "playground"),
    ("walker_run", "playground"),
    ("cheetah_run", "playground"),
    ("quadruped_run", "playground"),
    ("hopper_hop", "playground"),
    ("humanoid_walk", "dm_control"),  # gets up first
)
"""Task and protocol of each cell, row by row. Any task that has a shipped policy can be added."""
COLUMNS = 3
WIDTH, HEIGHT, SECONDS = 272, 204, 6.0
"""Size of a cell in pixels, and time that passes."""


def draw(path: Path, shown: Sequence[tuple[str, str]] = SHOWN, seconds: float = SECONDS) -> None:
    """Draws every cell's shipped policy from a reset on, all at the same time.

    Raises:
        ValueError: a task has no policy under its protocol.
    """
    cells = [frames(task, WIDTH, HEIGHT, seconds, protocol) for task, protocol in shown]
    save_moving(path, [_grid(moment) for moment in zip(*cells, strict=True)])


def _grid(cells: Sequence[torch.Tensor]) -> torch.Tensor:
    """Returns cells in rows of ``COLUMNS``; the last row must be full."""
    rows = [joined(cells[i : i + COLUMNS], dim=1, gap=4) for i in range(0, len(cells), COLUMNS)]
    return joined(rows, dim=0, gap=4)


if __name__ == "__main__":
    draw(PICTURE)
