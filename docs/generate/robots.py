"""What docs/robots.md says of the robots in numbers and curves, from folders of ``python -m benchmarks robots``."""

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

import torchrl_loco
from benchmarks.robots import MJLAB, metrics_of
from generate.markdown import table
from torchrl_loco.policy import shipped_policies

Row = dict[str, Any]
ROOT = Path(__file__).parents[2]
ALL = ROOT / "benchmarks" / "results"
RESULTS = (ALL / "2026-11-30" / "h200-robots", ALL / "2026-11-26" / "h100-robots")
"""Trained by today's presets; by those of before, with more seeds, by REPPO and by mjlab."""
CURVES = ROOT / "docs" / "_static" / "robots.png"
MOVING = ROOT / "docs" / "_static" / "robots.webp"
GPUS = {"H100": "#f5a623", "H200": "#c2571a"}
"""The color of what was trained on each."""
TRAINERS = {"REPPO": "#3b7dd8", "mjlab": "#9aa7ad"}
"""Trainers with a color of their own."""
NAMES = {"go1_velocity": "Go1", "g1_velocity": "G1", "go2_velocity": "Go2", "h1_velocity": "H1"}


class Column(NamedTuple):
    """A column of a table: its label, the key of its figures, by what they are divided, how shown, and the worst."""

    label: str
    key: str
    unit: float
    shown: str
    worst: Callable[[Iterable[float]], float]


TRAINING = (
    Column("worlds", "worlds", 1, ".0f", max),
    Column("million frames/s", "frames/s", 1e6, ".3g", min),
    Column("to the level (s)", "to mjlab's (s)", 1, ".1f", max),
    Column("training (s)", "seconds", 1, ".0f", max),
    Column("return", "return", 1, ".1f", min),
    Column("all, from the start of the process (s)", "wall", 1, ".0f", max),
)
FALLS = (("falls", ".1f"), ("error (m/s)", ".3f"), ("error (rad/s)", ".3f"))
VERIFIED = (
    *(Column(label, label, 1, shown, max) for label, shown in FALLS),
    *(Column(f"{label}, on time", f"{label}, on time", 1, shown, max) for label, shown in FALLS),
    Column("falls in the training simulator", "falls, training simulator", 1, ".1f", max),
)


def tables(folders: Sequence[Path] = RESULTS) -> dict[str, str]:
    """Returns what the page takes from folders, by the names that its comments give them."""
    shown = "![A Go1, a G1, an H1 and a Go2 walk as they are told](_static/robots.webp)\n" if MOVING.exists() else ""
    of_page = {"robots-moving": shown, "robots-shipped": shipped()}
    found = rows_of(folders)
    if not found:
        none = "There are no figures in this copy of the repository.\n"
        return {**of_page, "robots-training": none, "robots-curves": "", "robots-verified": none}
    ours = by_trainer(found)
    episodes = " or ".join(sorted({f"{row['episodes']}" for row in found if "episodes" in row}))
    links = " and ".join(dict.fromkeys(_link(row["folder"] / "results.json") for row in found))
    return {
        **of_page,
        "robots-training": _table(ours, TRAINING) + f"\nFrom {links}.\n",
        "robots-curves": "![Return against seconds of training, a line for each seed](_static/robots.png)\n",
        "robots-verified": _table(ours, VERIFIED)
        + f"\nFalls are episodes, of {episodes} of each policy; a third of them are on time. From {links}.\n",
    }


def _link(file: Path) -> str:
    name = file.relative_to(ALL) if file.is_relative_to(ALL) else file.name
    return f"[{name}](../benchmarks/results/{name})"


def rows_of(folders: Sequence[Path] = RESULTS) -> list[Row]:
    """Returns the rows of the folders that are there, each with its ``folder``."""
    files = [file for folder in folders if (file := folder / "results.json").exists()]
    return [{**row, "folder": file.parent} for file in files for row in json.loads(file.read_text())["rows"]]


