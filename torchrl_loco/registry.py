"""Ids of environments, and ``make``. No environment is imported until it is made."""

import dataclasses
import functools
import importlib
import re
import warnings
from importlib import metadata
from typing import TYPE_CHECKING, Any

from torchrl_loco.checks import check_choice

if TYPE_CHECKING:
    from torchrl_loco.envs import LocoEnv

GROUP = "torchrl_loco.envs"
"""Group of the entry points by which installed distributions add environments: ``id = "module:Class"``."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """An environment that :func:`make` knows.

    Attributes:
        target: where its class is, as ``"module:Class"``.
        summary: what the task asks for, in a sentence; empty for a plug-in: its class docstring is used.
        distribution: name and version of the distribution that a plug-in comes from; empty for ours.
    """

    target: str
    summary: str = ""
    distribution: str = ""


OURS = {
    "walker_stand": Entry("torchrl_loco.envs.walker:WalkerStand", "Stand up and stay upright."),
    "walker_walk": Entry("torchrl_loco.envs.walker:WalkerWalk", "Walk at 1 m/s or faster."),
    "walker_run": Entry("torchrl_loco.envs.walker:WalkerRun", "Run at 8 m/s or faster."),
    "humanoid_stand": Entry("torchrl_loco.envs.humanoid:HumanoidStand", "Stand still and upright."),
    "humanoid_walk": Entry("torchrl_loco.envs.humanoid:HumanoidWalk", "Walk at 1 m/s or faster, in any direction."),
    "humanoid_run": Entry("torchrl_loco.envs.humanoid:HumanoidRun", "Run at 10 m/s or faster, in any direction."),
    "cheetah_run": Entry("torchrl_loco.envs.cheetah:CheetahRun", "Run at 10 m/s or faster."),
    "hopper_stand": Entry("torchrl_loco.envs.hopper:HopperStand", "Stand upright on one leg."),
    "hopper_hop": Entry("torchrl_loco.envs.hopper:HopperHop", "Hop forward at 2 m/s or faster."),
    "quadruped_walk": Entry("torchrl_loco.envs.quadruped:QuadrupedWalk", "Walk forward at 0.5 m/s or faster."),
    "quadruped_run": Entry("torchrl_loco.envs.quadruped:QuadrupedRun", "Run forward at 5 m/s or faster."),
}
"""The environments of this package by id."""

ALIASES = {f"mjx/{id}-v0": id for id in OURS}


@functools.cache
def registered() -> dict[str, Entry]:
    """Returns all environments by id: ours, then the plug-ins of installed distributions, which are looked up once.

    A plug-in whose id is taken or malformed is left out with a warning.
    """
    entries = dict(OURS)
    for point in sorted(metadata.entry_points(group=GROUP), key=lambda point: point.name):
        origin = f"{point.dist.name} {point.dist.version}" if point.dist else "an unknown distribution"
        taken = entries.get(ALIASES.get(point.name, point.name))
        if taken is not None:
            reason = f"{taken.distribution or 'torchrl_loco'} already has this id"
        elif not re.fullmatch(r"[\w.-]+", point.name):
            reason = "an id consists of letters, digits and _ . -, because run folders are named after it"
        else:
            entries[point.name] = Entry(point.value, distribution=origin)
            continue
        warnings.warn(f"environment {point.name!r} of {origin} ({point.value}) is ignored: {reason}", stacklevel=3)
    return entries


def list_envs() -> list[str]:
    """Returns the ids that :func:`torchrl_loco.make` takes: ours, then those of plug-ins, without aliases."""
    return list(registered())


def canonical_id(id: str) -> str:
    """Returns the id that ``id``, or an alias, stands for.

    Raises:
        ValueError: there is no such id; the message names the nearest one and all of them.
    """
    return check_choice("environment", ALIASES.get(id, id) if isinstance(id, str) else id, list_envs(), also=ALIASES)


def env_class(id: str) -> "type[LocoEnv]":
    """Returns the class of ``id`` or an alias.

    Raises:
        ValueError: there is no such id; the message names the nearest one and all of them.
        ImportError: the plug-in that it comes from is broken; the message names its distribution.
    """
    name = canonical_id(id)
    entry = registered()[name]
    module, _, attribute = entry.target.partition(":")
    if not entry.distribution:
        return getattr(importlib.import_module(module), attribute)

    from torchrl_loco.envs import LocoEnv

    origin = f"environment {name!r} of {entry.distribution} ({entry.target})"
    try:
        cls = functools.reduce(getattr, attribute.split("."), importlib.import_module(module))
    except Exception as error:  # a plug-in's module may raise anything
        raise ImportError(f"{origin} cannot be loaded: {type(error).__name__}: {error}") from error
    if not (isinstance(cls, type) and issubclass(cls, LocoEnv)):
        raise ImportError(f"{origin} is no subclass of torchrl_loco.LocoEnv")
    try:
        cls.check_class()
    except (TypeError, ValueError) as error:
        raise ImportError(f"{origin}: {error}") from error
    return cls


def summary(id: str) -> str:
    """Returns what a task asks for, in a sentence.

    Raises:
        ValueError: there is no such task.
        ImportError: the plug-in that it comes from is broken.
    """
    id = canonical_id(id)
    return registered()[id].summary or (env_class(id).__doc__ or "").strip().split("\n")[0]


TAKEN_BY_TORCHRL = {
    "auto_reset": "step_and_maybe_reset, rollout and collectors reset by themselves",
    "policy": "pass it to rollout or to a collector",
}
"""Arguments that TorchRL takes out of those of every environment before it is made, and what to do instead."""


def make(id: str, *args: Any, **kwargs: Any) -> "LocoEnv":
    """Makes an environment.

    Args:
        id: one of :func:`torchrl_loco.list_envs`, or its alias ``mjx/<id>-v0``.
        args: positional arguments of :class:`torchrl_loco.LocoEnv`: ``num_envs``, ``device``, ``seed``, ``protocol``.
        kwargs: keyword arguments of :class:`torchrl_loco.LocoEnv`, fields of :class:`torchrl_loco.SimConfig` among
            them, such as ``episode_length=500``.

    Returns:
        The environment, ready for ``reset()``; its batch size is ``(num_envs,)``, or ``()`` for ``num_envs=None``.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.
        ImportError: the plug-in that the environment comes from is broken.
        MemoryError: the device has no room for so many worlds.

    Example:
        >>> env = torchrl_loco.make("walker_walk", num_envs=16, device="cpu", seed=0)
        >>> env.rollout(100)["next", "reward"].shape
        torch.Size([16, 100, 1])
    """
    for name, instead in TAKEN_BY_TORCHRL.items():
        if kwargs.get(name):
            raise ValueError(f"{name} is no argument: {instead}")
    env = env_class(id)(*args, **kwargs)
    if env.engine == "compiled" and (ignored := [name for name in ("njmax", "naconmax") if name in kwargs]):
        why = "the compiled step has no such limits, engine='mujoco_warp' has"
        warnings.warn(f"{' and '.join(ignored)} have no effect: {why}", stacklevel=2)
    return env
