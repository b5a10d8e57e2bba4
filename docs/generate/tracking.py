"""Draws how motions are learned, a line for each training: ``PYTHONPATH=docs python -m generate.tracking``."""

import csv
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "2026-11-27" / "tracking" / "curves.csv"
PICTURE = ROOT / "docs" / "_static" / "tracking.png"
PANELS = {"all": "59 clips, one policy", "J_Dance4_Broadway": "J_Dance4_Broadway"}
COLUMNS = {"episode_length": "control steps of an episode", "metric/body_error": "error of the bodies (m)"}


def main() -> None:
    """Writes the picture."""
    runs = defaultdict[str, list[dict[str, str]]](list)
    with RESULTS.open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            runs[row["run"]].append(row)
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
