"""What REPPO computes beside its networks on CUDA: a kernel of Triton for each, forth and back.

torch would launch up to thirty for each, and torch.compile needs seconds at every start to make as many as here.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from torchrl_loco.training.adam import aligned
from torchrl_loco.training.mlp import compile_only, run

HALF_LOG_2_PI, LOG_2 = tl.constexpr(0.5 * math.log(2.0 * math.pi)), tl.constexpr(math.log(2.0))
ROWS = 16  # that a block of threads has at once, where they are short


@triton.jit
def _joined(
    left, right, out, n, reads, count, width, left_row, right_row, block_n: tl.constexpr, block_k: tl.constexpr
):  # fmt: skip
    _, at, ks, inside = _places(n, width, block_n, block_k)
    behind = inside & (ks >= reads) & (ks < reads + count)
    both = tl.load(left + at * left_row + ks, inside & (ks < reads), 0.0).to(tl.float32)
    both += tl.load(right + at * right_row + ks - reads, behind, 0.0).to(tl.float32)
    tl.store(out + at * width + ks, both.to(out.dtype.element_ty), inside)


@triton.jit
def _softmax(logits, row, bins, logits_row, block_k: tl.constexpr):
    ks = tl.arange(0, block_k)
    xs = tl.load(logits + row * logits_row + ks, ks < bins, -float("inf")).to(tl.float32)
    most = tl.max(xs, 0)
    grown = tl.exp(xs - most)
    total = tl.sum(grown, 0)
    return xs, grown / total, most + tl.log(total)


@triton.jit(do_not_specialize=["returns_row"])
def _entropy(
    logits, returns, edges, losses, slopes, bins, logits_row, returns_row, low, high, scale, block_k: tl.constexpr
):
    row, ks = tl.program_id(0).to(tl.int64), tl.arange(0, block_k)
    xs, shares, log_total = _softmax(logits, row, bins, logits_row, block_k)
    center = tl.load(returns + row * returns_row)
    center = tl.where(center < low, low, tl.where(center > high, high, center))  # what is not a number stays
    below = tl.erf((tl.load(edges + ks, ks < bins, 0.0) - center) * scale)
    above = tl.erf((tl.load(edges + ks + 1, ks < bins, 0.0) - center) * scale)
    whole = tl.erf((tl.load(edges + bins) - center) * scale) - tl.erf((tl.load(edges) - center) * scale)
    wanted = tl.where(ks < bins, (above - below) / whole, 0.0)
    tl.store(losses + row, log_total - tl.sum(tl.where(ks < bins, wanted * xs, 0.0), 0))
    tl.store(slopes + row * bins + ks, (shares - wanted).to(slopes.dtype.element_ty), ks < bins)


@triton.jit
def _mean(logits, centers, out, bins, logits_row, block_k: tl.constexpr):
    row, ks = tl.program_id(0).to(tl.int64), tl.arange(0, block_k)
    _, shares, _ = _softmax(logits, row, bins, logits_row, block_k)
    tl.store(out + row, tl.sum(shares * tl.load(centers + ks, ks < bins, 0.0), 0))


@triton.jit
def _mean_back(d, logits, centers, dx, bins, logits_row, block_k: tl.constexpr):
    row, ks = tl.program_id(0).to(tl.int64), tl.arange(0, block_k)
    _, shares, _ = _softmax(logits, row, bins, logits_row, block_k)
    of_bins = tl.load(centers + ks, ks < bins, 0.0)
    slope = tl.load(d + row) * shares * (of_bins - tl.sum(shares * of_bins, 0))
    tl.store(dx + row * bins + ks, slope.to(dx.dtype.element_ty), ks < bins)


@triton.jit(do_not_specialize=["weights_row"])
def _squared_error(
    found, wanted, weights, losses, slopes, width, found_row, wanted_row, weights_row, block_k: tl.constexpr
):  # fmt: skip
    row, ks = tl.program_id(0).to(tl.int64), tl.arange(0, block_k)
    places, inside = row * width + ks, ks < width
    aim = tl.load(wanted + row * wanted_row + ks, inside, 0.0).to(tl.float32)
    error = tl.load(found + row * found_row + ks, inside, 0.0).to(tl.float32) - aim
    weight = tl.load(weights + row * weights_row) / width
    tl.store(losses + row, weight * tl.sum(error * error, 0))
    tl.store(slopes + places, (2.0 * weight * error).to(slopes.dtype.element_ty), inside)


@triton.jit
def _places(n, nu, block_n: tl.constexpr, block_k: tl.constexpr):
    rows, ks = tl.program_id(0) * block_n + tl.arange(0, block_n), tl.arange(0, block_k)
    return rows, rows.to(tl.int64)[:, None], ks[None, :], (rows[:, None] < n) & (ks[None, :] < nu)


@triton.jit
def _tanh(u):
    return 2.0 * tl.sigmoid(2.0 * u) - 1.0


@triton.jit
def _draw(loc, scale, noise, action, log_prob, n, nu, block_n: tl.constexpr, block_k: tl.constexpr):
    rows, at, ks, inside = _places(n, nu, block_n, block_k)
    s = tl.load(scale + at * nu + ks, inside, 1.0)
    e = tl.load(noise + at * nu + ks, inside, 0.0)
    u = tl.load(loc + at * nu + ks, inside, 0.0) + s * e
    tl.store(action + at * nu + ks, _tanh(u), inside)
    slope = 2.0 * (LOG_2 - u - (tl.maximum(-2.0 * u, 0.0) + tl.log(1.0 + tl.exp(-2.0 * tl.abs(u)))))  # log of tanh's
    each = -0.5 * e * e - tl.log(s) - HALF_LOG_2_PI - slope
    tl.store(log_prob + rows, tl.sum(tl.where(inside, each, 0.0), 1), rows < n)


@triton.jit
def _draw_back(
    by_action, by_log_prob, loc, scale, noise, by_loc, by_scale, n, nu, block_n: tl.constexpr, block_k: tl.constexpr
):  # fmt: skip
    rows, at, ks, inside = _places(n, nu, block_n, block_k)
    s = tl.load(scale + at * nu + ks, inside, 1.0)
    e = tl.load(noise + at * nu + ks, inside, 0.0)
    a = _tanh(tl.load(loc + at * nu + ks, inside, 0.0) + s * e)
    of_log = tl.load(by_log_prob + rows, rows < n, 0.0)[:, None]
    by_u = tl.load(by_action + at * nu + ks, inside, 0.0) * (1.0 - a * a) + 2.0 * a * of_log
    tl.store(by_loc + at * nu + ks, by_u, inside)
    tl.store(by_scale + at * nu + ks, by_u * e - of_log / s, inside)


@triton.jit(do_not_specialize=["old_row", "old_scale_row"])
def _actor_loss(
    old_loc, old_scale, loc, scale, log_prob, value, temperature, kl_weight, bound,
    numbers, by_loc, by_scale, by_log_prob, by_value, n, nu, old_row, old_scale_row,
    block_n: tl.constexpr, block_k: tl.constexpr,
):  # fmt: skip
    rows, at, ks, inside = _places(n, nu, block_n, block_k)
    here, share = rows < n, 1.0 / n
    s = tl.load(scale + at * nu + ks, inside, 1.0)
    ratio = tl.load(old_scale + at * old_scale_row + ks, inside, 1.0) / s
    away = tl.where(
        inside, (tl.load(old_loc + at * old_row + ks, inside, 0.0) - tl.load(loc + at * nu + ks, inside, 0.0)) / s, 0.0
    )
    kl = tl.sum(tl.where(inside, 0.5 * (ratio * ratio + away * away - 1.0) - tl.log(ratio), 0.0), 1)
    far, log = kl >= bound, tl.load(log_prob + rows, here, 0.0)
    weight, of_entropy = tl.load(kl_weight), tl.load(temperature)
    loss = tl.where(far, weight * kl, of_entropy * log - tl.load(value + rows, here, 0.0))
    tl.store(numbers + rows, loss, here)
    tl.store(numbers + n + rows, -log, here)
    tl.store(numbers + 2 * n + rows, kl, here)
    tl.store(numbers + 3 * n + rows, tl.where(far, 1.0, 0.0), here)
    back = tl.where(far, share * weight, 0.0)[:, None] / s
    tl.store(by_loc + at * nu + ks, -back * away, inside)
    tl.store(by_scale + at * nu + ks, back * (1.0 - ratio * ratio - away * away), inside)
    tl.store(by_log_prob + rows, tl.where(far, 0.0, share * of_entropy), here)
    tl.store(by_value + rows, tl.where(far, 0.0, -share), here)


def _block(width: int, warps: int = 2) -> dict[str, int]:
    return {"block_k": triton.next_power_of_2(width), "num_warps": warps}


def joined(rows: Tensor, action: Tensor, reads: int, width: int, start: Callable[..., None] = run) -> Tensor:
    """Returns the first ``reads`` numbers of rows ``(n, k)``, then actions ``(n, nu)``, then zeros, ``(n, width)``."""
    n, out = len(rows), rows.new_empty(len(rows), width)
    args = rows, action, out, n, reads, action.shape[1], width, rows.stride(0), action.stride(0)
    start(_joined, _grid(n), args, {"block_n": ROWS, **_block(width, 4)})
    return out


def _sizes(logits: Tensor) -> tuple[int, int]:
    return logits.shape[1], logits.stride(0)


def entropy(logits: Tensor, returns: Tensor, bins: Any, start: Callable[..., None] = run) -> tuple[Tensor, Tensor]:
    """Returns cross entropies of ``ValueBins`` with returns ``(n,)``, and their slopes by the logits ``(n, count)``."""
    losses, slopes = logits.new_empty(len(logits), dtype=torch.float32), logits.new_empty(logits.shape)
    args = logits, returns, bins.edges, losses, slopes, *_sizes(logits), returns.stride(0)
    start(_entropy, (len(logits),), (*args, bins.low, bins.high, bins.sharpness), _block(logits.shape[1]))
    return losses, slopes


def mean(logits: Tensor, centers: Tensor, start: Callable[..., None] = run) -> Tensor:
    """Returns the means, ``(n,)``, of distributions over bins with these centers, given as logits ``(n, count)``."""
    out = torch.empty(len(logits), device=logits.device)
    start(_mean, (len(logits),), (logits, centers, out, *_sizes(logits)), _block(logits.shape[1]))
    return out


def mean_back(d: Tensor, logits: Tensor, centers: Tensor, start: Callable[..., None] = run) -> Tensor:
    """Returns the slopes of :func:`mean` by the logits."""
    dx = logits.new_empty(logits.shape)
    start(_mean_back, (len(logits),), (d, logits, centers, dx, *_sizes(logits)), _block(logits.shape[1]))
    return dx


def squared_error(
    found: Tensor, wanted: Tensor, weights: Tensor, start: Callable[..., None] = run
) -> tuple[Tensor, Tensor]:
    """Returns mean squared errors of rows ``(n, width)``, times weights ``(n,)``, and their slopes by ``found``."""
    losses, slopes = found.new_empty(len(found), dtype=torch.float32), found.new_empty(found.shape)
    args = found, wanted, weights, losses, slopes, found.shape[1], found.stride(0), wanted.stride(0), weights.stride(0)
    start(_squared_error, (len(found),), args, _block(found.shape[1]))
    return losses, slopes


def draw(loc: Tensor, scale: Tensor, noise: Tensor, start: Callable[..., None] = run) -> tuple[Tensor, Tensor]:
    """Returns actions and their log-probabilities as ``reppo.sample`` does, of ``(n, nu)``."""
    n, nu = loc.shape
    action, log_prob = torch.empty_like(loc), loc.new_empty(n)
    start(_draw, _grid(n), (loc, scale, noise, action, log_prob, n, nu), _rows(nu))
    return action, log_prob


def draw_back(
    by_action: Tensor, by_log_prob: Tensor, loc: Tensor, scale: Tensor, noise: Tensor, start: Callable[..., None] = run
) -> tuple[Tensor, Tensor]:
    """Returns the slopes of :func:`draw` by means and deviations."""
    (n, nu), slopes = loc.shape, (torch.empty_like(loc), torch.empty_like(loc))
    start(_draw_back, _grid(n), (by_action, by_log_prob, loc, scale, noise, *slopes, n, nu), _rows(nu))
    return slopes


def actor_loss(
    own: tuple[Tensor, Tensor],
    old: tuple[Tensor, Tensor],
    log_prob: Tensor,
    value: Tensor,
    weights: tuple[Tensor, Tensor],
    bound: float,
    start: Callable[..., None] = run,
) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Returns numbers of the actor's loss, ``(4, n)``, and the slopes of its mean.

    ``own`` and ``old`` are means and deviations ``(n, nu)``, log-probabilities and values ``(n,)``, and ``weights``
    temperature and weight of the divergence. The numbers are loss, entropy, divergence and whether that is beyond the
    bound. Slopes are by ``own``, by log-probabilities and values.
    """
    n, nu = own[0].shape
    numbers, slopes = value.new_empty(4, n), tuple(map(torch.empty_like, (*own, log_prob, value)))
    args = *old, *own, log_prob, value, *weights, bound, numbers, *slopes, n, nu, old[0].stride(0), old[1].stride(0)
    start(_actor_loss, _grid(n), args, _rows(nu))
    return numbers, slopes


