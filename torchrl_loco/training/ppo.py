"""Proximal policy optimization (Schulman et al., 2017)."""

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale
from torch import nn
from torch.func import functional_call
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator

from torchrl_loco.policy import ObservationNorm, layers_of
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network, log_slope, make_actor, network_of
from torchrl_loco.training.adam import ALIGNED
from torchrl_loco.training.algorithm import Acting, Algorithm, clip_and_step
from torchrl_loco.training.config import PPOConfig
from torchrl_loco.training.kernels import clipped_loss, drawn, normalised
from torchrl_loco.training.spaces import Spaces

LR_RANGE = (1e-5, 1e-2)
"""Of a learning rate that follows the divergence."""


class PPO(Algorithm):
    """Generalised advantage estimates, then epochs of minibatches over the clipped loss.

    Networks compute in bfloat16 on CUDA if the settings ask for that, with weights that are rounded as one vector.
    """

    config_type = PPOConfig
    metric_names = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "grad_norm")
    config: PPOConfig

    def __init__(self, config: PPOConfig, spaces: Spaces, network: Network | None = None) -> None:
        super().__init__(config, spaces, network)
        self.actor, self.critic, self.norms = make_actor_critic(config, spaces, network)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic})
        parts: Any = self.actor[0].module, self.critic.module
        (_, mean, self._scale), (_, value) = parts
        self._mean, self._value = Rows(mean, spaces.observation), Rows(value, spaces.critic)
        self._dtype = torch.bfloat16 if config.bf16 and self.device.type == "cuda" else torch.float32
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = self.make_optimizer("actor and critic", parameters)
        self._stream = torch.cuda.Stream(self.device) if self.device.type == "cuda" else None
        # By which a gradient step multiplies the learning rate, between these divergences.
        self._kl_bounds = torch.tensor([0.0, 0.5 * config.target_kl, 2.0 * config.target_kl], device=self.device)
        self._lr_factors = torch.tensor([1.0, 1.5, 1.0, 1 / 1.5], device=self.device)

    def _normalised(self, td: TensorDictBase) -> dict[str, torch.Tensor]:
        """Returns normalised observations, with zeros up to the length of the rows of weights."""
        return {key: normalised(td[key], norm, self._dtype, ALIGNED) for key, norm in self.norms.items()}

    def _std(self) -> torch.Tensor:
        """Returns the standard deviations of actions, the same in all states, shape ``(nu,)``."""
        return self._scale(torch.zeros(self.spaces.action, device=self.device))[1]

    def acting(self) -> nn.Module:
        """Returns the actor as a policy for collectors, with networks that compute as in gradient steps."""
        written = ("action", "action_log_prob", *("before_tanh",) * self.spaces.bounded)
        return Acting(self.actor, self.act, written)

    @torch.no_grad()
    def act(self, td: TensorDictBase) -> TensorDictBase:
        """Returns ``td`` with actions and their log-probabilities; with what they were before tanh, if bounded."""
        rows = normalised(td["observation"], self.norms["observation"], self._dtype, ALIGNED)
        rows = rows.view(-1, rows.shape[-1])
        explores = exploration_type() in (ExplorationType.RANDOM, None)
        noise = (torch.randn if explores else torch.zeros)(len(rows), self.spaces.action, device=self.device)
        mean = self._mean(rows, self.optimizer.wide(self._dtype))
        values = drawn(mean, self._std(), noise, self.spaces.bounded)
        names = "action", "action_log_prob", *("before_tanh",) * self.spaces.bounded
        for name, value in zip(names, values, strict=True):
            td[name] = value.view((*td.batch_size, *value.shape[1:]))
        return td

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns what the loss reads, of shape ``(num_envs, num_steps)``, with advantages and value targets."""
        key, after = self.spaces.critic_key, batch["next"]
        now, weights = self._normalised(batch), self.optimizer.wide(self._dtype)
        value, later = (self._value(rows[key], weights).float() for rows in (now, self._normalised(after)))
        advantage, target = self._estimates(value, later, after)
        action, log_prob = batch["action"], batch["action_log_prob"]
        if self.spaces.bounded:  # densities before tanh, whose slope cancels in a ratio
            action = batch["before_tanh"]
            log_prob = log_prob + log_slope(action).sum(-1)
        read = {"action": action, "log_prob": log_prob, "advantage": advantage, "value_target": target}
        return TensorDict({**now, **read}, batch.batch_size)

    def _estimates(
        self, value: torch.Tensor, later: torch.Tensor, after: TensorDictBase
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns generalised advantage estimates and the critic's targets, of shape ``(num_envs, num_steps, 1)``.

        At a time limit the value of the true terminal observation is bootstrapped; termination ends the return.
        """
        config = self.config
        errors = config.reward_scale * after["reward"] + config.gamma * later * ~after["terminated"] - value
        decay = config.gamma * config.lmbda * ~after["done"]
        advantage, advantages = torch.zeros_like(errors[:, 0]), []
        for error, factor in zip(reversed(errors.unbind(1)), reversed(decay.unbind(1)), strict=True):
            advantage = torch.addcmul(error, factor, advantage)
            advantages.append(advantage)
        whole = torch.stack(advantages[::-1], dim=1)
        return whole, whole + value

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[torch.Tensor]:
        """Returns the metrics, a scalar each, of a step down the clipped loss, the critic's and the entropy's."""
        config, weights = self.config, self.optimizer.wide(self._dtype)
        with self._beside():  # as are the slopes of what is computed there
            value = self._value(minibatch[self.spaces.critic_key], weights)
        outputs = self._mean(minibatch["observation"], weights), self._std(), value
        self._join()
        bounds = config.clip_epsilon, config.entropy_coeff, self.spaces.bounded
        *slopes, metrics = clipped_loss(*outputs, minibatch, *bounds)
        self.optimizer.zero_grad()
        torch.autograd.backward(outputs, slopes)
        if config.target_kl:
            self._follow(metrics[self.metric_names.index("kl_approx")])
        return [*metrics, clip_and_step(self.optimizer, config.max_grad_norm)]

    @contextlib.contextmanager
    def _beside(self) -> Iterator[None]:
        """Lets CUDA work on another stream, until :meth:`_join`: small networks leave most of it idle."""
        if self._stream is None:
            yield
        else:
            self._stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(self._stream):
                yield

    def _join(self) -> None:
        if self._stream is not None:
            torch.cuda.current_stream().wait_stream(self._stream)

    def schedule(self, progress: float) -> None:
        """Sets the learning rate, unless it follows the divergence."""
        if not self.config.target_kl:
            super().schedule(progress)

    def _follow(self, kl: torch.Tensor) -> None:
        """Lowers the learning rate where a step goes too far from the policy that collected, raises it where not far.

        A divergence that is not positive, as that of the first step of a batch, says nothing.
        """
        kl = distributed.mean_of_ranks(kl).nan_to_num(0.0)
        factor = self._lr_factors.take(torch.bucketize(kl, self._kl_bounds))
        for group in self.optimizer.param_groups:
            group["lr"].mul_(factor).clamp_(*LR_RANGE)


