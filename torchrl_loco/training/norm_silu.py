"""Layer norm and SiLU in one kernel, forwards and backwards.

Between the matrix products of small networks, torch spends most of a gradient step reading and writing activations.
One kernel for both reads and writes them once. Its C++ is compiled by Warp for a row's width.
"""

import collections
import functools
from typing import Any

import torch
import warp as wp
from torch import nn

from torchrl_loco.sim import launch_on_tensors

LANES = 32
"""Threads that share a row on CUDA; they hold it in registers. On the CPU one does."""
BLOCK = 256
"""Threads of a block on CUDA."""
BLOCKS = 264
"""Blocks of the backward kernel, which add up the gradients of weight and bias over their rows: 2 for each of 132
multiprocessors."""
WIDEST = 1024
"""The longest row that was tried."""

PREAMBLE = """
  enum { WIDTH = %(width)d };
#undef UNROLL
#ifdef __CUDA_ARCH__
  enum { LANES = 32, WARPS = %(warps)d };
#define UNROLL _Pragma("unroll")
#else
  enum { LANES = 1, WARPS = 1 };
#define UNROLL  // a row in one thread would take long to compile
#endif
  enum { SLOTS = WIDTH / LANES, PACKED = LANES == 32 && WIDTH %% 128 == 0 };
  struct Lane {
    // The column of a slot: four neighbours a lane where rows are read and written 16 bytes at a time.
    static CUDA_CALLABLE int column(int lane, int slot) {
      return PACKED ? slot / 4 * 128 + lane * 4 + slot %% 4 : slot * LANES + lane;
    }
    static CUDA_CALLABLE void read(const float* row, int lane, float* values) {
#ifdef __CUDA_ARCH__
      if (PACKED) {
        UNROLL for (int i = 0; i < SLOTS / 4; ++i) {
          const float4 four = reinterpret_cast<const float4*>(row)[i * 32 + lane];
          values[4 * i] = four.x, values[4 * i + 1] = four.y, values[4 * i + 2] = four.z, values[4 * i + 3] = four.w;
        }
        return;
      }
#endif
      UNROLL for (int slot = 0; slot < SLOTS; ++slot) values[slot] = row[column(lane, slot)];
    }
    static CUDA_CALLABLE void write(float* row, int lane, const float* values) {
#ifdef __CUDA_ARCH__
      if (PACKED) {
        UNROLL for (int i = 0; i < SLOTS / 4; ++i)
          reinterpret_cast<float4*>(row)[i * 32 + lane] =
              make_float4(values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]);
        return;
      }
#endif
      UNROLL for (int slot = 0; slot < SLOTS; ++slot) row[column(lane, slot)] = values[slot];
    }
    static CUDA_CALLABLE float sum(float x) {
#ifdef __CUDA_ARCH__
      UNROLL for (int o = 16; o; o >>= 1) x += __shfl_xor_sync(~0u, x, o);
#endif
      return x;
    }
    static CUDA_CALLABLE float sigmoid(float x) {
#ifdef __CUDA_ARCH__
      return __fdividef(1.0f, 1.0f + __expf(-x));
#else
      return 1.0f / (1.0f + expf(-x));
#endif
    }
  };
"""

FORWARD = """
  const int lane = thread % LANES, row = thread / LANES;
  float values[SLOTS], w[SLOTS], b[SLOTS];
  Lane::read(&x.data[size_t(row) * WIDTH], lane, values);
  Lane::read(weight.data, lane, w);
  Lane::read(bias.data, lane, b);
  float mean = 0.0f, var = 0.0f;
  UNROLL for (int slot = 0; slot < SLOTS; ++slot) mean += values[slot];
  mean = Lane::sum(mean) / WIDTH;
  UNROLL for (int slot = 0; slot < SLOTS; ++slot) var += (values[slot] - mean) * (values[slot] - mean);
  const float scale = 1.0f / sqrtf(Lane::sum(var) / WIDTH + eps);
  UNROLL for (int slot = 0; slot < SLOTS; ++slot) {
    const float a = (values[slot] - mean) * scale * w[slot] + b[slot];
    values[slot] = a * Lane::sigmoid(a);
  }
  Lane::write(&y.data[size_t(row) * WIDTH], lane, values);
  if (lane == 0) {
    moments.data[2 * row] = mean;
    moments.data[2 * row + 1] = scale;
  }
"""

