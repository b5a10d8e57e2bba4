"""Proximal policy optimization (Schulman et al., 2017), by TorchRL's ClipPPOLoss and GAE."""

import math
from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor
from torch import nn
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_loco.policy import ObservationNorm
from torchrl_loco.training.actor import make_actor
from torchrl_loco.training.algorithm import Algorithm, clip_and_step
from torchrl_loco.training.config import PPOConfig


class PPO(Algorithm):
    """Generalised advantage estimates, then epochs of minibatches over the clipped loss."""

    metric_names = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "grad_norm")
    config: PPOConfig

    def __init__(self, config: PPOConfig) -> None:
        super().__init__(config)
        self.actor, self.critic, self.norm = make_actor_critic(config)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic})
        # At a time limit the value of the true terminal observation is bootstrapped; termination ends the return.
        self.gae = GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=self.critic, average_gae=False)
        self.loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=0.5,
            loss_critic_type="smooth_l1",
            normalize_advantage=True,
        )
        self.optimizer = self.make_optimizer("actor and critic", self.loss.parameters())

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns the ``batch``, of shape ``(num_envs, num_steps)``, with advantages and value targets."""
        scaled = batch.copy().set(("next", "reward"), batch["next", "reward"] * self.config.reward_scale)
        self.gae(scaled)
        return scaled.select(*self.loss.in_keys, "advantage", "value_target", "state_value", strict=False)

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[torch.Tensor]:
        """Returns the metrics, a scalar each, of a step down the clipped loss, the critic's and the entropy's."""
        losses = self.loss(minibatch)
        self.optimizer.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
        grad_norm = clip_and_step(self.optimizer, self.config.max_grad_norm)
        return [*(losses[name] for name in self.metric_names[:-1]), grad_norm]


class StateIndependentScale(nn.Module):
    """Appends a learned log standard deviation, the same in every state, to the mean of an action."""

    def __init__(self, size: int, init_std: float) -> None:
        super().__init__()
        self.log_std = nn.Parameter(torch.full((size,), math.log(init_std)))

    def forward(self, loc: torch.Tensor) -> torch.Tensor:
        """Returns means of shape ``(..., size)`` with the log deviations behind them, ``(..., 2 size)``."""
        return torch.cat([loc, self.log_std.expand_as(loc)], dim=-1)


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
