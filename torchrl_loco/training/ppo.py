"""Proximal policy optimization (Schulman et al., 2017), by TorchRL's ClipPPOLoss."""

import math
from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchrl_loco.policy import ObservationNorm
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network, make_actor, network_of
from torchrl_loco.training.algorithm import Algorithm, clip_and_step
from torchrl_loco.training.config import PPOConfig
from torchrl_loco.training.spaces import Spaces

LR_RANGE = (1e-5, 1e-2)
"""Of a learning rate that follows the divergence."""


class PPO(Algorithm):
    """Generalised advantage estimates, then epochs of minibatches over the clipped loss."""

    config_type = PPOConfig
    metric_names = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "grad_norm")
    config: PPOConfig

    def __init__(self, config: PPOConfig, spaces: Spaces, network: Network | None = None) -> None:
        super().__init__(config, spaces, network)
        self.actor, self.critic, self.norms = make_actor_critic(config, spaces, network)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic})
        self.loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=spaces.bounded,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=0.5,
            loss_critic_type="smooth_l1",
            normalize_advantage=True,
            functional=False,  # else torch.compile would trace for seconds how parameters enter the modules
        )
        self.optimizer = self.make_optimizer("actor and critic", self.loss.parameters())
        self._compiled_losses, self._compiled_estimates = self.fused(self._losses), self.fused(self._estimates)
        self._compiled_lr = self.fused(self._following_lr)

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns what the loss reads, of shape ``(num_envs, num_steps)``, with advantages and value targets."""
        key, after = self.spaces.critic_key, batch["next"]
        ends = after["done"], after["terminated"]
        advantage, target = self._compiled_estimates(batch[key], after[key], after["reward"], *ends)
        # In an order that every process repeats: torch.compile finds what it made of the entries in that order.
        read = batch.select(*dict.fromkeys(("observation", key)), "action", "action_log_prob")
        return read.update({"advantage": advantage, "value_target": target})

    def _estimates(
        self,
        observation: torch.Tensor,
        later: torch.Tensor,
        reward: torch.Tensor,
        done: torch.Tensor,
        terminated: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns generalised advantage estimates and the critic's targets, of shape ``(num_envs, num_steps, 1)``.

        At a time limit the value of the true terminal observation is bootstrapped; termination ends the return.
        """
        config, value = self.config, self.critic.module(observation)
        next_value = self.critic.module(later) * ~terminated
        errors = config.reward_scale * reward + config.gamma * next_value - value
        decay = config.gamma * config.lmbda * ~done
        advantage, advantages = torch.zeros_like(errors[:, 0]), []
        for error, factor in zip(reversed(errors.unbind(1)), reversed(decay.unbind(1)), strict=True):
            advantage = error + factor * advantage
            advantages.append(advantage)
        whole = torch.stack(advantages[::-1], dim=1)
        return whole, whole + value

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[torch.Tensor]:
        """Returns the metrics, a scalar each, of a step down the clipped loss, the critic's and the entropy's."""
        loss, metrics = self._compiled_losses(minibatch)
        self.optimizer.zero_grad()
        loss.backward()
        if self.config.target_kl:
            self._follow(metrics[self.metric_names.index("kl_approx")])
        return [*metrics, clip_and_step(self.optimizer, self.config.max_grad_norm)]

    def _losses(self, minibatch: TensorDictBase) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the loss, a scalar, and the metrics but for the norm of its gradient, ``(len(metric_names) - 1,)``.

        torch.compile leaves out what else TorchRL's loss finds. That samples the entropy where it is compiled, and else
        waits for the device; neither is needed where actions are unbounded: deviations are the same in all states.
        """
        losses = self.loss(minibatch)
        if not self.spaces.bounded:
            scale: Any = self.actor[0].module[-1]
            deviations = scale(torch.zeros_like(minibatch["action"][0]))
            entropy = IndependentNormal(*deviations, validate_args=False).entropy()
            losses.update({"entropy": entropy.detach(), "loss_entropy": -self.config.entropy_coeff * entropy})
        loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        return loss, torch.stack([losses[name].detach() for name in self.metric_names[:-1]])

    def schedule(self, progress: float) -> None:
        """Sets the learning rate, unless it follows the divergence."""
        if not self.config.target_kl:
            super().schedule(progress)

    def _follow(self, kl: torch.Tensor) -> None:
        """Lowers the learning rate where a step goes too far from the policy that collected, raises it where not far.

        A divergence that is not positive, as that of the first step of a batch, says nothing.
        """
        kl = distributed.mean_of_ranks(kl)
        for group in self.optimizer.param_groups:
            group["lr"].copy_(self._compiled_lr(kl, group["lr"]))

    def _following_lr(self, kl: torch.Tensor, lr: torch.Tensor) -> torch.Tensor:
        target = self.config.target_kl
        raised = torch.where((kl > 0.0) & (kl < 0.5 * target), 1.5 * lr, lr)
        return torch.where(kl > 2.0 * target, lr / 1.5, raised).clamp(*LR_RANGE)


class InBFloat16(nn.Sequential):
    """A network whose matrix products are in bfloat16 on CUDA; its results are float32."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Returns what the network gives, float32."""
        with torch.autocast("cuda", torch.bfloat16, enabled=input.is_cuda):
            return super().forward(input).float()


def make_actor_critic(
    config: PPOConfig, spaces: Spaces, network: Network | None = None
) -> tuple[ProbabilisticActor, ValueOperator, dict[str, ObservationNorm]]:
    """Returns actor, critic and the norms of what they read, for PPO; the critic writes ``state_value``.

    Args:
        config: the settings.
        spaces: what they read and write.
        network: makes the actor's network, from an observation to means, and the critic's; else both are MLPs.
    """

    def mlp(inputs: int, outputs: int) -> nn.Sequential:
        return MLP(inputs, outputs, num_cells=list(config.hidden), activation_class=nn.SiLU)

    def make(inputs: int, outputs: int) -> nn.Module:
        return mlp(inputs, outputs) if network is None else network_of(network, inputs, outputs)

    norms = {"observation": ObservationNorm(spaces.observation)}
    mean: Any = make(spaces.observation, spaces.action)
    if network is None:
        nn.init.orthogonal_(mean[-1].weight, gain=0.01)  # the first actions are near zero, whatever is observed
    scale = AddStateIndependentNormalScale(spaces.action, init_value=math.log(config.init_std))
    mean, value = (InBFloat16(part) if config.bf16 else part for part in (mean, make(spaces.critic, 1)))
    whole = nn.Sequential(norms["observation"], mean, scale)
    actor = make_actor(spaces, config.device, whole, log_prob=True)
    if spaces.privileged is not None:
        norms["privileged"] = ObservationNorm(spaces.privileged)
    critic = ValueOperator(nn.Sequential(norms[spaces.critic_key], value), in_keys=[spaces.critic_key])
    return actor, critic.to(config.device), norms
