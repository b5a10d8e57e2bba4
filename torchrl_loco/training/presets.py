"""The settings of a training run, and the presets as data."""

import dataclasses
import math
from pathlib import Path
from typing import Any, Literal

import torch

from torchrl_loco.config import PROTOCOLS
from torchrl_loco.envs.checks import check_count, check_device, check_seed
from torchrl_loco.registry import env_class


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of one training run. Frames are control steps of one world (0.025 s)."""

    task: str
    """Id of the environment."""
    protocol: Literal["playground", "dm_control"] = "playground"
    """Settings of the solver and of the reset."""
    device: str = "cpu"
    """Where physics and networks live."""
    seed: int = 0
    """Decides every random draw of the run."""
    out: Path = Path("runs")
    """Folder that the run's own folder is made in."""

    num_envs: int = 64
    """Worlds stepped together."""
    total_frames: int = 1_228_800
    """Frames to collect, over all worlds."""
    action_repeat: int = 4
    """Frames for which an action is held."""
    episode_length: int = 400
    """Frames after which an episode is truncated in training; evaluation always plays the task's own length. Shorter
    ones practise the beginning, getting up, more often."""
    decisions: int = 32
    """Actions that each world takes between two updates."""

    reward_scale: float = 0.05
    """Factor on the reward before advantages are estimated, which keeps values within the critic's easy reach."""
    gamma: float = 0.98
    """Discount of a decision."""
    lmbda: float = 0.95
    """Decay of the generalised advantage estimate."""
    lr: float = 1e-3
    """Learning rate of Adam at the start; it falls linearly to nothing at the end."""
    epochs: int = 10
    """Passes over a batch."""
    minibatch_size: int = 512
    """Decisions in one gradient step."""
    clip_epsilon: float = 0.2
    """Range of the probability ratio that is not clipped."""
    entropy_coeff: float = 1e-3
    """Weight of the entropy bonus."""
    max_grad_norm: float = 1.0
    """Norm to which gradients are clipped."""
    init_std: float = 1.0
    """Standard deviation of an action before tanh, at the start."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of actor and critic."""

    eval_episodes: int = 32
    """Episodes of the evaluation at the end."""
    video_seconds: float = 10.0
    """Length of the video of the trained policy (s); 0 makes none."""

    def __post_init__(self) -> None:
        env_class(self.task)
        if self.protocol not in PROTOCOLS:
            raise ValueError(f"unknown protocol {self.protocol!r}: choose one of {', '.join(PROTOCOLS)}")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type is int and field.name != "seed":
                check_count(field.name, value)
            elif field.type is float:
                _check_range(field.name, value)
        check_seed(self.seed)
        check_device(self.device)
        if not self.hidden:
            raise ValueError("hidden must name the width of at least one layer")
        for width in self.hidden:
            check_count("each width of hidden", width)
        if self.minibatch_size > self.batch_size:
            raise ValueError(
                f"minibatch_size ({self.minibatch_size}) must not exceed the batch of num_envs * decisions "
                f"({self.batch_size})"
            )
        if self.total_frames < self.frames_per_batch:
            raise ValueError(
                f"total_frames ({self.total_frames}) must be at least one batch of num_envs * decisions * "
                f"action_repeat ({self.frames_per_batch})"
            )

    @property
    def batch_size(self) -> int:
        """Decisions in one batch."""
        return self.num_envs * self.decisions

    @property
    def frames_per_batch(self) -> int:
        """Frames in one batch."""
        return self.batch_size * self.action_repeat


# Lower and upper end of what each real-valued field may be; the lower end itself is allowed where it is listed.
_RANGES: dict[str, tuple[float, float]] = {"gamma": (0, 1), "lmbda": (0, 1), "clip_epsilon": (0, 1)}
_MAY_BE_ZERO = ("lmbda", "entropy_coeff", "video_seconds")


def _check_range(name: str, value: Any) -> None:
    low, high = _RANGES.get(name, (0, math.inf))
    above = value >= low if name in _MAY_BE_ZERO else value > low
    if not (above and value <= high and math.isfinite(value)):
        bracket = "[" if name in _MAY_BE_ZERO else "("
        raise ValueError(f"{name} must lie in {bracket}{low}, {high}], got {value}")


_ON_CPU: dict[str, Any] = {}
_ON_CUDA: dict[str, Any] = {
    "num_envs": 4096,
    "decisions": 16,
    "total_frames": 40_000_000,
    "minibatch_size": 8192,
    "epochs": 5,
    "lr": 5e-4,
    "episode_length": 1000,
    "eval_episodes": 128,
}


def preset(task: str, device: torch.device | str | None = None, **overrides: Any) -> PPOConfig:
    """Returns the settings for ``task`` on ``device``, with ``overrides`` on top.

    Raises:
        ValueError: the device is not here, or a field is out of range; the message names what is valid.
    """
    device = check_device(device)
    values = _ON_CUDA if device.type == "cuda" else _ON_CPU
    return PPOConfig(task, **{"device": str(device), **values, **overrides})
