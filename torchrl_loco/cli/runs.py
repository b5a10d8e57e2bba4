"""Commands that train, and what they leave: train, resume and plot."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from torchrl_loco.checks import check_int, check_run, is_run_group
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.cli.options import settings

if TYPE_CHECKING:
    from torchrl_loco import training


def train(options: Any, args: list[str]) -> None:
    """Trains what the options of the command say.

    Args:
        options: the settings, as :func:`torchrl_loco.cli.options.task_options` types them.
        args: of the command line.
    """
    with user_errors():
        if {"--seed", "--seeds"} <= {arg.partition("=")[0] for arg in args}:
            raise ValueError("--seed trains one seed, --seeds several: pass one of them")
        config, seeds, gpus = settings(options)
        if seeds:
            _refuse_seeds_of_ranks(gpus)
            group = _begin_group(config, seeds)
        missing = missing_processes(gpus, config.device)
    if seeds:
        _train_group(group)
    elif missing:
        from torchrl_loco.training import distributed

        distributed.launch(missing, args)
    else:
        with _joined(config.device):
            with user_errors():
                from torchrl_loco import training

                trainer = training.begin(config)
            train_to_end(trainer)


def resume(run: tyro.conf.Positional[Path], /, gpus: int | None = None, total_frames: int | None = None) -> None:
    """Continue a run that was stopped, from its last checkpoint, as if it had not been stopped.

    Args:
        run: folder of the run, or of the runs of several seeds, of which all that is missing is trained.
        gpus: as in train: pass the same number to continue exactly.
        total_frames: train one run to another number of frames, also if it is complete. The learning rate follows the
            new number from here on. Trials keep the length with which they began.
    """
    with user_errors():
        check_run(run, or_group=True)
        from torchrl_loco import training

        if is_run_group(run):
            if total_frames is not None:
                raise ValueError(f"{run} holds the runs of several seeds: total_frames is for one of them")
            _refuse_seeds_of_ranks(gpus)
            group = training.RunGroup(run)
            group.check()
        else:
            folder = training.RunFolder(run)
            training.Given().check(folder)
            device = folder.load_config().device
            missing = missing_processes(gpus, device)
    if is_run_group(run):
        _train_group(group)
    elif missing:
        more = [] if total_frames is None else [f"--total_frames={total_frames}"]
        training.distributed.launch(missing, ["resume", str(run), f"--gpus={gpus}", *more])
    else:
        with _joined(device):
            with user_errors():
                if total_frames is not None:
                    if training.distributed.is_first():
                        folder.extend(total_frames)
                    training.distributed.wait_for_all()
                trainer = training.Trainer(folder, resume=True)
            train_to_end(trainer)


def plot(runs: tyro.conf.Positional[tuple[Path, ...]], /, out: Path = Path("learning_curves.png")) -> None:
    """Plot the learning curves of runs; runs that differ only in their seed become a mean and a band.

    Args:
        runs: folders of the runs, or of the runs of several seeds.
        out: the picture; an existing one is replaced.
    """
    with user_errors():
        from torchrl_loco import training

        folders: list[training.RunFolder] = []
        for run in runs:
            check_run(run, or_group=True)
            folders += training.RunGroup(run).plotted if is_run_group(run) else [training.RunFolder(run)]
        training.plot_runs(folders, out)
    print(out)


def _refuse_seeds_of_ranks(gpus: int | None) -> None:
    """Checks that several seeds are trained by one process.

    A seed that fails must not end the others, but ranks that wait for a failed one cannot go on.
    """
    if (gpus or 1) > 1 or int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError("several seeds are trained one after the other by one process: pass --seed with several GPUs")


def missing_processes(gpus: int | None, device: str) -> int:
    """Checks the number of processes that is asked for. Returns how many are still to be started."""
    if gpus is None:
        return 0
    check_int("gpus", gpus)
    if "RANK" in os.environ:  # of torchrun
        if gpus != int(os.environ["WORLD_SIZE"]):
            raise ValueError(f"torchrun has started {os.environ['WORLD_SIZE']} processes: leave --gpus {gpus} out")
        return 0
    if gpus > 1 and device != "cpu":
        import torch

        if gpus > (count := torch.cuda.device_count()):
            raise ValueError(f"gpus must be at most the {count} GPUs of this machine, got {gpus}")
    return gpus if gpus > 1 else 0


@contextlib.contextmanager
def _joined(device: str) -> Iterator[None]:
    """Connects the ranks of torchrun, if there are several, while the block lasts."""
    from torchrl_loco.training import distributed

    with contextlib.ExitStack() as ranks:
        with user_errors():
            ranks.enter_context(distributed.joined(device))
        yield


def _begin_group(config: "training.TrainingConfig", seeds: tuple[int, ...]) -> "training.RunGroup":
    """Makes the folder for the runs of several seeds."""
    from torchrl_loco import training

    group = training.RunGroup.create(config, seeds)
    if note := training.tuning_note(config):
        print(note)
    print(f"folder of the runs: {group.path}")
    return group


def _train_group(group: "training.RunGroup") -> None:
    """Trains the seeds that are missing and prints where the results are; exits with 1 if some failed."""
    way = f"to continue: torchrl-loco resume {group.path}"
    try:
        with user_errors(OSError):  # as of a run
            failed = group.train()
    except (KeyboardInterrupt, SystemExit):
        print(way, file=sys.stderr)
        raise
    if failed:
        print(way, file=sys.stderr)
        raise SystemExit(1)
    print(f"policies, curves, videos and logs: {group.path}")


def train_to_end(trainer: "training.Trainer") -> None:
    """Trains to the last frame and prints where the results are."""
    from torchrl_loco.training.distributed import is_first
    from torchrl_loco.training.start import Given, saying_how_to_continue

    with saying_how_to_continue(trainer, Given()), user_errors(OSError):  # others are bugs and keep their traceback
        trainer.train()
    if is_first():
        print(f"policy, curve, video and logs: {trainer.run.path}")