def _grid(n: int) -> tuple[int]:
    return (triton.cdiv(n, ROWS),)


def _rows(nu: int) -> dict[str, int]:
    return {"block_n": ROWS, **_block(nu)}


class Joined(torch.autograd.Function):
    """Rows, actions behind them, and zeros, as a function of the actions."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, action: Tensor, reads: int, width: int) -> Tensor:
        """Returns ``(n, width)``, of which the first ``reads`` are those of rows."""
        ctx.at, ctx.dtype = slice(reads, reads + action.shape[1]), action.dtype
        return joined(rows, action, reads, width)

    @staticmethod
    def backward(ctx: Any, d: Tensor) -> tuple[None, Tensor | None, None, None]:
        """Returns the slopes by the actions."""
        return None, d[:, ctx.at].to(ctx.dtype) if ctx.needs_input_grad[1] else None, None, None


class BinMean(torch.autograd.Function):
    """The mean of distributions over bins as a function of their logits."""

    @staticmethod
    def forward(ctx: Any, logits: Tensor, centers: Tensor) -> Tensor:
        """Returns means, ``(n,)``, of logits ``(n, count)``."""
        ctx.save_for_backward(logits, centers)
        return mean(logits, centers)

    @staticmethod
    def backward(ctx: Any, d: Tensor) -> tuple[Tensor, None]:
        """Returns the slopes by the logits."""
        return mean_back(d.contiguous(), *ctx.saved_tensors), None


class MeanLoss(torch.autograd.Function):
    """The mean of losses whose slopes are known."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, losses: Tensor, slopes: Tensor) -> Tensor:
        """Returns the mean of the losses ``(n,)`` of rows ``(n, k)``, a scalar; ``slopes`` are theirs, by the rows."""
        ctx.save_for_backward(slopes)
        return losses.mean()

    @staticmethod
    def backward(ctx: Any, d: Tensor) -> tuple[Tensor, None, None]:
        """Returns the slopes by the rows."""
        (slopes,) = ctx.saved_tensors
        return slopes * (d / len(slopes)), None, None


