"""The actor that all algorithms share: a squashed Gaussian on raw observations, and the policy it becomes."""

import copy
import dataclasses
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Independent, Normal, TransformedDistribution
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor
from torchrl.modules.distributions.continuous import SafeTanhTransform

from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.training.config import TrainingConfig


class SquashedNormal(TransformedDistribution):
    """Independent normal variables under tanh.

    TorchRL's ``TanhNormal`` is the same, but reads its bounds at every construction: on CUDA the host would wait for
    that at every step, and gradient steps could not be recorded.

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
    """Returns a tanh-normal actor around a network that gives means and standard deviations.

    It reads ``observation`` and writes ``loc``, ``scale``, ``action`` and, if asked to, ``action_log_prob``.
    """
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=Bounded(-1.0, 1.0, (config.action_size,), device=config.device, dtype=torch.float32),
        distribution_class=SquashedNormal,
        return_log_prob=log_prob,
    ).to(config.device)


def deterministic_policy(actor: ProbabilisticActor, config: TrainingConfig, info: dict[str, Any]) -> Policy:
    """Returns the policy that takes the mode of an actor's distribution, without the parts that only training needs.

    Its info holds the settings of the training, and ``info`` on top.
    """
    kinds = (ObservationNorm, nn.Linear, nn.LayerNorm, nn.SiLU)
    *layers, last = (copy.deepcopy(module) for module in actor.modules() if isinstance(module, kinds))
    # The mean's rows of the last layer; initialising it would draw from the generator that training draws from.
    head = nn.utils.skip_init(nn.Linear, config.hidden[-1], config.action_size)
    head.load_state_dict({name: value[: config.action_size] for name, value in last.state_dict().items()})
    settings = {
        name: value for name, value in dataclasses.asdict(config).items() if name not in ("out", "device", "logger")
    }
    network = nn.Sequential(*layers, head.to(config.device), nn.Tanh())
    return Policy(network, {"algorithm": config.algorithm, **settings, **info})
