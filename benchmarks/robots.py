"""Robots that follow velocity commands: trained by their presets, timed to mjlab's reward, verified in C MuJoCo."""

import contextlib
import csv
import importlib.util
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.cases import INTERRUPTED, until_interrupted
from benchmarks.processes import MeasurementError
from benchmarks.published import read
from benchmarks.results import Row, circumstances
from torchrl_loco.policy import Policy
from torchrl_loco.training import RunFolder

COLUMNS = {
    **{"run": "", "frames": "d", "seconds": ".1f", "frames/s": ".0f", "to mjlab's (s)": ".1f", "wall": ".0f"},
    **{"return": ".1f", "length": ".0f", "falls": "d", "episodes": "d", "error (m/s)": ".3f", "error (rad/s)": ".3f"},
}
MJLAB = {"go1_velocity": ("return", 64.5), "g1_velocity": ("episode_length", 950.0)}
"""What mjlab's Go1 earns after 151 s on an H100, and the length of episodes in which a G1 walks (control steps): a
column of the metrics, and its value. Both rewards are weights times terms times the control step, summed."""
KEPT = ("iteration", "frames", "seconds", "return", "episode_length", "episodes")
"""Columns of the metrics that are kept."""


def robots(
    folder: Path, tasks: Sequence[str], seeds: Sequence[int], device: torch.device, settings: list[str], episodes: int
) -> list[Row]:
    """Trains what a folder of results lacks, verifies its policies, and returns a row for each.

    It can be stopped and called again: runs go on from their last checkpoint, and what is done is not done again.
    Without onnxruntime, or with no episodes, nothing is verified, which can be made up for elsewhere: call it there
    without seeds.

    Args:
        folder: where each run has a folder of small files.
        tasks: ids of environments.
        seeds: all tasks are trained with the first of them, then with the next.
        device: where to train, and where the simulator of the training plays.
        settings: further settings of a training, as ``name=value``.
        episodes: how many episodes a policy is verified in, 0 for later.
    """
    jobs = [(task, seed) for seed in seeds for task in tasks]
    missing = [job for job in jobs if not (folder / _name(*job) / "policy.safetensors").exists()]
    for task, seed in until_interrupted(missing, "robots"):
        train(folder, task, seed, device, settings)
    runs = [path.parent for path in sorted(folder.glob("*/policy.safetensors"))]
    unverified = [run for run in runs if episodes and not (run / "verify.json").exists()]
    if unverified and importlib.util.find_spec("onnxruntime") is None:
        print("onnxruntime is not installed: nothing is verified", file=sys.stderr)
        unverified = []
    for run in until_interrupted([] if INTERRUPTED.is_set() else unverified, "verify"):
        verify(run, device, episodes)
    return [row(run) for run in runs]


def _name(task: str, seed: int) -> str:
    return f"{task}-seed{seed}"


def train(folder: Path, task: str, seed: int, device: torch.device, settings: list[str]) -> None:
    """Trains a task in a process of its own, or goes on, and keeps the run's small files.

    Raises:
        MeasurementError: the training failed.
    """
    work, kept = folder / "unfinished" / _name(task, seed), folder / _name(task, seed)
    begun = [run for run in map(RunFolder, sorted(work.glob("*/"))) if run.has_checkpoint or run.is_finished]
    wall = None
    if not (begun and begun[0].is_finished):
        if begun:
            options = ["resume", begun[0].path]
        else:
            shutil.rmtree(work, ignore_errors=True)  # of a process that died before its first checkpoint
            chosen = [f"seed={seed}", f"device={device}", "video_seconds=0", f"out={work}", *settings]
            options = ["train", task, *(f"--{setting}" for setting in chosen)]
        started = time.time()
        status = subprocess.run([sys.executable, "-m", "torchrl_loco", *map(str, options)], check=False).returncode
        wall = None if begun else time.time() - started
        if status:
            raise MeasurementError(f"{' '.join(map(str, options))} ended with status {status}")
    (run,) = map(RunFolder, work.glob("*/"))
    kept.mkdir(parents=True)
    for name in ("config.json", "evaluations.csv"):
        shutil.copy(run.path / name, kept)
    columns = run.read_metrics()
    lines = [dict(zip(KEPT, values, strict=True)) for values in zip(*(columns[key] for key in KEPT), strict=True)]
    write_metrics(kept, lines)
    (kept / "about.json").write_text(f"{json.dumps({**circumstances(device), 'wall': wall}, indent=1)}\n")
    run.load_policy("cpu").save(kept / "policy.safetensors", small=True)  # the last thing: it marks the run as done
    shutil.rmtree(work)
    with contextlib.suppress(OSError):  # another run is unfinished
        work.parent.rmdir()


def write_metrics(folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes the metrics of a run."""
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, KEPT, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: f"{value:.10g}" for key, value in row.items()} for row in rows)


def verify(run: Path, device: torch.device, episodes: int) -> None:
    """Writes what ``torchrl-loco verify`` finds of a run's policy.

    Raises:
        MeasurementError: it found nothing.
    """
    options = [run / "policy.safetensors", "--device", device, "--episodes", episodes, "--out", run / "verify.json"]
    subprocess.run([sys.executable, "-m", "torchrl_loco", "verify", *map(str, options)], check=False)  # 1: falls
    if not (run / "verify.json").exists():
        raise MeasurementError(f"{run} could not be verified")


def row(run: Path) -> Row:
    """Returns the figures of a run. Times begin after the first iteration, in which kernels are made."""
    info, metrics = Policy.load(run / "policy.safetensors", "cpu").info, metrics_of(run)
    first, last = metrics[0], metrics[-1]
    found: Row = {"run": run.name, "task": info["task"], "algorithm": info["algorithm"], "device": info["trained_on"]}
    found |= {"seed": info["seed"], "worlds": info["num_envs"], "frames": round(last["frames"])}
    found |= {"seconds": last["seconds"], "first iteration (s)": first["first"], "return": last["return"]}
    found["length"] = last["episode_length"]
    if len(metrics) > 1:
        found["frames/s"] = (last["frames"] - first["frames"]) / last["seconds"]
    if info["task"] in MJLAB:
        column, value = MJLAB[info["task"]]
        reached = [line["seconds"] for line in metrics if line["episodes"] > 0 and line[column] >= value]
        found["to mjlab's (s)"] = reached[0] if reached else None
    if (run / "about.json").exists():
        found["wall"] = json.loads((run / "about.json").read_text())["wall"]
    if (run / "verify.json").exists():
        outcomes = json.loads((run / "verify.json").read_text())["outcomes"]
        for simulator, where in (("C MuJoCo", ""), ("training simulator", ", training simulator")):
            for episodes, which in (("all", ""), ("delay 0", ", on time")):
                figures = outcomes.get(simulator, {}).get(episodes, {})
                names = {"linear_error": "error (m/s)", "angular_error": "error (rad/s)", "return": "return, verified"}
                found |= {f"{names.get(key, key)}{which}{where}": value for key, value in figures.items()}
    return found


def metrics_of(run: Path) -> list[dict[str, float]]:
    """Returns the metrics of a run; ``seconds`` count from the end of the first iteration, which took ``first``."""
    lines = [{key: float(line[key]) for key in KEPT} for line in read(run, "metrics.csv")]
    first = lines[0]["seconds"]
    return [{**line, "seconds": line["seconds"] - first, "first": first} for line in lines]
