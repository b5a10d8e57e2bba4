"""Returns as distributions over bins (HL-Gauss: Imani and White, 2018; Farebrother et al., 2024), and their loss.

The loss and its gradient are one kernel, whose C++ Warp compiles for a number of bins.
"""

import functools
import math
from typing import Any

import torch
import warp as wp
from torch import nn

from torchrl_loco.sim import launch_on_tensors
from torchrl_loco.training.norm_silu import lanes

BLOCK = 128
"""Threads of a block on CUDA."""

CROSS_ENTROPY = """
  enum { BINS = %(bins)d };
#ifdef __CUDA_ARCH__
  enum { LANES = 32 };
#else
  enum { LANES = 1 };
#endif
  struct Lane {
    static CUDA_CALLABLE float larger(float x, float y) { return x > y ? x : y; }
    static CUDA_CALLABLE float sum(float x) {
#ifdef __CUDA_ARCH__
      for (int o = 16; o; o >>= 1) x += __shfl_xor_sync(~0u, x, o);
#endif
      return x;
    }
    static CUDA_CALLABLE float max(float x) {
#ifdef __CUDA_ARCH__
      for (int o = 16; o; o >>= 1) x = larger(x, __shfl_xor_sync(~0u, x, o));
#endif
      return x;
    }
  };
  const int lane = thread %% LANES, row = thread / LANES;
  const float* logit = &logits.data[size_t(row) * BINS];
  float most = logit[0], total = 0.0f, loss = 0.0f;
  for (int bin = lane; bin < BINS; bin += LANES) most = Lane::larger(most, logit[bin]);
  most = Lane::max(most);
  for (int bin = lane; bin < BINS; bin += LANES) total += expf(logit[bin] - most);
  const float log_total = most + logf(Lane::sum(total));
  // The target: the share of a Gaussian about the return that lies in each bin, of what lies in any.
  const float given = returns.data[row], mean = given < low ? low : given > high ? high : given;
  const float mass = erff((edges.data[BINS] - mean) * slope) - erff((edges.data[0] - mean) * slope);
  for (int bin = lane; bin < BINS; bin += LANES) {
    const float below = erff((edges.data[bin] - mean) * slope), above = erff((edges.data[bin + 1] - mean) * slope);
    const float target = (above - below) / mass, log_probability = logit[bin] - log_total;
    loss -= target * log_probability;
    gradient.data[size_t(row) * BINS + bin] = expf(log_probability) - target;
  }
  loss = Lane::sum(loss);
  if (lane == 0) losses.data[row] = loss;
"""


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
        return logits.softmax(-1) @ self.centers

    def cross_entropy(self, logits: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
        """Returns the mean cross entropy of distributions to the Gaussians about returns, a scalar.

        It has a first derivative only, by the logits.

        Args:
            logits: float32, shape ``(n, count)``.
            returns: float32, shape ``(n,)``.
        """
        return _CrossEntropy.apply(logits, returns, self).mean()


class _CrossEntropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: torch.Tensor, returns: torch.Tensor, bins: ValueBins) -> torch.Tensor:
        logits, returns = logits.contiguous(), returns.contiguous()
        losses, gradient = torch.empty_like(returns), torch.empty_like(logits)
        inputs = (logits, returns, bins.edges, bins.low, bins.high, 1.0 / (math.sqrt(2.0) * bins.sigma))
        launch_on_tensors(_kernel(logits.shape[-1]), lanes(logits) * len(logits), inputs, (losses, gradient), BLOCK)
        ctx.save_for_backward(gradient)
        return losses

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_losses: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return ctx.saved_tensors[0] * grad_losses.unsqueeze(-1), None, None


@functools.cache
def _kernel(bins: int) -> wp.Kernel:
    """Returns the kernel for a number of bins."""

    @wp.func_native(CROSS_ENTROPY % {"bins": bins})
    def row_of(
        thread: int,
        logits: wp.array2d[float],
        returns: wp.array[float],
        edges: wp.array[float],
        low: float,
        high: float,
        slope: float,
        losses: wp.array[float],
        gradient: wp.array2d[float],
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def cross_entropy(
        # In:
        logits_in: wp.array2d[float],
        returns_in: wp.array[float],
        edges_in: wp.array[float],
        low: float,
        high: float,
        slope: float,
        # Out:
        losses_out: wp.array[float],
        gradient_out: wp.array2d[float],
    ):
        row_of(wp.tid(), logits_in, returns_in, edges_in, low, high, slope, losses_out, gradient_out)

    return cross_entropy
