"""The training loop: collect, update, log; evaluate and save now and then; plot and record at the end."""

import contextlib
import copy
import dataclasses
import functools
import gc
import json
import logging
import math
import sys
import time
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tqdm.auto import tqdm

from torchrl_loco.checks import check_device, several
from torchrl_loco.collector import RolloutCollector
from torchrl_loco.envs.access import set_stage
from torchrl_loco.envs.imagined import STATE
from torchrl_loco.envs.transforms import load_transforms, state_of_transforms
from torchrl_loco.policy import Policy
from torchrl_loco.sim.simulation import check_memory
from torchrl_loco.source import content_of, source_of
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Spaces, deterministic_policy
from torchrl_loco.training.algorithm import Algorithm, begin_from, check_order, settings_for_small_networks
from torchrl_loco.training.config import check_packages_of
from torchrl_loco.training.environments import Environments, Given, unwrapped
from torchrl_loco.training.episodes import Episodes
from torchrl_loco.training.evaluation import Evaluator, describe, evaluation_seed, record, shipped_return, summarize
from torchrl_loco.training.loggers import Loggers
from torchrl_loco.training.plots import plot_runs
from torchrl_loco.training.ppo import PPO
from torchrl_loco.training.process import interruptible, lock, unlock
from torchrl_loco.training.reppo import REPPO
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.svg import SVG
from torchrl_loco.training.trials import Trials

COPIES_IN_BATCH = 8
"""How often the pixels of a batch lie in memory: before and after a step, collected, stacked, packed and shuffled."""
_ALIVE: "weakref.WeakSet[Trainer]" = weakref.WeakSet()
ALGORITHMS: dict[str, type[Algorithm]] = {cls.config_type.algorithm: cls for cls in (PPO, REPPO, SVG)}


class NothingToLearnError(ValueError):
    """No step of a batch was finite, or the networks are no longer finite."""


