"""Proximal policy optimization (Schulman et al., 2017)."""

import functools
import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
import warp as wp
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP, ValueOperator

from torchrl_loco.encoder import PixelEncoder
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network, Spaces, log_slope, make_actor, network_of
from torchrl_loco.training.adam import LARGE, SMALL, launch
from torchrl_loco.training.algorithm import Acting, Algorithm, choose, clip_and_step
from torchrl_loco.training.config import PPOConfig, TrainingConfig
from torchrl_loco.training.rows import Rows, normalise_of, normalised, start_triton, triton_kernels

LOWEST_LR, HIGHEST_LR = wp.constant(1e-5), wp.constant(1e-2)  # of a learning rate that follows the divergence
HALF_LOG_2_PI = wp.constant(0.5 * math.log(2.0 * math.pi))
LOG_2 = wp.constant(math.log(2.0))
CRITIC_COEFF = 0.5
METRICS = 5  # numbers of a step whose means are metrics; the slopes of the deviations follow them


class PPO(Algorithm):
    """Generalised advantage estimates, then epochs of minibatches over the clipped loss.

    Networks compute in bfloat16 on CUDA if the settings ask for that, with weights that are rounded as one vector.
    """

    config_type = PPOConfig
    metric_names = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "grad_norm")
    config: PPOConfig

    def __init__(self, config: PPOConfig, spaces: Spaces, network: Network | None = None) -> None:
        super().__init__(config, spaces, network)

        def make(inputs: int, outputs: int) -> nn.Module:
            if network is not None:
                return network_of(network, inputs, outputs)
            return MLP(inputs, outputs, num_cells=list(config.hidden), activation_class=nn.SiLU)

        def after_first(key: str, outputs: int) -> tuple[nn.Module, Any]:
            """Returns what makes features of an entry, a norm or an encoder, and a network of these."""
            if key in self.norms:
                return self.norms[key], make(spaces.rows[key], outputs)
            assert spaces.pixels is not None
            encoder = PixelEncoder(spaces.pixels, strides=config.strides)
            return encoder, make(encoder.features, outputs)

        first, mean = after_first(spaces.actor_key, spaces.action)
        if network is None:
            nn.init.orthogonal_(mean[-1].weight, gain=0.01)  # the first actions are near zero, whatever is observed
        self._scale = AddStateIndependentNormalScale(spaces.action, init_value=math.log(config.init_std))
        self.actor = make_actor(spaces, config.device, nn.Sequential(first, mean, self._scale), log_prob=True)
        of_critic, value = after_first(spaces.critic_key, 1)
        whole = nn.Sequential(of_critic, value)
        self.critic = ValueOperator(whole, in_keys=[spaces.critic_key]).to(config.device)
        self.networks = nn.ModuleDict({"actor": self.actor, "critic": self.critic})
        self._dtype = torch.bfloat16 if config.bf16 and self.device.type == "cuda" else torch.float32
        self._mean, self._value = (
            Rows(net, part if isinstance(part, PixelEncoder) else spaces.rows[key], self._dtype)
            for net, part, key in ((mean, first, spaces.actor_key), (value, of_critic, spaces.critic_key))
        )
        if {*mean.parameters()} & {*value.parameters()}:  # kernels would write both networks' slopes to one place
            self._mean.in_triton = self._value.in_triton = False
        self.optimizer = self.make_optimizer("actor and critic", self.networks.parameters())  # each once
        self._compile()
        self._written = ("action", "action_log_prob", *("before_tanh",) * spaces.bounded)

    @classmethod
    def start_compilers(cls, config: TrainingConfig) -> None:
        """Starts Triton, which computes networks in bfloat16."""
        super().start_compilers(config)
        if config.bf16 and not config.from_pixels:
            start_triton(torch.device(config.device))

    def _compile(self) -> None:
        """Compiles its kernels all at once, instead of each where it is first launched."""
        action = self.spaces.action, self.spaces.bounded, self._dtype
        small = draw_of(*action), loss_of(*action), follow
        large = normalise_of(self._dtype), choose
        self.optimizer.compile_with([*((kernel, LARGE) for kernel in large), *((kernel, SMALL) for kernel in small)])
        if fast := [rows for rows in (self._mean, self._value) if rows.in_triton]:
            mlp, weights = triton_kernels("mlp"), self.optimizer.wide(self._dtype)
            parts = self.optimizer.parts(mlp.PARTS).detach()
            mlp.compile_ahead([rows.own(weights) for rows in fast], self.config.minibatch_size, parts)

    def _read(self, td: TensorDictBase, key: str) -> Tensor:
        """Returns pixels as they are; other entries normalised, with zeros up to the length of the rows of weights."""
        return normalised(td[key], self.norms[key], self._dtype) if key in self.norms else td[key]

    def _std(self) -> Tensor:
        """Returns the standard deviations of actions, the same in all states, shape ``(nu,)``."""
        return self._scale(torch.zeros(self.spaces.action, device=self.device))[1]

    def acting(self) -> nn.Module:
        """Returns the actor as a policy for collectors, with networks that compute as in gradient steps."""
        return Acting(self.actor, self.act, self._written)

    @torch.no_grad()
    def act(self, td: TensorDictBase) -> TensorDictBase:
        """Returns ``td`` with actions and their log-probabilities; with what they were before tanh, if bounded."""
        rows = self._read(td, self.spaces.actor_key)
        rows = rows.reshape(-1, *rows.shape[td.ndim :])
        explores = exploration_type() is ExplorationType.RANDOM
        noise = (torch.randn if explores else torch.zeros)(len(rows), self.spaces.action, device=self.device)
        mean = self._mean(rows, self.optimizer.wide(self._dtype))
        values = drawn(mean, self._std(), noise, self.spaces.bounded)
        for name, value in zip(self._written, values, strict=True):
            td[name] = value.view((*td.batch_size, *value.shape[1:]))
        return td

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Returns what the loss reads, of shape ``(num_envs, num_steps)``, with advantages and value targets."""
        key, after, weights = self.spaces.critic_key, batch["next"], self.optimizer.wide(self._dtype)
        now = {name: self._read(batch, name) for name in dict.fromkeys((self.spaces.actor_key, key))}
        value, later = (self._values(rows, weights) for rows in (now[key], self._read(after, key)))
        advantage, target = self._estimates(value, later, after)
        action, log_prob = batch["action"], batch["action_log_prob"]
        if self.spaces.bounded:  # densities before tanh, whose slope cancels in a ratio
            action = batch["before_tanh"]
            log_prob = log_prob + log_slope(action).sum(-1)
        read = {"action": action, "log_prob": log_prob, "advantage": advantage, "value_target": target}
        return TensorDict({**now, **read}, batch.batch_size)

    def _values(self, rows: Tensor, weights: Mapping[nn.Parameter, Tensor]) -> Tensor:
        """Returns what the critic expects of a batch, ``(num_envs, num_steps, 1)``."""
        if not self.spaces.critic_sees:
            return self._value(rows, weights).float()
        # Step by step: a whole batch would fill the memory with what convolutions give.
        return torch.stack([self._value(step, weights).float() for step in rows.unbind(1)], dim=1)

    def _estimates(self, value: Tensor, later: Tensor, after: TensorDictBase) -> tuple[Tensor, Tensor]:
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

    def gradient_step(self, minibatch: TensorDictBase) -> Iterable[Tensor]:
        """Returns the metrics, a scalar each, of a step down the clipped loss, the critic's and the entropy's."""
        config, weights, parts = self.config, self.optimizer.wide(self._dtype), self.optimizer.parts
        self.optimizer.zero_grad()
        with self.beside():  # as are the slopes of what is computed there
            value = self._value(minibatch[self.spaces.critic_key], weights, parts)
        outputs = self._mean(self.observed(minibatch), weights, parts), self._std(), value
        self.join()
        *slopes, metrics = clipped_loss(*outputs, minibatch, config, self.spaces.bounded)
        learning = [pair for pair in zip(outputs, slopes, strict=True) if pair[0].requires_grad]
        torch.autograd.backward([output for output, _ in learning], [slope for _, slope in learning])
        self.join()  # autograd waits only for gradients that it adds up itself
        if config.target_kl:
            self._follow(metrics[self.metric_names.index("kl_approx")])
        return [*metrics, clip_and_step(self.optimizer, config.max_grad_norm)]

    def minibatches(self, steps: TensorDictBase) -> Iterable[TensorDictBase]:
        """Returns minibatches whose advantages have mean 0 and standard deviation 1."""
        standardise(steps["advantage"].view(-1, self.config.minibatch_size))
        return super().minibatches(steps)

    def schedule(self, progress: float) -> None:
        """Sets the learning rate, unless it follows the divergence."""
        if not self.config.target_kl:
            super().schedule(progress)

    def _follow(self, kl: Tensor) -> None:
        """Lowers the learning rate where a step goes too far from the policy that collected, raises it where not far.

        A divergence that is not positive, as that of the first step of a batch, says nothing.
        """
        kl = distributed.mean_of_ranks(kl)
        for group in self.optimizer.param_groups:
            launch(follow, 1, [kl.view(1), self.config.target_kl], [group["lr"].view(1)])


# What is computed of each number, in one kernel each: torch would launch five to a hundred for it. torch.compile fuses
# them as well, but takes half a minute for that at a first start.


@wp.kernel(enable_backward=False)
def follow(kl: wp.array[float], target: float, lr: wp.array[float]):
    factor = float(1.0)
    if kl[0] > 0.0 and kl[0] <= 0.5 * target:
        factor = 1.5
    if kl[0] > 2.0 * target:
        factor = 1.0 / 1.5
    lr[0] = wp.clamp(lr[0] * factor, LOWEST_LR, HIGHEST_LR)


@wp.func
def log_slope_of(u: float) -> float:
    """Of tanh, exact for large u too."""
    softplus = wp.max(-2.0 * u, 0.0) + wp.log(1.0 + wp.exp(-2.0 * wp.abs(u)))
    return 2.0 * (LOG_2 - u - softplus)


@functools.cache
def draw_of(nu: int, bounded: bool, dtype: torch.dtype) -> wp.Kernel:
    """Returns the kernel that draws ``nu`` actions in each state."""
    Rows: Any = wp.array2d(dtype=wp.dtype_from_torch(dtype))  # noqa: N806

    @wp.kernel(enable_backward=False, module="unique")
    def draw(
        mean: Rows,
        std: wp.array[float],
        noise: wp.array2d[float],
        normal: wp.array2d[float],
        action: wp.array2d[float],
        log_prob: wp.array[float],
    ):
        row = wp.tid()
        total = float(0.0)
        for i in range(wp.static(nu)):
            e = noise[row, i]
            u = float(mean[row, i]) + std[i] * e
            total -= 0.5 * e * e + wp.log(std[i]) + HALF_LOG_2_PI
            normal[row, i] = u
            if wp.static(bounded):
                action[row, i] = wp.tanh(u)
                total -= log_slope_of(u)
        log_prob[row] = total

    return draw


@torch.no_grad()
def drawn(mean: Tensor, std: Tensor, noise: Tensor, bounded: bool) -> tuple[Tensor, ...]:
    """Returns actions and their log-probabilities; and if tanh bounds them, what they were before it.

    Means and standard normal noise have shape ``(n, nu)``, standard deviations ``(nu,)``.
    """
    normal, log_prob = torch.empty_like(noise), noise.new_empty(len(noise))
    action = torch.empty_like(noise) if bounded else normal
    launch(draw_of(noise.shape[1], bounded, mean.dtype), len(noise), [mean, std, noise], [normal, action, log_prob])
    return (action, log_prob, normal) if bounded else (action, log_prob)


def lanes_of(device: torch.device) -> int:
    """Returns how many threads add up what they have without memory between them: a warp, on the CPU one."""
    return 32 if device.type == "cuda" else 1


ADD_LANES = """
#ifdef __CUDA_ARCH__
#pragma unroll 1
for (int apart = 16; apart > 0; apart /= 2) {
  for (auto& number : values.c) number += __shfl_xor_sync(0xffffffffu, number, apart);
}
#endif
return values;
"""


@functools.cache
def adding(numbers: Any) -> wp.Function:
    """Returns the function that adds up vectors of all lanes, in an order that is always the same."""

    @wp.func_native(ADD_LANES)
    def add(values: numbers) -> numbers: ...

    return add


add_moments = adding(wp.vec2d)


@wp.kernel(enable_backward=False, grid_stride=False)
def moments_of_parts(numbers: wp.array2d[float], lanes: int, moments: wp.array3d[wp.float64]):
    row, thread = wp.tid()
    own = wp.vec2d()
    for first in range(thread, numbers.shape[1], 8 * lanes * lanes):
        for i in range(8):  # reads that do not wait for each other
            place = first + i * lanes * lanes
            read = numbers[row, wp.min(place, numbers.shape[1] - 1)]
            number = wp.float64(wp.where(place < numbers.shape[1], read, 0.0))
            own += wp.vec2d(number, number * number)
    total = add_moments(own)
    if thread % lanes == 0:
        moments[row, thread // lanes, 0] = total[0]
        moments[row, thread // lanes, 1] = total[1]


@wp.kernel(enable_backward=False, grid_stride=False)
def standardise_by(moments: wp.array3d[wp.float64], lanes: int, numbers: wp.array2d[float]):
    row, column = wp.tid()
    part = column % lanes
    total = add_moments(wp.vec2d(moments[row, part, 0], moments[row, part, 1]))
    if column < numbers.shape[1]:
        mean = total[0] / wp.float64(numbers.shape[1])
        var = float(total[1] - total[0] * mean) / float(wp.max(numbers.shape[1] - 1, 1))  # one has no deviation
        away = float(wp.float64(numbers[row, column]) - mean)
        numbers[row, column] = away / wp.max(wp.sqrt(var), 1.0e-6)


@torch.no_grad()
def standardise(numbers: Tensor) -> None:
    """Gives each row of ``(m, n)`` numbers mean 0 and standard deviation 1, in place.

    On CUDA a row has as many parts as there are lanes, whose threads read at once: torch's has one block of threads.
    Moments are sums of squares in double precision there, where a mean cancels less than single precision rounds.
    """
    if not numbers.is_cuda:  # where torch is quicker
        spread, center = torch.std_mean(numbers, 1, correction=min(1, numbers.shape[1] - 1), keepdim=True)
        numbers.sub_(center).div_(spread.clamp(min=1e-6))  # one has no deviation
        return
    (rows, count), lanes = numbers.shape, lanes_of(numbers.device)
    moments = numbers.new_empty(rows, lanes, 2, dtype=torch.float64)
    launch(moments_of_parts, (rows, lanes * lanes), [numbers, lanes], [moments])
    launch(standardise_by, (rows, -(-count // lanes) * lanes), [moments, lanes], [numbers])


@functools.cache
def loss_of(nu: int, bounded: bool, dtype: torch.dtype) -> wp.Kernel:
    """Returns the kernel of PPO's loss for ``nu`` actions.

    Lanes write a row of sums together; the mean of the rows is that of the steps. Loops over actions stay loops: a
    launch fetches each instruction anew, which takes longer than to execute it.
    """
    Rows: Any = wp.array2d(dtype=wp.dtype_from_torch(dtype))  # noqa: N806
    Actions, Sums = (wp.types.vector(size, float) for size in (nu, METRICS + nu))  # noqa: N806
    add = adding(Sums)

    @wp.kernel(enable_backward=False, module="unique")
    def loss(
        mean: Rows,
        std: wp.array[float],
        value: Rows,
        action: wp.array2d[float],
        old_log_prob: wp.array[float],
        advantage: wp.array[float],
        target: wp.array[float],
        noise: wp.array2d[float],
        lowest: float,
        highest: float,
        entropy_coeff: float,
        lanes: int,
        slope_mean: Rows,
        slope_value: Rows,
        sums: wp.array2d[float],
    ):
        thread = wp.tid()
        step = wp.min(thread, mean.shape[0] - 1)  # whoever comes after the last does the same, and adds nothing
        share = 1.0 / float(mean.shape[0])
        log_prob = float(0.0)
        entropy = float(0.0)
        zs = Actions()
        for i in range(mean.shape[1]):
            z = (action[step, i] - float(mean[step, i])) / std[i]
            zs[i] = z
            constant = wp.log(std[i]) + HALF_LOG_2_PI
            log_prob -= 0.5 * z * z + constant
            if wp.static(bounded):  # of one sample u under tanh
                e = noise[step, i]
                entropy += 0.5 * e * e + constant + log_slope_of(float(mean[step, i]) + std[i] * e)
            else:
                entropy += 0.5 + constant
        log_ratio = log_prob - old_log_prob[step]
        clipped = wp.clamp(log_ratio, lowest, highest)
        gain = wp.exp(log_ratio) * advantage[step]
        clipped_gain = wp.exp(clipped) * advantage[step]
        slope = -gain
        if gain > clipped_gain:  # what is not a number is followed, to be seen
            slope = 0.0
        error = float(value[step, 0]) - target[step]
        of_value = wp.clamp(error, -1.0, 1.0)
        if wp.isnan(error):
            of_value = error
        slope_value[step, 0] = slope_value.dtype(share * CRITIC_COEFF * of_value)
        own = Sums()
        own[0] = -wp.min(gain, clipped_gain)
        own[1] = CRITIC_COEFF * wp.where(wp.abs(error) < 1.0, 0.5 * error * error, wp.abs(error) - 0.5)
        own[2] = entropy
        own[3] = -log_ratio
        own[4] = wp.where(clipped == log_ratio, 0.0, 1.0)
        for i in range(mean.shape[1]):
            z = zs[i]
            by_mean = slope * z / std[i]
            by_std = (slope * (z * z - 1.0) - entropy_coeff) / std[i]
            if wp.static(bounded):
                e = noise[step, i]
                turn = 2.0 * entropy_coeff * wp.tanh(float(mean[step, i]) + std[i] * e)
                by_mean += turn
                by_std += turn * e
            slope_mean[step, i] = slope_mean.dtype(share * by_mean)
            own[METRICS + i] = by_std
        if thread > step:
            own = Sums()
        total = add(own)
        weight = float(sums.shape[0]) / float(mean.shape[0])
        for i in range(thread % lanes, sums.shape[1], lanes):
            sums[thread // lanes, i] = weight * total[i]

    return loss


@torch.no_grad()
def clipped_loss(
    mean: Tensor,
    std: Tensor,
    value: Tensor,
    data: Mapping[str, Tensor],
    config: PPOConfig,
    bounded: bool,
) -> tuple[Tensor, ...]:
    """Computes the slopes of PPO's loss: clipped objective, smooth L1 error of the critic and entropy bonus.

    It is the loss of TorchRL's ``ClipPPOLoss``. ``mean``, ``(n, nu)``, and ``std``, ``(nu,)`` in all states, are those
    of the actions, before tanh, if they are bounded by it: their entropy is that of one sample then. ``value`` is what
    the critic expects, ``(n, 1)``. ``data`` has of each step ``action``, before tanh too, ``(n, nu)``, ``log_prob`` of
    that when it was drawn, ``(n,)``, ``advantage``, normalised, and ``value_target``, ``(n, 1)``.

    Returns:
        The slopes by means, deviations and values, in their shapes; and of the metrics ``(5,)`` the means over the
        steps: the clipped objective's loss, the critic's, the entropy, the divergence from the policy that collected,
        and the fraction of steps whose ratio of probabilities is clipped.
    """
    steps, nu = mean.shape
    noise = torch.randn(mean.shape, device=mean.device) if bounded else std.new_empty(0, nu)
    numbers = [data[name].reshape(steps) for name in ("log_prob", "advantage", "value_target")]
    inputs = [mean, std, value, data["action"], *numbers, noise]
    rows = -(-steps // (lanes := lanes_of(mean.device)))
    slopes = torch.empty_like(mean), torch.empty_like(value), std.new_empty(rows, METRICS + nu)
    bounds = math.log1p(-config.clip_epsilon), math.log1p(config.clip_epsilon)
    launch(loss_of(nu, bounded, mean.dtype), rows * lanes, [*inputs, *bounds, config.entropy_coeff, lanes], slopes)
    means = slopes[2].mean(0)
    return slopes[0], means[METRICS:], slopes[1], means[:METRICS]
