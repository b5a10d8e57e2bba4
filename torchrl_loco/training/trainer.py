"""The training loop: collect, update, log; evaluate and save now and then; plot and record at the end."""

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import EnvBase, FrameSkipTransform
from tqdm.auto import tqdm

from torchrl_loco.checks import check_device
from torchrl_loco.collector import RolloutCollector
from torchrl_loco.envs.autoreset import TransformedEnv
from torchrl_loco.policy import Policy
from torchrl_loco.registry import env_class, make
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import deterministic_policy
from torchrl_loco.training.algorithm import Algorithm, settings_for_small_networks
from torchrl_loco.training.config import TrainingConfig, check_loggers
from torchrl_loco.training.evaluation import (
    Evaluator,
    describe,
    evaluate_policy,
    evaluation_seed,
    fallen_return,
    poor_return,
    summarize,
)
from torchrl_loco.training.interrupts import interruptible
from torchrl_loco.training.loggers import Loggers
from torchrl_loco.training.playback import record
from torchrl_loco.training.plots import plot_runs
from torchrl_loco.training.ppo import PPO
from torchrl_loco.training.reppo import REPPO
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.trials import Trials

ALGORITHMS: dict[str, Callable[[Any], Algorithm]] = {"ppo": PPO, "reppo": REPPO}


