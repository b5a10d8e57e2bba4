"""Layer norm and SiLU in one kernel, forwards and backwards.

Between the matrix products of small networks, torch spends most of a gradient step reading and writing activations.
One kernel for both reads and writes them once. Its C++ is compiled by Warp for a row's width.
"""

import functools
from typing import Any

import torch
import warp as wp
from torch import nn

from torchrl_loco.sim import joined_to_torch

WARP = 32
"""Threads that share a row on CUDA; they hold it in registers. On the CPU one does."""
BLOCK = 256
"""Threads of a block."""
GROUPS = 1056
"""Warps of the backward kernel: each adds up the gradients of weight and bias over its rows. 8 for each of 132
multiprocessors."""
WIDEST = 1024
"""The longest row that registers hold."""

PREAMBLE = """
#ifdef __CUDA_ARCH__
  enum { LANES = 32 };
#else
  enum { LANES = 1 };
#endif
  enum { WIDTH = %d, SLOTS = (WIDTH + LANES - 1) / LANES };
  struct Lane {
    static CUDA_CALLABLE float sum(float x) {
#ifdef __CUDA_ARCH__
      for (int o = 16; o; o >>= 1) x += __shfl_xor_sync(~0u, x, o);
#endif
      return x;
    }
  };
  // The lane holds the entries lane, lane + LANES, ... of a row.
#undef OWN
#define OWN(slot, column) _Pragma("unroll") for (int slot = 0, column = lane; slot < SLOTS; ++slot, column += LANES) \\
    if (WIDTH %% LANES == 0 || column < WIDTH)
  struct Row {
    float normed[SLOTS];
    float scale;  // one over the standard deviation
    CUDA_CALLABLE void load(const float* x, int lane, float eps) {
      float mean = 0.0f, var = 0.0f;
      OWN(slot, column) { normed[slot] = x[column]; mean += normed[slot]; }
      mean = Lane::sum(mean) / WIDTH;
      OWN(slot, column) { normed[slot] -= mean; var += normed[slot] * normed[slot]; }
      scale = 1.0f / sqrtf(Lane::sum(var) / WIDTH + eps);
      OWN(slot, column) normed[slot] *= scale;
    }
  };
"""

FORWARD = """
  Row r;
  r.load(&x.data[size_t(row) * WIDTH], lane, eps);
  OWN(slot, column) {
    const float a = r.normed[slot] * weight.data[column] + bias.data[column];
    y.data[size_t(row) * WIDTH + column] = a / (1.0f + expf(-a));
  }
"""

BACKWARD = """
  float weight_sum[SLOTS], bias_sum[SLOTS];
  OWN(slot, column) weight_sum[slot] = bias_sum[slot] = 0.0f;
  for (int row = group; row < rows; row += groups) {
    Row r;
    float g[SLOTS];  // gradient of the normalised row
    float mean = 0.0f, along = 0.0f;
    r.load(&x.data[size_t(row) * WIDTH], lane, eps);
    OWN(slot, column) {
      const float w = weight.data[column], a = r.normed[slot] * w + bias.data[column];
      const float gate = 1.0f / (1.0f + expf(-a));
      const float grad_a = grad_y.data[size_t(row) * WIDTH + column] * gate * (1.0f + a * (1.0f - gate));
      weight_sum[slot] += grad_a * r.normed[slot];
      bias_sum[slot] += grad_a;
      g[slot] = grad_a * w;
      mean += g[slot];
      along += g[slot] * r.normed[slot];
    }
    mean = Lane::sum(mean) / WIDTH;
    along = Lane::sum(along) / WIDTH;
    OWN(slot, column)
      grad_x.data[size_t(row) * WIDTH + column] = r.scale * (g[slot] - mean - r.normed[slot] * along);
  }
  if (sums.shape[1] == 0) return;  // they are not asked for
  OWN(slot, column) {
    sums.data[size_t(2 * group) * WIDTH + column] = weight_sum[slot];
    sums.data[size_t(2 * group + 1) * WIDTH + column] = bias_sum[slot];
  }
"""