BACKWARD = """
  float weight_sum[SLOTS], bias_sum[SLOTS];
  UNROLL for (int slot = 0; slot < SLOTS; ++slot) weight_sum[slot] = bias_sum[slot] = 0.0f;
  const int rows = x.shape[0], lane = thread % LANES, group = thread / LANES;
  for (int row = group; row < rows; row += blocks * WARPS) {
    float normed[SLOTS], grad[SLOTS];
    Lane::read(&x.data[size_t(row) * WIDTH], lane, normed);
    Lane::read(&grad_y.data[size_t(row) * WIDTH], lane, grad);
    const float shift = moments.data[2 * row], scale = moments.data[2 * row + 1];
    float mean = 0.0f, along = 0.0f;
    UNROLL for (int slot = 0; slot < SLOTS; ++slot) {
      const int column = Lane::column(lane, slot);
      const float w = weight.data[column];
      normed[slot] = (normed[slot] - shift) * scale;
      const float a = normed[slot] * w + bias.data[column];
      const float gate = Lane::sigmoid(a);
      const float grad_a = grad[slot] * gate * (1.0f + a * (1.0f - gate));
      weight_sum[slot] += grad_a * normed[slot];
      bias_sum[slot] += grad_a;
      grad[slot] = grad_a * w;
      mean += grad[slot];
      along += grad[slot] * normed[slot];
    }
    mean = Lane::sum(mean) / WIDTH;
    along = Lane::sum(along) / WIDTH;
    UNROLL for (int slot = 0; slot < SLOTS; ++slot) grad[slot] = scale * (grad[slot] - mean - normed[slot] * along);
    Lane::write(&grad_x.data[size_t(row) * WIDTH], lane, grad);
  }
  if (sums.shape[0] == 0) return;  // they are not asked for
  float* total = &sums.data[size_t(group / WARPS) * 2 * WIDTH];
#ifdef __CUDA_ARCH__
  __shared__ float shared[2 * WIDTH];
  for (int warp = 0; warp < WARPS; ++warp) {  // one after the other, so that the sum has one order
    if (group % WARPS == warp) {
      UNROLL for (int slot = 0; slot < SLOTS; ++slot) {
        const int column = Lane::column(lane, slot);
        shared[column] = weight_sum[slot] + (warp == 0 ? 0.0f : shared[column]);
        shared[WIDTH + column] = bias_sum[slot] + (warp == 0 ? 0.0f : shared[WIDTH + column]);
      }
    }
    __syncthreads();
  }
  for (int i = threadIdx.x; i < 2 * WIDTH; i += blockDim.x) total[i] = shared[i];
#else
  Lane::write(total, lane, weight_sum);
  Lane::write(total + WIDTH, lane, bias_sum);
#endif
"""


class Layers(nn.Sequential):
    """Layers one after the other; on CUDA a layer norm and the SiLU that follows it are one kernel.

    The kernel takes float32 rows whose length is a multiple of 32, up to 1024. Torch computes others.
    """

    def forward(self, x: torch.Tensor) -> Any:
        """Returns what the last layer makes of ``x``, of shape ``(..., width)``."""
        layers = collections.deque(self)
        while layers:
            layer = layers.popleft()
            if layers and isinstance(layers[0], nn.SiLU) and isinstance(layer, nn.LayerNorm) and has_kernel(layer, x):
                layers.popleft()
                x = norm_silu(x, layer.weight, layer.bias, layer.eps)
            else:
                x = layer(x)
        return x


def has_kernel(norm: nn.LayerNorm, x: torch.Tensor) -> bool:
    """Returns whether the kernel computes a layer norm, and the SiLU that follows it, of rows ``(..., width)``."""
    width = x.shape[-1]
    fits = x.is_cuda and x.dtype == torch.float32 and width <= WIDEST and width % LANES == 0
    return fits and norm.normalized_shape == (width,) and norm.bias is not None


