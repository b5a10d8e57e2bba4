"""Random numbers of hooks in plain torch: each is a function of seed, world, episode, step, hook and its place there.

SplitMix64 (Steele, Lea and Flood, 2014): a stream begins at a hash of what it belongs to and advances by a constant;
a number is the hash of its place. Everything is element-wise work on int64, so it compiles with the hooks.
"""

import math
import zlib

import torch

GOLDEN = -7046029254386353131  # 0x9E3779B97F4A7C15 as a signed number, as are the next two
FIRST, SECOND = -4658895280553007687, -7723592293110705685  # 0xBF58476D1CE4E5B9, 0x94D049BB133111EB


def _shifted(z: torch.Tensor, bits: int) -> torch.Tensor:
    """Returns a logical shift to the right: torch's keeps the sign."""
    return (z >> bits) & ((1 << (64 - bits)) - 1)


def mix(z: torch.Tensor) -> torch.Tensor:
    """Returns a hash of int64 numbers, of the same shape."""
    z = (z ^ _shifted(z, 30)) * FIRST
    z = (z ^ _shifted(z, 27)) * SECOND
    return z ^ _shifted(z, 31)


def stream(
    seed: torch.Tensor, world: torch.Tensor, episode: torch.Tensor, step: torch.Tensor, hook: str
) -> torch.Tensor:
    """Returns where the stream of a hook begins in each world, int64 ``(num_envs, 1)``.

    The seed is int64 ``(1,)``; world (its index among all workers'), episodes begun and control steps since the reset
    are integers ``(num_envs,)``. A draw that is added to one hook changes no other.
    """
    start = mix(seed + ((zlib.crc32(hook.encode()) >> 1) << 32))
    for part in (world, episode, step):
        start = mix(start + (part.long() + 1) * GOLDEN)
    return start.unsqueeze(-1)


def places(first: int, count: int, device: torch.device) -> torch.Tensor:
    """Returns ``count`` places of a stream from ``first`` on, int64 ``(count,)``: draws are hashes of the sums."""
    return torch.arange(first + 1, first + 1 + count, device=device) * GOLDEN


def to_unit(bits: torch.Tensor) -> torch.Tensor:
    """Returns floats in [0, 1), of the upper 24 bits."""
    return _shifted(bits, 40).float() * 2.0**-24


def to_normal(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Returns normal numbers of two independent draws from [0, 1) (Box and Muller)."""
    radius = (-2.0 * (1.0 - first).log()).sqrt()
    return radius * (2.0 * math.pi * second).cos()
