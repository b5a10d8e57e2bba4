"""Normal variables under tanh: samples with their log-probabilities, and divergences."""

import math

import torch
from torch.nn.functional import softplus


def sample(loc: torch.Tensor, scale: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns actions ``tanh(u)``, u = loc + scale * noise, and their log-probabilities, shape ``(...)``.

    The log-probability is computed from u, not from the action, so it stays exact where tanh saturates.

    Args:
        loc: means before tanh, shape ``(..., nu)``.
        scale: standard deviations before tanh, of the same shape.
        noise: standard normal numbers, of the same shape.
    """
    u = loc + scale * noise
    log_prob = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2.0 * math.pi) - log_slope(u)
    return u.tanh(), log_prob.sum(-1)


def log_slope(u: torch.Tensor) -> torch.Tensor:
    """Returns log(1 - tanh(u)^2), exact for large u too, of any shape ``(...)``."""
    return 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))


def kl(old_loc: torch.Tensor, old_scale: torch.Tensor, loc: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Returns KL(old || new) of diagonal Gaussians, shape ``(...)``, which equals that of their images under tanh.

    Means and standard deviations have shape ``(..., nu)``.
    """
    ratio, distance = old_scale / scale, (old_loc - loc) / scale
    return (0.5 * (ratio.square() + distance.square() - 1.0) - ratio.log()).sum(-1)
