"""Adam on clipped gradients in few kernels: parameters and moments lie in one vector each."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from torchrl_loco.training.compiling import compiled

SETTINGS = "lr", "betas", "eps", "weight_decay", "maximize"
"""Of a group of parameters, which a step follows."""

ALIGNED = 4
"""Numbers at a multiple of which each parameter begins: matrix products read 16 bytes at a time."""


class CompiledAdam(torch.optim.Adam):
    """Adam whose step clips the gradients of all parameters together, compiled.

    It moves the parameters into one vector for each group, of which they are views then. torch's own kernels of several
    tensors give a block of threads 65,536 numbers, so that networks of a few hundred thousand parameters leave most
    multiprocessors idle; a kernel that is compiled for each of many tensors takes seconds to compile.

    Args:
        parameters: parameters, or groups of them.
        lr: the learning rate, a tensor.
        eps: what is added to the root of the second moment.
    """

    def __init__(self, parameters: Iterable[Any], lr: Tensor, eps: float) -> None:
        super().__init__(parameters, lr=lr, eps=eps, capturable=True, fused=True)
        self._clipped_step = compiled(clipped_step, "a step of Adam")
        self._vectors = [
            (index, vectors) for index, group in enumerate(self.param_groups) for vectors in of_group(group)
        ]
        for _, vectors in self._vectors:
            for parameter, state in vectors.states():
                self.state[parameter] = state

    @torch.no_grad()
    def clipped_step(self, max_norm: float) -> Tensor:
        """Clips the gradients to a norm, and makes a step.

        Returns:
            The norm before, a scalar.
        """
        vectors = [(v.parameters, v.gradients(), v.first, v.second, v.steps) for _, v in self._vectors]
        settings = [{name: self.param_groups[index][name] for name in SETTINGS} for index, _ in self._vectors]
        return self._clipped_step(vectors, settings, max_norm)

    @torch.no_grad()
    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues from a state, whose moments are copied; those that it lacks begin at zero."""
        own = dict(self.state)
        super().load_state_dict(state_dict)
        for parameter, state in own.items():
            loaded = self.state.get(parameter, {})
            for name, value in state.items():
                value.copy_(loaded[name]) if name in loaded else value.zero_()
            self.state[parameter] = state


class Vectors:
    """Parameters of one type, one after the other, and what Adam keeps of them, as vectors of one length.

    Args:
        parameters: the parameters, which become views.
    """

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self._parts = parameters
        self._gaps = [part.new_zeros(-part.numel() % ALIGNED) for part in parameters]
        self.parameters = torch.cat(self._with_gaps([part.detach() for part in parameters]))
        self.first, self.second = torch.zeros_like(self.parameters), torch.zeros_like(self.parameters)
        self.steps = torch.zeros((), device=self.parameters.device)
        for part, view in zip(parameters, self._views_of(self.parameters), strict=True):
            part.data = view

    def _with_gaps(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        pairs = zip(tensors, self._gaps, strict=True)
        return [piece for tensor, gap in pairs for piece in (tensor.flatten(), gap)]

    def _views_of(self, vector: Tensor) -> list[Tensor]:
        pieces = vector.split([len(piece) for piece in self._with_gaps(self._parts)])[::2]
        return [piece.view(part.shape) for part, piece in zip(self._parts, pieces, strict=True)]

    def gradients(self) -> Tensor:
        """Returns the gradients as a new vector, zero where there is none."""
        found = [torch.zeros_like(part) if part.grad is None else part.grad for part in self._parts]
        return torch.cat(self._with_gaps(found))

    def states(self) -> Iterator[tuple[nn.Parameter, dict[str, Tensor]]]:
        """Yields each parameter with what torch's Adam keeps of it, as views."""
        views = zip(self._parts, self._views_of(self.first), self._views_of(self.second), strict=True)
        for part, first, second in views:
            yield part, {"step": self.steps, "exp_avg": first, "exp_avg_sq": second}


def of_group(group: dict[str, Any]) -> list[Vectors]:
    """Returns the vectors of a group's parameters, one for each of their types."""
    types = dict.fromkeys(parameter.dtype for parameter in group["params"])
    return [Vectors([parameter for parameter in group["params"] if parameter.dtype == kind]) for kind in types]


def clipped_step(
    vectors: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]],
    settings: Sequence[dict[str, Any]],
    max_norm: float,
) -> Tensor:
    """Makes a step of Adam on gradients that are clipped to a norm, in place.

    Args:
        vectors: of each group the parameters, gradients, first and second moments, and the number of steps.
        settings: of each the :data:`SETTINGS`.
        max_norm: of all gradients together.

    Returns:
        The norm before, a scalar.
    """
    norm = torch.stack([gradient.norm() for _, gradient, *_ in vectors]).norm()
    factor = (max_norm / (norm + 1e-6)).clamp(max=1.0)  # that of clip_grad_norm_
    for (parameters, gradients, first, second, steps), own in zip(vectors, settings, strict=True):
        numbers, (beta1, beta2) = {name: own[name] for name in SETTINGS if name != "betas"}, own["betas"]
        kind: dict[str, Any] = {"foreach": False, "capturable": True, "amsgrad": False}
        adam(
            [parameters],
            [gradients * factor],
            [first],
            [second],
            [],
            [steps],
            **kind,
            **numbers,
            beta1=beta1,
            beta2=beta2,
        )
    return norm
