"""Rotations of many worlds in torch; quaternions are (w, x, y, z)."""

import torch


def product(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Returns the products of quaternions, ``(n, 4)``."""
    aw, ax, ay, az = one.unbind(-1)
    bw, bx, by, bz = other.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def matrix(quaternion: torch.Tensor) -> torch.Tensor:
    """Returns the orientations of unit quaternions, ``(n, 3, 3)``."""
    w, x, y, z = quaternion.unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def small_turn(angles: torch.Tensor) -> torch.Tensor:
    """Returns quaternions that turn by ``angles`` (rad), ``(n, 3)``, where these are small."""
    half = 0.5 * angles
    return torch.cat([(1.0 - half.square().sum(-1, keepdim=True)).clamp(min=0.01).sqrt(), half], dim=-1)
