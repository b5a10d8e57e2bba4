"""Linear layers with SiLU between them on CUDA: a kernel of Triton for a layer, and one for each kind of its slopes.

As torch computes them, a gradient step of small networks mostly reads and writes: SiLU, its slope and the slopes of
biases are passes of their own over all activations.
"""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

PARTS = 16
"""In how many parts rows are summed to slopes by weights; the parts come last, so that the order is always one."""
FORWARD = {"block_n": 128, "block_o": 128, "block_k": 64, "num_warps": 8, "num_stages": 3}
ROWS = {"block_n": 64, "block_o": 64, "block_k": 128, "num_warps": 4, "num_stages": 2}
WEIGHTS = {"block_n": 64, "block_o": 128, "block_k": 128, "num_warps": 4, "num_stages": 3}
"""Rows, outputs and inputs of a layer that a block of threads has at once, as they were fastest on an H200."""
MOST = 2**31
"""Numbers that rows may have, gaps included: places are counted in 32 bits."""


@triton.jit
def _forward(
    x, w, b, out, slope, n, k, o, x_row, w_row,
    silu: tl.constexpr, keep: tl.constexpr, block_n: tl.constexpr, block_o: tl.constexpr, block_k: tl.constexpr,
):  # fmt: skip
    pid, across = tl.program_id(0), tl.cdiv(o, block_o)
    rows = (pid // across) * block_n + tl.arange(0, block_n)
    outs = (pid % across) * block_o + tl.arange(0, block_o)
    total = tl.zeros((block_n, block_o), tl.float32)
    for start in range(0, k, block_k):
        ks = start + tl.arange(0, block_k)
        xs = tl.load(x + rows[:, None] * x_row + ks[None, :], (rows[:, None] < n) & (ks[None, :] < k), 0.0)
        ws = tl.load(w + outs[None, :] * w_row + ks[:, None], (outs[None, :] < o) & (ks[:, None] < k), 0.0)
        total = tl.dot(xs, ws, total)
    total += tl.load(b + outs, outs < o, 0.0).to(tl.float32)[None, :]
    places = rows[:, None] * o + outs[None, :]
    inside = (rows[:, None] < n) & (outs[None, :] < o)
    if silu:
        # One instruction instead of an exponential and a division; what is wrong of a sum, at most 2^-12 of it, is less
        # than bfloat16 rounds.
        half = tl.inline_asm_elementwise("tanh.approx.f32 $0, $1;", "=f,f", [0.5 * total], tl.float32, True, 1)
        share = 0.5 + 0.5 * half
        given = total * share
        if keep:
            tl.store(slope + places, (share * (1.0 + total - given)).to(slope.dtype.element_ty), inside)
        total = given
    tl.store(out + places, total.to(out.dtype.element_ty), inside)


@triton.jit
def _by_rows(
    d, w, slope, out, n, k, o, d_row, w_row, block_n: tl.constexpr, block_o: tl.constexpr, block_k: tl.constexpr
):
    pid, across = tl.program_id(0), tl.cdiv(k, block_k)
    rows = (pid // across) * block_n + tl.arange(0, block_n)
    ks = (pid % across) * block_k + tl.arange(0, block_k)
    total = tl.zeros((block_n, block_k), tl.float32)
    for start in range(0, o, block_o):
        outs = start + tl.arange(0, block_o)
        ds = tl.load(d + rows[:, None] * d_row + outs[None, :], (rows[:, None] < n) & (outs[None, :] < o), 0.0)
        ws = tl.load(w + outs[:, None] * w_row + ks[None, :], (outs[:, None] < o) & (ks[None, :] < k), 0.0)
        total = tl.dot(ds, ws, total)
    places = rows[:, None] * k + ks[None, :]
    inside = (rows[:, None] < n) & (ks[None, :] < k)
    slopes = tl.load(slope + places, inside, 0.0).to(tl.float32)
    tl.store(out + places, (total * slopes).to(out.dtype.element_ty), inside)


@triton.jit
def _by_weights(
    d, x, dw, db, n, k, o, d_row, x_row, w_row, width, per_part,
    block_n: tl.constexpr, block_o: tl.constexpr, block_k: tl.constexpr,
):  # fmt: skip
    tile, part, across = tl.program_id(0), tl.program_id(1), tl.cdiv(k, block_k)
    outs = (tile // (across + 1)) * block_o + tl.arange(0, block_o)
    first, end = part * per_part, tl.minimum(n, (part + 1) * per_part)
    if tile % (across + 1) == across:  # a block of threads of its own for the bias
        sums = tl.zeros((block_n, block_o), tl.float32)
        for start in range(first, end, block_n):
            rows = start + tl.arange(0, block_n)
            ds = tl.load(d + rows[:, None] * d_row + outs[None, :], (rows[:, None] < end) & (outs[None, :] < o), 0.0)
            sums += ds.to(tl.float32)
        tl.store(db + part * width + outs, tl.sum(sums, 0), outs < o)
    else:
        ks = (tile % (across + 1)) * block_k + tl.arange(0, block_k)
        total = tl.zeros((block_o, block_k), tl.float32)
        for start in range(first, end, block_n):
            rows = start + tl.arange(0, block_n)
            ds = tl.load(d + rows[:, None] * d_row + outs[None, :], (rows[:, None] < end) & (outs[None, :] < o), 0.0)
            xs = tl.load(x + rows[:, None] * x_row + ks[None, :], (rows[:, None] < end) & (ks[None, :] < k), 0.0)
            total = tl.dot(tl.trans(ds), xs, total)
        places = part * width + outs[:, None] * w_row + ks[None, :]
        tl.store(dw + places, total, (outs[:, None] < o) & (ks[None, :] < k))


def compile_ahead(networks: Iterable[Sequence[Tensor]], n: int, parts: Tensor) -> None:
    """Compiles what networks of such weights need for ``n`` rows, and for their slopes, all kernels at once."""
    with all_at_once(parts.device):
        for weights in networks:
            rows = weights[0].new_empty(n, weights[0].shape[1])
            _forward_all(rows, weights, keep=False, start=compile_only)
            out, kept = _forward_all(rows, weights, keep=True, start=compile_only)
            _backward_all(out, weights, kept, parts, start=compile_only)


@contextlib.contextmanager
def all_at_once(device: torch.device) -> Iterator[None]:
    """Lets kernels that are compiled within be compiled side by side; they are there at its end."""
    with ThreadPoolExecutor() as pool, torch.cuda.device(device), triton.AsyncCompileMode(pool):
        yield


def compile_only(kernel: Any, grid: tuple[int, ...], args: Sequence[Any], sizes: Mapping[str, Any]) -> None:
    """Compiles a kernel for what :func:`run` would launch."""
    kernel.warmup(*args, grid=grid, **sizes)


def run(kernel: Any, grid: tuple[int, ...], args: Sequence[Any], sizes: Mapping[str, Any]) -> None:
    """Launches a kernel on the device of its first argument, on torch's current stream there."""
    with torch.cuda.device(args[0].device):
        kernel[grid](*args, **sizes)


def _sizes(settings: dict[str, int], k: int, o: int) -> dict[str, int]:
    """Returns settings for a layer of ``k`` inputs and ``o`` outputs: no wider than that, as products allow it."""
    widest = {name: max(16, triton.next_power_of_2(size)) for name, size in (("block_k", k), ("block_o", o))}
    return {name: min(size, widest.get(name, size)) for name, size in settings.items()}


def _forward_all(
    rows: Tensor, weights: Sequence[Tensor], keep: bool, start: Callable[..., None] = run
) -> tuple[Tensor, list[Tensor]]:
    """Returns what a network gives, and what its slopes need: what each layer reads, and SiLU's slope there."""
    n, given, kept = len(rows), rows, [rows]
    for index, (weight, bias) in enumerate(zip(weights[::2], weights[1::2], strict=True)):
        o, k = weight.shape
        silu = 2 * index + 2 < len(weights)
        out = rows.new_empty(n, o)
        slope = torch.empty_like(out) if silu and keep else out
        sizes = _sizes(FORWARD, k, o)
        grid = triton.cdiv(n, sizes["block_n"]) * triton.cdiv(o, sizes["block_o"])
        layer = given, weight, bias, out, slope, n, k, o, given.stride(0), weight.stride(0)
        start(_forward, (grid,), layer, {"silu": silu, "keep": keep, **sizes})
        kept += [slope, out] if silu else []
        given = out
    return given, kept


def _backward_all(
    d: Tensor, weights: Sequence[Tensor], kept: Sequence[Tensor], parts: Tensor, start: Callable[..., None] = run
) -> None:
    """Writes the slopes by weights, which are views of a vector, into parts of one; ``d`` are those by the outputs."""
    n, inputs, slopes = len(d), kept[::2], kept[1::2]
    for index in reversed(range(len(inputs))):
        weight, bias = weights[2 * index : 2 * index + 2]
        (o, k), x = weight.shape, inputs[index]
        sizes = _sizes(WEIGHTS, k, o)
        tiles = triton.cdiv(o, sizes["block_o"]) * (triton.cdiv(k, sizes["block_k"]) + 1)
        per_part = triton.cdiv(n, PARTS * sizes["block_n"]) * sizes["block_n"]
        places = [parts[:, part.storage_offset() :] for part in (weight, bias)]
        strides = d.stride(0), x.stride(0), weight.stride(0), parts.stride(0)
        start(_by_weights, (tiles, PARTS), (d, x, *places, n, k, o, *strides, per_part), sizes)
        if index:
            out, sizes = torch.empty_like(x), _sizes(ROWS, k, o)
            grid = triton.cdiv(n, sizes["block_n"]) * triton.cdiv(k, sizes["block_k"])
            layer = d, weight, slopes[index - 1], out, n, k, o, d.stride(0), weight.stride(0)
            start(_by_rows, (grid,), layer, sizes)
            d = out


class SiluNetwork(torch.autograd.Function):
    """A network as a function of rows; slopes by its weights are written elsewhere."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, parts: Tensor | None, *weights: Tensor) -> Tensor:
        """Returns what it gives, ``(n, outputs)``.

        Args:
            ctx: autograd's.
            rows: what it reads, ``(n, inputs)``, in the type of the weights.
            parts: where slopes by weights go, shape ``(PARTS, length)``, which stands for the weights in autograd;
                ``None``: there will be none.
            weights: weights and biases of the layers in turn, views of one vector of that length.
        """
        out, kept = _forward_all(rows, weights, keep=parts is not None)
        ctx.parts, ctx.number = parts, len(weights)
        if parts is not None:
            ctx.save_for_backward(*weights, *kept)
        return out

    @staticmethod
    def backward(ctx: Any, d: Tensor) -> tuple[None, ...]:
        """Writes the slopes by weights."""
        weights, kept = ctx.saved_tensors[: ctx.number], ctx.saved_tensors[ctx.number :]
        _backward_all(d.contiguous(), weights, kept, ctx.parts.detach())
        return (None,) * (2 + ctx.number)
