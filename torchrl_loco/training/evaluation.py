"""How good a policy is, and what it looks like."""

from collections.abc import Callable, Iterator
from pathlib import Path

import imageio.v3 as imageio
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, step_mdp
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm.auto import trange

from torchrl_loco.registry import make
from torchrl_loco.training.presets import PPOConfig

Policy = Callable[[TensorDictBase], TensorDictBase]


def evaluate(policy: Policy, config: PPOConfig, episodes: int, seed: int) -> torch.Tensor:
    """Plays full episodes of the task in fresh worlds, without exploration.

    Returns:
        The return of each episode, shape ``(episodes,)``.
    """
    env = make(config.task, episodes, config.device, seed, config.protocol)
    returns = torch.zeros(episodes, 1, device=env.device)
    alive = torch.ones_like(returns, dtype=torch.bool)
    for after in _play(policy, env, config.action_repeat, env.config.episode_length, "evaluation"):
        returns += after["reward"] * alive
        alive &= ~after["done"]
    return returns.squeeze(-1)


def record(policy: Policy, config: PPOConfig, path: Path, seconds: float, seed: int, camera: str = "side") -> None:
    """Writes a video of one world from its reset on, in real time."""
    env = make(config.task, 1, config.device, seed, config.protocol)
    frame_rate = round(1 / env.config.ctrl_dt)
    with imageio.imopen(path, "w", plugin="pyav") as video:
        video.init_video_stream("h264", fps=frame_rate)
        for _ in _play(policy, env, config.action_repeat, round(seconds * frame_rate), "video"):
            video.write_frame(env.render(camera, 480, 360)[0].cpu().numpy())


@torch.no_grad()
def _play(policy: Policy, env: EnvBase, action_repeat: int, frames: int, label: str) -> Iterator[TensorDictBase]:
    """Yields what each of so many frames from a reset brings, with every action held for ``action_repeat`` of them."""
    td = env.reset()
    for frame in trange(frames, desc=label, leave=False):
        if frame % action_repeat == 0:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                td = policy(td)
        action = td["action"]
        td = env.step(td)
        yield td["next"]
        td = step_mdp(td).set("action", action)
