"""Networks as functions of rows, with other weights than their own: in another type, or longer by zeros.

And the normalised rows that they read.
"""

import contextlib
import functools
import importlib
import itertools
import logging
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any

import torch
import warp as wp
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.functional import pad

from torchrl_loco.encoder import PixelEncoder
from torchrl_loco.policy import ObservationNorm, layers_of
from torchrl_loco.training.adam import LARGE, aligned, launch

HEIGHT = 8  # rows of which a thread normalises a number


class Rows:
    """A network as a function of rows that are longer than it reads, by zeros, with other weights than its own.

    Args:
        network: layers one after the other; any other, as a critic may be, computes as a whole.
        first: how many numbers it reads, or an encoder of pixels, which is part of the function then.
        dtype: the type of rows and weights.

    Attributes:
        in_triton: whether kernels of Triton compute all of it (``mlp.py``).
    """

    def __init__(self, network: nn.Module, first: PixelEncoder | int, dtype: torch.dtype) -> None:
        self._encoder = first if isinstance(first, PixelEncoder) else None
        self._inputs = inputs = first if isinstance(first, int) else first.features
        self._layers = [network]
        with contextlib.suppress(TypeError):
            layers = layers_of(network)
            rows = torch.linspace(-1.0, 1.0, 4 * inputs, device=next(network.parameters()).device).view(4, inputs)
            with torch.no_grad():  # a Sequential may have a forward of its own
                found, expected = nn.Sequential(*layers)(rows.clone()), network(rows.clone())
            self._layers = layers if torch.allclose(found, expected, rtol=1e-4, atol=1e-5) else self._layers
        self._parameters = list(network.parameters())
        fits = dtype == torch.bfloat16 and not self._encoder and are_linear_and_silu(self._layers, self._parameters)
        normed, device = set(normed_silus(self._layers)), self._parameters[0].device
        self.in_triton = fits and triton_works(device)
        self._normed = normed if normed and triton_works(device) else set()

    def own(self, weights: Mapping[nn.Parameter, Tensor]) -> list[Tensor]:
        """Returns its own of the weights; rows of those after the first are as short as what they multiply."""
        first, *others = (weights[part].detach() for part in self._parameters)
        pairs = zip(others, self._parameters[1:], strict=True)
        return [first, *(whole[..., : part.shape[-1]] for whole, part in pairs)]

    def __call__(
        self,
        rows: Tensor,
        weights: Mapping[nn.Parameter, Tensor],
        parts: Callable[[int], Tensor] | None = None,
    ) -> Tensor:
        """Returns what it gives, ``(..., outputs)``, with ``weights`` for its own, whose rows may be longer as well.

        The network itself sees rows one after the other, whatever dimensions they have here: a layer may look at these.
        Kernels of Triton write slopes by the weights into so many ``parts`` of the gradient as they ask for; without
        parts they compute only where there are no gradients.
        """
        of_row = 3 if self._encoder else 1
        flat = rows.reshape(-1, *rows.shape[-of_row:])
        return self._computed(flat, weights, parts).view(*rows.shape[:-of_row], -1)

    def _computed(
        self, rows: Tensor, weights: Mapping[nn.Parameter, Tensor], parts: Callable[[int], Tensor] | None
    ) -> Tensor:
        learns = torch.is_grad_enabled() if parts is None else not all(part.requires_grad for part in self._parameters)
        if self.in_triton and not learns:
            mlp = triton_kernels("mlp")
            if len(rows) * max(rows.stride(0), *map(len, self._parameters)) < mlp.MOST:
                into = None if parts is None else parts(mlp.PARTS)
                return mlp.SiluNetwork.apply(rows, into, *self.own(weights))
        if self._encoder:
            own = {name: weights[part][..., : part.shape[-1]] for name, part in self._encoder.named_parameters()}
            rows = functional_call(self._encoder, own, (rows,)).to(next(iter(own.values())).dtype)
        left = None  # of a linear layer, the bias that the norm behind it adds
        for index, layer in enumerate(self._layers):
            if index - 1 in self._normed:
                continue
            reads_long = index == 0 and isinstance(layer, nn.Linear) and not self._encoder
            if index == 0 and not reads_long:
                rows = rows[..., : self._inputs]
                rows = rows if isinstance(layer, nn.LayerNorm) else rows.clone()  # an activation may write in place
            own = {
                name: whole if reads_long or whole.shape == part.shape else whole[..., : part.shape[-1]]
                for name, part in layer.named_parameters()
                for whole in (weights[part],)
            }
            if index in self._normed:
                rows, left = triton_kernels("normed").NormedSilu.apply(rows, left, *own.values(), layer.eps), None
            elif isinstance(layer, nn.Linear):
                left = own.pop("bias", None) if index + 1 in self._normed else None
                rows, outputs = Affine.apply(rows, own["weight"], own.get("bias")), len(own["weight"])
                rows = rows if rows.shape[-1] == outputs else rows[..., :outputs]  # backward, a slice is copied
            else:
                rows = functional_call(layer, own, (rows,))
        return rows


