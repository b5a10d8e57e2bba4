"""Relative entropy pathwise policy optimization (Voelcker et al., 2025, arXiv 2507.11019).

On-policy like PPO, but the actor ascends the gradient of a critic Q(s, a) instead of weighting sampled actions. Three
things keep that gradient reliable: the critic is a distribution over returns, it learns from fresh data only, and the
actor minimises the KL divergence from the policy that collected the data wherever it exceeds a bound.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, mse_loss
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.objectives.utils import hold_out_net
from torchrl.objectives.value.functional import td_lambda_return_estimate

from torchrl_loco.encoder import PixelEncoder
from torchrl_loco.policy import ObservationNorm, layers_of
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network, Spaces, log_slope, make_actor, network_of, normed_layers
from torchrl_loco.training.adam import LARGE, FlatAdam
from torchrl_loco.training.algorithm import Acting, Algorithm, choose, clip_and_step
from torchrl_loco.training.config import REPPOConfig, TrainingConfig
from torchrl_loco.training.reppo_rows import ReppoRows
from torchrl_loco.training.rows import normalise_of, start_triton, triton_works


class REPPO(Algorithm):
    """Soft lambda-returns, then epochs of minibatches: the critic's cross entropy, the actor's constrained ascent."""

    config_type = REPPOConfig
    metric_names = (
        *("loss_critic", "loss_aux", "value", "grad_norm_critic"),
        *("loss_actor", "kl", "kl_exceeded", "entropy", "temperature", "kl_weight", "grad_norm_actor"),
    )
    batch_metric_names = ("return_min", "return_max", "return_clipped")
    config: REPPOConfig

    def __init__(self, config: REPPOConfig, spaces: Spaces, network: Network | None = None) -> None:
        super().__init__(config, spaces, network)
        self.action_bound = 1.0 if spaces.bounded else config.action_bound
        encoder = PixelEncoder(spaces.pixels, strides=config.strides) if spaces.pixels else None
        sight = PixelEncoder(spaces.pixels, strides=config.strides) if spaces.pixels and spaces.critic_sees else None
        inputs, outputs = encoder.features if encoder else spaces.observation, 2 * spaces.action
        if network is None:
            head = nn.Linear(config.hidden[-1], outputs)
            layers = [*normed_layers(inputs, config.hidden), head]
        else:
            layers = layers_of(network_of(network, inputs, outputs))
        extract = NormalParamExtractor("exp")
        whole = nn.Sequential(encoder or self.norms["observation"], *layers, extract)
        self.actor = make_actor(spaces, config.device, whole, log_prob=False, bound=config.action_bound)
        bins = ValueBins(config.min_value, config.max_value, config.num_bins)
        self.critic = DistributionalQ((spaces.critic, spaces.action), config.hidden, bins, sight).to(config.device)
        # From pixels or normalised observations to means and standard deviations.
        self.distribution = self.actor[0].module if encoder else self.actor[0].module[1:]
        self.dual = DualVariables(config).to(self.device)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic, "dual": self.dual})
        for key in self.norms.keys() - {spaces.actor_key}:  # the critic's networks read what is normalised already
            self.networks[f"{key}_norm"] = self.norms[key]
        self.critic_optimizer = self.make_optimizer("critic", self.critic.parameters())
        # The gradient of a dual variable's logarithm shrinks with the variable: an eps of 1e-5 would keep it small.
        groups = [{"params": list(self.actor.parameters())}, {"params": list(self.dual.parameters()), "eps": 1e-8}]
        self.actor_optimizer = self.make_optimizer("actor", groups)
        self._nets: ReppoRows | Modules = Modules(self.distribution, self.critic)
        if not spaces.pixels and triton_works(self.device):
            sizes, dtype = (spaces.observation, spaces.critic), torch.bfloat16 if config.bf16 else torch.float32
            actor = nn.Sequential(*layers)
            self._nets = ReppoRows(actor, extract, self.critic, sizes, dtype, config.minibatch_size)
            self.critic_optimizer.compile_with([(normalise_of(dtype), LARGE), (choose, LARGE)])
        self._fused_values = self.fused(self._values, "actor and critic", config.bf16)
        self._fused_critic_losses = self.fused(self._nets.losses, "the critic", config.bf16)
        self._fused_actor_losses = self.fused(self._actor_losses, "the actor", config.bf16)

    @classmethod
    def start_compilers(cls, config: TrainingConfig) -> None:
        """Starts Triton, or torch.compile from pixels and where Triton does not work."""
        if config.from_pixels or not start_triton(torch.device(config.device)):
            super().start_compilers(config)

    def fused(self, function: Callable[..., Any], what: str, bf16: bool = False, **options: bool) -> Callable[..., Any]:
        """Returns a function of tensors as kernels of torch.compile, or itself if it calls kernels of Triton."""
        return function if isinstance(self._nets, ReppoRows) else super().fused(function, what, bf16, **options)

    def acting(self) -> nn.Module:
        """Returns the actor as a policy for collectors, with networks that compute as in gradient steps on CUDA."""
        if isinstance(self._nets, ReppoRows):
            return Acting(self.actor, self._act, ("loc", "scale", "action"))
        return Acting(self.actor, self.fused(self.actor, "the actor"))

    @torch.no_grad()
    def _act(self, td: TensorDictBase) -> TensorDictBase:
        """Returns ``td`` with actions and the distribution that they were drawn from."""
        self._nets.take(self.actor_optimizer)
        key = self.spaces.actor_key
        loc, scale = self._nets.distribution(self._nets.normalised(td[key], self.norms[key]))
        explores = exploration_type() is ExplorationType.RANDOM
        before_tanh = torch.addcmul(loc, scale, torch.randn_like(loc)) if explores else loc
        return td.update({"loc": loc, "scale": scale, "action": before_tanh.tanh() * self.action_bound})

    def _read(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Returns what networks read of a batch, by entry: rows of numbers normalised, pixels as they are."""
        rows = {key: self._nets.normalised(td[key], norm) for key, norm in self.norms.items()}
        return rows | ({"pixels": td["pixels"]} if self.spaces.pixels else {})

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns soft lambda-returns, ``(num_envs, num_steps)``, the features to predict, and normalised observations.

        Entropy counts as reward. Values of next states are those of one sampled action. At a time limit the value of
        the true terminal observation is bootstrapped; termination ends the return.
        """
        config, after = self.config, batch["next"]
        now, later = self._read(batch), self._read(after)
        self._nets.take(self.actor_optimizer, self.critic_optimizer)
        noise = torch.randn_like(batch["action"])
        observed = later[self.spaces.actor_key], later[self.spaces.critic_key]
        if self.spaces.pixels:  # step by step: a whole batch would fill the memory with what convolutions give
            steps = zip(*(each.unbind(1) for each in (*observed, noise)), strict=True)
            parts = [self._fused_values(*step) for step in steps]
            log_prob, value, features = (torch.stack(part, dim=1) for part in zip(*parts, strict=True))
        else:
            log_prob, value, features = self._fused_values(*observed, noise)
        alive = ~after["terminated"]
        reward = after["reward"] * config.reward_scale
        reward = reward - config.gamma * self.dual.temperature * log_prob.unsqueeze(-1) * alive
        returns = td_lambda_return_estimate(
            config.gamma, config.lmbda, value.unsqueeze(-1), reward, after["done"], after["terminated"]
        )
        estimates = {"returns": returns.squeeze(-1), "features": features, "alive": alive.squeeze(-1).float()}
        action = batch["action"] / self.action_bound  # what the losses see lies in [-1, 1]
        return batch.select("loc", "scale").update({"action": action, **now, **estimates})

    def batch_metrics(self, data: TensorDictBase) -> Tensor:
        """Returns least and largest return of a batch, and the fraction beyond the critic's bins by more than a bin."""
        returns, bins = data["returns"], self.critic.bins
        least, largest = returns.aminmax()
        below, largest = distributed.largest_of_ranks(torch.stack([-least, largest]))
        beyond = (returns < bins.low - bins.width) | (returns > bins.high + bins.width)
        return torch.stack([-below, largest, beyond.float().mean()])

    def note(self, metrics: Mapping[str, Sequence[float]]) -> str:
        """Returns which returns the critic could not represent, and which settings change that, if there were any."""
        beyond = [fraction for fraction in metrics["return_clipped"] if fraction > 0.0]
        if not beyond:
            return ""
        config, least, largest = self.config, min(metrics["return_min"]), max(metrics["return_max"])
        options = []
        if least < config.min_value:
            options.append(f"--min_value {math.floor(1.5 * least):g}")
        if largest > config.max_value:
            options.append(f"--max_value {math.ceil(1.5 * largest):g}")
        return (
            f"Returns from {least:.4g} to {largest:.4g} occurred, but the critic represents those from "
            f"{config.min_value:g} to {config.max_value:g} and cut off up to {max(beyond):.2%} of a batch: pass "
            f"{' '.join(options)}, or a smaller --reward_scale"
        )

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[Tensor]:
        """Returns the metrics, a scalar each, of a step of the critic, then one of the actor and the dual variables."""
        return [*self.critic_step(minibatch), *self.actor_step(minibatch)]

    def _values(self, observation: Tensor, of_critic: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns log-probability, value and features of one action in each state, made of standard normal noise."""
        loc, scale = self._nets.distribution(observation)
        action, log_prob = self._nets.sample(loc, scale, noise)
        return log_prob, *self._nets.value_and_features(of_critic, action)

    def critic_step(self, minibatch: TensorDictBase) -> list[Tensor]:
        """Returns the metrics of the critic, which learns to predict returns and its own features of the next step."""
        names = self.spaces.critic_key, "action", "returns", "features", "alive"
        self._nets.take(self.critic_optimizer)
        loss, aux = self._fused_critic_losses(*(minibatch[name] for name in names))
        self.critic_optimizer.zero_grad()
        (loss + self.config.aux_coeff * aux).backward()
        grad_norm = clip_and_step(self.critic_optimizer, self.config.max_grad_norm)
        return [loss, aux, minibatch["returns"].mean(), grad_norm]

    def actor_step(self, minibatch: TensorDictBase) -> list[Tensor]:
        """Returns the metrics of the actor: it ascends value and entropy near the old policy, and goes back to it."""
        config, temperature, kl_weight = self.config, self.dual.temperature, self.dual.kl_weight
        names = self.spaces.critic_key, "loc", "scale"
        noise, observation = torch.randn_like(minibatch["loc"]), self.observed(minibatch)
        with hold_out_net(self.critic):  # gradients pass through it, but not to its parameters
            self._nets.take(self.actor_optimizer, self.critic_optimizer)
            loss, entropy, divergence, exceeded = self._fused_actor_losses(
                observation, *(minibatch[name] for name in names), noise, temperature.detach(), kl_weight.detach()
            )
        # The dual variables rise while their constraint is violated: too little entropy, too much divergence.
        excess_entropy = entropy - config.target_entropy * noise.shape[-1]
        dual_loss = temperature * excess_entropy - kl_weight * (divergence - config.kl_bound)
        self.actor_optimizer.zero_grad()
        (loss + dual_loss).backward()
        grad_norm = clip_and_step(self.actor_optimizer, config.max_grad_norm)
        self.dual.clamp_()
        return [loss, divergence, exceeded, entropy, temperature, kl_weight, grad_norm]

    def _actor_losses(
        self,
        observation: Tensor,
        of_critic: Tensor,
        old_loc: Tensor,
        old_scale: Tensor,
        noise: Tensor,
        temperature: Tensor,
        kl_weight: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns the actor's loss, and without gradients mean entropy, mean divergence and how often it is too large.

        All are scalars, of ``n`` steps; the last one is a fraction of them.
        """
        nets, old, weights = self._nets, (old_loc, old_scale), (temperature, kl_weight)
        loc, scale = nets.distribution(observation)
        action, log_prob = nets.sample(loc, scale, noise)
        value, _ = nets.value_and_features(of_critic, action)
        return nets.actor_losses((loc, scale), old, log_prob, value, weights, self.config.kl_bound)


class DualVariables(nn.Module):
    """The learned Lagrange multipliers of the actor's loss: of the entropy (temperature) and of the KL divergence."""

    def __init__(self, config: REPPOConfig) -> None:
        super().__init__()
        self.log_temperature = nn.Parameter(torch.tensor(math.log(config.init_temperature)))
        self.log_kl_weight = nn.Parameter(torch.tensor(math.log(config.init_kl_weight)))
        self._min_log_temperature = math.log(config.min_temperature)
        self._min_log_kl_weight = math.log(config.min_kl_weight)

    @torch.no_grad()
    def clamp_(self) -> None:
        """Keeps the weights at or above their minima."""
        self.log_temperature.clamp_(min=self._min_log_temperature)
        self.log_kl_weight.clamp_(min=self._min_log_kl_weight)

    @property
    def temperature(self) -> Tensor:
        """Weight of the entropy, a scalar."""
        return self.log_temperature.exp()

    @property
    def kl_weight(self) -> Tensor:
        """Weight of the divergence, a scalar."""
        return self.log_kl_weight.exp()


def sample(loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Returns actions ``tanh(u)``, u = loc + scale * noise, and their log-probabilities, shape ``(...)``.

    Standard normal noise, means and standard deviations have shape ``(..., nu)``. The log-probability is computed from
    u, not from the action, so it stays exact where tanh saturates.
    """
    u = loc + scale * noise
    log_prob = -0.5 * noise.square() - scale.log() - 0.5 * math.log(2.0 * math.pi) - log_slope(u)
    return u.tanh(), log_prob.sum(-1)


def kl(old_loc: Tensor, old_scale: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    """Returns KL(old || new) of diagonal Gaussians, shape ``(...)``, which equals that of their images under tanh.

    Means and standard deviations have shape ``(..., nu)``.
    """
    ratio, distance = old_scale / scale, (old_loc - loc) / scale
    return (0.5 * (ratio.square() + distance.square() - 1.0) - ratio.log()).sum(-1)


def actor_losses(
    own: tuple[Tensor, Tensor],
    old: tuple[Tensor, Tensor],
    log_prob: Tensor,
    value: Tensor,
    weights: tuple[Tensor, Tensor],
    bound: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns the actor's loss, and without gradients mean entropy, mean divergence and how often it is too large.

    All are scalars, of ``n`` steps; the last one is a fraction of them.

    Args:
        own: means and standard deviations, ``(n, nu)``.
        old: those of the policy that collected.
        log_prob: log-probabilities of drawn actions, ``(n,)``.
        value: what the critic expects of them, ``(n,)``.
        weights: temperature and weight of the divergence, scalars.
        bound: of the divergence.
    """
    temperature, kl_weight = weights
    divergence = kl(*old, *own)
    exceeded = divergence >= bound
    loss = torch.where(exceeded, kl_weight * divergence, temperature * log_prob - value).mean()
    return loss, -log_prob.detach().mean(), divergence.detach().mean(), exceeded.float().mean()


# The networks.


class Modules:
    """Actor and critic as modules: from pixels, and where there are no kernels of Triton (see ``ReppoRows``)."""

    def __init__(self, distribution: nn.Module, critic: "DistributionalQ") -> None:
        self.distribution, self.losses, self.value_and_features = distribution, critic.losses, critic.value_and_features
        self.sample, self.actor_losses = sample, actor_losses

    def take(self, *optimizers: FlatAdam) -> None:
        """Does nothing: modules compute with the parameters themselves."""

    def normalised(self, rows: Tensor, norm: ObservationNorm) -> Tensor:
        """Returns normalised rows."""
        return norm(rows)


class ValueBins(nn.Module):
    """Returns as distributions over evenly spaced bins (HL-Gauss: Imani and White, 2018; Farebrother et al., 2024).

    A return below ``low``, the center of the first bin, counts as one at it, and so does one above that of the last.
    """

    SPREAD = 0.75  # standard deviation of a target, in widths of a bin

    centers: Tensor  # of the bins, (count,)
    edges: Tensor  # (count + 1,)

    def __init__(self, low: float, high: float, count: int) -> None:
        super().__init__()
        half = (high - low) / (count - 1) / 2
        self.register_buffer("centers", torch.linspace(low, high, count), persistent=False)
        self.register_buffer("edges", torch.linspace(low - half, high + half, count + 1), persistent=False)
        self.low, self.high, self.width = low, high, 2 * half
        self.sharpness = 1.0 / (math.sqrt(2.0) * self.width * self.SPREAD)  # of the error function

    def encode(self, returns: Tensor) -> Tensor:
        """Returns the probabilities, shape ``(..., count)``, of a Gaussian about each return of shape ``(...)``."""
        returns = returns.clamp(self.low, self.high).unsqueeze(-1)
        below = torch.erf((self.edges - returns) * self.sharpness)
        return below.diff(dim=-1) / (below[..., -1:] - below[..., :1])

    def decode(self, logits: Tensor) -> Tensor:
        """Returns the mean, shape ``(...)``, of distributions given as logits of shape ``(..., count)``."""
        return (logits.softmax(-1) * self.centers).sum(-1)


class DistributionalQ(nn.Module):
    """Critic Q(s, a) whose output is a distribution over returns, with a second head that predicts its next features.

    It reads normalised observations, or pixels, of which ``sight`` makes features. ``sizes`` are those of what it
    observes and of an action. The heads have one hidden layer of the encoder's last width.
    """

    def __init__(
        self, sizes: tuple[int, int], hidden: tuple[int, ...], bins: ValueBins, sight: PixelEncoder | None = None
    ) -> None:
        super().__init__()
        self.bins, self.sight = bins, sight
        observed, width = sight.features if sight else sizes[0], hidden[-1]
        self.encoder = nn.Sequential(*normed_layers(observed + sizes[1], hidden), nn.Linear(width, width))
        last = nn.Linear(width, len(bins.centers))
        with torch.no_grad():  # the initial prediction is a return of zero
            last.bias.add_(40.0 * bins.encode(torch.zeros(())))
        self.value_head = nn.Sequential(nn.LayerNorm(width), nn.SiLU(), *normed_layers(width, (width,)), last)
        self.predictor = nn.Sequential(
            nn.LayerNorm(width), nn.SiLU(), *normed_layers(width, (width,)), nn.Linear(width, width)
        )

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns logits of shape ``(..., count)`` and the predicted next features of shape ``(..., hidden[-1])``."""
        features = self._features(observation, action)
        return self.value_head(features), self.predictor(features)

    def losses(
        self, observation: Tensor, action: Tensor, returns: Tensor, features: Tensor, alive: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns the losses of the returns and of the features, of ``n`` steps: scalars."""
        logits, predicted = self(observation, action)
        aux = (mse_loss(predicted, features, reduction="none").mean(-1) * alive).mean()
        return cross_entropy(logits, self.bins.encode(returns)), aux

    def value_and_features(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean return, shape ``(...)``, and the features, shape ``(..., hidden[-1])``."""
        features = self._features(observation, action)
        return self.bins.decode(self.value_head(features)), features

    def _features(self, observation: Tensor, action: Tensor) -> Tensor:
        seen = self.sight(observation) if self.sight else observation
        return self.encoder(torch.cat([seen, action], dim=-1))
