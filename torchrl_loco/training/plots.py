"""Plots of learning curves."""

import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchrl_loco import storage
from torchrl_loco.checks import check_packages
from torchrl_loco.training.config import TrainingConfig
from torchrl_loco.training.run_folder import RunFolder

check_packages("a plot", ["matplotlib"], "train")  # so that a run fails at its start, though it imports it at its end

IRRELEVANT = (
    *("seed", "out", "device", "eval_interval", "eval_episodes", "video_seconds", "checkpoint_seconds"),
    *("keep", "logger"),
)
"""Settings that do not affect learning."""


def plot_runs(runs: Sequence[RunFolder], picture: Path) -> None:
    """Plots return against frames of ``runs`` into ``picture``.

    Runs that differ only in their seed, or in settings that do not change learning, share a line, their mean, and a
    band from least to greatest; each of them is a faint line. Runs that were stopped early count in neither if others
    were not. Evaluations are dots: the mean over episodes, with their standard deviation as a bar.

    Raises:
        ValueError: there are no runs, or one has no metrics yet.
    """
    if not runs:
        raise ValueError("no runs to plot")
    from matplotlib.figure import Figure  # takes a second

    figure = Figure(figsize=(7, 4.2), layout="constrained")  # without pyplot: a caller's backend stays as it is
    axes = figure.subplots()
    for config, group in grouped(runs).items():
        label = f"{config.label}, {config.algorithm}, {config.protocol}, {config.num_envs} worlds"
        metrics = [run.read_metrics() for run in group]
        if damaged := [run.path for run, table in zip(group, metrics, strict=True) if "return" not in table]:
            raise ValueError(f"{damaged[0] / 'metrics.csv'} is damaged: it has no column return")
        whole = [m for m in metrics if is_whole(m["frames"], config.total_frames)] or metrics
        frames, returns = shared_curve(whole)
        millions = frames / 1e6
        seconds = np.mean([m["seconds"][-1] for m in whole])
        count = f"{len(group)}" if len(whole) == len(group) else f"{len(whole)} of {len(group)}"
        seeds = "" if len(group) == 1 else f", {count} seeds"
        (line,) = axes.plot(millions, returns.mean(0), label=f"{label}{seeds}, {seconds:.0f} s")
        axes.fill_between(millions, returns.min(0), returns.max(0), color=line.get_color(), alpha=0.2, linewidth=0)
        for one in metrics if len(group) > 1 else ():
            axes.plot(np.array(one["frames"]) / 1e6, one["return"], color=line.get_color(), alpha=0.35, linewidth=0.7)
        for run in group:
            rows = run.read_evaluations()
            axes.errorbar(
                [row["frames"] / 1e6 for row in rows],
                [row["mean"] for row in rows],
                [row["std"] for row in rows],
                fmt="o",
                markersize=4,
                capsize=3,
                color=line.get_color(),
            )
    axes.set(
        xlabel="frames (million)",
        ylabel="return of an episode",
        title="line: sampled actions in training; dots: evaluations without exploration",
    )
    axes.title.set_fontsize("small")
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize="small")
    content = io.BytesIO()
    figure.savefig(content, dpi=150, format=picture.suffix[1:] or "png")
    storage.replace_file(picture, content.getvalue())


def grouped(runs: Sequence[RunFolder]) -> dict[TrainingConfig, list[RunFolder]]:
    """Returns the runs that share a line, by their settings without those that do not change learning."""
    groups: dict[TrainingConfig, list[RunFolder]] = {}
    defaults = {name: getattr(TrainingConfig, name) for name in IRRELEVANT}
    for run in runs:
        groups.setdefault(dataclasses.replace(run.load_config(), **defaults), []).append(run)
    return groups


def shared_curve(metrics: Sequence[dict[str, list[float]]]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frames at which all of several runs have a row, and their returns there, ``(runs, frames)``."""
    curves = [dict(zip(m["frames"], m["return"], strict=True)) for m in metrics]
    shared = sorted(set.intersection(*map(set, curves)))  # runs on several GPUs have fewer and larger batches
    return np.array(shared), np.array([[curve[frames] for frames in shared] for curve in curves])


def is_whole(frames: Sequence[float], total: int) -> bool:
    """Returns whether a run with rows at these frames had no room for a further batch as large as its last."""
    before, last = [0.0, *frames][-2:]
    return 2 * last - before > total
