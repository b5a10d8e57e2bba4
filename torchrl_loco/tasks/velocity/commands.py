"""Velocity commands: how they are drawn, and how they turn a robot toward a heading."""

import math

import torch

from torchrl_loco.envs.view import View

Ranges = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
"""Least and greatest velocity forward, to the left (m/s), and yaw rate (rad/s).

A curriculum has them by the control step of training from which they hold, in rising order.
"""

STAND, TURN, AHEAD = 0.1, 0.3, 0.2  # shares of the commands that stand still, hold a heading, and go straight ahead
EVERY = (3.0, 8.0)  # least and greatest time for which a command holds (s)
SLOWEST = 0.3  # least velocity straight ahead (m/s)
STIFFNESS = 0.5  # yaw rate by error of heading (1/s)

NAMES = ("forward (m/s)", "left (m/s)", "yaw rate (rad/s)")  # of the numbers of a command

ROWS: dict[str, int | tuple[int, ...]] = {
    "command": 3,
    "heading": (),
    "holds_heading": (),
    "until_command": (),
    "command_age": (),
    "trained": (),
}
"""Rows of memory: the command; the heading (rad) and whether it is held; time until the next (s); time since it was
drawn (s); control steps of training, over all episodes of the world."""


def limits(s: View, curriculum: dict[int, Ranges]) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns least and greatest command of each world, ``(num_envs, 3)``, by what its memory has of ``trained``."""
    stages = list(curriculum.items())
    low, high = (
        torch.tensor(bounds, device=s.device).expand(s.num_envs, 3) for bounds in zip(*stages[0][1], strict=True)
    )
    for first, ranges in stages[1:]:
        reached = s.trained.unsqueeze(-1) >= first
        later = [torch.tensor(bounds, device=s.device) for bounds in zip(*ranges, strict=True)]
        low, high = torch.where(reached, later[0], low), torch.where(reached, later[1], high)
    return low, high


def check(curriculum: dict[int, Ranges]) -> None:
    """Raises ValueError if steps do not rise from 0, or a least velocity is above the greatest."""
    if list(curriculum) != sorted({0, *curriculum}):
        raise ValueError(f"curriculum must name control steps that rise from 0, got {list(curriculum)}")
    for step, ranges in curriculum.items():
        if len(ranges) != 3 or any(low > high for low, high in ranges):
            raise ValueError(f"curriculum at {step} must have 3 pairs of a least and a greatest value, got {ranges}")


def reached(curriculum: dict[int, Ranges], steps: int) -> tuple[list[float], list[float]]:
    """Returns least and greatest command after so many control steps of training."""
    ranges = [ranges for first, ranges in curriculum.items() if steps >= first][-1]
    return [low for low, _ in ranges], [high for _, high in ranges]


def first(curriculum: dict[int, Ranges]) -> dict[str, tuple[float, float]]:
    """Returns the ranges of commands at the start of a curriculum, by name."""
    return dict(zip(NAMES, next(iter(curriculum.values())), strict=True))


def draw(s: View, curriculum: dict[int, Ranges]) -> dict[str, torch.Tensor]:
    """Returns rows of a new command: of command, heading, whether it is held, time until the next, and its age."""
    low, high = limits(s, curriculum)
    command, kind = low + (high - low) * s.uniform(0.0, 1.0, 3), s.uniform(0.0, 1.0, 3)
    stands, holds, ahead = kind[:, 0] < STAND, kind[:, 1] < TURN, kind[:, 2] < AHEAD
    forward = torch.minimum(command[:, :1].abs().clamp(min=SLOWEST), high[:, :1].clamp(min=0.0))
    straight = torch.cat([forward, torch.zeros_like(command[:, 1:])], dim=-1)
    command = torch.where(ahead.unsqueeze(-1), straight, command)
    return {
        "command": torch.where(stands.unsqueeze(-1), 0.0, command),
        "heading": s.uniform(-math.pi, math.pi),
        "holds_heading": (holds & ~stands & ~ahead).float(),
        "until_command": s.uniform(*EVERY),
        "command_age": torch.zeros_like(s.command_age),
    }


def turned(
    s: View, rows: dict[str, torch.Tensor], yaw: torch.Tensor, curriculum: dict[int, Ranges]
) -> dict[str, torch.Tensor]:
    """Returns rows of :func:`draw` for worlds that look toward ``yaw`` (rad), ``(num_envs,)``.

    The yaw rate turns those that hold a heading toward it.
    """
    low, high = limits(s, curriculum)
    error = rows["heading"] - yaw
    rate = STIFFNESS * torch.atan2(error.sin(), error.cos())  # the shorter way
    rate = torch.minimum(torch.maximum(rate, low[:, 2]), high[:, 2])
    command = rows["command"]
    rate = torch.where(rows["holds_heading"] > 0, rate, command[:, 2]).unsqueeze(-1)
    return {**rows, "command": torch.cat([command[:, :2], rate], dim=-1)}
