"""Normal variables under tanh: samples with their log-probabilities, and divergences, in one kernel each.

A gradient step with small networks is bound by the number of its kernels more than by their arithmetic.
"""

from typing import Any

import torch
import warp as wp

from torchrl_loco.sim import launch_on_tensors

BLOCK = 64
"""Threads of a block on CUDA. A thread has a row; small blocks spread a minibatch over all multiprocessors."""
LOG_2 = wp.constant(0.6931471805599453)
HALF_LOG_2PI = wp.constant(0.9189385332046727)


def sample(loc: torch.Tensor, scale: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns actions ``tanh(u)``, u ~ N(loc, scale), by reparametrisation, and their log-probabilities ``(...)``.

    The log-probability is computed from u, not from the action, so it stays exact where tanh saturates. Both have a
    first derivative only.

    Args:
        loc: means before tanh, float32, shape ``(..., nu)``.
        scale: standard deviations before tanh, of the same shape.
    """
    return _Sample.apply(loc, scale, torch.randn_like(loc))


def kl(old_loc: torch.Tensor, old_scale: torch.Tensor, loc: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Returns KL(old || new) of diagonal Gaussians, shape ``(...)``, which equals that of their images under tanh.

    Means and standard deviations are float32 and have shape ``(..., nu)``. The result has a first derivative only, by
    the new ones.
    """
    return _KL.apply(old_loc, old_scale, loc, scale)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, loc: torch.Tensor, scale: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, ...]:
        action, log_prob = loc.new_empty(loc.shape), loc.new_empty(loc.shape[:-1])
        _launch(sample_forward, (loc, scale, noise), (action, log_prob))
        ctx.save_for_backward(scale, noise, action)
        return action, log_prob

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_action: torch.Tensor, grad_log_prob: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scale, noise, action = ctx.saved_tensors
        gradients = scale.new_empty(scale.shape), scale.new_empty(scale.shape)
        _launch(sample_backward, (scale, noise, action, grad_action, grad_log_prob), gradients)
        return *gradients, None


class _KL(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *normals: torch.Tensor) -> torch.Tensor:
        divergence = normals[0].new_empty(normals[0].shape[:-1])
        _launch(kl_forward, normals, (divergence,))
        ctx.save_for_backward(*normals)
        return divergence

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_divergence: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        scale = ctx.saved_tensors[-1]
        gradients = scale.new_empty(scale.shape), scale.new_empty(scale.shape)
        _launch(kl_backward, (*ctx.saved_tensors, grad_divergence), gradients)
        return None, None, *gradients


def _launch(kernel: wp.Kernel, inputs: tuple[torch.Tensor, ...], outputs: tuple[torch.Tensor, ...]) -> None:
    """Launches a kernel on tensors whose last dimension is a row's, and on those that have a number for each row."""
    shape = inputs[0].shape
    of_rows = [x.reshape(-1, shape[-1]) if x.shape == shape else x.reshape(-1) for x in inputs]
    written = [x.view(-1, shape[-1]) if x.shape == shape else x.view(-1) for x in outputs]
    launch_on_tensors(kernel, shape[:-1].numel(), of_rows, written, BLOCK)


@wp.kernel(enable_backward=False)
def sample_forward(
    # In:
    loc_in: wp.array2d[float],
    scale_in: wp.array2d[float],
    noise_in: wp.array2d[float],
    # Out:
    action_out: wp.array2d[float],
    log_prob_out: wp.array[float],
):
    row = wp.tid()
    log_prob = float(0.0)
    for i in range(loc_in.shape[1]):
        scale, noise = scale_in[row, i], noise_in[row, i]
        u = loc_in[row, i] + scale * noise
        action_out[row, i] = wp.tanh(u)
        # log(1 - tanh(u)^2), exact for large u too
        log_slope = 2.0 * (LOG_2 - wp.abs(u) - wp.log(1.0 + wp.exp(-2.0 * wp.abs(u))))
        log_prob += -0.5 * noise * noise - wp.log(scale) - HALF_LOG_2PI - log_slope
    log_prob_out[row] = log_prob


@wp.kernel(enable_backward=False)
def sample_backward(
    # In:
    scale_in: wp.array2d[float],
    noise_in: wp.array2d[float],
    action_in: wp.array2d[float],
    grad_action_in: wp.array2d[float],
    grad_log_prob_in: wp.array[float],
    # Out:
    grad_loc_out: wp.array2d[float],
    grad_scale_out: wp.array2d[float],
):
    row = wp.tid()
    grad_log_prob = grad_log_prob_in[row]
    for i in range(scale_in.shape[1]):
        action = action_in[row, i]
        grad_u = grad_action_in[row, i] * (1.0 - action * action) + grad_log_prob * 2.0 * action
        grad_loc_out[row, i] = grad_u
        grad_scale_out[row, i] = grad_u * noise_in[row, i] - grad_log_prob / scale_in[row, i]


@wp.kernel(enable_backward=False)
def kl_forward(
    # In:
    old_loc_in: wp.array2d[float],
    old_scale_in: wp.array2d[float],
    loc_in: wp.array2d[float],
    scale_in: wp.array2d[float],
    # Out:
    divergence_out: wp.array[float],
):
    row = wp.tid()
    divergence = float(0.0)
    for i in range(loc_in.shape[1]):
        scale = scale_in[row, i]
        ratio, distance = old_scale_in[row, i] / scale, (old_loc_in[row, i] - loc_in[row, i]) / scale
        divergence += 0.5 * (ratio * ratio + distance * distance - 1.0) - wp.log(ratio)
    divergence_out[row] = divergence


@wp.kernel(enable_backward=False)
def kl_backward(
    # In:
    old_loc_in: wp.array2d[float],
    old_scale_in: wp.array2d[float],
    loc_in: wp.array2d[float],
    scale_in: wp.array2d[float],
    grad_divergence_in: wp.array[float],
    # Out:
    grad_loc_out: wp.array2d[float],
    grad_scale_out: wp.array2d[float],
):
    row = wp.tid()
    grad = grad_divergence_in[row]
    for i in range(loc_in.shape[1]):
        scale = scale_in[row, i]
        ratio, distance = old_scale_in[row, i] / scale, (old_loc_in[row, i] - loc_in[row, i]) / scale
        grad_loc_out[row, i] = -grad * distance / scale
        grad_scale_out[row, i] = grad * (1.0 - ratio * ratio - distance * distance) / scale
