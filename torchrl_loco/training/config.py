"""The settings of a training run, field by field, and what is valid."""

import dataclasses
import math
import re
from pathlib import Path
from typing import Any, ClassVar, Literal

from torchrl_loco.checks import check_count, check_seed
from torchrl_loco.config import PROTOCOLS
from torchrl_loco.ids import canonical_id


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """Settings of any training run. Frames are control steps of one world.

    Raises:
        TypeError: a count is no integer.
        ValueError: a field is out of range, or does not fit another; the message names what is valid.
    """

    algorithm: ClassVar[str]

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
    """Factor on the reward before returns are estimated, which keeps values within the critic's easy reach."""
    gamma: float = 0.98
    """Discount of a decision."""
    lmbda: float = 0.95
    """Decay of the return's estimate over steps (GAE's and TD's lambda)."""
    lr: float = 1e-3
    """Learning rate of Adam at the start; it falls linearly to lr * final_lr at the end."""
    final_lr: float = 0.0
    """Share of the learning rate that is left at the end."""
    epochs: int = 10
    """Passes over a batch."""
    minibatch_size: int = 512
    """Decisions in one gradient step."""
    max_grad_norm: float = 1.0
    """Norm to which gradients are clipped."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of actor and critic."""

    eval_interval: int = 0
    """Frames between two evaluations during training; 0 evaluates at the end only."""
    eval_episodes: int = 32
    """Episodes of an evaluation."""
    video_seconds: float = 10.0
    """Length of the video of the trained policy (s); 0 makes none."""
    checkpoint_seconds: float = 60.0
    """Time between two checkpoints (s)."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", canonical_id(self.task))
        if self.protocol not in PROTOCOLS:
            raise ValueError(f"unknown protocol {self.protocol!r}: choose one of {', '.join(PROTOCOLS)}")
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type is int and field.name not in ("seed", "eval_interval"):
                check_count(field.name, value)
            elif field.type is float:
                _check_range(field.name, value)
        check_seed(self.seed)
        if self.eval_interval != 0:
            check_count("eval_interval (if not 0)", self.eval_interval)
        _check_kind_of_device(self.device)  # whether it is here is asked where it is used: a run may be from elsewhere
        if not self.hidden:
            raise ValueError("hidden must name the width of at least one layer")
        for width in self.hidden:
            check_count("each width of hidden", width)
        if self.minibatch_size > self.batch_size:
            raise ValueError(
                f"minibatch_size ({self.minibatch_size}) must not exceed the batch of num_envs ({self.num_envs}) * "
                f"decisions ({self.decisions}) = {self.batch_size}: pass minibatch_size={self.batch_size} or less, or "
                f"decisions={math.ceil(self.minibatch_size / self.num_envs)} or more"
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

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self._env_class.observation_size

    @property
    def action_size(self) -> int:
        """Length of an action."""
        from torchrl_loco import models

        return models.from_path(self._env_class.mjcf).nu

    @property
    def _env_class(self) -> Any:
        from torchrl_loco.registry import env_class  # takes seconds, which whoever looks at settings need not wait for

        return env_class(self.task)


@dataclasses.dataclass(frozen=True)
class PPOConfig(TrainingConfig):
    """Settings of proximal policy optimization."""

    algorithm: ClassVar[str] = "ppo"

    clip_epsilon: float = 0.2
    """Range of the probability ratio that is not clipped."""
    entropy_coeff: float = 1e-3
    """Weight of the entropy bonus."""
    init_std: float = 1.0
    """Standard deviation of an action before tanh, at the start."""


@dataclasses.dataclass(frozen=True)
class REPPOConfig(TrainingConfig):
    """Settings of relative entropy pathwise policy optimization.

    Raises:
        ValueError: a field is out of range, or does not fit another; the message names what is valid.
    """

    algorithm: ClassVar[str] = "reppo"

    kl_bound: float = 0.1
    """Divergence from the policy that collected a batch, in one state, from which on an action is drawn back (nats)."""
    init_kl_weight: float = 0.01
    """Weight of that divergence at the start; it is learned."""
    target_entropy: float = -0.5
    """Entropy of an action that is aimed at, for each of its entries (nats)."""
    init_temperature: float = 0.01
    """Weight of the entropy at the start; it is learned."""
    min_temperature: float = 3e-4
    """Least weight of the entropy. From much less it would take too long to rise again when entropy falls."""
    num_bins: int = 151
    """Bins of the critic's distribution over returns."""
    max_value: float = 150.0
    """Return that the last bin stands for; the first stands for 0."""
    aux_coeff: float = 1.0
    """Weight of the critic's second task, which is to foresee its own features of the next step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.init_temperature < self.min_temperature:
            raise ValueError(
                f"init_temperature ({self.init_temperature}) must not be below min_temperature ({self.min_temperature})"
            )
        if self.num_bins < 2:
            raise ValueError(f"num_bins must be an integer of at least 2, got {self.num_bins}")


CONFIGS: dict[str, type[TrainingConfig]] = {config.algorithm: config for config in (PPOConfig, REPPOConfig)}


# Lower and upper end of what each real-valued field may be; the lower end itself is allowed where it is listed.
_RANGES: dict[str, tuple[float, float]] = {
    "gamma": (0, 1),
    "lmbda": (0, 1),
    "clip_epsilon": (0, 1),
    "final_lr": (0, 1),
    "target_entropy": (-math.inf, math.inf),
}
_MAY_BE_ZERO = ("lmbda", "entropy_coeff", "video_seconds", "final_lr", "aux_coeff", "checkpoint_seconds")


def _check_kind_of_device(name: str) -> None:
    if not re.fullmatch(r"cpu|cuda(:\d+)?", str(name)):
        raise ValueError(f"no device {name!r}: choose one of cpu, cuda, cuda:0, ...")


def _check_range(name: str, value: Any) -> None:
    low, high = _RANGES.get(name, (0, math.inf))
    above = value >= low if name in _MAY_BE_ZERO else value > low
    if not (above and value <= high and math.isfinite(value)):
        bracket = "[" if name in _MAY_BE_ZERO else "("
        raise ValueError(f"{name} must lie in {bracket}{low}, {high}], got {value}")
