"""Which settings are used for which task on which device, as data."""

import dataclasses
from typing import TYPE_CHECKING, Any

from torchrl_loco.checks import check_choice, check_device
from torchrl_loco.registry import canonical_id, env_class
from torchrl_loco.training.config import CONFIGS, REPPOConfig, TrainingConfig

if TYPE_CHECKING:
    import torch

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

NO_FLOOR: Settings = {"min_temperature": 1e-9}
"""No effective lower bound of the temperature: these tasks train well without one."""
MORE_STEPS: Settings = {"lr": 1e-3, "minibatch_size": 4096, **NO_FLOOR}
"""Twice the gradient steps for each batch, at a higher learning rate: for tasks that stay stable under both."""
HOPPER: Settings = {**MORE_STEPS, "action_repeat": 2, "reward_scale": 0.5, "episode_length": 100}
"""The reward is sparse: noise held for two frames explores further, and more of a short episode is the fall at its
start, in which the hopper can still turn to a side from which it gets up."""
UPRIGHT: Settings = {"lr": 2e-3, "minibatch_size": 2048, "target_entropy": -1.0}
"""Less noise, and twice the gradient steps of MORE_STEPS at twice the learning rate. With the steps and the rate of
MORE_STEPS three of four runs under ``dm_control`` settled on a crouching gait, which earns a tenth less; with these
two of ten in 40 million frames, none of six in 65 million, and none of five in 60 million after BETTER_OF_TWO."""
BETTER_OF_TWO: Settings = {"trials": 2, "trial_fraction": 0.2}
"""For gaits that are decided early, by chance. Of eleven runs of walker_run under ``playground`` with one trial at this
learning rate, the three that ended below 920 had the lowest returns after 15 million frames."""
GETTING_UP: Settings = {"episode_length": 100, "gamma": 0.98, "max_value": 75.0}
"""For tasks that lose return mostly while the body gets up or gains speed, which is much of a short episode."""
STEADY: Settings = {"init_kl_weight": 0.02, "min_kl_weight": 0.02}
"""A lower bound of the divergence's weight, which falls far near the best return: without one, three of six runs of
humanoid_walk broke down."""
TASKS: dict[tuple[str, str], Settings] = {
    ("reppo", "walker_stand"): {**MORE_STEPS, **GETTING_UP, "total_frames": 34_000_000, "epochs": 2},
    ("reppo", "walker_walk"): {**MORE_STEPS, **GETTING_UP, "total_frames": 19_000_000, "eval_interval": 2_000_000},
    ("reppo", "walker_run"): {
        **NO_FLOOR,
        **UPRIGHT,
        **BETTER_OF_TWO,
        "total_frames": 75_000_000,
        "episode_length": 200,
    },
    ("reppo", "humanoid_stand"): {**NO_FLOOR, **STEADY, **GETTING_UP, "total_frames": 80_000_000},
    ("reppo", "humanoid_walk"): {**NO_FLOOR, **STEADY, **GETTING_UP, "total_frames": 100_000_000},
    ("reppo", "humanoid_run"): {"total_frames": 300_000_000, "episode_length": 200},
    ("reppo", "cheetah_run"): {**MORE_STEPS, "total_frames": 30_000_000},
    ("reppo", "hopper_stand"): {**HOPPER, "total_frames": 60_000_000},
    ("reppo", "hopper_hop"): {**HOPPER, "total_frames": 160_000_000},
    ("reppo", "quadruped_walk"): {**MORE_STEPS, "total_frames": 30_000_000},
    ("reppo", "quadruped_run"): {**MORE_STEPS, "total_frames": 50_000_000},
}
"""Further settings of a task on CUDA, by algorithm and task."""

TUNED_ON_CPU = ("ppo", ("walker_stand", "walker_walk"))
"""Algorithm and tasks that were tuned on a CPU."""

TUNED_IN_GENERAL = ("walker", "humanoid")
"""Bodies on which the general settings for CUDA were tuned."""

DEFAULT_ALGORITHM = {"cpu": "ppo", "cuda": "reppo"}


def preset(
    task: str, device: "torch.device | str | None" = None, algorithm: str | None = None, **overrides: Any
) -> TrainingConfig:
    """Returns the settings for ``task`` on ``device``, with ``overrides`` on top.

    A task that was not tuned takes the general settings of algorithm and device, tuned on the walker and the humanoid.

    Args:
        task: id of the environment.
        device: where to train; ``None`` takes CUDA if there is any.
        algorithm: "ppo" or "reppo"; ``None`` takes the default of the device.
        overrides: fields of the settings.

    Raises:
        ValueError: there is no such device or algorithm, or a field is out of range; the message names what is valid.
    """
    task = canonical_id(task)
    device = check_device(device)
    algorithm = DEFAULT_ALGORITHM[device.type] if algorithm is None else algorithm
    kind = CONFIGS[check_choice("algorithm", algorithm, CONFIGS)]
    for name in overrides:
        check_choice("setting", name, [field.name for field in dataclasses.fields(kind)])
    return kind(task, **{"device": str(device), **tuned_settings(task, device.type, algorithm), **overrides})


def tuned_settings(task: str, device: str, algorithm: str) -> Settings:
    """Returns the settings of a preset that differ from the defaults, for a kind of device, "cpu" or "cuda"."""
    return {**SETTINGS[algorithm, device], **(TASKS.get((algorithm, task), {}) if device == "cuda" else {})}


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
    if (config.algorithm, config.task) in TASKS or env_class(config.task).body in TUNED_IN_GENERAL:
        return ""
    tuned = " and the ".join(TUNED_IN_GENERAL)
    return f"No settings of {config.algorithm} were tuned for {config.task}: these were tuned on the {tuned}."


def _values_cut_off(config: TrainingConfig) -> str:
    """Returns a note if returns may be larger than the critic of REPPO can represent, else an empty string."""
    if not isinstance(config, REPPOConfig):
        return ""
    largest = config.reward_scale * config.action_repeat / max(1.0 - config.gamma, 1e-9)
    if largest <= config.max_value * (1.0 + 1e-9):  # of rounding
        return ""
    scale = config.reward_scale * config.max_value / largest
    return (
        f"Returns of up to {largest:.4g} may occur, but the critic cannot tell those above --max_value "
        f"{config.max_value:g} apart: raise it, or pass --reward_scale {scale:.3g}."
    )
