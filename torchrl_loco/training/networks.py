"""Actors and critics, all on raw observations: normalisation is part of the networks."""

import contextlib
import copy
import dataclasses
import math
from collections.abc import Iterator
from typing import Any

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torch.distributions import Independent, Normal, TransformedDistribution
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.modules.distributions.continuous import SafeTanhTransform

from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.training.config import PPOConfig, REPPOConfig, TrainingConfig


class StateIndependentScale(nn.Module):
    """Appends a learned log standard deviation, the same in every state, to the mean of an action."""

    def __init__(self, size: int, init_std: float) -> None:
        super().__init__()
        self.log_std = nn.Parameter(torch.full((size,), math.log(init_std)))

    def forward(self, loc: torch.Tensor) -> torch.Tensor:
        """Returns means of shape ``(..., size)`` with the log deviations behind them, ``(..., 2 size)``."""
        return torch.cat([loc, self.log_std.expand_as(loc)], dim=-1)


class ValueBins(nn.Module):
    """Returns as distributions over evenly spaced bins (HL-Gauss: Imani and White, 2018; Farebrother et al., 2024).

    Args:
        low: return that the center of the first bin stands for.
        high: return that the center of the last bin stands for.
        count: number of bins.

    Attributes:
        centers: returns that the bins stand for, shape ``(count,)``.
        edges: returns between them, shape ``(count + 1,)``, the outer ends included.
    """

    SPREAD = 0.75
    """Standard deviation of a target, in widths of a bin."""

    centers: torch.Tensor
    edges: torch.Tensor

    def __init__(self, low: float, high: float, count: int) -> None:
        super().__init__()
        half = (high - low) / (count - 1) / 2
        self.register_buffer("centers", torch.linspace(low, high, count), persistent=False)
        self.register_buffer("edges", torch.linspace(low - half, high + half, count + 1), persistent=False)
        self.low, self.high, self.sigma = low, high, 2 * half * self.SPREAD

    def encode(self, returns: torch.Tensor) -> torch.Tensor:
        """Returns the probabilities, shape ``(..., count)``, of a Gaussian about each return of shape ``(...)``."""
        returns = returns.clamp(self.low, self.high).unsqueeze(-1)
        below = torch.erf((self.edges - returns) / (math.sqrt(2.0) * self.sigma))
        return below.diff(dim=-1) / (below[..., -1:] - below[..., :1])

    def decode(self, logits: torch.Tensor) -> torch.Tensor:
        """Returns the mean, shape ``(...)``, of distributions given as logits of shape ``(..., count)``."""
        return logits.softmax(-1) @ self.centers


