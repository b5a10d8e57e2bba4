"""Warm starts: networks that begin with the weights of another run, or of a policy."""

from pathlib import Path

from torch import nn

from torchrl_loco.policy import Policy, layers_of
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.run_folder import RunFolder


def begin_from(algorithm: Algorithm, source: Path, device: str) -> None:
    """Gives networks the weights of a run's checkpoint, actor and critic, or the actor those of a policy file.

    Args:
        algorithm: its networks are changed.
        source: a run folder, or a policy file. A run without a checkpoint has a policy.
        device: where they compute.

    Raises:
        FileNotFoundError: there is no such run or file.
        ValueError: the weights do not fit: other sizes, or another algorithm.
    """
    if source.is_dir() and (run := RunFolder(source)).has_checkpoint:
        try:
            algorithm.load_networks(run.load_checkpoint(device)["algorithm"]["networks"])
        except (RuntimeError, KeyError) as error:
            raise ValueError(f"init: the networks of {source} do not fit this run: {error}") from error
        return
    policy = RunFolder(source).load_policy(device) if source.is_dir() else Policy.load(source, device)
    mine = [layer for part in algorithm.actor[0].module for layer in _layers(part)]
    for own, other in zip(mine, layers_of(policy.module), strict=False):
        _copy(own, other, source, last=own is mine[-1])


def _layers(part: nn.Module) -> list[nn.Module]:
    try:
        return layers_of(part)
    except TypeError:  # what makes a distribution of the last layer
        return []


def _copy(own: nn.Module, other: nn.Module, source: Path, *, last: bool) -> None:
    """Copies the weights of a layer; the last of an actor also gives what a policy does not have: its deviations.

    Raises:
        ValueError: they have other sizes.
    """
    mine, theirs = own.state_dict(), other.state_dict()
    for name, values in theirs.items():
        fits = name in mine and mine[name].shape[1:] == values.shape[1:]
        rows = len(values) if values.ndim else 1
        if type(own) is not type(other) or not fits or (values.ndim and len(mine[name]) not in (rows, 2 * rows * last)):
            shapes = [tuple(each[name].shape) if name in each else None for each in (theirs, mine)]
            raise ValueError(f"init: the policy of {source} has {name} of shape {shapes[0]}, this run {shapes[1]}")
        if values.ndim:
            mine[name][:rows] = values
        else:
            mine[name] = values
    own.load_state_dict(mine)