class Affine(torch.autograd.Function):
    """A linear layer whose bias gets its gradient from a product of matrices: torch's sums take three times as long.

    On CUDA it computes a multiple of ``ALIGNED`` outputs; those beyond its own are zero.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        """Returns what the layer gives of rows ``(n, inputs)``, shape ``(n, outputs)``."""
        ctx.outputs, more = len(weight), aligned(len(weight)) - len(weight) if rows.is_cuda else 0
        if more:
            weight, bias = pad(weight, (0, 0, 0, more)), None if bias is None else pad(bias, (0, more))
        ctx.save_for_backward(rows, weight)
        return nn.functional.linear(rows, weight, bias)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """Returns the slopes by rows, weight and bias."""
        (rows, weight), (by_rows, by_weight, by_bias) = ctx.saved_tensors, ctx.needs_input_grad
        of_weight = (slope.mT @ rows)[: ctx.outputs] if by_weight else None
        of_bias = (slope.new_ones(1, len(slope)) @ slope)[0, : ctx.outputs] if by_bias else None
        return slope @ weight if by_rows else None, of_weight, of_bias


# In C++, as Warp computes the address of each number from strides anew, and of indices that may be negative.
NORMALISE = f"""
const int HEIGHT = {HEIGHT}, width = rows.shape[1], wide = out.shape[1];
const int first = group * HEIGHT, last = wp::min(HEIGHT, rows.shape[0] - first) - 1, read = wp::min(column, width - 1);
const float* from = rows.data + size_t(first) * width + read;
auto* to = out.data + size_t(first) * wide + column;
float own[HEIGHT];  // whose reads are all on their way before the first write
for (int i = 0; i < HEIGHT; ++i, from += i <= last ? width : 0) own[i] = *from;
const float center = mean.data[read], spread = wp::sqrt(var.data[read] + 1e-6f);
for (int i = 0; i < HEIGHT; ++i, to += wide) {{
  float value = (own[i] - center) / spread;
  if (value == value) value = wp::clamp(value, -limit, limit);  // what is not a number is to be seen
  if (i <= last) *to = column < width ? value : 0.0f;
}}
"""


# A kernel is of one type of numbers, in a module of its own: one that is added to a module unloads what graphs replay.
@functools.cache
def normalise_of(dtype: torch.dtype) -> wp.Kernel:
    """Returns the kernel that writes normalised rows; all arrays are contiguous."""
    Wide: Any = wp.array2d(dtype=wp.dtype_from_torch(dtype))  # noqa: N806

    @wp.func_native(NORMALISE)
    def write(
        rows: wp.array2d[float],
        mean: wp.array[float],
        var: wp.array[float],
        limit: float,
        out: Wide,
        group: int,
        column: int,
    ): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False)
    def normalise(rows: wp.array2d[float], mean: wp.array[float], var: wp.array[float], limit: float, out: Wide):
        group, column = wp.tid()
        write(rows, mean, var, limit, out, group, column)

    return normalise


@torch.no_grad()
def normalised(rows: Tensor, norm: ObservationNorm, dtype: torch.dtype) -> Tensor:
    """Returns what ``norm`` makes of rows of shape ``(..., n)``, with zeros up to a multiple of ``ALIGNED``."""
    norm.check(rows)
    wide = rows.new_empty(*rows.shape[:-1], aligned(rows.shape[-1]), dtype=dtype)
    flat, out = rows.reshape(-1, rows.shape[-1]).contiguous(), wide.view(-1, wide.shape[-1])
    dim = -(-len(out) // HEIGHT), out.shape[1]
    launch(normalise_of(dtype), dim, [flat, norm.mean, norm.var, norm.limit], [out], LARGE)
    return wide


def are_linear_and_silu(layers: Sequence[nn.Module], parameters: Sequence[nn.Parameter]) -> bool:
    """Returns whether layers are linear ones with SiLU between them, each with a weight and a bias of its own."""
    kinds = [nn.Linear, nn.SiLU] * (len(layers) // 2) + [nn.Linear]
    return list(map(type, layers)) == kinds and len(parameters) == len(kinds) + 1


def normed_silus(layers: Sequence[nn.Module]) -> Iterator[int]:
    """Yields the numbers of the layer norms of rows, with a weight and a bias, after which SiLU follows."""
    for index, (layer, after) in enumerate(itertools.pairwise(layers)):
        if type(layer) is nn.LayerNorm and type(after) is nn.SiLU and len(layer.normalized_shape) == 1:
            if layer.weight is not None and layer.bias is not None:
                yield index


def triton_kernels(name: str) -> ModuleType:
    """Returns a module of kernels, ``mlp``, ``normed`` or ``reppo_kernels``, which imports Triton."""
    return importlib.import_module(f"torchrl_loco.training.{name}")


@functools.cache
def triton_works(device: torch.device) -> bool:
    """Returns whether Triton can compile kernels for a device. A warning says why it cannot for a GPU.

    Triton comes with torch for Linux, and needs a compiler of C. GPUs before compute capability 8.0, without tensor
    cores for bfloat16, keep torch's kernels.
    """
    if device.type != "cuda" or torch.cuda.get_device_capability(device) < (8, 0):
        return False
    try:
        importlib.import_module("triton").runtime.driver.active.get_current_target()  # which compiles C
    except Exception as error:
        logging.getLogger("torchrl_loco").warning(
            "starts and updates take longer: Triton, which needs Linux and gcc or clang, cannot make kernels here (%s)",
            error,
        )
        return False
    return True


def start_triton(device: torch.device) -> bool:
    """Returns whether Triton works, and lets a thread hash Triton's own files if it does.

    Triton names the kernels of its cache by that hash, which takes half a second.
    """
    works = triton_works(device)
    if works and (key := getattr(importlib.import_module("triton").runtime.cache, "triton_key", None)):
        threading.Thread(target=key, daemon=True).start()
    return works