class Draw(torch.autograd.Function):
    """Actions and their log-probabilities as functions of means and deviations."""

    @staticmethod
    def forward(ctx: Any, loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Returns actions ``(n, nu)`` and log-probabilities ``(n,)``."""
        ctx.save_for_backward(loc, scale, noise)
        return draw(loc, scale, noise)

    @staticmethod
    def backward(ctx: Any, by_action: Tensor, by_log_prob: Tensor) -> tuple[Tensor, Tensor, None]:
        """Returns the slopes by means and deviations."""
        return *draw_back(by_action.contiguous(), by_log_prob.contiguous(), *ctx.saved_tensors), None


class ActorLoss(torch.autograd.Function):
    """The actor's loss, which goes back to the old policy where it is too far, and what is told of it."""

    @staticmethod
    def forward(ctx: Any, loc: Tensor, scale: Tensor, *others: Any) -> tuple[Tensor, Tensor]:
        """Returns the mean loss, a scalar, and the means of all numbers of :func:`actor_loss`, ``(4,)``."""
        numbers, slopes = actor_loss((loc, scale), *others)
        ctx.save_for_backward(*slopes)
        means = numbers.mean(1)
        ctx.mark_non_differentiable(means)
        return means[0].clone(), means

    @staticmethod
    def backward(ctx: Any, d: Tensor, _: Any) -> tuple[Tensor | None, ...]:
        """Returns the slopes by means, deviations, log-probabilities and values."""
        by_loc, by_scale, by_log_prob, by_value = torch._foreach_mul(ctx.saved_tensors, d)
        return by_loc, by_scale, None, by_log_prob, by_value, None, None


def compile_ahead(bins: Any, like: Tensor, n: int, width: int, reads: int, nu: int) -> None:
    """Compiles it for ``n`` steps, a width of features, ``reads`` numbers and ``nu`` actions, typed as ``like``."""
    count, one = len(bins.centers), like.new_empty(n, dtype=torch.float32)
    logits = like.new_empty(n, aligned(count))[:, :count]  # as rows.Affine gives them
    rows, actions = like.new_empty(n, width), one.new_empty(n, nu)
    joined(like.new_empty(n, aligned(reads)), actions, reads, aligned(reads + nu), compile_only)
    entropy(logits, one, bins, compile_only)
    mean(logits, bins.centers, compile_only)
    mean_back(one, logits, bins.centers, compile_only)
    squared_error(rows, rows, one, compile_only)
    draw(actions, actions, actions, compile_only)
    draw_back(actions, one, actions, actions, actions, compile_only)
    actor_loss((actions, actions), (actions, actions), one, one, (one, one), 0.1, compile_only)
