"""The training loop: collect, update, write down; at the end evaluate, plot and record."""

import time

import torch
from torchrl.modules import ProbabilisticActor
from tqdm.auto import tqdm

from torchrl_loco.envs.checks import check_count, check_seed
from torchrl_loco.training.collection import make_collector, make_env
from torchrl_loco.training.evaluation import evaluate, record
from torchrl_loco.training.networks import make_actor_critic
from torchrl_loco.training.presets import PPOConfig
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.update import PPOUpdate

EPISODE_LENGTH = 1000
"""Control steps of an episode of all tasks, to which the mean reward in training is scaled up."""


def evaluation_seed(config: PPOConfig) -> int:
    """Returns the seed that the run's evaluation draws its episodes from, apart from those of training."""
    return (config.seed + 1_000_003) % 2**32


def train(run: RunFolder) -> None:
    """Runs PPO as the settings in a new run folder say, and fills the folder.

    A progress bar shows the return (mean reward of the last batch times the length of an episode) and the frames per
    second. Interrupted, the run still leaves its checkpoint and learning curve.
    """
    config = run.load_config()
    print(f"run folder: {run.path}")
    torch.manual_seed(config.seed)
    env = make_env(config, config.num_envs, seed=config.seed, stagger=True, episode_length=config.episode_length)
    actor, critic, norm = make_actor_critic(config, env.base_env.observation_size, env.action_spec)
    update = PPOUpdate(config, actor, critic)
    collector = make_collector(config, env, actor)
    frames, start = 0, time.perf_counter()
    try:
        with tqdm(total=config.total_frames, unit="frame", unit_scale=True, desc=config.task) as bar:
            for iteration, batch in enumerate(collector):
                reward = batch["next", "reward"].mean().item() / config.action_repeat
                losses = update(batch, progress=frames / config.total_frames)
                norm.update(batch["observation"])  # after the update: its old log-probabilities stay comparable
                frames += config.frames_per_batch
                seconds = time.perf_counter() - start
                row = {
                    "iteration": iteration,
                    "frames": frames,
                    "seconds": round(seconds, 3),
                    "frames_per_second": round(frames / seconds, 1),
                    "return": round(reward * EPISODE_LENGTH, 3),
                    **{key: round(value, 6) for key, value in losses.items()},
                }
                run.append_metrics(row)
                bar.set_postfix({"return": f"{row['return']:.0f}"}, refresh=False)
                bar.update(config.frames_per_batch)
    finally:
        collector.shutdown()
        if frames:
            run.save_checkpoint(
                {
                    "frames": frames,
                    "actor": actor.state_dict(),
                    "critic": critic.state_dict(),
                    "optimizer": update.optimizer.state_dict(),
                }
            )
            run.plot_learning_curve()
    finish(run, actor)


def finish(run: RunFolder, actor: ProbabilisticActor) -> None:
    """Evaluates the trained policy, draws the learning curve and records the video."""
    config = run.load_config()
    seed = evaluation_seed(config)
    summary = summarize(evaluate(actor, config, config.eval_episodes, seed))
    run.save_evaluation(summary)
    run.plot_learning_curve(summary)
    if config.video_seconds > 0:
        record(actor, config, run.video, config.video_seconds, seed)
    report(summary)


def evaluate_run(
    run: RunFolder, episodes: int | None = None, seed: int | None = None, device: str | None = None
) -> dict[str, float]:
    """Evaluates the policy in a run's checkpoint and returns the summary of the returns.

    Args:
        run: the run.
        episodes: number of episodes; ``None`` takes the run's own setting.
        seed: seed that the episodes are drawn from; ``None`` plays those of the run's own evaluation again.
        device: where to play them; ``None`` takes where the run was trained.

    Raises:
        FileNotFoundError: the run has no checkpoint.
        ValueError: an argument is out of range, or the checkpoint cannot be read.
    """
    config = run.load_config() if device is None else run.load_config(device=device)
    episodes = check_count("episodes", config.eval_episodes if episodes is None else episodes)
    seed = evaluation_seed(config) if seed is None else check_seed(seed)
    env = make_env(config, 1)
    actor, _, _ = make_actor_critic(config, env.base_env.observation_size, env.action_spec)
    actor.load_state_dict(run.load_checkpoint(config.device)["actor"])
    return summarize(evaluate(actor, config, episodes, seed))


def summarize(returns: torch.Tensor) -> dict[str, float]:
    """Returns number, mean, standard deviation and extremes of episode returns of shape ``(episodes,)``."""
    return {
        "episodes": len(returns),
        "mean": returns.mean().item(),
        "std": returns.std(correction=0).item(),
        "min": returns.min().item(),
        "max": returns.max().item(),
    }


def report(summary: dict[str, float]) -> None:
    """Prints the summary of an evaluation."""
    print(
        f"return {summary['mean']:.1f} +- {summary['std']:.1f} over {summary['episodes']:.0f} episodes "
        f"(min {summary['min']:.1f}, max {summary['max']:.1f})"
    )
