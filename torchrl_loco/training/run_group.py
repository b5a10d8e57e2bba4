"""Runs that differ only in their seed, in one folder."""

import dataclasses
import json
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from torchrl_loco.checks import SEED, check_device, check_int, is_run_group
from torchrl_loco.policy import Policy
from torchrl_loco.training.config import TrainingConfig, check_loggers, config_from_json
from torchrl_loco.training.evaluation import describe, shipped_return
from torchrl_loco.training.lock import lock, unlock
from torchrl_loco.training.plots import plot_runs
from torchrl_loco.training.run_folder import RunFolder, new_folder, unused_path
from torchrl_loco.training.trainer import Trainer


class RunGroup:
    """Runs of several seeds on disk: a run folder for each, ``group.json``, and ``learning_curve.png`` of all of them.

    Args:
        path: an existing folder that :meth:`create` made.

    Raises:
        FileNotFoundError: ``path`` is no folder with a ``group.json``.
        ValueError: ``group.json`` is damaged, or of another release.
    """

    config: TrainingConfig
    """Settings of all runs, but for their seed."""
    seeds: tuple[int, ...]
    """Their seeds."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not is_run_group(self.path):
            raise FileNotFoundError(f"{path} does not hold the runs of several seeds: it has no group.json")
        file = self.path / "group.json"
        try:
            values = json.loads(file.read_text())
            self.seeds = _check_seeds(values["seeds"])
            self.config = config_from_json(values["config"])
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise ValueError(f"{file} is damaged or from another release: {error}") from error

    @classmethod
    def create(cls, config: TrainingConfig, seeds: Sequence[int]) -> "RunGroup":
        """Makes a new folder for runs in ``config.out``, named after task, time and number of seeds.

        Args:
            config: the settings; their seed is not used.
            seeds: the seeds.

        Returns:
            The group, without runs yet.

        Raises:
            TypeError: a seed is no integer.
            ValueError: there are no seeds, one is out of range or named twice, or this machine lacks the device.
            ImportError: the package of a logger is missing, or the environment is a plug-in, which is broken.
            OSError: the folder cannot be made.
        """
        seeds = _check_seeds(seeds)
        path = new_folder(config, f"{len(seeds)}-seeds")
        values = {"seeds": seeds, "config": config.to_json()}
        (path / "group.json").write_text(json.dumps(values, indent=2) + "\n")
        return cls(path)

    @property
    def runs(self) -> dict[int, RunFolder]:
        """The run of each seed that was begun; the one that got furthest if there are several."""
        found: dict[int, RunFolder] = {}
        for file in sorted(self.path.glob("*/config.json")):
            run = RunFolder(file.parent)
            seed = run.load_config().seed
            if seed not in found or run.is_finished or (run.has_checkpoint and not found[seed].is_finished):
                found[seed] = run
        return found

    @property
    def plotted(self) -> list[RunFolder]:
        """The runs that have collected a batch, of which there is something to plot."""
        return [run for run in self.runs.values() if run.has_metrics]

    @property
    def _missing(self) -> list[int]:
        runs = self.runs
        return [seed for seed in self.seeds if seed not in runs or not runs[seed].is_finished]

    def check(self) -> None:
        """Checks that there is something to train, and that it can be trained here: from now on, by no other process.

        Raises:
            ValueError: there is nothing to train, or this machine lacks the device.
            ImportError: the package of a logger is missing.
            BlockingIOError: another process is training it.
        """
        check_device(self.config.device)
        check_loggers(self.config.logger)
        if not self._missing:
            raise ValueError(f"{self.path} is complete: all of its {len(self.seeds)} seeds are trained")
        lock(self.path)

    def train(self) -> dict[int, str]:
        """Trains what is missing, one seed after the other, and plots all of them as one curve.

        A finished run stays as it is, a stopped one is continued, and one without a checkpoint is begun anew in a
        folder of its own. If a seed fails, its traceback is written to ``error.txt`` in its run folder, and the next
        seed begins. At the end, the returns of all seeds are printed.

        Returns:
            What went wrong, by seed; empty if all seeds are trained.

        Raises:
            KeyboardInterrupt: Ctrl-C or SIGTERM; what is missing is trained by the next call.
            ValueError: there is nothing to train, or this machine lacks the device.
            ImportError: the package of a logger is missing.
            BlockingIOError: another process is training it.
        """
        self.check()
        runs, failed = self.runs, {}
        try:
            for seed in self._missing:
                try:
                    self._train(seed, runs.get(seed))
                except Exception as error:
                    failed[seed] = f"{type(error).__name__}: {error}"
                    print(f"seed {seed} failed: {failed[seed]}", file=sys.stderr)
                finally:
                    self._plot()
        finally:
            unlock(self.path)
        print(self._report(failed))
        return failed

    def _train(self, seed: int, run: RunFolder | None) -> None:
        resume = run is not None and run.has_checkpoint
        if run is None or not resume:
            run = RunFolder.create(dataclasses.replace(self.config, seed=seed, out=self.path))
        print(f"seed {seed}, {self.seeds.index(seed) + 1} of {len(self.seeds)}: {run.path}", flush=True)
        try:
            trainer = Trainer(run, resume)
            try:
                trainer.train()
            finally:
                trainer.env.close()  # its memory is for the next seed
        except Exception:
            unused_path(run.path / "error.txt").write_text(traceback.format_exc())
            raise

    def _plot(self) -> None:
        if runs := self.plotted:
            plot_runs(runs, self.path / "learning_curve.png")

    def _report(self, failed: dict[int, str]) -> str:
        """Returns the return of each seed, their mean, and what the shipped policy earns."""
        lines, means, runs = [], [], self.runs
        for seed in self.seeds:
            if seed in runs and runs[seed].is_finished:
                summary = Policy.load(runs[seed].policy, "cpu").info
                means.append(summary["mean"])
                lines.append(f"seed {seed}: {describe(summary)}")
            else:
                lines.append(f"seed {seed} failed: {failed[seed]}")
        if means:
            mean = sum(means) / len(means)
            count = f"{len(means)} of {len(self.seeds)} seeds" if failed else f"{len(means)} seeds"
            lines.append(f"mean of {count}: {mean:.1f}, from {min(means):.1f} to {max(means):.1f}")
        return "\n".join(filter(None, [*lines, shipped_return(self.config)]))


def _check_seeds(seeds: Sequence[int]) -> tuple[int, ...]:
    """Returns seeds as a tuple.

    Raises:
        TypeError: one is no integer.
        ValueError: there are none, one is out of range, or one is named twice.
    """
    checked = tuple(check_int("each of seeds", seed, SEED) for seed in seeds)
    if not checked:
        raise ValueError("seeds must name at least one seed")
    if len(set(checked)) < len(checked):
        twice = next(seed for seed in checked if checked.count(seed) > 1)
        raise ValueError(f"seeds must differ, but {twice} is named twice")
    return checked
