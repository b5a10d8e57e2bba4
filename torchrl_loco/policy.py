"""Trained policies, in files that hold tensors and settings but no code."""

import copy
import inspect
import logging
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from torch import nn

from torchrl_loco import storage
from torchrl_loco.checks import check_choice, check_device, is_run
from torchrl_loco.config import PROTOCOLS
from torchrl_loco.encoder import PixelEncoder
from torchrl_loco.registry import canonical_id, resolve

SHIPPED = Path(__file__).parent / "policies"  # has a folder for each protocol


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
        self.check(observation)
        return ((observation - self.mean) * torch.rsqrt(self.var + 1e-6)).clamp(-self.limit, self.limit)

    def check(self, observation: torch.Tensor) -> None:
        """Checks the size of observations of shape ``(..., size)``."""
        if observation.shape[-1] != len(self.mean):
            raise ValueError(
                f"this policy takes observations of size {len(self.mean)}, got size {observation.shape[-1]}: was it "
                "trained for another body?"
            )

    def update(self, observation: torch.Tensor) -> None:
        """Updates mean and variance with observations of shape ``(..., size)``; nothing, if there are none."""
        if observation.numel():
            self.merge(*moments(observation))

    @torch.no_grad()
    def merge(self, count: float | torch.Tensor, mean: torch.Tensor, var: torch.Tensor) -> None:
        """Updates mean and variance (without Bessel's correction) with those of ``count`` rows (Chan's formula)."""
        total = self.count + count
        share = count / total
        delta = mean - self.mean
        self.var.lerp_(var, share).add_(delta.square() * share * (1 - share))
        self.mean.add_(delta * share)
        self.count.copy_(total)


@torch.no_grad()
def moments(observation: torch.Tensor) -> tuple[int, torch.Tensor, torch.Tensor]:
    """Returns the number of observations of shape ``(..., size)``, their mean and variance, each ``(size,)``."""
    batch = observation.reshape(-1, observation.shape[-1])
    var, mean = torch.var_mean(batch, dim=0, correction=0)
    return len(batch), mean, var


EARNED = ("mean", "std", "min", "max", "episodes", "selected_by")  # of a policy's info, in the task of its training


def in_task(info: Mapping[str, Any], trained: str, task: str) -> dict[str, Any]:
    """Returns what a policy's info says in a task: in another than that of its training not what it earned.

    Nor are there options of the training that the other task lacks.
    """
    here, there = (name.rpartition(":")[2].partition("~")[0] for name in (task, trained))
    if here == there or (cls := resolve(task)).__qualname__ == there:  # of an id, the class may have been named
        return {**info, "task": task}
    kept = {name: value for name, value in without_returns(info).items() if name != "source_hash"}
    options = {name: value for name, value in kept.pop("options", {}).items() if name in cls.options}
    return {**kept, "task": task, **({"options": options} if options else {})}


