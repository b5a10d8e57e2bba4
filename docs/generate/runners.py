"""The picture at the top of the README: ``make runners``. It is kept in the repository, because GitHub shows it."""

from pathlib import Path

import imageio.v3 as imageio

from generate.tasks import joined, moments

PICTURE = Path(__file__).parent.parent / "_static" / "runners.png"
ROWS = (("walker_run", "humanoid_run"), ("cheetah_run", "quadruped_run"), ("hopper_stand", "hopper_hop"))
WIDTH, HEIGHT = 156, 142
"""Size of a frame, in pixels."""


def draw(path: Path, rows: tuple[tuple[str, ...], ...] = ROWS) -> None:
    """Draws the moments of several tasks, row by row."""
    strips = [joined([moments(name, WIDTH, HEIGHT) for name in row], dim=1, gap=12) for row in rows]
    imageio.imwrite(path, joined(strips, dim=0, gap=12).numpy())


if __name__ == "__main__":
    draw(PICTURE)
