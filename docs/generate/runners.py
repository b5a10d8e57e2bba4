"""The moving pictures of README, home page, robots and tasks: ``make runners``. They are kept for GitHub and PyPI."""

import sys
from pathlib import Path
from typing import NamedTuple

from generate import tasks
from generate.tasks import frames, joined, save_moving

STATIC = Path(__file__).parent.parent / "_static"
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
    """A picture of cells.

    Attributes:
        shown: task and protocol of each, row by row; the last row must be full.
        columns: how many are side by side.
        width: of a cell, in pixels.
        height: of a cell, in pixels.
        seconds: time that passes.
    """

    shown: tuple[tuple[str, str], ...]
    columns: int
    width: int
    height: int
    seconds: float = 6.0


SHOWN = {
    "runners.webp": Grid((*ROBOTS, *RUNNERS), 3, 272, 204),
    "robots.webp": Grid(ROBOTS, 2, 360, 270),
    "tracking.webp": Grid((("g1_tracking", "playground"), ("h1_tracking", "playground")), 2, 360, 270, 6.8),
    **{f"tasks/{name}.webp": Grid(((name, "playground"),), 1, 340, 255, 4.0) for name in tasks.RUNNERS},
}
"""What each file shows. Any task that has a shipped policy can be added."""


def draw(path: Path, grid: Grid) -> None:
    """Draws every cell's shipped policy from a reset on, all at the same time.

    Raises:
        ValueError: a task has no policy under its protocol.
    """
    cells = [frames(task, grid.width, grid.height, grid.seconds, protocol) for task, protocol in grid.shown]
    starts = range(0, len(cells), grid.columns)
    moments = [
        [joined(list(moment[i : i + grid.columns]), dim=1, gap=4) for i in starts]
        for moment in zip(*cells, strict=True)
    ]
    path.parent.mkdir(exist_ok=True)
    save_moving(path, [joined(rows, dim=0, gap=4) for rows in moments])


if __name__ == "__main__":
    for name in sys.argv[1:] or SHOWN:
        draw(STATIC / name, SHOWN[name])
