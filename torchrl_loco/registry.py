"""From an id to an environment."""

from pathlib import Path
from typing import Any

import torch

from torchrl_loco import envs
from torchrl_loco.config import suggestion

ENVS: dict[str, type[envs.LocoEnv]] = {
    "walker_stand": envs.WalkerStand,
    "walker_walk": envs.WalkerWalk,
    "walker_run": envs.WalkerRun,
    "humanoid_stand": envs.HumanoidStand,
    "humanoid_walk": envs.HumanoidWalk,
    "humanoid_run": envs.HumanoidRun,
}

ALIASES = {f"mjx/{name}-v0": name for name in ENVS}


def list_envs() -> list[str]:
    """Returns the ids that :func:`make` takes, without the aliases ``mjx/<id>-v0``."""
    return list(ENVS)


def canonical_id(id: str) -> str:
    """Returns the id that ``id``, or an alias, stands for.

    Raises:
        ValueError: there is no such id; the message names the nearest right one and all of them.
    """
    name = ALIASES.get(id, id)
    if name not in ENVS:
        hint = suggestion(str(id), [*ENVS, *ALIASES])
        raise ValueError(f"unknown environment {id!r}{hint}: choose one of {', '.join(ENVS)}")
    return name


def env_class(id: str) -> type[envs.LocoEnv]:
    """Returns the class of ``id`` or an alias; raises as :func:`canonical_id` does."""
    return ENVS[canonical_id(id)]


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
    """Makes one of the six environments.

    Args:
        id: one of :func:`list_envs`, or its alias ``mjx/<id>-v0``.
        num_envs: number of worlds, the batch size.
        device: where physics and tensors live; ``None`` takes CUDA if there is any, else the CPU.
        seed: integer in [0, 2**32) that, with world and episode, decides every random draw; ``None`` takes a fresh one.
        protocol: ``"playground"`` or ``"dm_control"``.
        reward_terms: whether to return each factor of the reward under ``("next", "reward_terms", name)``.
        stagger: whether a full ``reset()`` starts each world at a random point of its time limit.
        on_overflow: ``"warn"``, ``"raise"`` or ``"ignore"`` when contacts or constraints find no room.
        bad_world_file: a file, not there yet, that is to hold what the first world that is not finite came from.
        config: fields of :class:`torchrl_loco.SimConfig` to override, such as ``episode_length=500``.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.

    Example:
        >>> env = make("walker_walk", num_envs=16, device="cpu", seed=0)
        >>> env.rollout(100)["next", "reward"].shape
        torch.Size([16, 100, 1])
    """
    options: dict[str, Any] = {"reward_terms": reward_terms, "stagger": stagger, "on_overflow": on_overflow}
    return env_class(id)(num_envs, device, seed, protocol, bad_world_file=bad_world_file, **options, **config)
