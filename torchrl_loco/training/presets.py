"""Which settings are used on which device, as data. Those of a task on CUDA are the ``presets`` of its class."""

import dataclasses
from typing import TYPE_CHECKING, Any

from torchrl_loco import tasks
from torchrl_loco.checks import check_choice, check_device
from torchrl_loco.registry import resolve, task_name
from torchrl_loco.training.config import CONFIGS, REPPOConfig, TrainingConfig

if TYPE_CHECKING:
    import torch

    from torchrl_loco.envs import LocoEnv

Settings = dict[str, Any]

PPO_ON_CPU: Settings = {
    "num_envs": 128,
    "total_frames": 3_000_000,
    "action_repeat": 2,
    "epochs": 6,
    "minibatch_size": 1024,
    "video_seconds": 5.0,
}
PPO_ON_CUDA: Settings = {
    "num_envs": 4096,
    "num_steps": 16,
    "total_frames": 40_000_000,
    "minibatch_size": 8192,
    "epochs": 5,
    "lr": 5e-4,
    "episode_length": 1000,
    "eval_episodes": 128,
}
REPPO_ON_CPU: Settings = {
    "num_steps": 32,
    "action_repeat": 2,
    "episode_length": 1000,
    "total_frames": 1_228_800,
    "reward_scale": 0.5,
    "gamma": 0.98,
    "lr": 3e-4,
    "final_lr_fraction": 1.0,
    "epochs": 4,
    "minibatch_size": 256,
    "max_grad_norm": 0.5,
    "hidden": (256, 256),
    "max_value": 50.0,
}
REPPO_ON_CUDA: Settings = {
    "num_envs": 8192,
    "num_steps": 16,
    "total_frames": 100_000_000,
    "action_repeat": 1,
    "episode_length": 1000,
    "reward_scale": 1.0,
    "gamma": 0.99,
    "lr": 6e-4,
    "final_lr_fraction": 0.1,
    "epochs": 4,
    "minibatch_size": 8192,
    "max_grad_norm": 0.5,
    "hidden": (512, 512),
    "eval_interval": 5_000_000,
    "eval_episodes": 128,
}
SETTINGS: dict[tuple[str, str], Settings] = {
    ("ppo", "cpu"): PPO_ON_CPU,
    ("ppo", "cuda"): PPO_ON_CUDA,
    ("reppo", "cpu"): REPPO_ON_CPU,
    ("reppo", "cuda"): REPPO_ON_CUDA,
}
"""By algorithm and kind of device."""

OF_USERS: dict[str, Settings] = {
    "ppo": {"action_repeat": 1, "episode_length": 0},
    "reppo": {"action_repeat": 1, "episode_length": 0, "num_bins": 301},
}
"""By algorithm, for tasks that are not of this package: their own episodes, and returns of either sign."""

STEADY: Settings = {"init_kl_weight": 0.02, "min_kl_weight": 0.02}
"""What keeps a run from breaking down near the best return: a lower bound of the divergence's weight."""

TUNED_ON_CPU = ("ppo", ("walker_stand", "walker_walk"))
"""Algorithm and tasks that were tuned on a CPU."""

TUNED_IN_GENERAL = ("torchrl_loco.tasks.walker", "torchrl_loco.tasks.humanoid")
"""Modules of the tasks on which the general settings for CUDA were tuned."""

DEFAULT_ALGORITHM = {"cpu": "ppo", "cuda": "reppo"}


def preset(
    task: "str | type[LocoEnv]",
    device: "torch.device | str | None" = None,
    algorithm: str | None = None,
    **overrides: Any,
) -> TrainingConfig:
    """Returns the settings for ``task`` on ``device``, with ``overrides`` on top.

    A task takes the general settings of algorithm and device, tuned on the walker and the humanoid, and on CUDA the
    ``presets`` of its class on top: ``{"reppo": {"total_frames": 30_000_000}}``.

    Args:
        task: id of the environment, its class, or where that is: ``"path/to/file.py:Class"``.
        device: where to train; ``None`` takes CUDA if there is any.
        algorithm: "ppo" or "reppo"; ``None`` takes the default of the device.
        overrides: fields of the settings.

    Raises:
        ValueError: there is no such device or algorithm, or a field is out of range; the message names what is valid.
    """
    task, device = task_name(task), check_device(device)
    algorithm = DEFAULT_ALGORITHM[device.type] if algorithm is None else algorithm
    kind = CONFIGS[check_choice("algorithm", algorithm, CONFIGS)]
    for name in overrides:
        check_choice("setting", name, [field.name for field in dataclasses.fields(kind)])
    return kind(task, **{"device": str(device), **tuned_settings(task, device.type, algorithm), **overrides})


def tuned_settings(task: "str | type[LocoEnv]", device: str, algorithm: str) -> Settings:
    """Returns the settings of a preset that differ from the defaults, for a kind of device, "cpu" or "cuda"."""
    settings = {**SETTINGS[algorithm, device], **({} if is_ours(task) else OF_USERS[algorithm])}
    if device == "cuda":
        settings |= resolve(task).presets.get(algorithm, {})
    if not is_ours(task) and algorithm == "reppo":
        settings.setdefault("min_value", -settings.get("max_value", REPPOConfig.max_value))
    return settings


def is_ours(task: "str | type[LocoEnv]") -> bool:
    """Returns whether a task is one of this package, whose rewards lie in [0, 1] and whose bodies cannot fall."""
    return task_name(task) in tasks.found()


def tuning_note(config: TrainingConfig) -> str:
    """Returns a note if ``config.task`` was not tuned on its device, or settings do not fit each other, else ``""``."""
    return " ".join(note for note in (_untuned(config), _values_cut_off(config)) if note)


def _untuned(config: TrainingConfig) -> str:
    if config.device == "cpu":
        algorithm, tasks = TUNED_ON_CPU
        if config.algorithm == algorithm and config.task in tasks:
            return ""
        tuned = " and ".join(tasks)
        return f"On a CPU only {tuned} by {algorithm} were tuned: other tasks need a GPU, or many more frames."
    cls = resolve(config.task)
    if config.algorithm in vars(cls).get("presets", {}) or cls.__module__ in TUNED_IN_GENERAL:
        return ""
    bases = [base.__name__ for base in cls.__mro__ if config.algorithm in vars(base).get("presets", {})]
    tuned = bases[0] if bases else "the " + " and the ".join(name.rpartition(".")[2] for name in TUNED_IN_GENERAL)
    return f"No settings of {config.algorithm} were tuned for {config.task}: these were tuned on {tuned}."


def _values_cut_off(config: TrainingConfig) -> str:
    """Returns a note if returns may be larger than the critic of REPPO can represent, else an empty string."""
    if not isinstance(config, REPPOConfig) or not is_ours(config.task):
        return ""  # of other rewards only the run itself can tell
    largest = config.reward_scale * config.action_repeat / max(1.0 - config.gamma, 1e-9)
    if largest <= config.max_value * (1.0 + 1e-9):  # of rounding
        return ""
    scale = config.reward_scale * config.max_value / largest
    return (
        f"Returns of up to {largest:.4g} may occur, but the critic cannot tell those above --max_value "
        f"{config.max_value:g} apart: raise it, or pass --reward_scale {scale:.3g}."
    )
