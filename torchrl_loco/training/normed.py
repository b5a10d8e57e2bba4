"""Layer norm with SiLU after it on CUDA: a kernel of Triton forth, one back, and one for slopes by weights."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from torchrl_loco.training.mlp import compile_only, run

PROGRAMS = 1024
"""Blocks of threads that sum slopes over rows. Each row is of one warp, up to a width, which needs no barriers."""
WIDTH_OF_WARP = 512


@triton.jit
def _layer_norm(x, add, row, width, x_row, eps, adds: tl.constexpr, block: tl.constexpr):
    ks = tl.arange(0, block)
    xs = tl.load(x + row * tl.cast(x_row, tl.int64) + ks, ks < width, 0.0).to(tl.float32)
    if adds:
        xs += tl.load(add + ks, ks < width, 0.0).to(tl.float32)
    centered = tl.where(ks < width, xs - tl.sum(xs, 0) / width, 0.0)
    scale = tl.rsqrt(tl.sum(centered * centered, 0) / width + eps)
    return centered * scale, scale


@triton.jit
def _forward(x, add, w, b, out, width, x_row, eps, adds: tl.constexpr, block: tl.constexpr):
    row, ks = tl.program_id(0), tl.arange(0, block)
    normed, _ = _layer_norm(x, add, row, width, x_row, eps, adds, block)
    gain, shift = tl.load(w + ks, ks < width, 0.0).to(tl.float32), tl.load(b + ks, ks < width, 0.0).to(tl.float32)
    u = normed * gain + shift
    tl.store(out + row * tl.cast(width, tl.int64) + ks, (u * tl.sigmoid(u)).to(out.dtype.element_ty), ks < width)


@triton.jit
def _backward(
    d, x, add, w, b, dx, sums, n, width, x_row, eps, adds: tl.constexpr, learns: tl.constexpr, block: tl.constexpr
):  # fmt: skip
    ks = tl.arange(0, block)
    gain, shift = tl.load(w + ks, ks < width, 0.0).to(tl.float32), tl.load(b + ks, ks < width, 0.0).to(tl.float32)
    by_gain, by_shift = tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32)
    by_x = tl.zeros((block,), tl.float32)
    for row in range(tl.program_id(0), n, tl.num_programs(0)):
        place = row * tl.cast(width, tl.int64) + ks
        slope = tl.load(d + place, ks < width, 0.0).to(tl.float32)
        normed, scale = _layer_norm(x, add, row, width, x_row, eps, adds, block)
        u = normed * gain + shift
        share = tl.sigmoid(u)
        du = slope * share * (1.0 + u * (1.0 - share))
        dn = du * gain
        of_x = scale * (dn - normed * (tl.sum(dn * normed, 0) / width) - tl.sum(dn, 0) / width)
        tl.store(dx + place, of_x.to(dx.dtype.element_ty), ks < width)
        if learns:
            by_gain += du * normed
            by_shift += du
            if adds:
                by_x += of_x
    if learns:
        at = sums + tl.program_id(0) * 3 * width + ks
        tl.store(at, by_gain, ks < width)
        tl.store(at + width, by_shift, ks < width)
        if adds:
            tl.store(at + 2 * width, by_x, ks < width)


@triton.jit
def _sum_of_parts(sums, out, parts, width, block_n: tl.constexpr, block_k: tl.constexpr):
    ks = tl.program_id(0) * block_k + tl.arange(0, block_k)
    total = tl.zeros((block_n, block_k), tl.float32)
    for start in range(0, parts, block_n):
        rows = start + tl.arange(0, block_n)
        inside = (rows[:, None] < parts) & (ks[None, :] < width)
        total += tl.load(sums + rows[:, None] * width + ks[None, :], inside, 0.0)
    tl.store(out + ks, tl.sum(total, 0).to(out.dtype.element_ty), ks < width)


def _block(width: int) -> dict[str, int]:
    block = triton.next_power_of_2(width)
    return {"block": block, "num_warps": min(16, max(1, block // WIDTH_OF_WARP))}


def normed(
    rows: Tensor, add: Tensor | None, weight: Tensor, bias: Tensor, eps: float, start: Callable[..., None] = run
) -> Tensor:
    """Returns SiLU of layer norm of rows ``(n, width)``, each contiguous, to which ``add`` is added before."""
    n, width = rows.shape
    out = rows.new_empty(n, width)
    args = rows, weight if add is None else add, weight, bias, out, width, rows.stride(0), eps
    start(_forward, (n,), args, {"adds": add is not None, **_block(width)})
    return out


def normed_back(
    d: Tensor,
    rows: Tensor,
    add: Tensor | None,
    weight: Tensor,
    bias: Tensor,
    eps: float,
    learns: bool,
    start: Callable[..., None] = run,
) -> tuple[Tensor, Tensor]:
    """Returns slopes by rows, and if it ``learns`` those by weight, bias and ``add``, ``(3, width)``."""
    n, width = rows.shape
    dx, programs = torch.empty_like(d), min(n, PROGRAMS)
    sums, total = torch.empty(programs, 3 * width, device=d.device), weight.new_empty(3, width)
    args = d, rows, weight if add is None else add, weight, bias, dx, sums, n, width, rows.stride(0), eps
    start(_backward, (programs,), args, {"adds": add is not None, "learns": learns, **_block(width)})
    if learns:
        sizes = {"block_n": 256, "block_k": 16, "num_warps": 8}
        start(_sum_of_parts, (triton.cdiv(3 * width, sizes["block_k"]),), (sums, total, programs, 3 * width), sizes)
    return dx, total


class NormedSilu(torch.autograd.Function):
    """SiLU of layer norm as a function of rows, of what is added to each, weight and bias."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, add: Tensor | None, weight: Tensor, bias: Tensor, eps: float) -> Tensor:
        """Returns what it gives, ``(n, width)``."""
        ctx.save_for_backward(rows, add, weight, bias)
        ctx.eps = eps
        return normed(rows, add, weight, bias, eps)

    @staticmethod
    def backward(ctx: Any, d: Tensor) -> tuple[Tensor | None, ...]:
        """Returns the slopes by rows, by what is added, by weight and bias."""
        rows, add, weight, bias = ctx.saved_tensors
        learns = any(ctx.needs_input_grad[1:4])
        dx, total = normed_back(d.contiguous(), rows, add, weight, bias, ctx.eps, learns)
        if not learns:
            return dx, None, None, None, None
        by_weight, by_bias, by_add = total
        return dx, None if add is None else by_add, by_weight, by_bias, None


def compile_ahead(widths: Iterable[int], like: Tensor, n: int) -> None:
    """Compiles it for ``n`` rows of such widths, of the type that ``like`` has."""
    for width in widths:
        rows, one = like.new_empty(n, width), like.new_empty(width)
        for add in (None, one):
            normed(rows, add, one, one, 1e-5, compile_only)
            for learns in (False, True):
                normed_back(rows, rows, add, one, one, 1e-5, learns, compile_only)
