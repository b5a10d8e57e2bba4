"""What PPO computes of each number, in one kernel each: torch would launch five to a hundred for it.

torch.compile fuses them as well, but takes half a minute for that at a first start.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
import warp as wp

from torchrl_loco.policy import ObservationNorm
from torchrl_loco.sim.graph import EXCLUSIVE, current_stream, joined_to_torch, torch_is_recording
from torchrl_loco.sim.warp_init import init_warp

HALF_LOG_2_PI = wp.constant(0.5 * math.log(2.0 * math.pi))
LOG_2 = wp.constant(math.log(2.0))
CRITIC_COEFF = 0.5
METRICS = 5
"""Numbers of a step whose means are metrics; the slopes of the deviations follow them."""


def launch(kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
    """Launches a kernel on torch's current stream, or adds it to what torch records.

    Args:
        kernel: the kernel.
        dim: its threads.
        inputs: numbers, and tensors on one device, which it reads.
        outputs: tensors that it writes.
    """
    init_warp()
    device = wp.device_from_torch(outputs[0].device)
    arrays = [[wp.from_torch(x.detach()) if isinstance(x, torch.Tensor) else x for x in xs] for xs in (inputs, outputs)]
    stream = current_stream(device)
    with EXCLUSIVE, joined_to_torch(device) if torch_is_recording(device) else wp.ScopedStream(stream, False):
        wp.launch(kernel, dim, *arrays, device=device)


# A kernel is of one type of numbers, in a module of its own: one that is added to a module unloads what graphs replay.
@functools.cache
def normalise_of(dtype: torch.dtype) -> wp.Kernel:
    """Returns the kernel that writes normalised rows."""
    Rows: Any = wp.array2d(dtype=wp.dtype_from_torch(dtype))  # noqa: N806

    @wp.kernel(enable_backward=False, module="unique")
    def normalise(rows: wp.array2d[float], mean: wp.array[float], var: wp.array[float], limit: float, out: Rows):
        row, column = wp.tid()
        value = float(0.0)
        if column < rows.shape[1]:
            value = wp.clamp((rows[row, column] - mean[column]) / wp.sqrt(var[column] + 1.0e-6), -limit, limit)
        out[row, column] = out.dtype(value)

    return normalise


@torch.no_grad()
def normalised(rows: torch.Tensor, norm: ObservationNorm, dtype: torch.dtype, aligned: int) -> torch.Tensor:
    """Returns what ``norm`` makes of rows of shape ``(..., n)``, with zeros up to a multiple of ``aligned``.

    Raises:
        ValueError: they have another length.
    """
    norm.check(rows)
    wide = rows.new_empty(*rows.shape[:-1], -(-rows.shape[-1] // aligned) * aligned, dtype=dtype)
    flat, out = rows.reshape(-1, rows.shape[-1]), wide.view(-1, wide.shape[-1])
    launch(normalise_of(dtype), tuple(out.shape), [flat, norm.mean, norm.var, norm.limit], [out])
    return wide


@wp.func
def log_slope(u: float) -> float:
    """Of tanh, exact for large u too."""
    softplus = wp.max(-2.0 * u, 0.0) + wp.log(1.0 + wp.exp(-2.0 * wp.abs(u)))
    return 2.0 * (LOG_2 - u - softplus)


@functools.cache
def draw_of(nu: int, bounded: bool, dtype: torch.dtype) -> wp.Kernel:
    """Returns the kernel that draws ``nu`` actions in each state."""
    Rows: Any = wp.array2d(dtype=wp.dtype_from_torch(dtype))  # noqa: N806

    @wp.kernel(enable_backward=False, module="unique")
    def draw(
        mean: Rows,
        std: wp.array[float],
        noise: wp.array2d[float],
        normal: wp.array2d[float],
        action: wp.array2d[float],
        log_prob: wp.array[float],
    ):
        row = wp.tid()
        total = float(0.0)
        for i in range(wp.static(nu)):
            e = noise[row, i]
            u = float(mean[row, i]) + std[i] * e
            total -= 0.5 * e * e + wp.log(std[i]) + HALF_LOG_2_PI
            normal[row, i] = u
            if wp.static(bounded):
                action[row, i] = wp.tanh(u)
                total -= log_slope(u)
        log_prob[row] = total

    return draw


@torch.no_grad()
def drawn(mean: torch.Tensor, std: torch.Tensor, noise: torch.Tensor, bounded: bool) -> tuple[torch.Tensor, ...]:
    """Returns actions and their log-probabilities; and if they are bounded, what they were before tanh.

    Args:
        mean: of the variables, shape ``(n, nu)``.
        std: their standard deviations, shape ``(nu,)``.
        noise: from which they are made, standard normal, shape ``(n, nu)``.
        bounded: whether actions are bounded by tanh.
    """
    normal, log_prob = torch.empty_like(noise), noise.new_empty(len(noise))
    action = torch.empty_like(noise) if bounded else normal
    launch(draw_of(noise.shape[1], bounded, mean.dtype), len(noise), [mean, std, noise], [normal, action, log_prob])
    return (action, log_prob, normal) if bounded else (action, log_prob)


class Slopes(NamedTuple):
    """What :func:`clipped_loss` returns, for ``n`` steps of ``nu`` actions."""

    mean: torch.Tensor
    """Slope of the loss by the means, shape ``(n, nu)``."""
    std: torch.Tensor
    """By the deviations, shape ``(nu,)``."""
    value: torch.Tensor
    """By the values, shape ``(n, 1)``."""
    metrics: torch.Tensor
    """Means over the steps, shape ``(5,)``: the clipped objective's loss, the critic's, the entropy, the divergence
    from the policy that collected, and the fraction of steps whose ratio of probabilities is clipped."""


@functools.cache
def loss_of(nu: int, bounded: bool, dtype: torch.dtype) -> wp.Kernel:
    """Returns the kernel of PPO's loss for ``nu`` actions."""
    Rows: Any = wp.array2d(dtype=wp.dtype_from_torch(dtype))  # noqa: N806

    @wp.kernel(enable_backward=False, module="unique")
    def loss(
        mean: Rows,
        std: wp.array[float],
        value: Rows,
        action: wp.array2d[float],
        old_log_prob: wp.array[float],
        advantage: wp.array[float],
        target: wp.array[float],
        noise: wp.array2d[float],
        spread: wp.array[float],
        center: wp.array[float],
        lowest: float,
        highest: float,
        entropy_coeff: float,
        slope_mean: Rows,
        slope_value: Rows,
        sums: wp.array2d[float],
    ):
        step = wp.tid()
        share = 1.0 / float(mean.shape[0])
        log_prob = float(0.0)
        entropy = float(0.0)
        for i in range(wp.static(nu)):
            z = (action[step, i] - float(mean[step, i])) / std[i]
            constant = wp.log(std[i]) + HALF_LOG_2_PI
            log_prob -= 0.5 * z * z + constant
            if wp.static(bounded):  # of one sample u under tanh
                e = noise[step, i]
                entropy += 0.5 * e * e + constant + log_slope(float(mean[step, i]) + std[i] * e)
            else:
                entropy += 0.5 + constant
        log_ratio = log_prob - old_log_prob[step]
        clipped = wp.clamp(log_ratio, lowest, highest)
        normal = (advantage[step] - center[0]) / wp.max(spread[0], 1.0e-6)
        gain = wp.exp(log_ratio) * normal
        clipped_gain = wp.exp(clipped) * normal
        slope = -gain
        if gain > clipped_gain:  # what is not a number is followed, to be seen
            slope = 0.0
        error = float(value[step, 0]) - target[step]
        of_value = wp.clamp(error, -1.0, 1.0)
        if wp.isnan(error):
            of_value = error
        slope_value[step, 0] = slope_value.dtype(share * CRITIC_COEFF * of_value)
        sums[step, 0] = -wp.min(gain, clipped_gain)
        sums[step, 1] = CRITIC_COEFF * wp.where(wp.abs(error) < 1.0, 0.5 * error * error, wp.abs(error) - 0.5)
        sums[step, 2] = entropy
        sums[step, 3] = -log_ratio
        sums[step, 4] = wp.where(clipped == log_ratio, 0.0, 1.0)
        for i in range(wp.static(nu)):
            z = (action[step, i] - float(mean[step, i])) / std[i]
            by_mean = slope * z / std[i]
            by_std = (slope * (z * z - 1.0) - entropy_coeff) / std[i]
            if wp.static(bounded):
                e = noise[step, i]
                turn = 2.0 * entropy_coeff * wp.tanh(float(mean[step, i]) + std[i] * e)
                by_mean += turn
                by_std += turn * e
            slope_mean[step, i] = slope_mean.dtype(share * by_mean)
            sums[step, METRICS + i] = by_std

    return loss


