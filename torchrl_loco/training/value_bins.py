"""Returns as distributions over bins (HL-Gauss: Imani and White, 2018; Farebrother et al., 2024)."""

import math

import torch
from torch import nn
from torch.nn.functional import cross_entropy


class ValueBins(nn.Module):
    """Returns as distributions over evenly spaced bins.

    A return below the first bin's center counts as one at it, and so does one above the last.

    Args:
        low: return at the center of the first bin.
        high: return at the center of the last bin, more than ``low``.
        count: number of bins.

    Attributes:
        centers: returns at the centers of the bins, shape ``(count,)``.
        edges: returns at the edges of the bins, shape ``(count + 1,)``.
    """

    SPREAD = 0.75
    """Standard deviation of a target, in widths of a bin."""

    centers: torch.Tensor
    edges: torch.Tensor

    def __init__(self, low: float, high: float, count: int) -> None:
        super().__init__()
        half = (high - low) / (count - 1) / 2
        self.register_buffer("centers", torch.linspace(low, high, count), persistent=False)
        self.register_buffer("edges", torch.linspace(low - half, high + half, count + 1), persistent=False)
        self.low, self.high, self.sigma = low, high, 2 * half * self.SPREAD
        self.width = 2 * half

    def encode(self, returns: torch.Tensor) -> torch.Tensor:
        """Returns the probabilities, shape ``(..., count)``, of a Gaussian about each return of shape ``(...)``."""
        returns = returns.clamp(self.low, self.high).unsqueeze(-1)
        below = torch.erf((self.edges - returns) / (math.sqrt(2.0) * self.sigma))
        return below.diff(dim=-1) / (below[..., -1:] - below[..., :1])

    def decode(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the mean, shape ``(...)``, of distributions given as logits of shape ``(..., count)``."""
        return (logits.softmax(-1) * self.centers).sum(-1)

    def cross_entropy(self, logits: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
        """Returns the mean cross entropy of distributions to the Gaussians about returns, a scalar.

        Args:
            logits: shape ``(n, count)``.
            returns: shape ``(n,)``.
        """
        return cross_entropy(logits, self.encode(returns))
