"""Time to a return, from the start of the process, beside Brax's PPO on Playground on the same device."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.processes import MeasurementError, environment_with, run_json
from benchmarks.results import Row
from torchrl_loco.training import RunFolder

COLUMNS = {"task": "", "trainer": "", "frames": "d", "seconds": ".1f", "mean": ".1f", "error": ""}
EVALUATIONS = 10
"""How often ours is evaluated, as often as the peer; each takes a few seconds, which count."""


def training(tasks: Sequence[str], device: torch.device, frames: int, peer: bool, path: Path | None) -> list[Row]:
    """Trains each task in processes of their own; returns a row for each evaluation.

    Args:
        tasks: ids of environments.
        device: where to train.
        frames: frames of our runs; the peer's are set by its own settings.
        peer: whether to train the peer too.
        path: folder with the peer's packages.
    """
    rows: list[Row] = []
    for task in tasks:
        rows += [{"task": task, "trainer": "ours", **row} for row in ours(task, device, frames)]
        if peer:
            try:
                arguments = ["benchmarks.peers.playground_ppo", task, time.time()]
                evaluations = run_json(arguments, environment_with(path))["evaluations"]
            except MeasurementError as error:
                evaluations = [{"error": str(error)}]
            rows += [{"task": task, "trainer": "brax ppo on playground", **row} for row in evaluations]
    return rows


def ours(task: str, device: torch.device, frames: int) -> list[Row]:
    """Runs our command and notes when each evaluation is written."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as out:
        settings = {"device": device, "total_frames": frames, "eval_interval": frames // EVALUATIONS}
        settings |= {"video_seconds": 0, "out": out}
        options = [f"--{name}={value}" for name, value in settings.items()]
        started = time.time()
        process = subprocess.Popen([sys.executable, "-m", "torchrl_loco", "train", task, *options])
        while process.poll() is None:
            time.sleep(0.05)
            for row in evaluations(Path(out))[len(rows) :]:
                seconds = time.time() - started
                rows.append({"frames": int(row["frames"]), "seconds": seconds, "mean": row["mean"]})
        if process.returncode:
            raise MeasurementError(f"training {task} ended with status {process.returncode}")
    return rows


def evaluations(out: Path) -> list[Row]:
    """Returns the evaluations so far of the run in a folder of runs, none before the first."""
    return [row for file in out.glob("*/evaluations.csv") for row in RunFolder(file.parent).read_evaluations()]
