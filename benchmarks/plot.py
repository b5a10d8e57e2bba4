"""A picture of throughput against the number of worlds."""

import json
from pathlib import Path

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot as plt


def plot(results: Path, picture: Path) -> None:
    """Draws the rows of a results file, a panel for each body and a line for each case."""
    data = json.loads(results.read_text())
    rows = data["rows"]
    bodies = list(dict.fromkeys(row["body"] for row in rows))
    figure, panels = plt.subplots(1, len(bodies), figsize=(5.5 * len(bodies), 4.2), squeeze=False, layout="constrained")
    for axes, body in zip(panels[0], bodies, strict=True):
        axes.set(title=f"{body}, {data['device']}, {data['date']}", xlabel="worlds", ylabel="million steps per second")
        axes.set_xscale("log", base=2)
        axes.grid(alpha=0.3)
        for case in dict.fromkeys(row["case"] for row in rows):
            of_case = [row for row in rows if row["body"] == body and row["case"] == case]
            worlds = [row["worlds"] for row in of_case]
            axes.plot(worlds, [row["worlds"] / row["ms"] / 1e3 for row in of_case], "o-", markersize=3, label=case)
        axes.set_ylim(bottom=0)
        axes.legend()
    figure.savefig(picture, dpi=150)
