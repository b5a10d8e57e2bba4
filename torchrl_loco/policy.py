"""Trained policies, in files that hold tensors and settings but no code."""

from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_loco import storage
from torchrl_loco.checks import check_choice, check_device
from torchrl_loco.config import PROTOCOLS
from torchrl_loco.registry import canonical_id

SHIPPED = Path(__file__).parent / "policies"
"""Has a folder for each protocol."""


class ObservationNorm(nn.Module):
    """Normalises observations by the running mean and variance of all that :meth:`update` was given.

    Args:
        size: length of an observation.
        limit: bound of the result; values beyond are clipped.
    """

    mean: torch.Tensor
    var: torch.Tensor
    count: torch.Tensor

    def __init__(self, size: int, limit: float = 10.0) -> None:
        super().__init__()
        self.limit = limit
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("var", torch.ones(size))
        self.register_buffer("count", torch.zeros(()))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Returns observations of shape ``(..., size)``, normalised.

        Raises:
            ValueError: they have another size.
        """
        if observation.shape[-1] != len(self.mean):
            raise ValueError(
                f"this policy takes observations of size {len(self.mean)}, got size {observation.shape[-1]}: was it "
                "trained for another body?"
            )
        return ((observation - self.mean) * torch.rsqrt(self.var + 1e-6)).clamp(-self.limit, self.limit)

    def update(self, observation: torch.Tensor) -> None:
        """Updates mean and variance with observations of shape ``(..., size)``."""
        self.merge(*moments(observation))

    @torch.no_grad()
    def merge(self, count: float | torch.Tensor, mean: torch.Tensor, var: torch.Tensor) -> None:
        """Updates mean and variance with those of further observations (Chan's parallel formula).

        Args:
            count: number of the observations.
            mean: their mean, shape ``(size,)``.
            var: their variance, without Bessel's correction, shape ``(size,)``.
        """
        total = self.count + count
        share = count / total
        delta = mean - self.mean
        self.var.lerp_(var, share).add_(delta.square() * share * (1 - share))
        self.mean.add_(delta * share)
        self.count.copy_(total)


@torch.no_grad()
def moments(observation: torch.Tensor) -> tuple[int, torch.Tensor, torch.Tensor]:
    """Returns the number of observations of shape ``(..., size)``, their mean and variance, each ``(size,)``."""
    batch = observation.flatten(0, -2)
    var, mean = torch.var_mean(batch, dim=0, correction=0)
    return len(batch), mean, var


class Policy(TensorDictModule):
    """A deterministic policy: reads ``observation``, shape ``(..., n)``, and writes ``action`` in [-1, 1].

    Args:
        network: a :class:`~torchrl_loco.policy.ObservationNorm`, then linear layers, layer norms and SiLUs, then a
            tanh.
        info: ``task``, ``protocol``, ``action_repeat``, and further information such as the return.
    """

    def __init__(self, network: nn.Sequential, info: dict[str, Any]) -> None:
        super().__init__(network, in_keys=["observation"], out_keys=["action"])
        self.info = info

    def save(self, path: Path) -> None:
        """Writes the policy to ``path`` in half precision, which changes an action by some thousandths at most."""
        layers = [_LAYER_NAMES[type(layer)] for layer in self.module]
        tensors = {  # half precision has too small a range for the observation's statistics
            name: tensor.to(torch.float32 if name.startswith("0.") else torch.float16)
            for name, tensor in self.module.state_dict().items()
        }
        storage.save(path, "policy", tensors, {"layers": layers, "info": self.info})

    @classmethod
    def load(cls, path: Path, device: torch.device | str | None = None) -> "Policy":
        """Reads a policy without executing code.

        Args:
            path: a file that :meth:`save` wrote.
            device: where it computes; ``None`` takes CUDA if there is any.

        Returns:
            The policy, without gradients.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is no policy, damaged, or of another version.
        """
        device = check_device(device)
        tensors, settings = storage.load(path, "policy")
        tensors = {name: tensor.float() for name, tensor in tensors.items()}
        try:
            names = settings["layers"]
            sized = [tensors.get(f"{i}.weight", tensors.get(f"{i}.mean")) for i in range(len(names))]
            network = nn.Sequential(*map(_make_layer, names, sized))
            network.load_state_dict(tensors)
            info = settings["info"]
        except (ValueError, KeyError, RuntimeError) as error:
            raise ValueError(f"{path} cannot be read as a policy: {error}") from error
        return cls(network.to(device).requires_grad_(False), info)


_LAYER_NAMES: dict[type[nn.Module], str] = {
    ObservationNorm: "observation_norm",
    nn.Linear: "linear",
    nn.LayerNorm: "layer_norm",
    nn.SiLU: "silu",
    nn.Tanh: "tanh",
}


def _make_layer(name: str, sized: torch.Tensor | None) -> nn.Module:
    """Returns the layer of a name, with the size of its tensor.

    Raises:
        ValueError: there is no such layer, or it needs a tensor.
    """
    if name == "silu":
        return nn.SiLU()
    if name == "tanh":
        return nn.Tanh()
    if sized is None:
        raise ValueError(f"layer {name!r} has no tensors")
    if name == "observation_norm":
        return ObservationNorm(len(sized))
    if name == "layer_norm":
        return nn.LayerNorm(len(sized))
    if name == "linear":
        return nn.Linear(sized.shape[1], sized.shape[0])
    raise ValueError(f"unknown layer {name!r}")


def load_policy(task: str, device: torch.device | str | None = None, protocol: str = "playground") -> Policy:
    """Loads the trained policy of a task that is shipped with the package.

    Args:
        task: id of the environment.
        device: where it computes; ``None`` takes CUDA if there is any.
        protocol: what it was trained under, "playground" or "dm_control".

    Returns:
        The policy. ``policy.info`` holds its return, protocol, frames, wall time, seed and settings. Hold each of
        its actions for ``policy.info["action_repeat"]`` control steps.

    Raises:
        ValueError: there is no such task or protocol, or no policy for them.
    """
    if str(task).endswith(".safetensors"):
        raise ValueError(f"load_policy takes the id of a task; load a file with torchrl_loco.Policy.load({task!r})")
    name, shipped = canonical_id(task), shipped_policies(check_choice("protocol", protocol, PROTOCOLS))
    if name not in shipped:
        others = [f"protocol={other!r}" for other in PROTOCOLS if name in shipped_policies(other)]
        raise ValueError(
            f"no policy for {name!r} under protocol {protocol!r} is shipped with this release: choose one of "
            f"{', '.join([*shipped, *others])}, or train one"
        )
    return Policy.load(shipped[name], device)


def shipped_policies(protocol: str) -> dict[str, Path]:
    """Returns the files of the policies that are shipped for a protocol, by task."""
    return {path.stem: path for path in sorted((SHIPPED / protocol).glob("*.safetensors"))}
