"""Pictures of results: throughput against worlds or GPUs, return against the time that training took."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from benchmarks.published import PUBLISHED, read
from benchmarks.results import Row

COLORS = {"playground": "C0", "dm_control": "C1"}
"""Of the protocols."""


def plot(results: Path, picture: Path) -> None:
    """Draws the rows of a results file, a panel for each body or task and a line for each case or trainer.

    Of a folder with an ``evaluations.csv`` it draws the returns, a panel for each task and a line for each seed.
    """
    if results.is_dir():
        plot_runs(results, picture)
        return
    data = json.loads(results.read_text())
    panel, draw = next((panel, draw) for key, panel, draw in KINDS if key in data["rows"][0])
    names = distinct(data["rows"], panel)
    figure, panels = plt.subplots(1, len(names), figsize=(5.5 * len(names), 4.2), squeeze=False, layout="constrained")
    for axes, name in zip(panels[0], names, strict=True):
        axes.set(title=f"{name}, {data['device']}, {data['date']}")
        draw(axes, [row for row in data["rows"] if row[panel] == name])
        axes.grid(alpha=0.3)
        axes.set_ylim(bottom=0)
        axes.legend()
    figure.savefig(picture, dpi=150)


def draw_throughput(axes: Axes, rows: Sequence[Row]) -> None:
    """Draws steps per second against worlds."""
    axes.set(xlabel="worlds", ylabel="million steps per second")
    axes.set_xscale("log", base=2)
    for case in distinct(rows, "case"):
        of_case = [row for row in rows if row["case"] == case]
        worlds = [row["worlds"] for row in of_case]
        axes.plot(worlds, [row["worlds"] / row["ms"] / 1e3 for row in of_case], "o-", markersize=3, label=case)


def draw_returns(axes: Axes, rows: Sequence[Row]) -> None:
    """Draws the return of evaluations against the time since the process was started."""
    axes.set(xlabel="seconds from the start of the process", ylabel="return of 1000 steps")
    for trainer in distinct(rows, "trainer"):
        found = [row for row in rows if row["trainer"] == trainer and "mean" in row]
        seconds, means = [row["seconds"] for row in found], [row["mean"] for row in found]
        axes.plot(seconds, means, "o-", markersize=3, label=trainer)


def draw_scaling(axes: Axes, rows: Sequence[Row]) -> None:
    """Draws frames per second against GPUs as multiples of the first row's, and what the cost model predicts."""
    axes.set(xlabel="GPUs", ylabel="frames per second, times those of one GPU")
    measured = [row for row in rows if "error" not in row]
    gpus = sorted({row["gpus"] for row in measured})
    axes.plot(gpus, [count / gpus[0] for count in gpus], ":", color="gray", label="as many times as GPUs")
    for color, algorithm in enumerate(distinct(measured, "algorithm")):
        found = [row for row in measured if row["algorithm"] == algorithm]
        lines = {"collection": "o--", "training": "o-"}
        for what, line in lines.items():
            ratios = [row[f"{what}, ratio"] for row in found]
            axes.plot([row["gpus"] for row in found], ratios, line, color=f"C{color}", label=f"{algorithm}, {what}")
        predicted = [row["predicted"] for row in found]
        axes.plot([row["gpus"] for row in found], predicted, "x", color=f"C{color}", label=f"{algorithm}, predicted")
    axes.set_xticks(gpus)


KINDS = (("gpus", "task", draw_scaling), ("trainer", "task", draw_returns), ("worlds", "body", draw_throughput))
"""A key of the rows of each kind of results, what makes a panel, and what draws it."""


def plot_runs(folder: Path, picture: Path) -> None:
    """Draws the return of every run's evaluations against training time, and published returns as dashed lines."""
    rows = read(folder, "evaluations.csv")
    found = distinct(rows, "task")
    tasks = [task for task in dict.fromkeys([*(task for task, _ in PUBLISHED), *found]) if task in found]
    columns = min(3, len(tasks))
    shape = (math.ceil(len(tasks) / columns), columns)
    figure, panels = plt.subplots(*shape, figsize=(4.5 * columns, 3.4 * shape[0]), squeeze=False, layout="constrained")
    for axes, task in zip(panels.flat, tasks, strict=False):
        draw_task(axes, task, [row for row in rows if row["task"] == task])
    for axes in panels.flat[len(tasks) :]:
        axes.remove()
    figure.savefig(picture, dpi=150)


def draw_task(axes: Axes, task: str, rows: Sequence[Row]) -> None:
    """Draws the return of each seed of a task in each protocol against training time."""
    axes.set(title=task, xlabel="seconds of training", ylabel="return of 1000 steps", ylim=(0, 1020))
    axes.grid(alpha=0.3)
    for protocol in distinct(rows, "protocol"):
        of_protocol = [row for row in rows if row["protocol"] == protocol]
        color, seeds = COLORS[protocol], distinct(of_protocol, "seed")
        for seed in seeds:
            found = [(float(row["seconds"]), float(row["mean"])) for row in of_protocol if row["seed"] == seed]
            label = f"{protocol}, seed {', '.join(seeds)}" if seed == seeds[0] else None
            axes.plot(*zip(*found, strict=True), "o-", markersize=2, linewidth=1, color=color, label=label)
        if (task, protocol) in PUBLISHED:
            published, by = PUBLISHED[task, protocol]
            axes.axhline(published, color=color, linestyle="--", linewidth=1, label=f"{by} {published}")
    axes.set_xlim(left=0)
    axes.legend(loc="lower right", fontsize="small")


def distinct(rows: Iterable[Row], key: str) -> list[str]:
    """Returns the values under a key, each once, in order."""
    return list(dict.fromkeys(row[key] for row in rows))
