"""What a policy earns over full episodes, and how it looks: evaluations, videos and the viewer in a window."""

import io
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import EnvBase, step_mdp
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tqdm.auto import trange

from torchrl_loco.checks import SEED, check_float, check_int
from torchrl_loco.collector import RolloutCollector
from torchrl_loco.envs import LocoEnv
from torchrl_loco.eyes.scene import to_the_horizon
from torchrl_loco.policy import Policy, load_policy, shipped_policies
from torchrl_loco.storage import replace_file
from torchrl_loco.training.algorithm import settings_for_small_networks
from torchrl_loco.training.config import TrainingConfig, check_video
from torchrl_loco.training.environments import make_for
from torchrl_loco.training.run_folder import RunFolder

PolicyFunc = Callable[[TensorDictBase], TensorDictBase]  # reads observation and writes action

PIECE = 25  # about how many frames are taken, and recorded, at a time: a whole number of actions
SIZE = 480, 360  # width and height of videos


class Evaluator:
    """Plays full episodes without exploration, for the same seed the same ones, until the last one has ended.

    On CUDA the steps are recorded in the first evaluation, and then replayed: for another policy of the same kind, load
    its weights into this one. There is a world for each episode.

    Attributes:
        metrics: of the last evaluation, by name, the terms of the reward, summed over an episode, and the task's
            metrics, means over its steps; all are means over episodes.
    """

    def __init__(self, policy: PolicyFunc, env: Any, action_repeat: int = 1) -> None:
        self.policy: Any = policy
        self.env = env
        self.metrics: dict[str, float] = {}
        self._frames = action_repeat * max(1, PIECE // action_repeat)
        self._held = _Held(policy, action_repeat)
        # A function is not watched for other weights, so it must not be recorded as if it were a module.
        held = self._held if isinstance(policy, nn.Module) else self._held.forward
        self._collector = RolloutCollector(
            env,
            policy if action_repeat == 1 else held,
            frames_per_batch=env.num_envs * self._frames,
            exploration_type=ExplorationType.DETERMINISTIC,
        )

    def returns(self, seed: int) -> torch.Tensor:
        """Returns the return of each episode, shape ``(episodes,)``; ``seed`` decides their initial states.

        An episode that the task cuts off before the time limit counts as if it had gone on as it was: else a policy
        that leaves its patch of rough ground would earn less than one that stays on it.
        """
        self.env.set_seed(seed)
        self._collector.load_state_dict({})
        returns = torch.zeros(self.env.num_envs, 1, device=self.env.device)
        alive = torch.ones_like(returns, dtype=torch.bool)
        steps, cut_off = torch.zeros_like(returns), torch.zeros_like(alive)
        sums, counts, earned = dict[str, torch.Tensor](), dict[str, torch.Tensor](), dict[str, torch.Tensor]()
        pieces = math.ceil(self.env.config.episode_length / self._frames)
        for _ in trange(pieces, desc="evaluation", leave=False, disable=None):  # no bar in logs
            self._held.begin()
            after = self._collector.rollout()["next"]
            metrics, terms = after.get("metrics", {}), after.get("reward_terms", {})
            signals = [after[name].unbind(1) for name in ("reward", "done", "terminated")]
            for t, (reward, done, terminated) in enumerate(zip(*signals, strict=True)):
                returns += torch.where(alive, reward, 0.0)
                steps += alive
                cut_off |= alive & done & ~terminated
                for name, values in metrics.items():
                    counted = alive & ~values[:, t].isnan()
                    sums[name] = sums.get(name, 0.0) + torch.where(counted, values[:, t], 0.0)
                    counts[name] = counts.get(name, 0.0) + counted
                for name, values in terms.items():
                    earned[name] = earned.get(name, 0.0) + torch.where(alive, values[:, t], 0.0)
                alive &= ~done
            if not alive.any():
                break
        share = torch.where(cut_off, (self.env.config.episode_length / steps).clamp(min=1.0), 1.0)
        self.metrics = {f"reward/{name}": (total * share).mean().item() for name, total in earned.items()}
        self.metrics |= {f"metric/{name}": (total / counts[name]).nanmean().item() for name, total in sums.items()}
        return (returns * share).squeeze(-1)


class _Held(nn.Module):
    """A policy each of whose actions is held for several frames; recordings have whole numbers of actions."""

    out_keys = ("action",)

    def __init__(self, policy: PolicyFunc, action_repeat: int) -> None:
        super().__init__()
        self._policy, self._repeat, self._frame = policy, action_repeat, 0

    def begin(self) -> None:
        """Lets the next frame be the first of an action, also after an evaluation that was interrupted."""
        self._frame = 0

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Returns ``td`` with the action, which the policy chooses in the first of its frames."""
        if self._frame % self._repeat == 0:
            self._action = self._policy(td.copy())["action"]
        self._frame += 1
        return td.set("action", self._action)


def summarize(returns: torch.Tensor) -> dict[str, float]:
    """Returns number, mean, standard deviation and extremes of episode returns of shape ``(episodes,)``."""
    return {
        "episodes": len(returns),
        "mean": returns.mean().item(),
        "std": returns.std(correction=0).item(),
        "min": returns.min().item(),
        "max": returns.max().item(),
    }


def describe(summary: dict[str, float]) -> str:
    """Returns the ``summary`` of an evaluation as a line of text."""
    if summary["episodes"] > 1 and summary["min"] == summary["max"]:
        return f"return {summary['mean']:.1f} in each of {summary['episodes']:.0f} episodes, which start and end alike"
    return (
        f"return {summary['mean']:.1f} +- {summary['std']:.1f} over {summary['episodes']:.0f} episodes "
        f"(min {summary['min']:.1f}, max {summary['max']:.1f})"
    )


def evaluation_seed(seed: int, final: bool) -> int:
    """Returns the seed of the episodes that select the best policy of a run, or of those that evaluate it at the end.

    Both differ from ``seed``, that of the training, and from each other.
    """
    return (seed + (1 + final) * 1_000_003) % 2**32


def evaluate_policy(policy: Policy, episodes: int | None = None, seed: int | None = None) -> dict[str, float]:
    """Evaluates a trained policy under the protocol that it was trained under, on the device on which it computes.

    Args:
        policy: a shipped policy, or one that a run has written.
        episodes: number of episodes; ``None`` takes that of the run, or a run's default.
        seed: seed of the episodes; ``None`` repeats those of the run's last evaluation.

    Returns:
        Number, mean, standard deviation and extremes of the returns.

    Raises:
        ValueError: an argument is out of range, or the policy was trained behind transforms.
    """
    info = policy.info
    of_run = info.get("eval_episodes", TrainingConfig.eval_episodes)
    episodes = check_int("episodes", of_run if episodes is None else episodes)
    seed = evaluation_seed(info.get("seed", 0), final=True) if seed is None else check_int("seed", seed, SEED)
    device = str(next(policy.parameters()).device)
    with settings_for_small_networks():
        env = make_for(policy, episodes, device, seed)
        return summarize(Evaluator(policy, env, info["action_repeat"]).returns(seed))


def evaluate_run(
    run: RunFolder, episodes: int | None = None, seed: int | None = None, device: str | None = None
) -> dict[str, float]:
    """Returns what :func:`evaluate_policy` does of the policy of a run; ``device=None`` takes that of its training.

    Raises:
        FileNotFoundError: the run has no policy yet.
        ValueError: an argument is out of range, or the policy cannot be read.
    """
    return evaluate_policy(run.load_policy(device or run.load_config().device), episodes, seed)


def shipped_return(config: TrainingConfig) -> str:
    """Returns a line that says what the shipped policy of a run's task earns, an empty one if none is shipped."""
    if config.task not in shipped_policies(config.protocol) or config.options:  # with which it earns something else
        return ""
    mean = load_policy(config.task, "cpu", config.protocol).info["mean"]
    return f"the policy shipped for {config.task} earns {mean:.1f}"


@torch.no_grad()
def play(policy: PolicyFunc, env: EnvBase, action_repeat: int, frames: int, label: str) -> Iterator[TensorDictBase]:
    """Yields what is under ``"next"`` of so many frames from a reset on, without exploration, beside a labelled bar.

    Further arguments are those of :func:`record`.
    """
    td = env.reset()
    for frame in trange(frames, desc=label, leave=False, disable=None):  # no bar in logs
        if frame % action_repeat == 0:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                td = policy(td)
        action = td["action"]
        td = env.step(td)
        yield td["next"]
        td = step_mdp(td).set("action", action)


def record(
    policy: PolicyFunc, env: LocoEnv, path: Path | str, seconds: float, action_repeat: int = 1, camera: str = "side"
) -> None:
    """Records the first world of an environment from its reset on, in real time.

    Args:
        policy: reads ``observation`` and writes ``action``.
        env: where it plays.
        path: the video file, written whole or not at all; its suffix chooses the container, the codec is H.264.
        seconds: length of the video (s).
        action_repeat: frames for which an action is held.
        camera: name of one of the model's cameras.

    Raises:
        ValueError: ``seconds`` or ``action_repeat`` is not positive, there is no such camera, or no batch of worlds.
        TypeError: one of them is no number.
    """
    seconds, action_repeat = check_float("seconds", seconds), check_int("action_repeat", action_repeat)
    env.check_picture(camera, *SIZE)
    if not env.batch_size:
        raise ValueError("the environment has no batch of worlds: make it with num_envs=1")
    frame_rate = 1 / env.config.ctrl_dt
    steps = play(policy, env, action_repeat, max(round(seconds * frame_rate), 1), "video")
    with settings_for_small_networks():
        write_video(path, (env.render(camera, *SIZE, worlds=1)[0] for _ in steps), frame_rate)


def write_video(path: Path | str, frames: Iterable[torch.Tensor], frame_rate: float) -> None:
    """Writes frames, uint8 ``(height, width, 3)``, as a video file, whole or not at all, as :func:`record` does."""
    check_video()
    import imageio.v3 as imageio

    content = io.BytesIO()
    with imageio.imopen(content, "w", plugin="pyav", extension=Path(path).suffix) as video:
        video.init_video_stream("h264", fps=frame_rate)
        for frame in frames:
            video.write_frame(frame.cpu().numpy())
    replace_file(Path(path), content.getvalue())


def has_display() -> bool:
    """Returns whether MuJoCo's viewer can open a window."""
    if sys.platform == "darwin":  # where the viewer needs MuJoCo's own launcher
        return "mjpython" in Path(sys.argv[0]).name or "MJPYTHON_BIN" in os.environ
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw warns where it fails
        return bool(glfw.init())


def view(policy: PolicyFunc, env: LocoEnv, action_repeat: int = 1) -> None:
    """Shows the first world of an environment in MuJoCo's viewer, in real time, until its window is closed.

    Arguments are those of :func:`record`.
    """
    import mujoco.viewer  # needs a display

    model = to_the_horizon(env.mj_model if env.ghost() is None else env.model_with_ghost)
    data = mujoco.MjData(model)
    with mujoco.viewer.launch_passive(model, data) as window:
        with window.lock():  # a free camera would lose a body that runs
            window.cam.type, window.cam.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        while window.is_running():
            due = time.perf_counter()
            for _ in play(policy, env, action_repeat, env.config.episode_length, "episode"):
                ghost = env.ghost()
                data.qpos[:] = (env.sim.qpos if ghost is None else torch.cat([env.sim.qpos, ghost], dim=-1))[0].cpu()
                for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_camlight):  # all that is seen
                    update(model, data)
                window.sync()
                due += env.config.ctrl_dt
                time.sleep(max(0.0, due - time.perf_counter()))
                if not window.is_running():
                    break