class Affine(torch.autograd.Function):
    """A linear layer whose bias gets its gradient from a product of matrices: torch's sums take three times as long."""

    @staticmethod
    def forward(ctx: Any, rows: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        """Returns what the layer gives, shape ``(..., outputs)``."""
        ctx.save_for_backward(rows, weight)
        return nn.functional.linear(rows, weight, bias)

    @staticmethod
    def backward(ctx: Any, slope: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Returns the slopes by rows, weight and bias."""
        (rows, weight), (by_rows, by_weight, by_bias) = ctx.saved_tensors, ctx.needs_input_grad
        of_bias = (slope.new_ones(1, len(slope)) @ slope)[0] if by_bias else None
        return slope @ weight if by_rows else None, slope.mT @ rows if by_weight else None, of_bias


class Rows:
    """A network as a function of rows that are longer than it reads, by zeros, with other weights than its own.

    Args:
        network: layers one after the other; any other, as a critic may be, computes as a whole.
        inputs: how many numbers of a row it reads.
    """

    def __init__(self, network: nn.Module, inputs: int) -> None:
        self._inputs, self._layers = inputs, [network]
        with contextlib.suppress(TypeError):
            layers = layers_of(network)
            rows = torch.linspace(-1.0, 1.0, 4 * inputs, device=next(network.parameters()).device).view(4, inputs)
            with torch.no_grad():  # a Sequential may have a forward of its own
                found, expected = nn.Sequential(*layers)(rows.clone()), network(rows.clone())
            self._layers = layers if torch.allclose(found, expected, rtol=1e-4, atol=1e-5) else self._layers

    def __call__(self, rows: torch.Tensor, weights: Mapping[nn.Parameter, torch.Tensor]) -> torch.Tensor:
        """Returns what it gives for ``rows``, shape ``(..., outputs)``.

        Args:
            rows: of at least as many numbers as it reads.
            weights: what takes the place of each parameter; of matrices, rows may be longer as well.
        """
        for index, layer in enumerate(self._layers):
            reads_long = index == 0 and isinstance(layer, nn.Linear)
            if index == 0 and not reads_long:
                rows = rows[..., : self._inputs].clone()  # an activation may write in place
            own = {
                name: whole if reads_long or whole.shape == part.shape else whole[..., : part.shape[-1]]
                for name, part in layer.named_parameters()
                for whole in (weights[part],)
            }
            if isinstance(layer, nn.Linear):
                rows = Affine.apply(rows, own["weight"], own.get("bias"))
            else:
                rows = functional_call(layer, own, (rows,))
        return rows


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
    whole = nn.Sequential(norms["observation"], mean, scale)
    actor = make_actor(spaces, config.device, whole, log_prob=True)
    if spaces.privileged is not None:
        norms["privileged"] = ObservationNorm(spaces.privileged)
    critic = ValueOperator(nn.Sequential(norms[spaces.critic_key], make(spaces.critic, 1)), in_keys=[spaces.critic_key])
    return actor, critic.to(config.device), norms
