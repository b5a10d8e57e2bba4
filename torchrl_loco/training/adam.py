"""Adam on clipped gradients in one kernel: parameters and moments lie in one vector each."""

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor, nn

from torchrl_loco.sim.compilation import compile_kernels
from torchrl_loco.sim.graph import EXCLUSIVE, current_stream
from torchrl_loco.sim.warp_init import init_warp
from torchrl_loco.training import distributed

ALIGNED = 16
"""Numbers at a multiple of which each parameter and each row of a matrix begins: products of matrices in bfloat16 read
16 bytes at a time, in Triton only where the stride of rows is a multiple of 16 numbers."""

SMALL, LARGE = 64, 256
"""Threads of a block: few in kernels with a thread for each step or world, so that all multiprocessors get blocks."""


def aligned(count: int) -> int:
    """Returns ``count`` rounded up to a multiple of ``ALIGNED``."""
    return count + -count % ALIGNED


class FlatAdam:
    """Adam (Kingma and Ba, 2015) that clips the gradients of all parameters together, on one vector for each group.

    It moves the parameters into the vectors, of which they are views then. torch's kernels of several tensors give a
    block of threads 65,536 numbers, so that networks of a few hundred thousand parameters leave most multiprocessors
    idle. States are those of ``torch.optim.Adam``.

    Args:
        parameters: parameters, or groups of them with settings of their own.
        lr: the learning rate, a tensor, which recorded steps follow.
        eps: what is added to the root of the second moment.
        betas: decay of the moments.

    Raises:
        ValueError: a group has another setting.
        TypeError: parameters are not in single precision.

    Attributes:
        param_groups: the groups, each a dict of ``params`` and its settings.
    """

    def __init__(
        self, parameters: Iterable[Any], lr: Tensor, eps: float = 1e-8, betas: tuple[float, float] = (0.9, 0.999)
    ) -> None:
        given = list(parameters)
        for group in given:
            if isinstance(group, dict) and (unknown := group.keys() - {"params", "lr", "eps", "betas"}):
                raise ValueError(f"a group of parameters has no setting {min(unknown)!r}: choose of lr, eps, betas")
        groups = given if given and isinstance(given[0], dict) else [{"params": given}]
        settings: dict[str, Any] = {"lr": lr, "eps": eps, "betas": betas}
        self.param_groups = [{**settings, **group, "params": list(group["params"])} for group in groups]
        self._vectors = [Vectors(group["params"], group["betas"]) for group in self.param_groups]

    def wide(self, dtype: torch.dtype) -> dict[nn.Parameter, Tensor]:
        """Returns all parameters in another type, each row with zeros up to a multiple of ``ALIGNED``.

        Gradients flow from them into the vectors at once, instead of parameter by parameter; none into those that do
        not require them.
        """
        self.adopt()
        return {part: view for vectors in self._vectors for part, view in vectors.wide(dtype)}

    def parts(self, count: int) -> Tensor:
        """Returns memory of shape ``(count, n)`` for parts of the gradient of the first group's vector, of length n.

        Whoever asks for it writes the same places each time. The next step adds the sum of the parts to what autograd
        gives, unless the gradients are forgotten before.
        """
        return self._vectors[0].in_parts(count)

    def compile_with(self, kernels: Iterable[tuple[wp.Kernel, int]]) -> None:
        """Compiles its kernel and others, each with the threads of a block, at once."""
        out = self._vectors[0].whole
        launches = [  # which do not look at what they are given
            functools.partial(launch, kernel, 1, [0] * (len(kernel.adj.args) - 1), [out], block_dim)
            for kernel, block_dim in ((step_of_adam, LARGE), *kernels)
        ]
        init_warp()
        compile_kernels(launches, wp.device_from_torch(out.device))

    def adopt(self) -> None:
        """Takes parameters back that were moved out of the vectors, as by ``module.to`` or a second optimizer."""
        for vectors in self._vectors:
            vectors.adopt()

    def zero_grad(self) -> None:
        """Forgets the gradients."""
        for vectors in self._vectors:
            vectors.forget_gradients()

    @torch.no_grad()
    def clipped_step(self, max_norm: float) -> Tensor:
        """Averages the gradients over the ranks, clips them to a norm and makes a step; returns the norm before."""
        gradients = [vectors.gradient() for vectors in self._vectors]
        distributed.average(gradients)
        norms = [gradient.norm() for gradient in gradients]
        norm = norms[0] if len(norms) == 1 else torch.stack(norms).norm()
        for group, vectors, gradient in zip(self.param_groups, self._vectors, gradients, strict=True):
            vectors.count()
            tensors = gradient, norm.view(1), group["lr"].view(1), vectors.counts
            settings = [max_norm, *group["betas"], group["eps"]]
            launch(step_of_adam, len(gradient), [*tensors, *settings], [vectors.whole, *vectors.moments], LARGE)
        return norm

    def state_dict(self) -> dict[str, Any]:
        """Returns moments and steps by the number of the parameter, and settings by group, as they are."""
        states = [state for vectors in self._vectors for state in vectors.states()]
        numbers = iter(range(len(states)))
        groups = [{**group, "params": [next(numbers) for _ in group["params"]]} for group in self.param_groups]
        return {"state": dict(enumerate(states)), "param_groups": groups}

    @torch.no_grad()
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues from a state, which is copied, in place; moments that it lacks begin at zero."""
        states = state_dict["state"]
        for number, state in self.state_dict()["state"].items():
            loaded = states.get(number, {})
            for name in ("exp_avg", "exp_avg_sq"):
                moments = loaded.get(name, torch.zeros_like(state[name]))
                if moments.shape != state[name].shape:
                    raise ValueError(f"a state of {tuple(moments.shape)} for a parameter of {tuple(state[name].shape)}")
                state[name].copy_(moments)
        step = max((float(loaded["step"]) for loaded in states.values() if "step" in loaded), default=0.0)
        for vectors in self._vectors:
            vectors.restart(step)
        for group, loaded in zip(self.param_groups, state_dict["param_groups"], strict=True):
            group["lr"].copy_(torch.as_tensor(loaded["lr"]))


class Vectors:
    """Parameters one after the other, which become views, and what Adam keeps of them, as vectors of one length."""

    def __init__(self, parameters: Sequence[nn.Parameter], betas: tuple[float, float]) -> None:
        if others := {str(part.dtype) for part in parameters} - {"torch.float32"}:
            raise TypeError(f"the parameters of networks must be torch.float32, not {', '.join(sorted(others))}")
        self._parts = parameters
        rows = [(part.shape[:-1].numel(), part.shape[-1]) if part.ndim else (1, 1) for part in parameters]
        self._wide_rows = [(count, aligned(size)) for count, size in rows]
        # Of a matrix and its gaps, or of a row and the gap behind it.
        sizes = [
            (count * wide, 0) if part.ndim > 1 else (size, wide - size)
            for part, (_, size), (count, wide) in zip(parameters, rows, self._wide_rows, strict=True)
        ]
        self._sizes = [size for pair in sizes for size in pair]
        self.whole = nn.Parameter(parameters[0].new_zeros(sum(self._sizes)))
        self.moments = torch.zeros_like(self.whole.detach()), torch.zeros_like(self.whole.detach())
        # The steps, and the betas to their power; what each is multiplied with at a step, and what is added.
        doubles: dict[str, Any] = {"dtype": torch.float64, "device": self.whole.device}
        self.counts = torch.tensor([0.0, 1.0, 1.0], **doubles)
        self._factors, self._summands = (torch.tensor(x, **doubles) for x in ([1.0, *betas], [1.0, 0.0, 0.0]))
        self._addresses: list[int] = []
        self._in_parts: Tensor | None = None
        self._has_parts = False  # since the gradients were forgotten
        self.adopt()

    @torch.no_grad()
    def adopt(self) -> None:
        """Makes parameters views, with the values that they have, where they are not."""
        if [part.data_ptr() for part in self._parts] == self._addresses:
            return
        views = self._views(self.whole)
        moved = [
            (part, view) for part, view in zip(self._parts, views, strict=True) if part.data_ptr() != view.data_ptr()
        ]
        if moved and self.whole.is_cuda and torch.cuda.is_current_stream_capturing():
            raise RuntimeError("parameters were moved while a step is recorded: move them before the training")
        for part, view in moved:
            part.data = view.copy_(part)
        self._addresses = [view.data_ptr() for view in views]

    def count(self) -> None:
        """Counts a step."""
        torch.addcmul(self._summands, self.counts, self._factors, out=self.counts)

    def restart(self, step: float) -> None:
        """Goes on after so many steps."""
        self.counts.copy_(torch.cat([self.counts.new_tensor([step]), self._factors[1:] ** step]))

    def _wide_views(self, vector: Tensor) -> list[Tensor]:
        """Returns the parts of a vector in the shapes of the parameters, but for the rows of matrices with gaps."""
        pieces = zip(self._parts, vector.split(self._sizes)[::2], self._wide_rows, strict=True)
        return [
            piece.view(*part.shape[:-1], wide) if part.ndim > 1 else piece.view(part.shape)
            for part, piece, (_, wide) in pieces
        ]

    def _views(self, vector: Tensor) -> list[Tensor]:
        """Returns the parts of a vector in the shapes of the parameters."""
        views = zip(self._parts, self._wide_views(vector), strict=True)
        return [view[..., : part.shape[-1]] if part.ndim > 1 else view for part, view in views]

    def wide(self, dtype: torch.dtype) -> Iterator[tuple[nn.Parameter, Tensor]]:
        """Yields each parameter with itself in another type, with rows as long as they lie in the vector."""
        for part, view in zip(self._parts, self._wide_views(self.whole.to(dtype)), strict=True):
            yield part, view if part.requires_grad else view.detach()

    def gradient(self) -> Tensor:
        """Returns the gradient, zero where there is none: that of the vector, and the parameters' own beside it."""
        given = [] if self.whole.grad is None else [self.whole.grad]
        if self._has_parts:
            given.append(torch.empty_like(self.whole))
            launch(sum_of_parts, len(self.whole), [self._in_parts], given[-1:], LARGE)
        gradient = functools.reduce(torch.add, given) if given else torch.zeros_like(self.whole)
        own = [(part.grad, view) for part, view in zip(self._parts, self._views(gradient), strict=True)]
        found = [(of_part, view) for of_part, view in own if of_part is not None]
        if found:
            torch._foreach_add_([view for _, view in found], [of_part for of_part, _ in found])
        return gradient

    def in_parts(self, count: int) -> Tensor:
        """Returns memory for parts of the gradient, of which it takes the sum."""
        if self._in_parts is None:
            self._in_parts = self.whole.new_zeros(count, len(self.whole), requires_grad=True)
        self._has_parts = True
        return self._in_parts

    def forget_gradients(self) -> None:
        """Forgets them."""
        self._has_parts = False
        for part in (self.whole, *self._parts):
            part.grad = None

    def states(self) -> Iterator[dict[str, Tensor]]:
        """Yields what Adam keeps of each parameter, as views."""
        for moments in zip(*map(self._views, self.moments), strict=True):
            yield dict(zip(("step", "exp_avg", "exp_avg_sq"), (self.counts[0], *moments), strict=True))


@wp.kernel(enable_backward=False)
def sum_of_parts(parts: wp.array2d[float], out: wp.array[float]):
    i = wp.tid()
    total = float(0.0)
    for part in range(parts.shape[0]):
        total += parts[part, i]
    out[i] = total


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


def launch(
    kernel: wp.Kernel,
    dim: int | tuple[int, ...],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    block_dim: int = SMALL,
) -> None:
    """Launches a kernel of ``dim`` threads on torch's current stream, or adds it to what torch records.

    It reads ``inputs``, numbers and tensors on one device, and writes the tensors ``outputs``.
    """
    init_warp()
    device = wp.device_from_torch(outputs[0].device)
    arrays = [[wp.from_torch(x.detach()) if isinstance(x, torch.Tensor) else x for x in xs] for xs in (inputs, outputs)]
    with EXCLUSIVE, wp.ScopedStream(current_stream(device), sync_enter=False):
        wp.launch(kernel, dim, *arrays, device=device, block_dim=block_dim)
