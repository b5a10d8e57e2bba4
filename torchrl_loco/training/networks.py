"""The actor and the critic, both on raw observations: normalisation is part of the networks."""

import math

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.data import TensorSpec
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_loco.training.presets import PPOConfig


class ObservationNorm(nn.Module):
    """Shifts and scales observations by the mean and variance of all that :meth:`update` saw.

    Args:
        size: length of an observation.
        limit: bound of the result; what lies beyond is clipped.
    """

    mean: torch.Tensor
    var: torch.Tensor
    count: torch.Tensor

    def __init__(self, size: int, limit: float = 10.0) -> None:
        super().__init__()
        self.limit = limit
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros(()))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Normalises observations of shape ``(..., size)``."""
        return ((observation - self.mean) * torch.rsqrt(self.var + 1e-6)).clamp(-self.limit, self.limit)

    @torch.no_grad()
    def update(self, observation: torch.Tensor) -> None:
        """Takes observations of shape ``(..., size)`` into mean and variance (Chan's parallel formula)."""
        batch = observation.flatten(0, -2)
        var, mean = torch.var_mean(batch, dim=0, correction=0)
        total = self.count + len(batch)
        share = len(batch) / total
        delta = mean - self.mean
        self.var.lerp_(var, share).add_(delta.square() * share * (1 - share))
        self.mean.add_(delta * share)
        self.count.copy_(total)


class StateIndependentScale(nn.Module):
    """Appends a learned log standard deviation, the same in every state, to the mean of an action."""

    def __init__(self, size: int, init_std: float) -> None:
        super().__init__()
        self.log_std = nn.Parameter(torch.full((size,), math.log(init_std)))

    def forward(self, loc: torch.Tensor) -> torch.Tensor:
        """Takes means of shape ``(..., size)`` to ``(..., 2 size)``."""
        return torch.cat([loc, self.log_std.expand_as(loc)], dim=-1)


def make_actor_critic(
    config: PPOConfig, observation_size: int, action_spec: TensorSpec
) -> tuple[ProbabilisticActor, ValueOperator, ObservationNorm]:
    """Makes a tanh-normal actor and a critic that share their observation norm.

    The actor reads ``observation`` and writes ``loc``, ``scale``, ``action`` and ``action_log_prob``; the critic writes
    ``state_value``.
    """
    device = action_spec.device
    action_size = action_spec.shape[-1]
    layers = {"num_cells": list(config.hidden), "activation_class": nn.SiLU, "device": device}
    norm = ObservationNorm(observation_size).to(device)
    scale = StateIndependentScale(action_size, config.init_std).to(device)
    mean = MLP(in_features=observation_size, out_features=action_size, **layers)
    nn.init.orthogonal_(mean[-1].weight, gain=0.01)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(norm, mean, scale, NormalParamExtractor("exp")),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    value = MLP(in_features=observation_size, out_features=1, **layers)
    critic = ValueOperator(nn.Sequential(norm, value), in_keys=["observation"])
    return actor, critic, norm
