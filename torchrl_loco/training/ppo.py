"""Proximal policy optimization (Schulman et al., 2017), by TorchRL's ClipPPOLoss and GAE."""

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor
from torch import nn
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_loco.policy import ObservationNorm
from torchrl_loco.training.actor import Network, StateIndependentScale, make_actor
from torchrl_loco.training.algorithm import Algorithm, clip_and_step
from torchrl_loco.training.config import PPOConfig
from torchrl_loco.training.spaces import Spaces


class PPO(Algorithm):
    """Generalised advantage estimates, then epochs of minibatches over the clipped loss."""

    config_type = PPOConfig
    metric_names = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "grad_norm")
    config: PPOConfig

    def __init__(self, config: PPOConfig, spaces: Spaces, network: Network | None = None) -> None:
        super().__init__(config, spaces, network)
        self.actor, self.critic, self.norms = make_actor_critic(config, spaces, network)
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
        on_cuda = self.device.type == "cuda"
        self._losses = torch.compile(self.loss, fullgraph=True) if config.compile and on_cuda else self.loss

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns the ``batch``, of shape ``(num_envs, num_steps)``, with advantages and value targets."""
        scaled = batch.copy().set(("next", "reward"), batch["next", "reward"] * self.config.reward_scale)
        self.gae(scaled)
        return scaled.select(*self.loss.in_keys, "advantage", "value_target", "state_value", strict=False)

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[torch.Tensor]:
        """Returns the metrics, a scalar each, of a step down the clipped loss, the critic's and the entropy's."""
        losses = self._losses(minibatch)
        self.optimizer.zero_grad()
        (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
        grad_norm = clip_and_step(self.optimizer, self.config.max_grad_norm)
        return [*(losses[name] for name in self.metric_names[:-1]), grad_norm]


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

    make = network or mlp
    norms = {"observation": ObservationNorm(spaces.observation)}
    mean: Any = make(spaces.observation, spaces.action)
    if network is None:
        nn.init.orthogonal_(mean[-1].weight, gain=0.01)  # the first actions are near zero, whatever is observed
    scale = StateIndependentScale(spaces.action, config.init_std)
    mean, value = (InBFloat16(part) if config.bf16 else part for part in (mean, make(spaces.critic, 1)))
    whole = nn.Sequential(norms["observation"], mean, scale, NormalParamExtractor("exp"))
    actor = make_actor(spaces, config.device, whole, log_prob=True)
    if spaces.privileged is not None:
        norms["privileged"] = ObservationNorm(spaces.privileged)
    critic = ValueOperator(nn.Sequential(norms[spaces.critic_key], value), in_keys=[spaces.critic_key])
    return actor, critic.to(config.device), norms
