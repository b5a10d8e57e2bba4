"""Networks as functions of rows, with other weights than their own: in another type, or longer by zeros."""

import contextlib
import functools
import importlib
import logging
from collections.abc import Callable, Mapping, Sequence
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from torchrl_loco.encoder import PixelEncoder
from torchrl_loco.policy import layers_of


class Rows:
    """A network as a function of rows that are longer than it reads, by zeros, with other weights than its own.

    Args:
        network: layers one after the other; any other, as a critic may be, computes as a whole.
        first: what gives the network its rows: a norm, which has been applied, or an encoder of pixels, which is part
            of the function then.
        dtype: the type of rows and weights.

    Attributes:
        in_triton: whether kernels of Triton compute it (``mlp.py``).
    """

    def __init__(self, network: nn.Module, first: nn.Module, dtype: torch.dtype) -> None:
        self._encoder = first if isinstance(first, PixelEncoder) else None
        self._inputs = inputs = self._encoder.features if self._encoder else len(first.mean)  # type: ignore[arg-type]
        self._layers = [network]
        with contextlib.suppress(TypeError):
            layers = layers_of(network)
            rows = torch.linspace(-1.0, 1.0, 4 * inputs, device=next(network.parameters()).device).view(4, inputs)
            with torch.no_grad():  # a Sequential may have a forward of its own
                found, expected = nn.Sequential(*layers)(rows.clone()), network(rows.clone())
            self._layers = layers if torch.allclose(found, expected, rtol=1e-4, atol=1e-5) else self._layers
        self._parameters = list(network.parameters())
        fits = dtype == torch.bfloat16 and not self._encoder and are_linear_and_silu(self._layers, self._parameters)
        self.in_triton = fits and triton_works(self._parameters[0].device)

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

        Kernels of Triton write slopes by the weights into so many ``parts`` of the gradient as they ask for.
        """
        if self.in_triton and (parts is None or all(part.requires_grad for part in self._parameters)):
            mlp, flat = triton_kernels(), rows.reshape(-1, rows.shape[-1])
            if len(flat) * max(flat.stride(0), *map(len, self._parameters)) < mlp.MOST:
                into = None if parts is None else parts(mlp.PARTS)
                return mlp.SiluNetwork.apply(flat, into, *self.own(weights)).view(*rows.shape[:-1], -1)
        if self._encoder:
            own = {name: weights[part][..., : part.shape[-1]] for name, part in self._encoder.named_parameters()}
            rows = functional_call(self._encoder, own, (rows,)).to(next(iter(own.values())).dtype)
        for index, layer in enumerate(self._layers):
            reads_long = index == 0 and isinstance(layer, nn.Linear) and not self._encoder
            if index == 0 and not reads_long:
                rows = rows[..., : self._inputs].clone()  # an activation may write in place
            own = {
                name: whole if reads_long or whole.shape == part.shape else whole[..., : part.shape[-1]]
                for name, part in layer.named_parameters()
                for whole in (weights[part],)
            }
            if isinstance(layer, nn.Linear):
                rows = Affine.apply(rows, own["weight"], own.get("bias"))
            else:
                rows = functional_call(layer, own, (rows,))
        return rows


class Affine(torch.autograd.Function):
    """A linear layer whose bias gets its gradient from a product of matrices: torch's sums take three times as long."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        """Returns what the layer gives, shape ``(..., outputs)``."""
        ctx.save_for_backward(rows, weight)
        return nn.functional.linear(rows, weight, bias)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """Returns the slopes by rows, weight and bias."""
        (rows, weight), (by_rows, by_weight, by_bias) = ctx.saved_tensors, ctx.needs_input_grad
        of_bias = (slope.new_ones(1, len(slope)) @ slope)[0] if by_bias else None
        return slope @ weight if by_rows else None, slope.mT @ rows if by_weight else None, of_bias


def are_linear_and_silu(layers: Sequence[nn.Module], parameters: Sequence[nn.Parameter]) -> bool:
    """Returns whether layers are linear ones with SiLU between them, each with a weight and a bias of its own."""
    kinds = [nn.Linear, nn.SiLU] * (len(layers) // 2) + [nn.Linear]
    return list(map(type, layers)) == kinds and len(parameters) == len(kinds) + 1


def triton_kernels() -> ModuleType:
    """Returns the module of the kernels, which imports Triton."""
    return importlib.import_module("torchrl_loco.training.mlp")


@functools.cache
def triton_works(device: torch.device) -> bool:
    """Returns whether Triton can compile kernels for a GPU; a warning says why it cannot.

    Triton comes with torch for Linux, and needs a compiler of C. GPUs before compute capability 8.0, without tensor
    cores for bfloat16, keep torch's kernels.
    """
    if torch.cuda.get_device_capability(device) < (8, 0):
        return False
    try:
        importlib.import_module("triton").runtime.driver.active.get_current_target()  # which compiles C
    except Exception as error:
        logging.getLogger("torchrl_loco").warning(
            "updates take a third longer: Triton, which needs Linux and gcc or clang, cannot make kernels here (%s)",
            error,
        )
        return False
    return True