class Trainer:
    """A training run: environment, algorithm, collector and counters.

    Within :func:`torchrl_loco.training.distributed.joined` each rank makes a trainer of the same run, steps worlds of
    its own, and learns from those of all ranks; rank 0 alone writes into the folder. ``num_envs`` and
    ``minibatch_size`` are those of a rank; frames count all ranks'.

    Args:
        run: the folder from which settings are read and into which everything is written.
        resume: whether to continue from the run's checkpoint. On the CPU, a run that was stopped and resumed equals one
            that was not, bit for bit. With another number of ranks, parameters and counters continue, the worlds start
            anew, and what that changes is printed.

    Raises:
        FileNotFoundError: there is no checkpoint to resume from.
        ValueError: the checkpoint cannot be read; the run is complete, or too short for so many ranks; trials are
            running that another number of ranks or of frames does not fit.
        ImportError: the package of a logger is missing.
    """

    def __init__(self, run: RunFolder, resume: bool = False) -> None:
        self.run = run
        config = run.load_config()
        self.config = config = dataclasses.replace(config, device=distributed.own_device(config.device))
        check_device(config.device)
        check_loggers(config.logger)
        checkpoint = run.load_checkpoint(config.device) if resume else None
        part, frames = config.shortest_part
        if checkpoint is None and frames < self.frames_per_iteration:
            raise ValueError(
                f"{part} ({frames}) must be at least {self.frames_per_iteration}: one batch of "
                f"{config.frames_per_batch} on each of {distributed.ranks()} ranks"
            )
        torch.manual_seed(config.seed)
        first, rank = distributed.is_first(), distributed.rank()
        self.env = make_env(config, run.nan_dump if first else run.nan_dump.with_stem(f"nan_dump_rank{rank}"))
        self.algorithm = ALGORITHMS[config.algorithm](config)
        self.trials = Trials(config, self.algorithm, self.frames_per_iteration)
        self.collector = RolloutCollector(self.env, self.algorithm.actor, frames_per_batch=config.batch_size)
        self.frames, self.iteration, self.seconds = 0, 0, 0.0
        self._best = -math.inf  # the evaluation that selected the policy
        if not first:  # the networks began alike, from here on each rank draws actions of its own
            torch.manual_seed(distributed.own_seed(config.seed))
        if checkpoint is not None:
            self._load(checkpoint)
        elif first:
            run.forget_after(0)  # what a process wrote that torchrun has restarted before its first checkpoint
        distributed.copy_from_first(self.algorithm.networks.state_dict().values())
        self._evaluator: Evaluator | None = None

    def train(self) -> None:
        """Trains to the last frame, then evaluates the best policy, plots the learning curve and records a video.

        A progress bar shows the return (mean reward of the last batch times the length of an episode) and the frames
        per second. At Ctrl-C or SIGTERM the iteration is finished and a checkpoint written before KeyboardInterrupt is
        raised; a second one stops at once.

        Raises:
            KeyboardInterrupt: Ctrl-C or SIGTERM.
            OSError: a logger cannot be opened.
        """
        with settings_for_small_networks():
            try:
                self._train()
            finally:
                self.algorithm.release()
            self.save()
            if distributed.is_first():
                self._finish()
            distributed.wait_for_all()

    def _train(self) -> None:
        config, first = self.config, distributed.is_first()
        saved, frames = time.perf_counter(), {"total": self.last_frame, "initial": self.frames}
        with (
            Loggers(self.run, self.frames) if first else contextlib.nullcontext() as loggers,
            tqdm(**frames, unit="frame", unit_scale=True, desc=config.task, disable=not first) as bar,
            interruptible(
                "stopping after this update, with a checkpoint; Ctrl-C again stops at once" if first else ""
            ) as interrupted,
        ):
            while self.frames < self.last_frame:
                row = self._iterate()
                if loggers is not None:
                    self.run.append_metrics(row)
                    loggers.log(row, self.frames)
                trial = {"trial": self.trials.label} if self.trials.running else {}
                bar.set_postfix({**trial, "return": f"{row['return']:.0f}"}, refresh=False)
                bar.update(self.frames_per_iteration)
                trial_is_over = self.trials.is_over(self.frames)
                if trial_is_over or self.frames >= self.last_frame or self._evaluation_is_due():
                    mean = None
                    if loggers is not None:
                        mean = self._evaluate()["mean"]
                        loggers.log({"evaluation": mean}, self.frames)
                    distributed.wait_for_all()
                    if trial_is_over:
                        self.trials.end(self.frames, distributed.from_first(mean))
                is_late = time.perf_counter() - saved > config.checkpoint_seconds
                stop, is_late = distributed.any_rank(interrupted(), is_late)
                if stop or is_late:
                    self.save()
                    saved = time.perf_counter()
                if stop:
                    if first:
                        plot_runs([self.run], self.run.path / "learning_curve.png")
                    raise KeyboardInterrupt

    @property
    def device_name(self) -> str:
        """Name of the device, with the number of ranks if there are several."""
        device = self.algorithm.device
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
        return name if distributed.ranks() == 1 else f"{distributed.ranks()} x {name}"

    @property
    def frames_per_iteration(self) -> int:
        """Frames between two updates, over all ranks."""
        return self.config.frames_per_batch * distributed.ranks()

    @property
    def last_frame(self) -> int:
        """Frames of a complete run, in whole batches from here on."""
        batches = (self.config.total_frames - self.frames) // self.frames_per_iteration
        return self.frames + batches * self.frames_per_iteration

    def _iterate(self) -> dict[str, float]:
        """Returns the metrics of collecting a batch and updating on it; reads from the device once."""
        config, algorithm, start = self.config, self.algorithm, time.perf_counter()
        full_length = env_class(config.task).defaults.episode_length  # in training, episodes may be shorter
        batch = self.collector.rollout()
        reward = batch["next", "reward"].mean() / config.action_repeat
        metrics = algorithm.update(batch, progress=self.trials.progress(self.frames))
        mean_reward, *means = distributed.mean_of_ranks(torch.cat([reward.view(1), metrics])).tolist()
        self.frames += self.frames_per_iteration
        self.iteration += 1
        seconds = time.perf_counter() - start
        self.seconds += seconds
        return {
            "iteration": self.iteration,
            "frames": self.frames,
            "seconds": round(self.seconds, 3),
            "frames_per_second": round(self.frames_per_iteration / seconds, 1),
            "return": round(mean_reward * full_length, 3),
            **{name: round(value, 6) for name, value in zip(algorithm.metric_names, means, strict=True)},
        }

    def _evaluation_is_due(self) -> bool:
        interval = self.config.eval_interval
        return interval > 0 and self.trials.own_frames(self.frames) % interval < self.frames_per_iteration

    def _evaluate(self) -> dict[str, float]:
        """Returns the summary of an evaluation of the current policy, which is saved if it is the best so far."""
        if self._evaluator is None:
            config, seed = self.config, evaluation_seed(self.config.seed, final=False)
            self._evaluator = Evaluator(
                config.task, config.eval_episodes, config.device, seed, config.protocol, config.action_repeat
            )
        when = {"frames": self.frames, "seconds": round(self.seconds, 3)}
        policy = deterministic_policy(self.algorithm.actor, self.config, {**when, "trained_on": self.device_name})
        summary = summarize(self._evaluator(policy))
        self.run.append_evaluation({**when, **summary})
        if summary["mean"] >= self._best:
            self._best = policy.info["selected_by"] = summary["mean"]
            policy.save(self.run.policy)
        return summary

    def _finish(self) -> None:
        """Evaluates the best policy in episodes that did not select it, plots the learning curve, records a video."""
        config = self.config
        policy = Policy.load(self.run.policy, config.device)
        summary = evaluate_policy(policy)
        plot_runs([self.run], self.run.path / "learning_curve.png")
        if config.video_seconds > 0:
            env = make(
                config.task, 1, config.device, evaluation_seed(config.seed, final=True), config.protocol, world_offset=0
            )
            record(policy, env, self.run.video, config.video_seconds, config.action_repeat)
        policy.info |= summary
        policy.save(self.run.policy)  # the last thing: it marks the run as finished
        print(f"best policy, in new episodes: {describe(summary)}")
        fallen = fallen_return(config, self.run.read_evaluations(), self.run.seeds)
        for note in filter(None, (fallen, poor_return(config, summary, self.run.seeds))):
            print(note)

    def save(self) -> None:
        """Writes the checkpoint, from which a run continues exactly; all ranks must call it."""
        on_cuda = self.algorithm.device.type == "cuda"
        own = {
            "collector": self.collector.state_dict(),
            "rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state(self.algorithm.device) if on_cuda else None,
        }
        if not distributed.is_first():  # that of rank 0 is the algorithm's
            own["generator"] = self.algorithm.generator.get_state()
        ranks = distributed.gathered(own)
        if distributed.is_first():
            counters = {"frames": self.frames, "iteration": self.iteration, "seconds": self.seconds}
            of = {
                "settings": self._identity(),
                "algorithm": self.algorithm.state_dict(),
                "trials": self.trials.state_dict(),
            }
            self.run.save_checkpoint({**counters, **of, **ranks[0], "further_ranks": ranks[1:]})
        distributed.wait_for_all()

    def _identity(self) -> dict[str, Any]:
        """Returns the settings that must not change while a run is stopped."""
        return {name: getattr(self.config, name) for name in ("algorithm", "task", "protocol", "num_envs", "hidden")}

    def _load(self, checkpoint: dict[str, Any]) -> None:
        for name, value in self._identity().items():
            if checkpoint["settings"][name] != value:
                raise ValueError(
                    f"the checkpoint in {self.run.path} is of a run with {name}={checkpoint['settings'][name]!r}, but "
                    f"its config.json has {name}={value!r}"
                )
        self.frames, self.iteration, self.seconds = (checkpoint[key] for key in ("frames", "iteration", "seconds"))
        if self.frames >= self.last_frame and self.run.is_finished:
            raise ValueError(
                f"{self.run.path} is complete: it has all of its {self.frames} frames. Pass --total_frames to train on"
            )
        rank = distributed.rank()
        generator = self.algorithm.generator.get_state()
        self.algorithm.load_state_dict(checkpoint["algorithm"])
        self.trials.load_state_dict(checkpoint["trials"])
        if distributed.is_first():
            self.run.forget_after(self.frames)
            means = [row["mean"] for row in self.run.read_evaluations()]
            if self.run.policy.is_file():  # maybe of an evaluation after the checkpoint, which is repeated inexactly
                means.append(Policy.load(self.run.policy, "cpu").info.get("selected_by", -math.inf))
            self._best = max(means, default=-math.inf)
        before = 1 + len(checkpoint.get("further_ranks", ()))  # a checkpoint without is of one process
        if before != distributed.ranks():
            self.algorithm.generator.set_state(generator)
            self._say_what_changes(before)
            return
        own = checkpoint if rank == 0 else checkpoint["further_ranks"][rank - 1]
        self.collector.load_state_dict(own["collector"])
        torch.set_rng_state(own["rng"].cpu())
        if own["cuda_rng"] is not None and self.algorithm.device.type == "cuda":
            torch.cuda.set_rng_state(own["cuda_rng"].cpu(), self.algorithm.device)
        if rank > 0:
            self.algorithm.generator.set_state(own["generator"].cpu())

    def _say_what_changes(self, ranks_before: int) -> None:
        """Prints what a run gets that was trained by another number of ranks.

        Raises:
            ValueError: what remains is less than a batch of so many ranks.
        """
        if self.frames >= self.last_frame:
            raise ValueError(
                f"only {self.config.total_frames - self.frames} frames remain, less than a batch of "
                f"{distributed.ranks()} ranks ({self.frames_per_iteration}): continue with {ranks_before}, as before"
            )
        if distributed.is_first():
            config, now = self.config, distributed.ranks()
            print(
                f"ranks: {ranks_before} so far, {now} from here on. A batch has {now * config.num_envs} worlds instead "
                f"of {ranks_before * config.num_envs}, a gradient step {now * config.minibatch_size} steps instead of "
                f"{ranks_before * config.minibatch_size}. All worlds start anew; networks, optimizers and counters "
                "continue",
                file=sys.stderr,
            )


def make_env(config: TrainingConfig, nan_dump: Path) -> EnvBase:
    """Returns the environment of a run: each action is held for ``config.action_repeat`` frames, rewards are summed.

    Its worlds are those of this rank: world k of rank r is world ``r * num_envs + k`` of the whole.

    If a world becomes non-finite, a NaN dump is written to ``nan_dump``, unless one is already there.
    """
    env = make(
        config.task,
        config.num_envs,
        config.device,
        config.seed,
        config.protocol,
        world_offset=distributed.rank() * config.num_envs,
        stagger=True,
        episode_length=config.episode_length,
        nan_dump=None if nan_dump.exists() else nan_dump,
    )
    return env if config.action_repeat == 1 else TransformedEnv(env, FrameSkipTransform(config.action_repeat))
