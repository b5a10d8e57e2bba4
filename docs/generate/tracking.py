"""Draws how motions are learned, a line for each training: ``PYTHONPATH=docs python -m generate.tracking``."""

import csv
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "2026-11-27" / "tracking" / "curves.csv"
OF_SVG = ROOT / "benchmarks" / "results" / "2026-11-28" / "svg"
PICTURE = ROOT / "docs" / "_static" / "tracking.png"
PICTURE_OF_SVG = ROOT / "docs" / "_static" / "many-motions.png"
PANELS = {"all": "59 clips, one policy", "J_Dance4_Broadway": "J_Dance4_Broadway"}
PPO = ("all, seed 1", "all, seed 2", "all, seed 3")
COLUMNS = {"episode_length": "control steps of an episode", "metric/body_error": "error of the bodies (m)"}


def read(path: Path) -> dict[str, list[dict[str, str]]]:
    """Returns the rows of a file by run."""
    runs = defaultdict[str, list[dict[str, str]]](list)
    with path.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            runs[row["run"]].append(row)
    return runs


def main() -> None:
    """Writes the pictures."""
    runs = read(RESULTS)
    draw_curves(runs)
    draw_svg({name: rows for name, rows in runs.items() if name in PPO}, read(OF_SVG / "curves.csv"))


def draw_svg(ppo: dict[str, list[dict[str, str]]], svg: dict[str, list[dict[str, str]]]) -> None:
    """Draws how 59 motions are learned by svg and by PPO."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    episodes, returns = figure.subplots(1, 2)
    before, preset = ({n: rows for n, rows in svg.items() if n.startswith(start)} for start in ("seed", "2048"))
    groups = (
        ("tab:orange", "PPO", "PPO", ppo),
        ("tab:blue", "svg, seed", "svg, rounds of 4096", before),
        ("tab:green", "svg, 2048", "svg, rounds of 2048", preset),
    )
    for color, _, label, some in groups:
        for name, rows in some.items():
            columns = ([float(row[key]) for row in rows] for key in ("seconds", "episode_length"))
            dashes = ":" if "anew" in name else "-"
            episodes.plot(*columns, dashes, color=color, lw=1.2, label=label + ", compiled anew" * (dashes == ":"))
    for name, rows in read(OF_SVG / "evaluations.csv").items():
        seconds, reached = ([float(row[key]) for row in rows] for key in ("seconds", "return"))
        color = next(color for color, start, *_ in groups if name.startswith(start))
        dashes = ":" if "anew" in name else "-"
        returns.plot(seconds, reached, "o" + dashes, color=color, ms=4, lw=1.2)
        returns.annotate(rows[-1]["lost"], (seconds[-1], reached[-1]), (5, -3), textcoords="offset points", size=7)
    episodes.set_ylabel("control steps of an episode, of 500")
    returns.set_ylabel("return of all clips (number: clips lost)")
    for axis in (episodes, returns):
        axis.set_xlabel("seconds of training, with compiling")
        axis.set_xlim(0 if axis is episodes else 40, 200 if axis is episodes else 800)
        axis.set_ylim(*((0.0, 500.0) if axis is episodes else (0.7, 1.0)))
        axis.grid(alpha=0.3)
    returns.set_xscale("log")
    returns.set_xticks([60, 120, 180, 600], ["60", "120", "180", "600"])
    returns.minorticks_off()
    shown = dict(zip(*episodes.get_legend_handles_labels()[::-1], strict=True))
    episodes.legend(shown.values(), shown.keys(), fontsize=7)
    figure.savefig(PICTURE_OF_SVG, dpi=110)


def draw_curves(runs: dict[str, list[dict[str, str]]]) -> None:
    """Draws how PPO learns motions."""
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    axes = figure.subplots(len(COLUMNS), len(PANELS), sharex="col")
    for (key, title), column in zip(PANELS.items(), axes.T, strict=True):
        for (name, label), axis in zip(COLUMNS.items(), column, strict=True):
            for run, rows in runs.items():
                if run.startswith(f"{key},"):
                    seconds = [float(row["seconds"]) for row in rows]
                    axis.plot(seconds, [float(row[name]) for row in rows], label=run.removeprefix(f"{key}, "), lw=1.2)
            axis.set_ylabel(label)
            axis.set_ylim(bottom=0.0)
            axis.grid(alpha=0.3)
        column[0].set_title(title)
        column[0].legend(fontsize=7)
        column[-1].set_xlabel("seconds of training, with compiling")
        column[-1].set_xlim(0, 240 if key == "all" else 85)
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    main()