class Trainer:
    """A training run: environment, algorithm, collector and counters.

    Within :func:`torchrl_loco.training.distributed.joined` each rank makes a trainer of the same run, steps worlds of
    its own, and learns from those of all ranks; rank 0 alone writes into the folder. ``num_envs`` and
    ``minibatch_size`` are those of a rank; frames count all ranks'.

    Args:
        run: the folder from which settings are read and into which everything is written.
        resume: whether to continue from the run's checkpoint. On the CPU, a run that was stopped and resumed equals one
            that was not, bit for bit, but one of svg, which forgets its steps. With another number of ranks, parameters
            and counters continue, the worlds start anew, and what that changes is printed.
        given: what is handed in as objects.
        total_frames: to how many frames a resumed run is trained; ``None`` leaves that as it was. As the device, it is
            stored in the folder once nothing is left to be refused.
        device: where a resumed run goes on; ``None`` keeps its device.
        options: of its task; ``None`` keeps them.

    Raises:
        FileNotFoundError: there is no checkpoint to resume from.
        ValueError: the checkpoint cannot be read; the run is complete, or too short for so many ranks; the run was
            begun with other objects; ``total_frames`` is not more than it has.
        TypeError: the network has a part that a policy's file cannot hold.
        ImportError: the package of a logger is missing.
        BlockingIOError: another process is training the run.
    """

    def __init__(
        self,
        run: RunFolder,
        resume: bool = False,
        given: Given | None = None,
        *,
        total_frames: int | None = None,
        device: str | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        if _ALIVE:  # they lie in cycles: batches, graphs and worlds of earlier trainings would stay beside its own
            gc.collect()
        _ALIVE.add(self)
        self.run = run
        changes = {"total_frames": total_frames, "device": device, "options": options}
        with contextlib.ExitStack() as undone:
            if distributed.is_first() and lock(run.path):
                undone.callback(unlock, run.path)
                run.remove_parts()
            self._make(given or Given(), resume, {name: new for name, new in changes.items() if new is not None})
            undone.pop_all()

    def _make(self, given: Given, resume: bool, changes: dict[str, Any]) -> None:
        run = self.run
        if resume:
            given.check(run)
        stored = run.load_config(**changes)
        self.config = config = dataclasses.replace(stored, device=distributed.own_device(stored.device))
        check_device(config.device)
        check_packages_of(config)
        checkpoint = run.load_checkpoint(config.device) if resume else None
        part, frames = config.shortest_part
        if checkpoint is None and frames < self.frames_per_iteration:
            raise ValueError(
                f"{part} ({frames}) must be at least {self.frames_per_iteration}: one batch of "
                f"{config.control_steps_per_batch} on each of {distributed.ranks()} ranks"
            )
        make_algorithm = given.algorithm or ALGORITHMS[config.algorithm]
        if torch.device(config.device).type == "cuda":
            make_algorithm.start_compilers(config)  # while the environment is made
        torch.manual_seed(config.seed)
        first, rank = distributed.is_first(), distributed.rank()
        self.environments = Environments(dataclasses.replace(config, task=run.task), given.env)
        dump = run.nan_dump if first else run.nan_dump.with_stem(f"nan_dump_rank{rank}")
        self.env = self.environments.training(dump)
        spaces = Spaces.of(self.env, config.critic_from_pixels)
        if spaces.pixels:
            needed = COPIES_IN_BATCH * config.frames_per_batch * math.prod(spaces.pixels)
            check_memory(needed, config.num_envs, torch.device(config.device))
        self.algorithm = make_algorithm(config, spaces, given.network)
        deterministic_policy(self.algorithm.actor, config, {})  # raises an error where it could not be saved
        self._base, _ = unwrapped(self.env)
        seen = {*self._base.groups, "depth"} & {*self.env.observation_spec.keys()}
        unread = ", ".join(sorted(seen - {"observation", "privileged", "pixels", STATE}))
        if unread and first and not self.environments.transforms and given.algorithm is None:  # which may read them
            logging.getLogger("torchrl_loco").warning(
                "networks do not read %s: join them to 'observation', in the task or by transforms", unread
            )
        length, from_start = self.environments.full_length, not self._base.stagger
        self.algorithm.attach(self._base)
        self.episodes = Episodes(config.num_envs, config.device, config.action_repeat, length, from_start)
        terms = self.env.observation_spec.get("reward_terms", None)
        self._terms = () if terms is None else tuple(terms.keys())
        self._content, self._source = content_of(run.task, self._base), source_of(run.task)
        self._progress_at_start = self._progress()
        self.trials = Trials(config, self.frames_per_iteration, self._begin_trial, self._kept_of_trial, self._restore)
        self.collector = RolloutCollector(self.env, self.algorithm.acting(), frames_per_batch=config.frames_per_batch)
        self._ahead: tuple[TensorDictBase, torch.Tensor] | None = None
        self._returned = 0.0  # when the last iteration ended
        self.frames, self.iteration, self.seconds = 0, 0, 0.0
        self._non_finite, self._index_errors, self._said = 0, 0, set[str]()
        self._alike: float | None = None  # the reward of the last batch, if there was only one
        self._ends_at_once = False
        self._best = -math.inf  # the evaluation that selected the policy
        self._transforms_of_best: dict[str, Any] = {}
        self._evaluator: Evaluator | None = None
        if not first:  # the networks began alike, from here on each rank draws actions of its own
            torch.manual_seed(distributed.own_seed(config.seed))
        if checkpoint is None and config.init:
            self._begin_from_init()
        if checkpoint is not None:
            self._load(checkpoint, changes.get("total_frames", math.inf))
        if first:  # nothing is refused any more
            if changes:
                run.store_config(stored)
            if resume:
                run.keep_source()
            run.forget_after(self.frames, self.iteration)  # of a process that was killed or restarted
        distributed.copy_from_first(self.algorithm.networks.state_dict().values())
        shared = self._base.world.shared
        self._summed = {name: shared[name].clone() for name in type(self._base).summed_over_ranks}

    # What trials begin with, and go back to.

    def _progress(self) -> dict[str, Any]:
        """Returns how far a curriculum has come, and what transforms have learned."""
        return {"stage": self._base.get_stage(), "transforms": state_of_transforms(self.env)}

    def _begin_from_init(self) -> None:
        begin_from(self.algorithm, Path(self.config.init), self.config.device, self._base.observation_layout)

    def _begin_trial(self) -> None:
        self.algorithm.begin_anew()
        if self.config.init:
            self._begin_from_init()
        distributed.copy_from_first(self.algorithm.networks.state_dict().values())
        self._set_progress(self._progress_at_start)

    def _kept_of_trial(self) -> dict[str, Any]:
        return {"algorithm": copy.deepcopy(self.algorithm.state_dict()), **self._progress()}

    def _restore(self, kept: dict[str, Any]) -> None:
        self.algorithm.restore(kept["algorithm"])
        self._set_progress(kept)

    def _set_progress(self, kept: dict[str, Any]) -> None:
        """Goes back to what :meth:`_progress` returned: the next episodes begin at its stage of the curriculum."""
        load_transforms(self.env, kept["transforms"])
        set_stage(self._base, kept["stage"])
        for name, values in self._summed.items():
            values.copy_(self._base.world.shared[name])

    def train(self) -> None:
        """Trains to the last frame, then evaluates the best policy, plots the learning curve and records a video.

        A progress bar shows the return (see :class:`torchrl_loco.training.episodes.Episodes`) and the frames per
        second. At Ctrl-C, SIGTERM or SIGHUP, which a terminal sends when it is closed, the iteration is finished, and
        the next if its batch is collected already; then a checkpoint is written before KeyboardInterrupt is raised. A
        second one stops at once.

        Raises:
            KeyboardInterrupt: one of these signals.
            OSError: a logger cannot be opened, or another process is training the run.
        """
        if distributed.is_first():
            lock(self.run.path)
        try:
            with settings_for_small_networks():
                try:
                    self._train()
                finally:
                    self.algorithm.release()
                self.save()
                if distributed.is_first():
                    self._finish()
                distributed.wait_for_all()
        finally:
            unlock(self.run.path)

    def _train(self) -> None:
        config, first = self.config, distributed.is_first()
        saved, frames = time.perf_counter(), {"total": self.last_frame, "initial": self.frames}
        with (
            Loggers(self.run, self.frames) if first else contextlib.nullcontext() as loggers,
            tqdm(**frames, unit="frame", unit_scale=True, desc=config.label, disable=not first) as bar,
            interruptible(
                "stopping after this update, with a checkpoint; Ctrl-C again stops at once" if first else ""
            ) as interrupted,
        ):
            self._returned = saved  # a pause since an earlier call is no time of a batch
            stop = is_late = False
            while self.frames < self.last_frame:
                row = self.iterate(ahead=not (stop or is_late))
                if loggers is not None:
                    self.run.append_metrics(row)
                    loggers.log(row, self.frames)
                trial = {"trial": self.trials.label} if self.trials.running else {}
                bar.set_postfix({**trial, "return": _rounded(row["return"])}, refresh=False)
                bar.update(self.frames_per_iteration)
                if first:
                    self._say_once(row)
                if self._evaluates_after(self.frames):
                    self._check_networks()
                    mean = None
                    if loggers is not None:
                        mean = self.evaluate()["mean"]
                        loggers.log({"evaluation": mean}, self.frames)
                    distributed.wait_for_all()
                    if self.trials.is_over(self.frames):
                        self.trials.end(self.frames, distributed.from_first(mean))
                        self.episodes.restart()
                is_late = time.perf_counter() - saved > config.checkpoint_seconds
                stop, is_late = distributed.any_rank(interrupted() or distributed.is_orphan(), is_late)
                if self._ahead is not None:  # no checkpoint holds that batch: the next update is on it
                    continue
                if stop or is_late:
                    self._check_networks()
                    self.save()
                    saved, is_late = time.perf_counter(), False
                if stop:
                    if first:
                        plot_runs([self.run], self.run.path / "learning_curve.png")
                    raise KeyboardInterrupt

    def _evaluates_after(self, frames: int) -> bool:
        """Returns whether an evaluation is due after so many frames: at the end of each policy, and in between."""
        interval = self.config.eval_interval
        between = bool(interval) and self.trials.own_frames(frames) % interval < self.frames_per_iteration
        return between or frames >= self.last_frame or self.trials.is_over(frames)

    def _check_networks(self) -> None:
        """Raises an error before networks that are not finite are evaluated, or take the place of a checkpoint."""
        if all(bool(part.isfinite().all()) for part in self.algorithm.networks.parameters()):
            return
        raise NothingToLearnError(
            f"the networks of {self.run.path} are not finite after {self.frames} frames: a smaller lr may help; "
            "the last rows of metrics.csv tell since when; an earlier checkpoint and policy are not overwritten"
        )

    def _say_once(self, row: dict[str, float]) -> None:
        """Prints what a user should know after a batch with these metrics, each thing once in a run."""
        notes = {}
        if self._non_finite and "non_finite" not in self._said:
            lost = self._index_errors
            beyond = f"; {lost} steps indexed constants or shared beyond their end" if lost else ""
            what = "episodes have ended because a state, an observation or a reward was not finite"
            notes["non_finite"] = f"{self._non_finite} {what}{beyond}"
        if self._alike is not None:
            notes["alike"] = f"the reward was {self._alike:g} in every step of every world: look at reward(self, s)"
        if self._ends_at_once:
            notes["ends_at_once"] = (
                "every episode ended at its first step: look at terminated(self, s) and begin(self, s)"
            )
        notes["algorithm"] = self.algorithm.note({key: [row[key]] for key in row})
        for kind, note in notes.items():
            if note and kind not in self._said:
                self._said.add(kind)
                tqdm.write(f"after {self.frames:,} frames: {note}")

    @property
    def device_name(self) -> str:
        """Name of the device, with the number of ranks if there are several."""
        device = self.algorithm.device
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
        return name if distributed.ranks() == 1 else f"{distributed.ranks()} x {name}"

    @property
    def frames_per_iteration(self) -> int:
        """Frames between two updates, over all ranks."""
        return self.config.control_steps_per_batch * distributed.ranks()

    @property
    def last_frame(self) -> int:
        """Frames of a complete run, in whole batches from here on."""
        batches = (self.config.total_frames - self.frames) // self.frames_per_iteration
        return self.frames + batches * self.frames_per_iteration

    def iterate(self, ahead: bool = False) -> dict[str, float]:
        """Returns the metrics of collecting a batch and updating on it; reads from the device once.

        The seconds are those of this call, or those since the last one if that collected the batch ahead.

        Args:
            ahead: whether the device may go on with the next batch while the host waits for the metrics.

        Raises:
            torchrl_loco.training.trainer.NothingToLearnError: no step of it was finite.
        """
        config, algorithm = self.config, self.algorithm
        start = time.perf_counter() if self._ahead is None else self._returned
        batch, ended = self._collect() if self._ahead is None else self._ahead
        self._ahead = None
        for name, kept in self._summed.items():
            distributed.add_changes(self._base.world.shared[name], kept)
        after = batch["next"]
        reward = after["reward"].mean() / config.action_repeat
        spread, ends = after["reward"].max() - after["reward"].min(), after["done"].float().mean()
        of_env = {f"reward/{name}": after["reward_terms", name].mean() / config.action_repeat for name in self._terms}
        told = {f"metric/{name}": after["metrics", name] for name in self._base.metric_names}
        of_env |= {name: values.nansum() for name, values in told.items()}
        counts = [(~values.isnan()).float().sum() for values in told.values()]
        health = self._base.health()["total"]
        lost = health["non_finite"], health["index_error"]
        numbers = torch.cat([ended, torch.stack([*lost, spread, ends, reward, *counts, *of_env.values()])])
        metrics = algorithm.update(batch, progress=self.trials.progress(self.frames))
        numbers = distributed.mean_of_ranks(torch.cat([numbers, metrics])).to("cpu", non_blocking=True)
        on_cuda = algorithm.device.type == "cuda"
        copied = torch.cuda.current_stream(algorithm.device).record_event() if on_cuda else None
        del batch, after  # so that the next one takes their place
        self._ahead = self._collected_ahead() if ahead else None
        if copied is not None:
            copied.synchronize()
        means = numbers.tolist()
        self.episodes.take(*(mean * distributed.ranks() for mean in means[:3]))
        non_finite, index_errors, spread, ends, mean_reward, *means = means[3:]
        self._index_errors = round(index_errors * distributed.ranks())
        counted, means = means[: len(counts)], means[len(counts) :]
        row = dict(zip((*of_env, *algorithm.metric_names, *algorithm.batch_metric_names), means, strict=True))
        for name, count in zip(told, counted, strict=True):  # over all ranks: each may have another number of steps
            row[name] = row[name] / count if count else math.nan
        before, self._non_finite = self._non_finite, round(non_finite * distributed.ranks())
        if ends == 1.0 and self._non_finite - before >= config.frames_per_batch * distributed.ranks():
            self._check_networks()
            raise NothingToLearnError(
                f"there is nothing to learn from: in all steps of a batch of {self.run.path} a state, observation or "
                "reward was not finite. torchrl-loco inspect shows the first, which its nan_dump.safetensors holds"
            )
        self._alike = mean_reward if spread == 0.0 else None
        self._ends_at_once = ends == 1.0
        self.frames += self.frames_per_iteration
        self.iteration += 1
        self._returned = time.perf_counter()
        seconds = self._returned - start
        self.seconds += seconds
        return {
            "iteration": self.iteration,
            "frames": self.frames,
            "seconds": round(self.seconds, 3),
            "frames_per_second": round(self.frames_per_iteration / seconds, 1),
            **self.episodes.metrics(mean_reward, self._base.config.episode_length),
            **{name: float(f"{value:.7g}") for name, value in row.items()},
        }

    def _collect(self) -> tuple[TensorDictBase, torch.Tensor]:
        """Returns a batch, and what :meth:`Episodes.add` says of it."""
        batch = self.collector.rollout()
        after = batch["next"]
        flags = (after[name].squeeze(-1) for name in ("done", "terminated"))
        return batch, self.episodes.add(after["reward"].squeeze(-1), *flags)

    def _collected_ahead(self) -> tuple[TensorDictBase, torch.Tensor] | None:
        """Returns the next batch, which CUDA collects after the algorithm's ``began``, or without one after the update.

        ``None`` where an evaluation follows, which begins at the stage of what was learned from, or a trial ends.
        """
        began = self.algorithm.began
        if self._evaluates_after(self.frames + self.frames_per_iteration):
            return None
        if not self.collector.replays or distributed.ranks() > 1:
            return None
        if began is None:
            return self._collect()
        now = torch.cuda.current_stream(self.algorithm.device)
        with torch.cuda.stream(self._beside):
            began.wait()
            collected = self._collect()
        now.wait_stream(self._beside)
        return collected

    @functools.cached_property
    def _beside(self) -> torch.cuda.Stream:
        return torch.cuda.Stream(self.algorithm.device)

    def evaluate(self) -> dict[str, float]:
        """Returns the summary of an evaluation of the current policy, which is saved if it is the best so far."""
        when = {"frames": self.frames, "seconds": round(self.seconds, 3)}
        of_env: dict[str, Any] = {"trained_on": self.device_name, "control_timestep": self._base.config.ctrl_dt}
        if stage := self._base.stage_of({"stage": self._base.get_stage()}):
            of_env["stage"] = stage
        of_env |= self.environments.own | ({"source_hash": self._source} if ":" in self.run.task else {})
        terms = self._base.observation_layout.get(self.algorithm.spaces.actor_key)
        if terms and not self.environments.transforms:
            of_env["terms"] = list(terms.items())
        policy = deterministic_policy(self.algorithm.actor, self.config, {**when, **of_env})
        self._compare_at(stage)
        summary = self._summary(policy, final=False)
        assert self._evaluator is not None
        self.run.append_evaluation({**when, **summary, **self._evaluator.metrics})
        if summary["mean"] >= self._best:
            self._best = policy.info["selected_by"] = summary["mean"]
            policy.save(self.run.policy)
            self._transforms_of_best = state_of_transforms(self.env)
        return summary

    def _compare_at(self, stage: Mapping[str, Any]) -> None:
        """Evaluates the best policy so far anew if a curriculum has gone on since: at its stage all was easier."""
        if not (stage and self._best > -math.inf):
            return
        best = Policy.load(self.run.policy, self.config.device)
        if best.info.get("stage") != json.loads(json.dumps(stage)):
            best.info["stage"], now = stage, state_of_transforms(self.env)
            load_transforms(self.env, self._transforms_of_best)
            self._best = best.info["selected_by"] = self._summary(best, final=False)["mean"]
            load_transforms(self.env, now)
            best.save(self.run.policy)

    def _summary(self, policy: Policy, final: bool) -> dict[str, float]:
        """Returns what a policy earns in the episodes that select the best policy, or in those at the end."""
        config, seed = self.config, evaluation_seed(self.config.seed, final)
        env = self.environments.evaluation(config.eval_episodes, seed, policy.info)
        if self._evaluator is None or self._evaluator.env is not env:  # with transforms it is a new one
            self._evaluator = Evaluator(policy, env, config.action_repeat)
        self._evaluator.policy.load_state_dict(policy.state_dict())
        return summarize(self._evaluator.returns(seed))

    def _finish(self) -> None:
        """Evaluates the best policy in episodes that did not select it, plots the learning curve, records a video."""
        config = self.config
        last = [row for row in self.run.read_evaluations() if row["frames"] == self.frames]
        if not (last and self.run.policy.is_file()):  # it was stopped, and no frame was left
            self.evaluate()
        recording = ", and its video is recorded" if config.video_seconds > 0 else ""
        print(f"all frames are done: the best policy plays new episodes{recording}", flush=True)
        policy = Policy.load(self.run.policy, config.device)
        load_transforms(self.env, self._transforms_of_best)
        summary = self._summary(policy, final=True)
        plot_runs([self.run], self.run.path / "learning_curve.png")
        if config.video_seconds > 0:
            seed = evaluation_seed(config.seed, final=True)
            shown = self.environments.shown(config.eval_episodes, seed, policy.info)
            record(policy, shown, self.run.video, config.video_seconds, config.action_repeat)
        policy.info |= summary | ({"options": dict(config.options)} if config.options else {})  # files may have moved
        policy.info["total_frames"] = config.total_frames
        policy.save(self.run.policy)  # the last thing: it marks the run as finished
        print(f"best policy, in new episodes: {describe(summary)}")
        shipped = "" if "full_length" in policy.info else shipped_return(config)
        for note in filter(None, (shipped, self.algorithm.note(self.run.read_metrics()))):
            print(note)

    def save(self) -> None:
        """Writes the checkpoint, from which a run continues exactly; all ranks must call it."""
        on_cuda = self.algorithm.device.type == "cuda"
        own = {
            "collector": self.collector.state_dict(),
            "episodes": self.episodes.state_dict(),
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
                "cases": list(self._base.cases().items()),
                "content": self._content,
                "options": _numbers_of(self.config.options),
                "spaces": dataclasses.asdict(self.algorithm.spaces),
                "algorithm": self.algorithm.state_dict(),
                "trials": self.trials.state_dict(),
                "transforms_of_best": self._transforms_of_best,
                "stage": self._base.get_stage(),
                "terms": list(self._terms),
                "observed": {group: list(sizes.items()) for group, sizes in self._base.observation_layout.items()},
                **self.environments.own,
            }
            self.run.save_checkpoint({**counters, **of, **ranks[0], "further_ranks": ranks[1:]}, self.config.keep)
        distributed.wait_for_all()

    def _identity(self) -> dict[str, Any]:
        """Returns the settings that must not change while a run is stopped."""
        names = ["algorithm", "task", "protocol", "num_envs", "hidden", "strides", "action_bound", "action_repeat"]
        names += ["randomize", "sim"]
        settings = dataclasses.asdict(self.config)
        return {name: settings[name] for name in names if name in settings}

    def _load(self, checkpoint: dict[str, Any], total_frames: float) -> None:
        for name, value in self._identity().items():
            if checkpoint["settings"].get(name, value) != value:  # one of an earlier revision may lack a setting
                raise ValueError(
                    f"the checkpoint in {self.run.path} is of a run with {name}={checkpoint['settings'][name]!r}, but "
                    f"its config.json has {name}={value!r}"
                )
        self.frames, self.iteration, self.seconds = (checkpoint[key] for key in ("frames", "iteration", "seconds"))
        if total_frames < self.frames:
            raise ValueError(
                f"total_frames must be at least the {self.frames} frames of {self.run.path}, got {total_frames}"
            )
        if self.frames >= self.last_frame and self.run.is_finished:
            raise ValueError(
                f"{self.run.path} is complete: it has all of its {self.frames} frames. Pass --total_frames to train on"
            )
        was_edited = checkpoint.get("content", self._content) != self._content
        sizes, now = checkpoint.get("spaces", {}), dataclasses.asdict(self.algorithm.spaces)
        if changed := [f"{key} {size}, now {now[key]}" for key, size in sizes.items() if now.get(key, size) != size]:
            raise ValueError(
                f"{self.run.path} cannot go on, since its networks were made for other sizes ({'; '.join(changed)}): "
                "train anew"
            )
        cases = list(self._base.cases().items())
        old = checkpoint.get("cases", cases)
        renamed = [steps for _, steps in old] == [steps for _, steps in cases] and not was_edited
        if old != cases and not renamed:  # the state of the worlds points into other tables
            named = [[f"{name} ({steps} steps)" for name, steps in each] for each in (old, cases)]
            of = [f"{', '.join(each[:3])}{' ...' * (len(each) > 3)}" for each in named]
            raise ValueError(
                f"{self.run.path} is a run of {len(old)} case(s), {of[0]}, and not of {len(cases)}, {of[1]}: train "
                "anew, with its weights by --init"
            )
        check_order(checkpoint.get("observed", {}), self._base.observation_layout, self.run.task)
        options = _numbers_of(self.config.options)
        was_edited |= checkpoint.get("options", options) != options
        if was_edited and distributed.is_first():
            print(
                f"{self.run.task} (a file or option of it, its model or a motion) was edited since the checkpoint: the "
                "run goes on as it is now, and its best policy is selected anew",
                file=sys.stderr,
            )
        terms = checkpoint.get("terms", self._terms)
        if set(terms) != set(self._terms) and distributed.is_first():
            names = [", ".join(each) or "none" for each in (terms, self._terms)]
            logging.getLogger("torchrl_loco").warning("terms of the reward: %s so far, %s from here on", *names)
        of_ranks = [checkpoint, *checkpoint.get("further_ranks", ())]  # a checkpoint without is of one process
        rank, before = distributed.rank(), len(of_ranks)
        own = of_ranks[rank % before]
        kind = "cpu" if checkpoint["cuda_rng"] is None else "cuda"
        same_ranks, same_kind = before == distributed.ranks(), kind == self.algorithm.device.type
        same = {} if same_ranks and same_kind else {"draws": False}  # which a user's algorithm may not take
        self.algorithm.load_state_dict(checkpoint["algorithm"], **same)
        self.trials.load_state_dict(checkpoint["trials"])
        if distributed.is_first():
            if self.run.policy.is_file() and not was_edited:
                try:
                    info = Policy.load(self.run.policy, "cpu").info
                except ValueError as error:
                    raise ValueError(f"{error}. Move it away: the run goes on without") from error
                if not self.environments.transforms or info.get("frames", 0) <= self.frames:
                    # Else no checkpoint holds the transforms of its time.
                    self._best = info.get("selected_by", -math.inf)
            self._transforms_of_best = checkpoint.get("transforms_of_best", {})
        if not same_kind and distributed.is_first():
            logging.getLogger("torchrl_loco").warning(
                "device: %s so far, %s from here on; actions and minibatches are drawn anew, and rounded otherwise",
                kind,
                self.config.device,
            )
        if not same_ranks:
            self._say_what_changes(before)
            self.episodes.load_state_dict(checkpoint["episodes"], running=False)
            self.collector.load_state_dict({"transforms": own["collector"].get("transforms", {})})
            set_stage(self._base, checkpoint.get("stage", {}))
            return
        self.collector.load_state_dict(own["collector"])
        self.episodes.load_state_dict(own["episodes"], running=True)
        torch.set_rng_state(own["rng"].cpu())
        if not same_kind:
            return
        if own["cuda_rng"] is not None:
            torch.cuda.set_rng_state(own["cuda_rng"].cpu(), self.algorithm.device)
        if rank > 0:
            self.algorithm.generator.set_state(own["generator"].cpu())

    def _say_what_changes(self, ranks_before: int) -> None:
        """Prints what a run gets that was trained by another number of ranks."""
        if self.frames >= self.last_frame:
            raise ValueError(
                f"only {self.config.total_frames - self.frames} frames remain, less than a batch of "
                f"{distributed.ranks()} ranks ({self.frames_per_iteration}): continue with {ranks_before}, as before"
            )
        if distributed.is_first():
            print(
                f"ranks: {ranks_before} so far, {distributed.ranks()} from here on, each with {self.config.num_envs} "
                f"worlds and minibatches of {self.config.minibatch_size}. All worlds start anew; networks, optimizers, "
                "transforms, counters and the stage of a curriculum continue",
                file=sys.stderr,
            )


def _rounded(value: float) -> str:
    """Returns a number with three digits or more."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _numbers_of(options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns options but those of text, such as places of files: what these hold is in the content of a run."""
    lists = {name: several(value) for name, value in options.items()}
    return {name: parts for name, parts in lists.items() if not any(isinstance(part, str) for part in parts)}
