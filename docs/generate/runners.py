"""The picture at the top of the README: ``make runners``. It is kept in the repository, because GitHub shows it."""

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as imageio

from generate.tasks import joined, moments

PICTURE = Path(__file__).parent.parent / "_static" / "runners.png"
TASKS = ("walker_run", "humanoid_run", "cheetah_run", "quadruped_run", "hopper_hop")
"""A task of each body."""
WIDTH, HEIGHT = 168, 126
"""Size of a frame, in pixels."""


def draw(path: Path, tasks: Sequence[str] = TASKS) -> None:
    """Draws a column for each task, with its moments from top to bottom."""
    columns = [joined(moments(name, WIDTH, HEIGHT), dim=0, gap=4) for name in tasks]
    imageio.imwrite(path, joined(columns, dim=1, gap=4).numpy())


if __name__ == "__main__":
    draw(PICTURE)
