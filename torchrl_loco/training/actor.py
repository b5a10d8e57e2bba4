"""The actor that all algorithms share: what it reads, a Gaussian on raw observations, and the policy it becomes."""

import copy
import dataclasses
import inspect
import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict.nn import AddStateIndependentNormalScale, NormalParamExtractor, TensorDictModule
from torch import nn
from torch.distributions import AffineTransform, Independent, Normal, TransformedDistribution
from torch.nn.functional import softplus
from torchrl.data import Bounded, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.modules.distributions.continuous import SafeTanhTransform

from torchrl_loco.policy import Policy, copied, difference, layers_of, random_observations
from torchrl_loco.training.config import TrainingConfig

Network = Callable[[int, int], nn.Module]  # makes a network of so many inputs and so many outputs

TOLERANCE = 1e-4
"""Largest difference of an action of a saved policy from the actor's, as a fraction of those above 1: rounding."""


@dataclasses.dataclass(frozen=True)
class Spaces:
    """The sizes of what actor and critic read, and of an action.

    The actor reads ``pixels`` where an environment has them, else ``observation``. The critic reads ``privileged``
    where an environment has it, else ``observation``; pixels only where there is neither, or if it is told to.
    """

    observation: int
    """Length of an observation; 0 if there is none."""
    action: int
    """Length of an action."""
    privileged: int | None = None
    """Length of what the critic alone reads; ``None`` where it reads the observation."""
    bounded: bool = True
    """Whether actions are bounded by [-1, 1]; else they are any numbers."""
    pixels: tuple[int, ...] | None = None
    """Height, width and channels of what the actor sees."""
    critic_sees: bool = False
    """Whether the critic reads pixels too."""

    @property
    def actor_key(self) -> str:
        """The entry that the actor reads."""
        return "observation" if self.pixels is None else "pixels"

    @property
    def critic_key(self) -> str:
        """The entry that the critic reads."""
        if self.critic_sees:
            return "pixels"
        return "observation" if self.privileged is None else "privileged"

    @property
    def rows(self) -> dict[str, int]:
        """Lengths of the rows of numbers that are read, by entry."""
        sizes = {"observation": self.observation, "privileged": self.privileged or 0}
        return {key: sizes[key] for key in dict.fromkeys((self.actor_key, self.critic_key)) if key in sizes}

    @property
    def critic(self) -> int:
        """Length of what the critic reads."""
        return self.observation if self.privileged is None else self.privileged

    @classmethod
    def of(cls, env: EnvBase, critic_sees: bool = False) -> "Spaces":
        """Returns those of an environment, of any batch size.

        Args:
            env: the environment.
            critic_sees: whether the critic is to read pixels too.

        Raises:
            ValueError: it has neither a flat observation nor pixels, or its actions are neither bounded by [-1, 1] nor
                unbounded.
        """
        spec = env.observation_spec
        if not env.action_spec.shape[-1]:
            raise ValueError("the model has no actuators: there is nothing to train")
        sizes = {}
        for key in ("observation", "privileged"):
            if key not in spec.keys():  # noqa: SIM118
                continue
            shape, dtype = spec[key].shape[len(env.batch_size) :], spec[key].dtype
            if dtype != torch.float32:
                raise ValueError(
                    f"{key!r} must be torch.float32 to train on, but is {dtype}: leave transforms out that change it, "
                    "or cast it back with torchrl.envs.DTypeCastTransform"
                )
            if len(shape) != 1:
                raise ValueError(
                    f"{key!r} must be a row of numbers for each world to train on, but has shape {tuple(shape)}: "
                    "flatten it, for example with torchrl.envs.FlattenObservation"
                )
            sizes[key] = shape[0]
        pixels: tuple[int, ...] | None = None
        if "pixels" in spec.keys():  # noqa: SIM118
            pixels, dtype = tuple(spec["pixels"].shape[len(env.batch_size) :]), spec["pixels"].dtype
            if dtype != torch.uint8 or len(pixels) != 3 or pixels[-1] % 3:
                raise ValueError(
                    "'pixels' to train on must be uint8 of shape (height, width, 3 * pictures), as frame_stack makes "
                    f"them, but are {dtype} of shape {pixels}: leave transforms of pixels out"
                )
        if "observation" not in sizes and pixels is None:
            raise ValueError(f"the environment must have an 'observation' to train on, it has {', '.join(spec.keys())}")
        low, high = env.action_spec.space.low, env.action_spec.space.high
        largest = torch.finfo(low.dtype).max  # which TorchRL has for infinity
        bounded = not ((low <= -largest).all() and (high >= largest).all())
        if bounded and not ((low == -1.0).all() and (high == 1.0).all()):
            raise ValueError("actions must be bounded by [-1, 1], or by nothing: set action_range in the class")
        sees = pixels is not None and (critic_sees or not sizes)
        return cls(
            sizes.get("observation", 0), env.action_spec.shape[-1], sizes.get("privileged"), bounded, pixels, sees
        )


class SquashedNormal(TransformedDistribution):
    """Independent normal variables under tanh, times a bound.

    TorchRL's ``TanhNormal`` is the same, but reads its bounds at every construction: on CUDA the host would wait for
    that at every step, and gradient steps could not be recorded. Means and standard deviations are those before tanh.
    """

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor, bound: float = 1.0) -> None:
        normal = Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)
        wider = [] if bound == 1.0 else [AffineTransform(0.0, bound)]
        super().__init__(normal, [SafeTanhTransform(cache_size=1), *wider], validate_args=False)
        self.bound = bound

    @property
    def deterministic_sample(self) -> torch.Tensor:
        """The image of the mean, shape ``(..., n)``."""
        return self.bound * self.base_dist.mean.tanh()


