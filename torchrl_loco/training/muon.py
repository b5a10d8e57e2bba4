"""Muon (Jordan et al., 2024): momentum whose matrices are made orthogonal, with a learning rate that graphs follow."""

from collections.abc import Iterable
from typing import Any

import torch

COEFFICIENTS = (3.4445, -4.775, 2.0315)  # of the polynomial that brings singular values near 1 (Jordan et al., 2024)
STEPS = 5  # how often it is applied
RMS = 0.2  # root mean square of a step's entries at a learning rate of 1, as Adam's have it (Liu et al., 2025)


class Muon(torch.optim.Optimizer):
    """Steps of matrices along their momentum, all of whose singular values become about 1.

    ``torch.optim.Muon`` does the same, but reads its learning rate on the host: a recorded step would keep the first.

    Args:
        matrices: parameters of two dimensions.
        lr: the learning rate, a tensor; one that suits Adam does here.
        momentum: decay of the momentum, which is Nesterov's.
    """

    def __init__(self, matrices: Iterable[torch.Tensor], lr: torch.Tensor, momentum: float = 0.95) -> None:
        super().__init__(list(matrices), {"lr": lr, "momentum": momentum})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Makes a step; parameters without a gradient stay."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                if "momentum" not in state:
                    state["momentum"] = torch.zeros_like(matrix)
                state["momentum"].lerp_(matrix.grad, 1.0 - group["momentum"])
                ahead = torch.lerp(matrix.grad, state["momentum"], group["momentum"])
                matrix.sub_(group["lr"] * (RMS * max(matrix.shape) ** 0.5) * orthogonal(ahead))


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """Returns a matrix with the singular vectors of another one, and singular values between about 0.7 and 1.2.

    Newton's and Schulz's iteration in bfloat16.
    """
    a, b, c = COEFFICIENTS
    tall = matrix.shape[0] > matrix.shape[1]
    found = (matrix.T if tall else matrix).bfloat16()
    found = found / found.norm().clamp(min=1e-7)
    for _ in range(STEPS):
        gram = found @ found.T
        found = torch.addmm(found, torch.addmm(gram, gram, gram, beta=b, alpha=c), found, beta=a)
    return (found.T if tall else found).to(matrix.dtype)
