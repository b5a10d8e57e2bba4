"""Everything that a run leaves, in one folder."""

import csv
import dataclasses
import itertools
import json
import pickle
from datetime import datetime
from pathlib import Path
from typing import Any

import matplotlib
import torch

from torchrl_loco.training.presets import PPOConfig

CHECKPOINT_VERSION = 1


class RunFolder:
    """A run on disk: ``config.json``, ``metrics.csv``, ``checkpoint.pt``, ``evaluation.json``, ``learning_curve.png``
    and ``video.mp4``.

    Args:
        path: an existing folder of a run.

    Raises:
        FileNotFoundError: ``path`` is no folder with a ``config.json``.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not (self.path / "config.json").is_file():
            raise FileNotFoundError(f"{self.path} is no run folder: it has no config.json")

    @classmethod
    def create(cls, config: PPOConfig) -> "RunFolder":
        """Makes a new folder for a run in ``config.out``, named after task, time and seed."""
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{config.task}-{stamp}-seed{config.seed}"
        Path(config.out).mkdir(parents=True, exist_ok=True)
        for suffix in itertools.count(1):  # runs may start within the same second
            path = Path(config.out) / (name if suffix == 1 else f"{name}-{suffix}")
            try:
                path.mkdir()
                break
            except FileExistsError:
                continue
        (path / "config.json").write_text(json.dumps(dataclasses.asdict(config), default=str, indent=2) + "\n")
        return cls(path)

    def load_config(self, **overrides: Any) -> PPOConfig:
        """Returns the settings of the run, with ``overrides`` on top, such as ``device="cpu"`` for a run from CUDA."""
        values = json.loads((self.path / "config.json").read_text())
        values.update(out=Path(values["out"]), hidden=tuple(values["hidden"]))
        return PPOConfig(**{**values, **overrides})

    @property
    def video(self) -> Path:
        """Where the video lies."""
        return self.path / "video.mp4"

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Adds a line to ``metrics.csv``."""
        path = self.path / "metrics.csv"
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row)
            if new:
                writer.writeheader()
            writer.writerow(row)

    def read_metrics(self) -> dict[str, list[float]]:
        """Returns the columns of ``metrics.csv``."""
        with (self.path / "metrics.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        return {key: [float(row[key]) for row in rows] for key in rows[0]}

    def save_checkpoint(self, entries: dict[str, Any]) -> None:
        """Writes the checkpoint; a crash while writing leaves the previous one."""
        part = self.path / "checkpoint.pt.part"
        torch.save({"version": CHECKPOINT_VERSION, **entries}, part)
        part.replace(self.path / "checkpoint.pt")

    def load_checkpoint(self, device: torch.device | str) -> dict[str, Any]:
        """Reads the checkpoint without executing code.

        Raises:
            FileNotFoundError: the run has none yet.
            ValueError: it is of another version, or no checkpoint at all.
        """
        path = self.path / "checkpoint.pt"
        if not path.is_file():
            raise FileNotFoundError(f"{self.path} has no checkpoint.pt: the run did not get that far")
        try:
            entries = torch.load(path, map_location=device, weights_only=True)
            version = entries["version"]
        except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError) as error:
            raise ValueError(f"{path} cannot be read as a checkpoint: {error}") from error
        if version != CHECKPOINT_VERSION:
            raise ValueError(f"{path} has version {version}, this release reads {CHECKPOINT_VERSION}")
        return entries

    def save_evaluation(self, summary: dict[str, float]) -> None:
        """Writes the summary of the evaluation."""
        (self.path / "evaluation.json").write_text(json.dumps(summary, indent=2) + "\n")

    def plot_learning_curve(self, evaluation: dict[str, float] | None = None) -> None:
        """Draws return against frames, with the evaluation at the end if there is one."""
        matplotlib.use("agg")
        from matplotlib import pyplot as plt

        metrics, config = self.read_metrics(), self.load_config()
        figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
        millions = [frames / 1e6 for frames in metrics["frames"]]
        label = f"training (sampled actions, episodes of {config.episode_length} steps)"
        axes.plot(millions, metrics["return"], label=label)
        if evaluation is not None:
            axes.errorbar(
                millions[-1],
                evaluation["mean"],
                evaluation["std"],
                fmt="o",
                capsize=4,
                label=f"evaluation: {evaluation['mean']:.0f} over {evaluation['episodes']} episodes",
            )
        axes.set(
            xlabel="frames (million)",
            ylabel="return of 1000 steps",
            title=f"{config.task}, {config.protocol}, {metrics['seconds'][-1]:.0f} s on {config.device}",
            ylim=(0, 1000),
        )
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right")
        figure.savefig(self.path / "learning_curve.png", dpi=150)
        plt.close(figure)