class NormSiLU(nn.Sequential):
    """Layer norm with weight and bias, then SiLU: on CUDA by one kernel, elsewhere one after the other.

    Args:
        width: length of a row.
    """

    def __init__(self, width: int) -> None:
        super().__init__(nn.LayerNorm(width), nn.SiLU())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Returns the image of ``x``, of shape ``(..., width)``, in the same shape."""
        norm = self[0]
        if not (x.is_cuda and x.shape[-1] <= WIDEST and isinstance(norm, nn.LayerNorm)):
            return super().forward(x)
        return norm_silu(x, norm.weight, norm.bias, norm.eps)


def norm_silu(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, eps: float) -> torch.Tensor:
    """Returns ``silu(layer_norm(x) * weight + bias)`` in the shape of ``x``, differentiable once.

    Args:
        x: float32, shape ``(..., width)``.
        weight: shape ``(width,)``.
        bias: shape ``(width,)``.
        eps: what is added to the variance.
    """
    return _NormSiLU.apply(x, weight, bias, eps)


class _NormSiLU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, eps: float) -> torch.Tensor:
        rows = x.contiguous().view(-1, x.shape[-1])
        y = torch.empty_like(rows)
        _launch("forward", len(rows), (rows, weight, bias, eps), (y,))
        ctx.save_for_backward(rows, weight, bias)
        ctx.eps = eps
        return y.view(x.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None, None]:
        rows, weight, bias = ctx.saved_tensors
        grad_x = torch.empty_like(rows)
        of_parameters = any(ctx.needs_input_grad[1:])
        sums = rows.new_empty(min(GROUPS, len(rows)), 2 * rows.shape[-1] if of_parameters else 0)
        given = grad_y.contiguous().view_as(rows)
        _launch("backward", len(sums), (rows, weight, bias, ctx.eps, given), (grad_x, sums))
        grad_weight, grad_bias = sums.sum(0).chunk(2) if of_parameters else (None, None)
        return grad_x.view(grad_y.shape), grad_weight, grad_bias, None


def _launch(kind: str, groups: int, inputs: tuple[Any, ...], outputs: tuple[torch.Tensor, ...]) -> None:
    """Launches a kernel on torch's current stream; while torch records, the launch joins the recording."""
    x = inputs[0]
    device = wp.get_device(str(x.device))
    lanes = WARP if device.is_cuda else 1
    arrays = [wp.from_torch(value.detach()) if isinstance(value, torch.Tensor) else value for value in inputs]
    with joined_to_torch(device):
        wp.launch(
            _kernels(x.shape[-1])[kind],
            dim=groups * lanes,
            inputs=[lanes, *arrays],
            outputs=[wp.from_torch(value) for value in outputs],
            device=device,
            block_dim=BLOCK,
        )


@functools.cache
def _kernels(width: int) -> dict[str, wp.Kernel]:
    """Returns the kernels for rows of a width."""

    @wp.func_native(PREAMBLE % width + FORWARD)
    def forward_row(
        lane: int,
        row: int,
        x: wp.array2d[float],
        weight: wp.array[float],
        bias: wp.array[float],
        eps: float,
        y: wp.array2d[float],
    ): ...

    @wp.func_native(PREAMBLE % width + BACKWARD)
    def backward_rows(
        lane: int,
        group: int,
        groups: int,
        rows: int,
        x: wp.array2d[float],
        weight: wp.array[float],
        bias: wp.array[float],
        eps: float,
        grad_y: wp.array2d[float],
        grad_x: wp.array2d[float],
        sums: wp.array2d[float],
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def norm_silu_forward(
        # In:
        lanes: int,
        x_in: wp.array2d[float],
        weight_in: wp.array[float],
        bias_in: wp.array[float],
        eps: float,
        # Out:
        y_out: wp.array2d[float],
    ):
        forward_row(wp.tid() % lanes, wp.tid() // lanes, x_in, weight_in, bias_in, eps, y_out)

    @wp.kernel(enable_backward=False, module="unique")
    def norm_silu_backward(
        # In:
        lanes: int,
        x_in: wp.array2d[float],
        weight_in: wp.array[float],
        bias_in: wp.array[float],
        eps: float,
        grad_y_in: wp.array2d[float],
        # Out:
        grad_x_out: wp.array2d[float],
        sums_out: wp.array2d[float],
    ):
        backward_rows(
            wp.tid() % lanes,
            wp.tid() // lanes,
            sums_out.shape[0],
            x_in.shape[0],
            x_in,
            weight_in,
            bias_in,
            eps,
            grad_y_in,
            grad_x_out,
            sums_out,
        )

    return {"forward": norm_silu_forward, "backward": norm_silu_backward}
