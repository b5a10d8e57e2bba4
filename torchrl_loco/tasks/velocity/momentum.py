"""The angular momentum of a robot."""

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from torchrl_loco.envs.view import View


def angular_momentum(s: "View") -> torch.Tensor:
    """Returns the angular momentum about the center of mass, world frame (kg m²/s), ``(num_envs, 3)``."""
    xmat, rotation, mass = s.xmat(".*"), s.angvel(".*"), s.model("body_mass").unsqueeze(-1)
    lever = (xmat * s.model("body_ipos").unsqueeze(-2)).sum(-1)
    position, velocity = s.xpos(".*") + lever, s.linvel(".*") + torch.linalg.cross(rotation, lever)
    center = (mass * position).sum(1, keepdim=True) / mass.sum(1, keepdim=True)
    orbit = torch.linalg.cross(position - center, mass * velocity)

    axes = s.model("body_iquat")  # of the principal moments, in the frame of each body
    seen = _rotated(axes * axes.new_tensor([1.0, -1.0, -1.0, -1.0]), (xmat * rotation.unsqueeze(-1)).sum(-2))
    spin = (xmat * _rotated(axes, s.model("body_inertia") * seen).unsqueeze(-2)).sum(-1)
    return (orbit + spin).sum(1)


def _rotated(quaternions: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Returns vectors ``(..., 3)`` rotated by unit quaternions ``(..., 4)``."""
    axis = quaternions[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + quaternions[..., :1] * twice + torch.linalg.cross(axis, twice)
