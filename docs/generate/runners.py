"""The moving pictures of README, home page and robots: ``make runners``. They are kept for GitHub and PyPI."""

from pathlib import Path
from typing import NamedTuple

from generate.tasks import frames, joined, save_moving

STATIC = Path(__file__).parent.parent / "_static"
SECONDS = 6.0
"""Time that passes in a picture."""
ROBOTS = (
    ("go1_velocity", "playground"),
    ("g1_velocity", "playground"),
    ("h1_velocity", "playground"),
    ("go2_velocity", "playground"),
)
RUNNERS = (
    ("humanoid_run", "playground"),
    ("walker_run", "playground"),
    ("cheetah_run", "playground"),
    ("quadruped_run", "playground"),
    ("humanoid_walk", "dm_control"),  # gets up first
)


class Grid(NamedTuple):
    """A picture of cells: task and protocol of each, row by row, of which the last must be full; pixels of a cell."""

    shown: tuple[tuple[str, str], ...]
    columns: int
    width: int
    height: int


PICTURES = {"runners.webp": Grid((*ROBOTS, *RUNNERS), 3, 272, 204), "robots.webp": Grid(ROBOTS, 2, 360, 270)}
"""Any task that has a shipped policy can be added."""


def draw(path: Path, grid: Grid, seconds: float = SECONDS) -> None:
    """Draws every cell's shipped policy from a reset on, all at the same time.

    Raises:
        ValueError: a task has no policy under its protocol.
    """
    cells = [frames(task, grid.width, grid.height, seconds, protocol) for task, protocol in grid.shown]
    moments = zip(*cells, strict=True)
    starts = range(0, len(cells), grid.columns)
    rows = ([joined(list(moment[i : i + grid.columns]), dim=1, gap=4) for i in starts] for moment in moments)
    save_moving(path, [joined(row, dim=0, gap=4) for row in rows])


if __name__ == "__main__":
    for name, grid in PICTURES.items():
        draw(STATIC / name, grid)