def shipped() -> str:
    """Returns which robots have a policy in the package, and what is known of each."""
    lines = []
    for task in [task for task in NAMES if task in shipped_policies("playground")]:
        info = torchrl_loco.load_policy(task, "cpu").info
        earned = f"return {info['mean']:.1f} ± {info['std']:.1f} in {info['episodes']} new episodes"
        how = f"{info['frames'] / 1e6:.0f} million frames on one {info['trained_on']}"
        lines.append(f"- `torchrl-loco play {task}`: {earned}, after {how}, seed {info['seed']}\n")
    return (
        f"Policies in the package, for `play`, `verify`, `export` and `load_policy`:\n\n{''.join(lines)}"
        if lines
        else ""
    )


Group = tuple[str, str, str]
"""Task, trainer and GPU."""


def by_trainer(rows: Sequence[Row]) -> dict[Group, list[Row]]:
    """Returns the rows of the seeds of each robot, by robot, by who trained it and where, in the order of the page."""
    groups: dict[Group, list[Row]] = {}
    for row in rows:
        if row["task"] in NAMES:
            trainer = "mjlab 1.6" if "mjlab" in row["algorithm"] else f"torchrl_loco, {row['algorithm'].upper()}"
            gpu = next((name for name in row["device"].split() if name in GPUS), row["device"])
            groups.setdefault((row["task"], trainer, gpu), []).append(row)

    def place(group: Group) -> tuple[int, bool, bool]:
        task, trainer, _ = group
        return [*NAMES].index(task), "mjlab" in trainer, "REPPO" in trainer

    return {group: groups[group] for group in sorted(groups, key=place)}


def _table(groups: dict[Group, list[Row]], columns: Sequence[Column]) -> str:
    """Returns a row for each robot and trainer: the mean over seeds, and the worst; empty columns are left out."""
    every = [row for seeds in groups.values() for row in seeds]
    columns = [column for column in columns if any(row.get(column.key) is not None for row in every)]
    rows = []
    for (task, trainer, gpu), seeds in sorted(groups.items(), key=lambda item: [*NAMES].index(item[0][0])):
        rows.append((NAMES[task], trainer, gpu, len(seeds), *(_figure(seeds, column) for column in columns)))
    return table(("robot", "trained by", "on", "seeds", *(column.label for column in columns)), rows)


def _figure(seeds: Sequence[Row], column: Column) -> str:
    """Returns the mean of a figure and the worst of several; what some seeds lack is said."""
    values = [row[column.key] / column.unit for row in seeds if row.get(column.key) is not None]
    if not values:
        return ""
    mean = f"{statistics.mean(values):{column.shown}}"
    worst = f" ({column.worst(values):{column.shown}})" if len({*values}) > 1 else ""
    return f"{mean}{worst}{f', {len(seeds) - len(values)} without' if len(values) < len(seeds) else ''}"


def draw(picture: Path, folders: Sequence[Path] = RESULTS) -> None:
    """Draws the return of each seed against seconds of training, a panel for each robot."""
    groups = by_trainer(rows_of(folders))
    tasks = list(dict.fromkeys(task for task, _, _ in groups))
    figure = Figure(figsize=(9, 3.2 * -(-len(tasks) // 2)), layout="constrained")
    panels = figure.subplots(-(-len(tasks) // 2), 2, squeeze=False).flat
    for task, axes in zip(tasks, panels, strict=False):
        for (name, trainer, gpu), seeds in groups.items():
            own = (color for word, color in TRAINERS.items() if word in trainer)
            color = next(own, GPUS.get(gpu, "#f5a623"))
            for seed, row in enumerate(seeds if name == task else ()):
                lines = [line for line in metrics_of(row["folder"] / row["run"])[1:] if line["episodes"] > 0]
                points = [(line["seconds"], line["return"]) for line in lines]
                label = None if seed else f"{trainer}, {gpu}"
                axes.plot(*zip(*points, strict=True), color=color, linewidth=1, label=label)
        column, value = MJLAB.get(task, ("", 0.0))
        if column == "return":
            axes.axhline(value, color="black", linestyle=":", linewidth=1, label=f"mjlab after 151 s: {value}")
        axes.set(title=NAMES[task], xscale="log", xlim=(1, None))
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize="small")
    for axes in panels:  # what is left
        axes.remove()
    figure.supxlabel("seconds of training")
    figure.supylabel("return of 1000 steps")
    figure.savefig(picture, dpi=110)
