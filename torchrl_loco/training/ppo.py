"""Proximal policy optimization, by TorchRL's ClipPPOLoss and GAE."""

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_loco.training.algorithm import Algorithm, clip_and_step
from torchrl_loco.training.config import PPOConfig
from torchrl_loco.training.networks import make_actor_critic


class PPO(Algorithm):
    """Generalised advantages, then minibatch epochs over the clipped loss."""

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
        """Returns the ``batch``, of shape ``(num_envs, decisions)``, with advantages and value targets."""
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
