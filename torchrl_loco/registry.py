"""From an id to an environment."""

import contextlib
from pathlib import Path
from typing import Any

import torch

from torchrl_loco import envs
from torchrl_loco.envs.checks import check_subclass
from torchrl_loco.ids import canonical_id, list_envs, origin, plugins

ENVS: dict[str, type[envs.LocoEnv]] = {
    "walker_stand": envs.WalkerStand,
    "walker_walk": envs.WalkerWalk,
    "walker_run": envs.WalkerRun,
    "humanoid_stand": envs.HumanoidStand,
    "humanoid_walk": envs.HumanoidWalk,
    "humanoid_run": envs.HumanoidRun,
}


def env_class(id: str) -> type[envs.LocoEnv]:
    """Returns the class of ``id`` or an alias.

    Raises:
        ValueError: there is no such id; the message names the nearest right one and all of them.
        ImportError: the distribution that it comes from is broken; the message names it.
    """
    name = canonical_id(id)
    if name in ENVS:
        return ENVS[name]
    point = plugins()[name]
    try:
        cls = point.load()
    except Exception as error:  # whatever another's module may raise
        reason = f"{type(error).__name__}: {error}"
        raise ImportError(f"environment {name!r} of {origin(point)} cannot be loaded: {reason}") from error
    if not (isinstance(cls, type) and issubclass(cls, envs.LocoEnv)):
        raise ImportError(f"environment {name!r} of {origin(point)} is no subclass of torchrl_loco.LocoEnv")
    try:
        check_subclass(cls)
    except TypeError as error:
        raise ImportError(f"environment {name!r} of {origin(point)}: {error}") from error
    return cls


def usable_classes() -> list[type[envs.LocoEnv]]:
    """Returns the classes of all environments, without those of broken distributions."""
    found = []
    for name in list_envs():
        with contextlib.suppress(ImportError):
            found.append(env_class(name))
    return found


def make(
    id: str,
    num_envs: int = 1,
    device: torch.device | str | None = None,
    seed: int | None = None,
    protocol: str = "playground",
    *,
    reward_terms: bool = False,
    stagger: bool = False,
    on_overflow: str = "warn",
    bad_world_file: Path | str | None = None,
    **config: Any,
) -> envs.LocoEnv:
    """Makes an environment.

    Args:
        id: one of :func:`torchrl_loco.list_envs`, or its alias ``mjx/<id>-v0``.
        num_envs: number of worlds, the batch size.
        device: where physics and tensors live; ``None`` takes CUDA if there is any, else the CPU.
        seed: integer in [0, 2**32) that, with world and episode, decides every random draw; ``None`` takes a fresh one.
        protocol: ``"playground"`` or ``"dm_control"``.
        reward_terms: whether to return each factor of the reward under ``("next", "reward_terms", name)``.
        stagger: whether a full ``reset()`` starts each world at a random point of its time limit.
        on_overflow: ``"warn"``, ``"raise"`` or ``"ignore"`` when contacts or constraints find no room.
        bad_world_file: a file, not there yet, that is to hold what the first world that is not finite came from.
        config: fields of :class:`torchrl_loco.SimConfig` to override, such as ``episode_length=500``.

    Returns:
        The environment, with batch size ``(num_envs,)``, ready for ``reset()``.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.
        ImportError: the environment is another distribution's, which is broken.

    Example:
        >>> env = torchrl_loco.make("walker_walk", num_envs=16, device="cpu", seed=0)
        >>> env.rollout(100)["next", "reward"].shape
        torch.Size([16, 100, 1])
    """
    options: dict[str, Any] = {"reward_terms": reward_terms, "stagger": stagger, "on_overflow": on_overflow}
    return env_class(id)(num_envs, device, seed, protocol, bad_world_file=bad_world_file, **options, **config)
