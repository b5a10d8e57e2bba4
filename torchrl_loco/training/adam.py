"""Adam on clipped gradients as few kernels of torch.compile."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from torchrl_loco.training.compiling import compiled

SETTINGS = "lr", "betas", "eps", "weight_decay", "maximize"
"""Of a group of parameters, which a step follows."""


class CompiledAdam(torch.optim.Adam):
    """Adam whose step clips the gradients of all parameters together, both compiled.

    torch's own kernels of several tensors give a block of threads 65,536 numbers: networks of a few hundred thousand
    parameters leave most multiprocessors idle.

    Args:
        parameters: parameters, or groups of them, on CUDA.
        lr: the learning rate, a tensor.
        eps: what is added to the root of the second moment.
    """

    def __init__(self, parameters: Iterable[Any], lr: Tensor, eps: float) -> None:
        super().__init__(parameters, lr=lr, eps=eps, capturable=True, fused=True)
        self._clipped_step = compiled(clipped_step, "a step of Adam")

    @torch.no_grad()
    def clipped_step(self, max_norm: float) -> Tensor:
        """Clips the gradients to a norm, and makes a step.

        Returns:
            The norm before, a scalar.
        """
        groups = [[p for p in group["params"] if p.grad is not None] for group in self.param_groups]
        trained = [parameter for group in groups for parameter in group]
        if any(parameter not in self.state for parameter in trained):  # the first step makes the moments
            norm = nn.utils.clip_grad_norm_(trained, max_norm)
            self.step()
            return norm
        gradients = [[parameter.grad for parameter in group] for group in groups]
        names = "exp_avg", "exp_avg_sq", "step"
        moments = [[[self.state[parameter][name] for parameter in group] for name in names] for group in groups]
        settings = [{name: group[name] for name in SETTINGS} for group in self.param_groups]
        return self._clipped_step(groups, gradients, moments, settings, max_norm)


def clipped_step(
    parameters: Sequence[list[Tensor]],
    gradients: Sequence[Sequence[Tensor]],
    moments: Sequence[Sequence[list[Tensor]]],
    settings: Sequence[dict[str, Any]],
    max_norm: float,
) -> Tensor:
    """Makes a step of Adam on gradients that are clipped to a norm, in place.

    Args:
        parameters: those of each group, of any shape.
        gradients: theirs.
        moments: of each group the first and second moments, and the numbers of steps.
        settings: of each group the :data:`SETTINGS`.
        max_norm: of all gradients together.

    Returns:
        The norm before, a scalar.
    """
    norm = torch.cat([gradient.flatten() for group in gradients for gradient in group]).norm()
    factor = (max_norm / (norm + 1e-6)).clamp(max=1.0)  # that of clip_grad_norm_
    for group, slopes, (first, second, steps), own in zip(parameters, gradients, moments, settings, strict=True):
        clipped, (beta1, beta2) = [slope * factor for slope in slopes], own["betas"]
        numbers = {name: own[name] for name in SETTINGS if name != "betas"}
        kind: dict[str, Any] = {"foreach": True, "capturable": True, "amsgrad": False}
        adam(group, clipped, first, second, [], steps, **kind, **numbers, beta1=beta1, beta2=beta2)
    return norm
