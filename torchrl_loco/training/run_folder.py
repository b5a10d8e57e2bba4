"""Everything that a run leaves, in one folder."""

import csv
import dataclasses
import itertools
import json
import pickle
import shutil
import zipfile
import zlib
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from torchrl_loco.checks import check_device, check_run
from torchrl_loco.policy import Policy
from torchrl_loco.registry import env_class
from torchrl_loco.training.config import CONFIGS, TrainingConfig

CHECKPOINT_VERSION = 2
ROOM_NEEDED = 200 * 2**20
"""Bytes that a run may need: checkpoints, video, metrics."""

_UNREADABLE = (
    *(zipfile.BadZipFile, zlib.error, pickle.UnpicklingError, NotImplementedError),
    *(RuntimeError, OSError, EOFError, LookupError, TypeError, ValueError),
)
"""What reading a damaged checkpoint may raise."""


class RunFolder:
    """A run on disk.

    It holds ``config.json``, ``metrics.csv``, ``tensorboard/``, ``evaluations.csv``, ``checkpoint.pt``,
    ``policy.safetensors``, ``learning_curve.png`` and ``video.mp4``; and ``bad_world.safetensors``, should a world not
    stay finite.

    Args:
        path: an existing folder of a run.

    Raises:
        FileNotFoundError: ``path`` is no folder with a ``config.json``.
    """

    def __init__(self, path: Path) -> None:
        self.path = check_run(path)

    @classmethod
    def create(cls, config: TrainingConfig) -> "RunFolder":
        """Makes a new folder for a run in ``config.out``, named after task, time and seed.

        Returns:
            The folder, with ``config`` in it.

        Raises:
            ValueError: the device is not here.
            ImportError: the environment is another distribution's, which is broken.
            OSError: the folder cannot be made, or the disk has no room for a run.
        """
        check_device(config.device)
        env_class(config.task)
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        name = f"{config.task}-{stamp}-seed{config.seed}"
        Path(config.out).mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(config.out).free
        if free < ROOM_NEEDED:
            raise OSError(f"{config.out} has {free / 2**20:.0f} MiB left, a run may need {ROOM_NEEDED / 2**20:.0f} MiB")
        for suffix in itertools.count(1):  # runs may start within the same second
            path = Path(config.out) / (name if suffix == 1 else f"{name}-{suffix}")
            try:
                path.mkdir()
                break
            except FileExistsError:
                continue
        values = {"algorithm": config.algorithm, **dataclasses.asdict(config)}
        (path / "config.json").write_text(json.dumps(values, default=str, indent=2) + "\n")
        return cls(path)

    def load_config(self, **overrides: Any) -> TrainingConfig:
        """Returns the settings of the run, with ``overrides`` on top, such as ``device="cpu"`` for a run from CUDA.

        Raises:
            ValueError: it was trained by an algorithm that this release has not, or a field is out of range.
        """
        values = json.loads((self.path / "config.json").read_text())
        values.update(out=Path(values["out"]), hidden=tuple(values["hidden"]))
        algorithm = values.pop("algorithm", None)
        if algorithm not in CONFIGS:
            raise ValueError(f"{self.path} was trained by {algorithm!r}, this release has {', '.join(CONFIGS)}")
        return CONFIGS[algorithm](**{**values, **overrides})

    @property
    def video(self) -> Path:
        """Where the video lies."""
        return self.path / "video.mp4"

    @property
    def policy(self) -> Path:
        """Where the trained policy lies, without what only training needs."""
        return self.path / "policy.safetensors"

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is something to resume from."""
        return (self.path / "checkpoint.pt").is_file()

    @property
    def bad_world(self) -> Path:
        """Where the first world lies that did not stay finite, if any."""
        return self.path / "bad_world.safetensors"

    @property
    def is_finished(self) -> bool:
        """Whether the trained policy has had its last evaluation."""
        return self.policy.is_file() and "mean" in Policy.load(self.policy, "cpu").info

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Adds ``row`` to ``metrics.csv``."""
        self._append("metrics.csv", row)

    def append_evaluation(self, row: dict[str, Any]) -> None:
        """Adds ``row`` to ``evaluations.csv``."""
        self._append("evaluations.csv", row)

    def read_metrics(self) -> dict[str, list[float]]:
        """Returns the columns of ``metrics.csv``.

        Raises:
            ValueError: there is no line yet.
        """
        rows = self._read("metrics.csv")
        if not rows:
            raise ValueError(f"{self.path} has no metrics yet")
        return {key: [row[key] for row in rows] for key in rows[0]}

    def read_evaluations(self) -> list[dict[str, float]]:
        """Returns the lines of ``evaluations.csv``, none if there was no evaluation yet."""
        return self._read("evaluations.csv")

    def forget_after(self, frames: int) -> None:
        """Removes the lines of metrics and evaluations after so many ``frames``: a resumed run writes them again."""
        for name in ("metrics.csv", "evaluations.csv"):
            path, part = self.path / name, self.path / f"{name}.part"
            if not path.exists():
                continue
            head, *lines = path.read_text().splitlines()
            at, count = head.split(",").index("frames"), head.count(",")
            whole = [line for line in lines if line.count(",") == count]  # a crash may have torn the last one
            part.write_text("\n".join([head, *(line for line in whole if float(line.split(",")[at]) <= frames)]) + "\n")
            part.replace(path)

    def _append(self, name: str, row: dict[str, Any]) -> None:
        path = self.path / name
        new = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, row, lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(row)

    def _read(self, name: str) -> list[dict[str, float]]:
        path = self.path / name
        if not path.exists():
            return []
        with path.open(newline="") as file:
            return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]

    def save_checkpoint(self, entries: dict[str, Any]) -> None:
        """Writes ``entries`` as the checkpoint; a crash while writing leaves the previous one."""
        part = self.path / "checkpoint.pt.part"
        torch.save({"version": CHECKPOINT_VERSION, **entries}, part)
        part.replace(self.path / "checkpoint.pt")

    def load_checkpoint(self, device: torch.device | str) -> dict[str, Any]:
        """Reads the checkpoint without executing code.

        Returns:
            Its entries, with tensors on ``device``.

        Raises:
            FileNotFoundError: the run has none yet.
            ValueError: it is of another version, or no checkpoint at all.
        """
        path = self.path / "checkpoint.pt"
        if not self.has_checkpoint:
            raise FileNotFoundError(f"{self.path} has no checkpoint.pt: the run did not get that far, train anew")
        try:
            with zipfile.ZipFile(path) as archive:  # torch.load looks at no checksum
                damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{damaged} is damaged")
            entries = torch.load(path, map_location=device, weights_only=True)
            version = entries["version"]
        except _UNREADABLE as error:
            raise ValueError(f"{path} cannot be read as a checkpoint: {error}") from error
        if version != CHECKPOINT_VERSION:
            raise ValueError(f"{path} has version {version}, this release reads {CHECKPOINT_VERSION}")
        return entries
