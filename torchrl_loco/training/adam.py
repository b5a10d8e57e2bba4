"""Adam on clipped gradients as few kernels of torch.compile."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim.adam import adam


class CompiledAdam(torch.optim.Adam):
    """Adam whose step clips the gradients of all parameters together, both compiled.

    torch's own kernels of several tensors give a block of threads 65,536 numbers: networks of a few hundred thousand
    parameters leave most multiprocessors idle.

    Args:
        parameters: parameters, or groups of them, on CUDA.
        settings: those of ``torch.optim.Adam``.
    """

    def __init__(self, parameters: Iterable[Any], **settings: Any) -> None:
        super().__init__(parameters, **settings, capturable=True, fused=True)
        self._clipped_step = torch.compile(clipped_step, fullgraph=True, dynamic=False)

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
        settings = [{name: group[name] for name in ("lr", "betas", "eps")} for group in self.param_groups]
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
        settings: of each group ``lr``, ``betas`` and ``eps``.
        max_norm: of all gradients together.

    Returns:
        The norm before, a scalar.
    """
    norm = torch.cat([gradient.flatten() for group in gradients for gradient in group]).norm()
    factor = (max_norm / (norm + 1e-6)).clamp(max=1.0)  # that of clip_grad_norm_
    for group, slopes, (first, second, steps), own in zip(parameters, gradients, moments, settings, strict=True):
        clipped, (beta1, beta2) = [slope * factor for slope in slopes], own["betas"]
        kind: dict[str, Any] = {"foreach": True, "capturable": True, "amsgrad": False, "maximize": False}
        numbers = {"lr": own["lr"], "beta1": beta1, "beta2": beta2, "eps": own["eps"], "weight_decay": 0.0}
        adam(group, clipped, first, second, [], steps, **kind, **numbers)
    return norm