class DistributionalQ(nn.Module):
    """Critic of actions whose output is a distribution over returns, with a second head that foresees features.

    Args:
        norm: normalises observations.
        sizes: length of an observation and of an action.
        hidden: widths of the encoder's layers; the heads have one hidden layer of the last width.
        bins: what the logits stand for.
    """

    def __init__(self, norm: ObservationNorm, sizes: tuple[int, int], hidden: tuple[int, ...], bins: ValueBins) -> None:
        super().__init__()
        self.norm, self.bins = norm, bins
        width = hidden[-1]
        self.encoder = nn.Sequential(*normed_layers(sum(sizes), hidden), nn.Linear(width, width))
        last = nn.Linear(width, len(bins.centers))
        with torch.no_grad():  # begin at a return of zero
            last.bias.add_(40.0 * bins.encode(torch.zeros(())))
        self.value_head = nn.Sequential(nn.LayerNorm(width), nn.SiLU(), *normed_layers(width, (width,)), last)
        self.foresight = nn.Sequential(
            nn.LayerNorm(width), nn.SiLU(), *normed_layers(width, (width,)), nn.Linear(width, width)
        )

    def forward(self, observation: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns logits of shape ``(..., count)`` and the foreseen features of shape ``(..., hidden[-1])``."""
        features = self.encoder(torch.cat([self.norm(observation), action], dim=-1))
        return self.value_head(features), self.foresight(features)

    def value_and_features(self, observation: torch.Tensor, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the mean return, shape ``(...)``, and the features, shape ``(..., hidden[-1])``."""
        features = self.encoder(torch.cat([self.norm(observation), action], dim=-1))
        return self.bins.decode(self.value_head(features)), features


def normed_layers(inputs: int, hidden: tuple[int, ...]) -> list[nn.Module]:
    """Returns layers of the given widths, each with layer norm and SiLU."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.LayerNorm(width), nn.SiLU()]
        inputs = width
    return layers


class SquashedNormal(TransformedDistribution):
    """Independent normal variables under tanh.

    TorchRL's ``TanhNormal`` is the same, but looks at its bounds whenever it is made: on CUDA the host would wait for
    that at every decision, and no gradient step could be recorded.

    Args:
        loc: means before tanh, shape ``(..., n)``.
        scale: standard deviations before tanh, of the same shape.
    """

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor) -> None:
        normal = Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)
        super().__init__(normal, SafeTanhTransform(cache_size=1), validate_args=False)

    @property
    def deterministic_sample(self) -> torch.Tensor:
        """The image of the mean, shape ``(..., n)``."""
        return self.base_dist.mean.tanh()


def make_actor(config: TrainingConfig, network: nn.Module, log_prob: bool) -> ProbabilisticActor:
    """Returns a tanh-normal actor around a network that gives means and log deviations.

    It reads ``observation`` and writes ``loc``, ``scale``, ``action`` and, if asked to, ``action_log_prob``.
    """
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=Bounded(-1.0, 1.0, (config.action_size,), device=config.device, dtype=torch.float32),
        distribution_class=SquashedNormal,
        return_log_prob=log_prob,
    ).to(config.device)


def make_actor_critic(config: PPOConfig) -> tuple[ProbabilisticActor, ValueOperator, ObservationNorm]:
    """Returns actor, critic and the observation norm that they share, for PPO; the critic writes ``state_value``."""
    layers = {"num_cells": list(config.hidden), "activation_class": nn.SiLU}
    norm = ObservationNorm(config.observation_size)
    mean = MLP(in_features=config.observation_size, out_features=config.action_size, **layers)
    nn.init.orthogonal_(mean[-1].weight, gain=0.01)
    scale = StateIndependentScale(config.action_size, config.init_std)
    actor = make_actor(config, nn.Sequential(norm, mean, scale, NormalParamExtractor("exp")), log_prob=True)
    value = MLP(in_features=config.observation_size, out_features=1, **layers)
    critic = ValueOperator(nn.Sequential(norm, value), in_keys=["observation"])
    return actor, critic.to(config.device), norm


def make_actor_q(config: REPPOConfig) -> tuple[ProbabilisticActor, DistributionalQ, ObservationNorm]:
    """Returns actor, critic and the observation norm that they share, for REPPO."""
    norm = ObservationNorm(config.observation_size)
    head = nn.Linear(config.hidden[-1], 2 * config.action_size)
    body = normed_layers(config.observation_size, config.hidden)
    actor = make_actor(config, nn.Sequential(norm, *body, head, NormalParamExtractor("exp")), log_prob=False)
    bins = ValueBins(0.0, config.max_value, config.num_bins)
    critic = DistributionalQ(norm, (config.observation_size, config.action_size), config.hidden, bins)
    return actor, critic.to(config.device), norm


def deterministic(actor: ProbabilisticActor, config: TrainingConfig, info: dict[str, Any]) -> Policy:
    """Returns the policy that takes the mode of an actor's actions, without what only training needs.

    Its info holds the settings of the training, and ``info`` on top.
    """
    kinds = (ObservationNorm, nn.Linear, nn.LayerNorm, nn.SiLU)
    *layers, last = (copy.deepcopy(module) for module in actor.modules() if isinstance(module, kinds))
    # The mean's rows of the last layer; initialising it would draw from the generator that training draws from.
    head = nn.utils.skip_init(nn.Linear, config.hidden[-1], config.action_size)
    head.load_state_dict({name: value[: config.action_size] for name, value in last.state_dict().items()})
    settings = {name: value for name, value in dataclasses.asdict(config).items() if name not in ("out", "device")}
    network = nn.Sequential(*layers, head.to(config.device), nn.Tanh())
    return Policy(network, {"algorithm": config.algorithm, **settings, **info})


@contextlib.contextmanager
def settings_for_small_networks() -> Iterator[None]:
    """Has torch compute in one thread on the CPU and round matrix products to TF32 on CUDA; puts the settings back.

    Threads would wait for each other most of the time, all the more where other work takes turns on the cores. TF32 is
    three times as fast.
    """
    threads, precision = torch.get_num_threads(), torch.get_float32_matmul_precision()
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.set_float32_matmul_precision(precision)
