"""The network that reads pixels: convolutions and features, after DrQ-v2 (Yarats et al., 2021, arXiv 2107.09645)."""

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn.functional import conv2d, pad

KERNEL = 3
DRQ = (2, 1, 1, 1)
"""Strides of DrQ-v2's convolutions."""
ALIGNED = 8
"""Channels at a multiple of which tensor cores convolve: with zeros up to that a first layer takes half the time."""


class PixelEncoder(nn.Module):
    """Makes features of pixels ``(height, width, channels)``, on CUDA in bfloat16.

    It sees what differs from the mean picture: what is the same in all of them would drown the rest, and actors would
    act alike in all states.
    """

    mean: torch.Tensor
    count: torch.Tensor

    def __init__(
        self, shape: Sequence[int], channels: int = 32, features: int = 50, strides: Sequence[int] = DRQ
    ) -> None:
        super().__init__()
        self.shape, self.channels, self.features, self.strides = tuple(shape), channels, features, tuple(strides)
        sides, least, (height, width, depth) = [*self.shape[:2]], 1, self.shape
        for stride in self.strides:
            sides = [(side - KERNEL) // stride + 1 for side in sides]
        for stride in reversed(self.strides):
            least = stride * (least - 1) + KERNEL
        if min(height, width) < least:
            raise ValueError(f"pixels to learn from must be at least {least} x {least}, got {width} x {height}")
        self.first = nn.Conv2d(depth, channels, KERNEL, self.strides[0])
        others = [nn.Conv2d(channels, channels, KERNEL, stride) for stride in self.strides[1:]]
        self.others = nn.Sequential(nn.ReLU(), *(layer for each in others for layer in (each, nn.ReLU())))
        last = nn.Linear(channels * sides[0] * sides[1], features)
        self.head = nn.Sequential(last, nn.LayerNorm(features), nn.Tanh())
        for layer in (self.first, *others, last):
            weight, bias = layer.parameters()
            nn.init.orthogonal_(weight, 1.0 if layer is last else nn.init.calculate_gain("relu"))
            nn.init.zeros_(bias)
        self.register_buffer("mean", torch.full(self.shape, 127.5))
        self.register_buffer("count", torch.zeros(()))

    @torch.no_grad()
    def merge(self, count: float | torch.Tensor, mean: torch.Tensor) -> None:
        """Updates the mean picture with the ``mean`` of further pictures, in the shape of one, and their number."""
        self.count.add_(count)
        self.mean.lerp_(mean, count / self.count)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Returns features ``(..., features)`` of pixels, uint8 ``(..., height, width, channels)``."""
        if tuple(pixels.shape[-3:]) != self.shape or pixels.dtype != torch.uint8:
            raise ValueError(
                f"this policy sees uint8 pixels of shape {self.shape}, got {pixels.dtype} of shape "
                f"{tuple(pixels.shape[-3:])}: pass the size and frame_stack that it was trained with"
            )
        rows = (pixels.reshape(-1, *self.shape) - self.mean) / 255.0
        gap = -self.shape[-1] % ALIGNED
        rows, weight = pad(rows, (0, gap)), pad(self.first.weight, (0, 0, 0, 0, 0, gap))
        with torch.autocast(pixels.device.type, torch.bfloat16, enabled=pixels.is_cuda):
            found = conv2d(rows.movedim(-1, 1), weight, self.first.bias, self.strides[0])  # channels_last in memory
            found = self.head(self.others(found).flatten(1))
        return found.float().view(*pixels.shape[:-3], self.features)


def shifted(pixels: torch.Tensor, most: int) -> torch.Tensor:
    """Returns pixels ``(n, height, width, channels)``, each picture moved by up to ``most`` of them each way at random.

    Its edges are repeated (Kostrikov et al., 2020, arXiv 2004.13649).
    """
    n, height, width, _ = pixels.shape
    by = torch.randint(-most, most + 1, (2, n, 1), device=pixels.device)
    rows = (torch.arange(height, device=pixels.device) + by[0]).clamp(0, height - 1)
    columns = (torch.arange(width, device=pixels.device) + by[1]).clamp(0, width - 1)
    return pixels[torch.arange(n, device=pixels.device).view(-1, 1, 1), rows.unsqueeze(2), columns.unsqueeze(1)]
