"""Which settings teach which task on which device, as data."""

from typing import TYPE_CHECKING, Any

from torchrl_loco.checks import check_device
from torchrl_loco.config import suggestion
from torchrl_loco.ids import OURS, canonical_id
from torchrl_loco.training.config import CONFIGS, TrainingConfig

if TYPE_CHECKING:
    import torch

Settings = dict[str, Any]

PPO_ON_CPU: Settings = {
    "num_envs": 32,
    "total_frames": 330_000,
    "action_repeat": 2,
    "lr": 2e-3,
    "minibatch_size": 256,
    "video_seconds": 5.0,
}
PPO_ON_CUDA: Settings = {
    "num_envs": 4096,
    "decisions": 16,
    "total_frames": 40_000_000,
    "minibatch_size": 8192,
    "epochs": 5,
    "lr": 5e-4,
    "episode_length": 1000,
    "eval_episodes": 128,
}
REPPO_ON_CPU: Settings = {
    "decisions": 32,
    "action_repeat": 2,
    "episode_length": 1000,
    "total_frames": 1_228_800,
    "reward_scale": 0.5,
    "gamma": 0.98,
    "lr": 3e-4,
    "final_lr": 1.0,
    "epochs": 4,
    "minibatch_size": 256,
    "max_grad_norm": 0.5,
    "hidden": (256, 256),
    "max_value": 50.0,
}
REPPO_ON_CUDA: Settings = {
    "num_envs": 2048,
    "decisions": 64,
    "total_frames": 100_000_000,
    "action_repeat": 1,
    "episode_length": 1000,
    "reward_scale": 1.0,
    "gamma": 0.99,
    "lr": 3e-4,
    "final_lr": 1.0,
    "epochs": 8,
    "minibatch_size": 2048,
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

NO_FLOOR: Settings = {"min_temperature": 1e-9}
"""The weight of entropy may fall to nothing, where it was never seen to do harm."""
GETTING_UP: Settings = {"episode_length": 400, "final_lr": 0.1}
"""Where a walker that stands earns nearly all there is: what is left to gain is to get up sooner, from any pose."""
TASKS: dict[tuple[str, str], Settings] = {
    ("reppo", "walker_stand"): {"total_frames": 10_000_000, **GETTING_UP, **NO_FLOOR},
    ("reppo", "walker_walk"): {"total_frames": 10_000_000, **GETTING_UP, **NO_FLOOR},
    ("reppo", "walker_run"): {"total_frames": 52_000_000, **NO_FLOOR},
    ("reppo", "humanoid_stand"): {"total_frames": 62_000_000, **NO_FLOOR},
    ("reppo", "humanoid_walk"): {"total_frames": 62_000_000, **NO_FLOOR},
    ("reppo", "humanoid_run"): {"total_frames": 105_000_000, "final_lr": 0.1},
}
"""What a task needs beside, by algorithm and task, on CUDA."""

TUNED_ON_CPU = ("ppo", "walker_stand")
"""What a CPU learns in minutes."""

DEFAULT_ALGORITHM = {"cpu": "ppo", "cuda": "reppo"}


def preset(
    task: str, device: "torch.device | str | None" = None, algorithm: str | None = None, **overrides: Any
) -> TrainingConfig:
    """Returns the settings for ``task`` on ``device``, with ``overrides`` on top.

    A task of another distribution takes those of the algorithm on the kind of device, without more: they teach the
    walker and the humanoid, and were not tuned for it.

    Args:
        task: id of the environment.
        device: where to train; ``None`` takes CUDA if there is any.
        algorithm: "ppo" or "reppo"; ``None`` takes what suits the device.
        overrides: fields of the settings.

    Raises:
        ValueError: there is no such device or algorithm, or a field is out of range; the message names what is valid.
    """
    task = canonical_id(task)
    device = check_device(device)
    algorithm = DEFAULT_ALGORITHM[device.type] if algorithm is None else algorithm
    if algorithm not in CONFIGS:
        hint = suggestion(algorithm, list(CONFIGS))
        raise ValueError(f"unknown algorithm {algorithm!r}{hint}: choose one of {', '.join(CONFIGS)}")
    values = {"device": str(device), **SETTINGS[algorithm, device.type]}
    if device.type == "cuda":
        values |= TASKS.get((algorithm, task), {})
    return CONFIGS[algorithm](task, **{**values, **overrides})


def untuned(config: TrainingConfig) -> str:
    """Returns what else than its task the preset behind ``config`` was made for, in a sentence, or an empty string."""
    if config.task not in OURS:
        return f"No settings were tuned for {config.task}, these are the ones that teach the walker and the humanoid."
    if config.device == "cpu" and (config.algorithm, config.task) != TUNED_ON_CPU:
        algorithm, task = TUNED_ON_CPU
        return f"The settings for a CPU are tuned for {task} by {algorithm}: all else wants a GPU, or many more frames."
    return ""
