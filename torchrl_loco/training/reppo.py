"""Relative entropy pathwise policy optimization (Voelcker et al., 2025, arXiv 2507.11019).

On-policy like PPO, but the actor climbs the gradient of a critic of actions, Q(s, a), instead of weighing sampled
actions. Three things make that gradient trustworthy: the critic is a distribution over returns, it learns from fresh
data alone, and the actor is drawn back wherever it has moved too far from the policy that collected the data.
"""

import math
from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from torch import nn
from torch.nn.functional import cross_entropy, mse_loss, softplus
from torchrl.objectives.value.functional import td_lambda_return_estimate

from torchrl_loco.training.algorithm import Algorithm, clip_and_step
from torchrl_loco.training.config import REPPOConfig
from torchrl_loco.training.networks import make_actor_q


class REPPO(Algorithm):
    """Soft lambda-returns, then minibatch epochs over the critic's cross entropy and the actor's bounded ascent."""

    metric_names = (
        *("loss_critic", "loss_aux", "value", "grad_norm_critic"),
        *("loss_actor", "kl", "kl_exceeded", "entropy", "temperature", "kl_weight", "grad_norm_actor"),
    )
    config: REPPOConfig

    def __init__(self, config: REPPOConfig) -> None:
        super().__init__(config)
        self.actor, self.critic, self.norm = make_actor_q(config)
        self.distribution = self.actor[0].module  # from observations to means and deviations
        self.weights = Weights(config).to(self.device)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic, "weights": self.weights})
        self._actor_parameters = [*self.actor.parameters(), *self.weights.parameters()]
        self.critic_optimizer = self.make_optimizer("critic", self.critic.parameters())
        # The gradient of a weight's logarithm shrinks with the weight: an eps of 1e-5 would hold it down.
        groups = [{"params": list(self.actor.parameters())}, {"params": list(self.weights.parameters()), "eps": 1e-8}]
        self.actor_optimizer = self.make_optimizer("actor", groups)

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns estimates, ``(num_envs, decisions)``, in which entropy counts as reward.

        They take one action drawn in every next state.

        At a time limit the true terminal observation is bootstrapped from; a termination ends the return.
        """
        config, after = self.config, batch["next"]
        loc, scale = self.distribution(after["observation"])
        action, log_prob = sample(loc, scale)
        value, features = self.critic.value_and_features(after["observation"], action)
        alive = ~after["terminated"]
        reward = after["reward"] * config.reward_scale
        reward = reward - config.gamma * self.weights.temperature * log_prob.unsqueeze(-1) * alive
        returns = td_lambda_return_estimate(
            config.gamma, config.lmbda, value.unsqueeze(-1), reward, after["done"], after["terminated"]
        )
        estimates = {"returns": returns.squeeze(-1), "features": features, "alive": alive.squeeze(-1).float()}
        return batch.select("observation", "action", "loc", "scale").update(estimates)

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[torch.Tensor]:
        """Returns the metrics, a scalar each, of a step of the critic, then one of the actor and the two weights."""
        return [*self._critic_step(minibatch), *self._actor_step(minibatch)]

    def _critic_step(self, minibatch: TensorDictBase) -> list[torch.Tensor]:
        """The critic learns the distribution of returns, and to foresee its own features of the next step.

        Returns:
            Its metrics.
        """
        logits, foreseen = self.critic(minibatch["observation"], minibatch["action"])
        target = self.critic.bins.encode(minibatch["returns"])
        loss = cross_entropy(logits, target)
        aux = (mse_loss(foreseen, minibatch["features"], reduction="none").mean(-1) * minibatch["alive"]).mean()
        self.critic_optimizer.zero_grad()
        (loss + self.config.aux_coeff * aux).backward()
        grad_norm = clip_and_step(self.critic_optimizer, self.config.max_grad_norm)
        return [loss, aux, minibatch["returns"].mean(), grad_norm]

    def _actor_step(self, minibatch: TensorDictBase) -> list[torch.Tensor]:
        """The actor climbs value and entropy where it is near the old policy, and goes back to it where it is not.

        Returns:
            Its metrics.
        """
        config, weights = self.config, self.weights
        loc, scale = self.distribution(minibatch["observation"])
        action, log_prob = sample(loc, scale)
        value, _ = self.critic.value_and_features(minibatch["observation"], action)
        divergence = kl(minibatch["loc"], minibatch["scale"], loc, scale)
        exceeded = divergence >= config.kl_bound
        climb = weights.temperature.detach() * log_prob - value
        loss = torch.where(exceeded, weights.kl_weight.detach() * divergence, climb).mean()
        # Both weights rise while what they weigh is not yet as wanted: too little entropy, too much divergence.
        excess_entropy = (-log_prob.detach() - config.target_entropy * action.shape[-1]).mean()
        excess_kl = (divergence.detach() - config.kl_bound).mean()
        dual = weights.temperature * excess_entropy - weights.kl_weight * excess_kl
        self.actor_optimizer.zero_grad()
        (loss + dual).backward(inputs=self._actor_parameters)  # and leave the critic's gradients alone
        grad_norm = clip_and_step(self.actor_optimizer, config.max_grad_norm)
        weights.clamp_()
        return [
            *(loss, divergence.mean(), exceeded.float().mean(), -log_prob.mean()),
            *(weights.temperature, weights.kl_weight, grad_norm),
        ]


class Weights(nn.Module):
    """The two learned weights of the actor's loss: of entropy (temperature) and of divergence."""

    def __init__(self, config: REPPOConfig) -> None:
        super().__init__()
        self.log_temperature = nn.Parameter(torch.tensor(math.log(config.init_temperature)))
        self.log_kl_weight = nn.Parameter(torch.tensor(math.log(config.init_kl_weight)))
        self._min_log_temperature = math.log(config.min_temperature)

    @torch.no_grad()
    def clamp_(self) -> None:
        """Keeps the temperature at its least value or above."""
        self.log_temperature.clamp_(min=self._min_log_temperature)

    @property
    def temperature(self) -> torch.Tensor:
        """Weight of the entropy, a scalar."""
        return self.log_temperature.exp()

    @property
    def kl_weight(self) -> torch.Tensor:
        """Weight of the divergence, a scalar."""
        return self.log_kl_weight.exp()


def sample(loc: torch.Tensor, scale: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns an action ``tanh(u)``, u ~ N(loc, scale), drawn differentiably, and its log-probability.

    Of means and deviations of shape ``(..., nu)`` come actions of that shape and log-probabilities of shape ``(...)``.
    Taken from u and not from the action, the log-probability stays exact where tanh saturates.
    """
    noise = torch.randn_like(loc)
    u = loc + scale * noise
    log_prob = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2 * math.pi)
    log_slope = 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))
    return u.tanh(), (log_prob - log_slope).sum(-1)


def kl(old_loc: torch.Tensor, old_scale: torch.Tensor, loc: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
    """Returns the divergence KL(old || new) of diagonal Gaussians, which is that of their images under tanh.

    Of means and deviations of shape ``(..., nu)`` come divergences of shape ``(...)``.
    """
    ratio = old_scale / scale
    return (0.5 * (ratio.square() + ((old_loc - loc) / scale).square() - 1.0) - ratio.log()).sum(-1)