def log_slope(u: torch.Tensor) -> torch.Tensor:
    """Returns log(1 - tanh(u)^2), exact for large u too, of any shape ``(...)``."""
    return 2.0 * (math.log(2.0) - u - softplus(-2.0 * u))


def network_of(make: Network, inputs: int, outputs: int) -> nn.Module:
    """Returns the network that a function of a user makes."""
    wanted = "a function of the numbers of inputs and outputs that returns an nn.Sequential"
    if isinstance(make, nn.Module) or not callable(make):
        raise TypeError(f"network must be {wanted}, got {type(make).__name__}")
    try:
        inspect.signature(make).bind(inputs, outputs)
    except TypeError as error:
        raise TypeError(f"network must be {wanted}, but cannot be called with two numbers: {error}") from None
    network = make(inputs, outputs)
    if not isinstance(network, nn.Module):
        raise TypeError(f"network must be {wanted}, but returned {type(network).__name__}")
    device = next((parameter.device for parameter in network.parameters()), None)
    try:
        with torch.no_grad():
            shape = tuple(network(torch.zeros(2, inputs, device=device)).shape)
    except RuntimeError as error:
        raise ValueError(f"network({inputs}, {outputs}) must take rows of {inputs} numbers: {error}") from error
    if shape != (2, outputs):
        raise ValueError(f"network({inputs}, {outputs}) must give {outputs} numbers for each row, but gave {shape[1:]}")
    return network


def normed_layers(inputs: int, hidden: Iterable[int]) -> list[nn.Module]:
    """Returns layers of the given widths, each with layer norm and SiLU."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.LayerNorm(width), nn.SiLU()]
        inputs = width
    return layers


def make_actor(
    spaces: Spaces, device: torch.device | str, network: nn.Module, log_prob: bool, bound: float | None = None
) -> ProbabilisticActor:
    """Returns a Gaussian actor around a network that gives means and standard deviations, under tanh if it is bounded.

    It reads ``observation`` or ``pixels``, and writes ``loc``, ``scale``, ``action`` and, if asked to,
    ``action_log_prob``. Actions that the environment does not bound have ``bound``, if there is one.
    """
    shape = (spaces.action,)
    if spaces.bounded:
        bound = 1.0
    spec = Unbounded(shape, device=device) if bound is None else Bounded(-bound, bound, shape, device=device)
    # Checks of arguments would wait for the device.
    settings = {"validate_args": False} if bound is None else {"bound": bound}
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=[spaces.actor_key], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=IndependentNormal if bound is None else SquashedNormal,
        distribution_kwargs=settings,
        return_log_prob=log_prob,
    ).to(device)


def deterministic_policy(actor: ProbabilisticActor, config: TrainingConfig, info: dict[str, Any]) -> Policy:
    """Returns the policy that takes the mode of an actor's distribution, without the parts that only training needs.

    Its info holds the settings of the training, and ``info`` on top.
    """
    *layers, last = map(copied, layers_of_actor(actor))
    if not any(isinstance(part, AddStateIndependentNormalScale) for part in actor[0].module):
        last = _first_half(last)
    squashed = _squashed(actor[-1].distribution_kwargs.get("bound"), last)
    elsewhere = ("out", "device", "logger", "init")
    settings = {name: value for name, value in dataclasses.asdict(config).items() if name not in elsewhere}
    policy = Policy(nn.Sequential(*layers, last, *squashed), {"algorithm": config.algorithm, **settings, **info})
    _check_that_they_agree(policy, actor)
    return policy


def layers_of_actor(actor: ProbabilisticActor) -> list[nn.Module]:
    """Returns the layers of an actor's network, without what makes a distribution of what the last one gives."""
    of_scale = (AddStateIndependentNormalScale, NormalParamExtractor)
    return [layer for part in actor[0].module if not isinstance(part, of_scale) for layer in layers_of(part)]


def _squashed(bound: float | None, last: Any) -> list[nn.Module]:
    """Returns the layers of :class:`SquashedNormal`: a tanh, and what multiplies by the bound; none without a bound."""
    if bound is None:
        return []
    if bound == 1.0:
        return [nn.Tanh()]
    size, weight = last.out_features, last.weight
    wider = nn.utils.skip_init(nn.Linear, size, size, bias=False, device=weight.device)
    wider.load_state_dict({"weight": bound * torch.eye(size)})
    return [nn.Tanh(), wider]


def _first_half(last: nn.Module) -> nn.Module:
    """Returns the layer that gives the first half of what a last layer gives: the means."""
    if not isinstance(last, nn.Linear):
        raise TypeError(
            f"the network must end in a Linear that gives means and deviations, not in {type(last).__name__}"
        )
    half = last.out_features // 2
    # Initialising it would draw from the generator that training draws from.
    head = nn.utils.skip_init(nn.Linear, last.in_features, half, bias=last.bias is not None)
    head.load_state_dict({name: value[:half] for name, value in last.state_dict().items()})
    return head.to(last.weight.device)


@torch.no_grad()
def _check_that_they_agree(policy: Policy, actor: ProbabilisticActor) -> None:
    """Compares a policy with the actor that it was made of, on the CPU and on random observations."""
    observation = random_observations(policy.module, 64, 2.0)
    network, last = copy.deepcopy(actor[0].module).cpu(), actor[-1]  # as a module it would import pandas
    expected = last.distribution_class(*network(observation), **last.distribution_kwargs).deterministic_sample
    error = difference(copy.deepcopy(policy.module).cpu()(observation), expected)
    if not error <= TOLERANCE:  # true for NaN too
        raise RuntimeError(
            f"the policy would act differently from the actor that was trained, by up to {error:.2g}: a Sequential in "
            "its network computes something else than its layers one after the other"
        )
