"""Experience: the environment as a policy sees it, and TorchRL's Collector on it."""

from typing import Any

from torchrl.collectors import Collector
from torchrl.envs import FrameSkipTransform, TransformedEnv
from torchrl.modules import ProbabilisticActor

from torchrl_loco.registry import make
from torchrl_loco.training.presets import PPOConfig


def make_env(config: PPOConfig, num_envs: int, **options: Any) -> TransformedEnv:
    """Makes the environment of a run, which holds an action for ``config.action_repeat`` frames and sums the reward."""
    env = make(config.task, num_envs, config.device, protocol=config.protocol, **options)
    return TransformedEnv(env, FrameSkipTransform(config.action_repeat))


def make_collector(config: PPOConfig, env: TransformedEnv, actor: ProbabilisticActor) -> Collector:
    """Makes the collector: iterating it gives batches of shape ``(num_envs, decisions)``."""
    return Collector(
        env,
        actor,
        frames_per_batch=config.batch_size,
        total_frames=config.total_frames // config.frames_per_batch * config.batch_size,
        device=config.device,
        track_traj_ids=False,  # tracking synchronises with the device at every step
        auto_register_policy_transforms=False,
        trust_policy=True,
    )