def without_returns(info: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what a policy's info says where its task is not that of its training any more: not what it earned."""
    return {name: value for name, value in info.items() if name not in EARNED}


def with_options(info: Mapping[str, Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what a policy's info says under other options of its task, such as motions: not what it earned."""
    return {**without_returns(info), "options": {**info.get("options", {}), **options}}


class Policy(TensorDictModule):
    """A deterministic policy: reads ``observation``, shape ``(..., n)``, and writes ``action``, shape ``(..., m)``.

    One whose network begins with a ``PixelEncoder`` reads ``pixels`` instead.

    Args:
        network: an :class:`~torchrl_loco.policy.ObservationNorm`, then linear layers, layer norms and activations; the
            last is a tanh where actions are bounded by [-1, 1]. ``layers_of`` says what a file can hold.
        info: ``task``, ``protocol``, ``action_repeat``, and further information such as the return.
    """

    reads_in_keys_alone = True  # so collectors need not zero the action where a world is reset

    def __init__(self, network: nn.Sequential, info: dict[str, Any]) -> None:
        reads = "pixels" if isinstance(network[0], PixelEncoder) else "observation"
        super().__init__(network, in_keys=[reads], out_keys=["action"])
        self.info = info

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase, *, tensordict_out: TensorDictBase | None = None) -> TensorDictBase:
        """Returns ``tensordict``, or ``tensordict_out``, with the action; given an observation, the action alone.

        tensordict's own method looks for pandas on the disk at each call, which takes as long as a small network, or
        imports it.
        """
        action = self.module(tensordict[self.in_keys[0]])
        return (tensordict if tensordict_out is None else tensordict_out).set("action", action)

    @property
    def is_bounded(self) -> bool:
        """Whether all actions lie in [-1, 1]: whether the last layer is a tanh."""
        return isinstance(self.module[-1], nn.Tanh)

    def save(self, path: Path, small: bool = False) -> None:
        """Writes the policy to a file.

        Args:
            path: where to.
            small: whether to store a linear layer's weights in 8 bits each, as shares of the largest of their row: a
                quarter of the size, for errors of 0.4 % of that at most. All else stays in single precision.

        Raises:
            TypeError: a layer is of a kind that a file cannot hold.
        """
        layers = layers_of(self.module)
        tensors: dict[str, torch.Tensor] = {}
        for i, layer in enumerate(layers):
            for name, tensor in layer.state_dict().items():
                rounded = small and isinstance(layer, nn.Linear) and name == "weight"
                tensors |= _in_8_bits(f"{i}.{name}", tensor) if rounded else {f"{i}.{name}": tensor.float()}
        storage.save(path, "policy", tensors, {"layers": [_description(layer) for layer in layers], "info": self.info})

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
        scales = {name: tensors.pop(name) for name in list(tensors) if name.endswith(SCALE)}
        tensors = {name: tensor.float() * scales.get(name + SCALE, 1.0) for name, tensor in tensors.items()}
        try:
            descriptions = settings["layers"]
            of_each: list[dict[str, torch.Tensor]] = [{} for _ in descriptions]
            for name, tensor in tensors.items():
                index, _, own = name.partition(".")
                of_each[int(index)][own] = tensor
            network = nn.Sequential(*map(_make_layer, descriptions, of_each))
            network.load_state_dict(tensors)
            info = settings["info"]
        except (ValueError, LookupError, TypeError, RuntimeError) as error:
            raise ValueError(f"{path} cannot be read as a policy: {error}") from error
        return cls(network.to(device).requires_grad_(False), info)


def check_terms(trained: Iterable[Sequence[Any]], now: Mapping[str, int], task: str) -> None:
    """Checks that a task observes in the order in which a policy was trained; other names are told in the log.

    Args:
        trained: names and sizes of the terms that the policy was trained on; none are known of older files.
        now: sizes of those of the task, by name.
        task: name of the task, for messages.

    Raises:
        ValueError: they come in another order.
    """
    before, own = [(str(name), int(size)) for name, size in trained], list(now.items())
    if not before or not own or before == own:
        return
    words = [", ".join(name for name, _ in terms) for terms in (before, own)]
    if sorted(before) == sorted(own):
        raise ValueError(f"the policy was trained on {words[0]}, {task} observes {words[1]}: another order")
    logging.getLogger("torchrl_loco").warning("the policy was trained on %s, %s observes %s", words[0], task, words[1])


SCALE = ".scale"  # what a file adds to the name of weights in 8 bits, for what to multiply them with


def _in_8_bits(name: str, weight: torch.Tensor) -> dict[str, torch.Tensor]:
    """Returns weights of shape ``(outputs, inputs)`` as integers from -127 to 127, and the scales ``(outputs, 1)``."""
    weight = weight.detach().float()
    scale = (weight.abs().amax(dim=1, keepdim=True) / 127).clamp(min=torch.finfo(torch.float32).tiny)
    return {name: (weight / scale).round().to(torch.int8), name + SCALE: scale}


KINDS: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "observation_norm": (ObservationNorm, ("limit",)),
    "pixel_encoder": (PixelEncoder, ("shape", "channels", "features", "strides")),
    "linear": (nn.Linear, ()),
    "layer_norm": (nn.LayerNorm, ("eps",)),
    "silu": (nn.SiLU, ()),
    "elu": (nn.ELU, ("alpha",)),
    "relu": (nn.ReLU, ()),
    "leaky_relu": (nn.LeakyReLU, ("negative_slope",)),
    "tanh": (nn.Tanh, ()),
    "gelu": (nn.GELU, ("approximate",)),
    "softplus": (nn.Softplus, ("beta", "threshold")),
    "mish": (nn.Mish, ()),
    "identity": (nn.Identity, ()),
}
"""The layers that a file can hold, by their names in it: the class, and the arguments that are stored."""

_NAMES = {kind: name for name, (kind, _) in KINDS.items()}


def layers_of(network: nn.Module) -> list[nn.Module]:
    """Returns the layers of a network that computes one after the other, in their order."""
    if type(network) in _NAMES:
        shape = network.normalized_shape if isinstance(network, nn.LayerNorm) else (1,)
        if len(shape) > 1:
            raise TypeError(f"a policy cannot hold a LayerNorm over {len(shape)} dimensions: pass the last one's size")
        return [network]
    if isinstance(network, nn.Sequential):
        return [layer for part in network for layer in layers_of(part)]
    kinds = ", ".join(kind.__name__ for kind, _ in KINDS.values() if kind not in (ObservationNorm, PixelEncoder))
    raise TypeError(
        f"a policy cannot hold {type(network).__name__}, so what it computes could not be saved: build the network as "
        f"nn.Sequential of {kinds}"
    )


def copied(layer: nn.Module) -> nn.Module:
    """Returns a copy of one of ``layers_of`` with tensors of its own; a layer norm without weights gets them."""
    if not isinstance(layer, nn.LayerNorm) or (layer.weight is not None and layer.bias is not None):
        return copy.deepcopy(layer)
    (size,) = layer.normalized_shape
    norm = nn.LayerNorm(size, layer.eps)
    if layer.weight is not None:
        norm.load_state_dict({"weight": layer.weight.detach().cpu(), "bias": torch.zeros(size)})
        norm.to(layer.weight.device)
    return norm


def random_observations(network: Any, count: int, spread: float) -> torch.Tensor:
    """Returns observations ``(count, n)`` on the CPU, always the same, ``spread`` times as spread as in the training.

    Of a network that reads pixels they are noise, uint8 ``(count, height, width, channels)``.

    Raises:
        TypeError: the network begins with neither a norm of observations nor an encoder of pixels.
    """
    norm, generator = network[0], torch.Generator().manual_seed(0)
    if isinstance(norm, PixelEncoder):
        return torch.randint(0, 256, (count, *norm.shape), dtype=torch.uint8, generator=generator)
    if not isinstance(norm, ObservationNorm):
        raise TypeError(f"a policy must begin with an ObservationNorm, this one begins with {type(norm).__name__}")
    noise = torch.randn(count, len(norm.mean), generator=generator)
    return norm.mean.cpu() + spread * noise * (norm.var.cpu() + 1e-6).sqrt()


def difference(actions: torch.Tensor, expected: torch.Tensor) -> float:
    """Returns the largest difference, as a fraction of actions above 1; infinity if the shapes differ."""
    if actions.shape != expected.shape:
        return math.inf
    return ((actions - expected).abs() / expected.abs().clamp(min=1.0)).max().item()


def _description(layer: nn.Module) -> str | list[Any]:
    """Returns the name of a layer, or its name and its arguments if they are not the default."""
    name = _NAMES[type(layer)]
    kind, known = KINDS[name]
    default = {key: inspect.signature(kind).parameters[key].default for key in known}
    settings = {key: getattr(layer, key) for key in known if getattr(layer, key) != default[key]}
    return [name, settings] if settings else name


def _make_layer(description: str | list[Any], tensors: dict[str, torch.Tensor]) -> nn.Module:
    """Returns the layer of a description, with the sizes of its tensors."""
    name, settings = (description, {}) if isinstance(description, str) else description
    if name not in KINDS:
        raise ValueError(f"unknown layer {name!r}")
    kind, known = KINDS[name]
    if unknown := settings.keys() - set(known):
        raise ValueError(f"layer {name!r} has no setting {min(unknown)!r}")
    if kind not in (ObservationNorm, nn.Linear, nn.LayerNorm):
        with torch.random.fork_rng(devices=[]):  # an encoder draws weights, which are replaced
            return kind(**settings)
    if not tensors:
        raise ValueError(f"layer {name!r} has no tensors")
    if kind is nn.Linear:
        outputs, inputs = tensors["weight"].shape
        return nn.utils.skip_init(nn.Linear, inputs, outputs, bias="bias" in tensors)
    return kind(len(tensors["mean" if kind is ObservationNorm else "weight"]), **settings)


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
    shipped = shipped_policies(check_choice("protocol", protocol, PROTOCOLS))
    try:
        name = canonical_id(task)
    except ValueError as error:
        if not is_run(Path(str(task))):
            raise
        of_run = f"torchrl_loco.training.RunFolder({task!r}).load_policy()"
        raise ValueError(f"load_policy takes the id of a task; load that of a run with {of_run}") from error
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
