"""Commands that train, and what they leave: train, resume and plot."""

import dataclasses
import os
import shlex
import sys
from pathlib import Path
from typing import Any

import tyro

from torchrl_loco import training
from torchrl_loco.checks import SEED, check_int, check_run
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.cli.motions import THOSE_OF_TRAINING, Motions
from torchrl_loco.cli.options import Flat, OtherTask, settings
from torchrl_loco.garbage import importing


def train(options: Any, args: list[str]) -> None:
    """Trains what the options say, typed by :func:`torchrl_loco.cli.options.task_options`, or as in ``args``."""
    with user_errors():
        if {"--seed", "--seeds"} <= {arg.partition("=")[0] for arg in args}:
            raise ValueError("--seed trains one seed, --seeds several: pass one of them")
        config, seeds, gpus = settings(options)
        if "--seeds" in args and not seeds:
            raise ValueError("--seeds must name at least one seed, as in --seeds 0 1 2")
        _check_seeds(seeds, gpus)
        missing = missing_processes(gpus, config.device)
    if missing:
        training.distributed.launch(missing, args)
        return
    runs = list[str]()
    try:
        for seed in seeds or (config.seed,):
            runs.append(_trained(dataclasses.replace(config, seed=seed)))
    except KeyboardInterrupt:
        if left := seeds[len(runs) + 1 :]:
            print(f"not begun: --seeds {' '.join(map(str, left))}", file=sys.stderr)
        raise
    if seeds:
        print(f"all seeds in one picture: torchrl-loco plot {shlex.join(runs)}")


def resume(
    run: tyro.conf.Positional[Path],
    /,
    gpus: int | None = None,
    total_frames: int | None = None,
    device: str | None = None,
    task: OtherTask = None,
    motions: Flat[Motions] = THOSE_OF_TRAINING,
) -> None:
    """Continue a run that was stopped, from its last checkpoint, as if it had not been stopped (but one of svg).

    Args:
        run: folder of the run.
        gpus: as in train: pass the same number to continue exactly.
        total_frames: train the run to another number of frames, also if it is complete. The learning rate follows the
            new number from here on. Trials keep the length with which they began.
        device: train on another device from here on.
        task: where its task is now.
        motions: where its motions are now.
    """
    with user_errors():
        check_run(run)
        folder = training.RunFolder(run) if task is None else training.start.resumed(run, task)
        training.Given().check(folder)
        asked: dict[str, Any] = {"total_frames": total_frames, "device": device}
        changes = {name: value for name, value in asked.items() if value is not None}
        if moved := motions.given(folder.task):
            changes["options"] = {**folder.load_config().options, **moved}
        missing = missing_processes(gpus, folder.load_config(**changes).device)
    if missing:
        more = [f"--{name}={value}" for name, value in changes.items() if name != "options"]
        more += [*(["--motion", *motions.motion] if motions.motion else []), f"--fps={motions.fps}"]
        more += [] if task is None else [f"--task={task}"]
        training.distributed.launch(missing, ["resume", str(run), f"--gpus={gpus}", *more])
    else:
        _trained(folder, **changes)


def plot(runs: tyro.conf.Positional[tuple[Path, ...]], /, out: Path = Path("learning_curves.png")) -> None:
    """Plot the learning curves of runs; runs that differ only in their seed become a mean and a band.

    Args:
        runs: folders of the runs.
        out: the picture; an existing one is replaced.
    """
    with user_errors():
        for run in runs:
            check_run(run)  # before what takes seconds to import
        training.plot_runs([training.RunFolder(run) for run in runs], out)
    print(out)


def _check_seeds(seeds: tuple[int, ...], gpus: int | None) -> None:
    """Checks the seeds that are trained one after the other, by one process: ranks have not been tried with several."""
    for seed in seeds:
        check_int("each of seeds", seed, SEED)
    if twice := [seed for seed in seeds if seeds.count(seed) > 1]:
        raise ValueError(f"seeds must differ, but {twice[0]} is named twice")
    if seeds and ((gpus or 1) > 1 or int(os.environ.get("WORLD_SIZE", "1")) > 1):
        raise ValueError("several seeds are trained one after the other by one process: pass --seed with several GPUs")


def missing_processes(gpus: int | None, device: str) -> int:
    """Checks the number of processes that is asked for. Returns how many are still to be started."""
    if gpus is None:
        return 0
    check_int("gpus", gpus)
    if "RANK" in os.environ and "WORLD_SIZE" in os.environ:  # of torchrun
        if gpus != int(os.environ["WORLD_SIZE"]):
            raise ValueError(f"torchrun has started {os.environ['WORLD_SIZE']} processes: leave --gpus {gpus} out")
        return 0
    if gpus > 1 and device != "cpu":
        import torch

        if gpus > (count := torch.cuda.device_count()):
            raise ValueError(f"gpus must be at most the {count} GPUs of this machine, got {gpus}")
    return gpus if gpus > 1 else 0


def _trained(what: "training.TrainingConfig | training.RunFolder", **changes: Any) -> str:
    """Trains to the last frame, and prints where the results are. Returns the folder of the run."""
    with user_errors(), importing():
        from torchrl_loco.training.start import Given, run_to_end
    run = run_to_end(what, Given(), user_errors, **changes)
    if os.environ.get("RANK", "0") == "0":
        print(f"policy, curve, video and logs: {run.path}")
    return str(run.path)