@torch.no_grad()
def clipped_loss(
    mean: torch.Tensor,
    std: torch.Tensor,
    value: torch.Tensor,
    data: Mapping[str, torch.Tensor],
    clip_epsilon: float,
    entropy_coeff: float,
    bounded: bool,
) -> Slopes:
    """Returns the slopes of PPO's loss: clipped objective, smooth L1 error of the critic and entropy bonus.

    It is the loss of TorchRL's ``ClipPPOLoss`` with advantages normalised by minibatch.

    Args:
        mean: of the actions, shape ``(n, nu)``; before tanh, if they are bounded.
        std: their standard deviations in all states, shape ``(nu,)``.
        value: what the critic expects, shape ``(n, 1)``.
        data: of each step ``action``, before tanh too, shape ``(n, nu)``, ``log_prob`` of that when it was drawn,
            shape ``(n,)``, ``advantage`` and ``value_target``, shape ``(n, 1)``.
        clip_epsilon: range of the ratio of probabilities that is not clipped.
        entropy_coeff: weight of the entropy.
        bounded: whether actions are bounded by tanh; their entropy is that of one sample then.
    """
    steps, nu = mean.shape
    spread, center = torch.std_mean(data["advantage"])
    noise = torch.randn(mean.shape, device=mean.device) if bounded else std.new_empty(0, nu)
    numbers = [data[name].reshape(steps) for name in ("log_prob", "advantage", "value_target")]
    inputs = [mean, std, value, data["action"], *numbers, noise, spread.view(1), center.view(1)]
    slopes = torch.empty_like(mean), torch.empty_like(value), std.new_empty(steps, METRICS + nu)
    bounds = math.log1p(-clip_epsilon), math.log1p(clip_epsilon)
    launch(loss_of(nu, bounded, mean.dtype), steps, [*inputs, *bounds, entropy_coeff], slopes)
    means = slopes[2].mean(0)
    return Slopes(slopes[0], means[METRICS:], slopes[1], means[:METRICS])


@wp.kernel(enable_backward=False)
def step_of_adam(
    gradient: wp.array[float],
    norm: wp.array[float],
    lr: wp.array[float],
    counts: wp.array[wp.float64],
    max_norm: float,
    beta1: float,
    beta2: float,
    eps: float,
    parameter: wp.array[float],
    first: wp.array[float],
    second: wp.array[float],
):
    i = wp.tid()
    slope = gradient[i] * wp.min(max_norm / (norm[0] + 1.0e-6), 1.0)
    of_first = float(wp.float64(1.0) - counts[1])
    of_second = float(wp.float64(1.0) - counts[2])
    first[i] = first[i] + (1.0 - beta1) * (slope - first[i])
    second[i] = beta2 * second[i] + (1.0 - beta2) * slope * slope
    parameter[i] = parameter[i] - lr[0] / of_first * first[i] / (wp.sqrt(second[i] / of_second) + eps)