def norm_silu(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, eps: float) -> torch.Tensor:
    """Returns ``silu(layer_norm(x) * weight + bias)`` in the shape of ``x``. It has a first derivative only.

    Args:
        x: float32, shape ``(..., width)``; on CUDA the width is a multiple of 32, at most 1024.
        weight: shape ``(width,)``.
        bias: shape ``(width,)``.
        eps: what is added to the variance.
    """
    return _NormSiLU.apply(x, weight, bias, eps)


class _NormSiLU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, eps: float) -> torch.Tensor:
        rows, weight, bias = _aligned(x).view(-1, x.shape[-1]), _aligned(weight), _aligned(bias)
        y, moments = rows.new_empty(x.shape), rows.new_empty(2 * len(rows))
        kernel, outputs = _kernels(rows.shape[-1])["forward"], (y.view(rows.shape), moments)
        launch_on_tensors(kernel, lanes(rows) * len(rows), (rows, weight, bias, eps), outputs, BLOCK)
        ctx.save_for_backward(rows, weight, bias, moments)
        return y

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad_y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None, torch.Tensor | None, None]:
        rows, weight, bias, moments = ctx.saved_tensors
        grad_x, given = torch.empty_like(rows), _aligned(grad_y).view(rows.shape)
        threads = BLOCK if rows.is_cuda else 1
        blocks = min(BLOCKS, -(-len(rows) * lanes(rows) // threads))
        of_parameters = any(ctx.needs_input_grad[1:])
        sums = rows.new_empty(blocks if of_parameters else 0, 2 * rows.shape[-1])
        kernel, inputs = _kernels(rows.shape[-1])["backward"], (blocks, rows, weight, bias, moments, given)
        launch_on_tensors(kernel, threads * blocks, inputs, (grad_x, sums), BLOCK)
        grad_weight, grad_bias = sums.sum(0).chunk(2) if of_parameters else (None, None)
        return grad_x.view(grad_y.shape), grad_weight, grad_bias, None


def _aligned(x: torch.Tensor) -> torch.Tensor:
    """Returns a contiguous tensor at an address from which 16 bytes can be read at a time; a copy only if needed."""
    x = x.contiguous()
    return x if x.data_ptr() % 16 == 0 else x.clone()


def lanes(rows: torch.Tensor) -> int:
    """Returns how many threads share a row."""
    return LANES if rows.is_cuda else 1


@functools.cache
def _kernels(width: int) -> dict[str, wp.Kernel]:
    """Returns the kernels for rows of a width."""
    preamble = PREAMBLE % {"width": width, "warps": BLOCK // LANES}

    @wp.func_native(preamble + FORWARD)
    def forward_row(
        thread: int,
        x: wp.array2d[float],
        weight: wp.array[float],
        bias: wp.array[float],
        eps: float,
        y: wp.array2d[float],
        moments: wp.array[float],
    ): ...

    @wp.func_native(preamble + BACKWARD)
    def backward_rows(
        thread: int,
        blocks: int,
        x: wp.array2d[float],
        weight: wp.array[float],
        bias: wp.array[float],
        moments: wp.array[float],
        grad_y: wp.array2d[float],
        grad_x: wp.array2d[float],
        sums: wp.array2d[float],
    ): ...

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=BLOCK)
    def norm_silu_forward(
        # In:
        x_in: wp.array2d[float],
        weight_in: wp.array[float],
        bias_in: wp.array[float],
        eps: float,
        # Out:
        y_out: wp.array2d[float],
        moments_out: wp.array[float],
    ):
        forward_row(wp.tid(), x_in, weight_in, bias_in, eps, y_out, moments_out)

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=(BLOCK, 2))
    def norm_silu_backward(
        # In:
        blocks: int,
        x_in: wp.array2d[float],
        weight_in: wp.array[float],
        bias_in: wp.array[float],
        moments_in: wp.array[float],
        grad_y_in: wp.array2d[float],
        # Out:
        grad_x_out: wp.array2d[float],
        sums_out: wp.array2d[float],
    ):
        backward_rows(wp.tid(), blocks, x_in, weight_in, bias_in, moments_in, grad_y_in, grad_x_out, sums_out)

    return {"forward": norm_silu_forward, "backward": norm_silu_backward}
