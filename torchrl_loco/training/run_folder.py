"""The folder that holds everything a run produces."""

import contextlib
import csv
import dataclasses
import io
import json
import logging
import pickle
import shutil
import zipfile
from collections.abc import Collection, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from torchrl_loco import known_files, storage
from torchrl_loco.checks import check_device, check_run, number_of
from torchrl_loco.policy import Policy, in_task
from torchrl_loco.registry import resolve
from torchrl_loco.source import files_of
from torchrl_loco.training import distributed
from torchrl_loco.training.config import TrainingConfig, check_packages_of, config_from_json

CHECKPOINT_VERSION = 7
WITHOUT_CHECKPOINT = "wait for one if it is being trained, else start a new run"

_UNREADABLE = (
    *(pickle.UnpicklingError, zipfile.BadZipFile, RuntimeError),
    *(OSError, EOFError, LookupError, TypeError, ValueError),
)
"""Errors that reading a damaged checkpoint may raise."""


def _as_json(config: TrainingConfig) -> bytes:
    return f"{json.dumps(config.to_json(), indent=2)}\n".encode()


def _read_table(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """Returns the columns of a CSV file and its rows, without those that a crash or a full disk has cut.

    Raises:
        ValueError: it is damaged: a value is no number, or no column is named frames.
    """
    rows = csv.DictReader(path.read_text(encoding="utf-8", errors="replace").split("\n")[:-1] if path.exists() else [])
    columns, found = list(rows.fieldnames or ()), [dict[Any, Any](row) for row in rows]
    if longer := [row for row in found if None in row]:
        count = len(columns) + len(longer[0][None])
        raise ValueError(f"{path} has a line of {count} columns, but its head names {len(columns)}")
    found = [row for row in found if None not in row.values()]
    wrong = [value for row in found for value in row.values() if value and number_of(value) is None]
    if wrong or (columns and "frames" not in columns):
        what = f"{wrong[0]!r} is no number" if wrong else f"its head is {','.join(columns)[:60]!r}"
        raise ValueError(f"{path} is damaged, {what}: mend it, or move it away")
    return columns, found


def _write_table(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> None:
    """Writes a CSV file as a whole; columns that a row lacks are empty in it."""
    text = io.StringIO()
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    storage.replace_file(path, text.getvalue().encode())


class RunFolder:
    """A run on disk.

    It holds ``config.json``, ``metrics.csv``, ``evaluations.csv``, ``checkpoint.pt``, ``policy.safetensors``,
    ``learning_curve.png``, ``video.mp4``, what its loggers write (``tensorboard/``, ``wandb/``, ``mlflow.db``),
    ``verify.json`` if the policy was verified, and ``nan_dump.safetensors`` if a world became non-finite.
    ``launch.txt`` names the launch by torchrun that began it, ``given.json`` what was handed to
    :func:`torchrl_loco.training.train` as an object. ``source/`` has a copy of the file of the task, if it is in one,
    of the modules beside it that it imports, and of its model, if that is below the same folder: they are what is run
    where that file is gone.

    Args:
        path: an existing run folder.
        task: where the class of its task is now, as the user says; ``None`` for what the folder says.

    Attributes:
        path: the folder.
        checkpoint: what the run continues from.
        policy: the trained policy, without the parts that only training needs.
        video: the video of that.
        nan_dump: state and action from which a world first became non-finite, if any.

    Raises:
        FileNotFoundError: ``path`` is no folder with a ``config.json``.
    """

    def __init__(self, path: Path, task: str | None = None) -> None:
        self.path, self._named = check_run(path), task
        self.checkpoint = self.path / "checkpoint.pt"
        self.policy = self.path / "policy.safetensors"
        self.video = self.path / "video.mp4"
        self.nan_dump = self.path / "nan_dump.safetensors"

    @classmethod
    def create(cls, config: TrainingConfig, given: Collection[str] = ()) -> "RunFolder":
        """Makes a new folder for a run in ``config.out``, named after task, time and seed.

        Args:
            config: the settings.
            given: what is handed to the trainer as an object, such as ``"network"``.

        Returns:
            The folder, with ``config`` in it.

        Raises:
            ValueError: this machine does not have the device.
            ImportError: the package of a logger is missing, or the module of the environment is broken.
            OSError: the folder cannot be made, or the file of the environment is missing.
        """
        check_device(config.device)
        resolve(config.task)
        check_packages_of(config)
        name = f"{config.label}-{datetime.now():%Y%m%d-%H%M%S}-seed{config.seed}"
        try:
            config.out.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise OSError(f"out must be a folder for runs, but {config.out} is a file or lies below one") from None
        while True:  # runs may start within the same second
            path = storage.unused_path(config.out / name)
            with contextlib.suppress(FileExistsError):
                path.mkdir()
                break
        if given:
            storage.replace_file(path / "given.json", f"{json.dumps(list(given))}\n".encode())
        storage.replace_file(path / "config.json", _as_json(config))  # from here on it is a run
        if launch := distributed.launch_id():
            storage.replace_file(path / "launch.txt", launch.encode())
        run = cls(path)
        try:
            run.keep_source()
        except BaseException:
            shutil.rmtree(path)
            raise
        return run

    @classmethod
    def of_launch(cls, config: TrainingConfig) -> "RunFolder | None":
        """Returns the run of these settings that this launch began before torchrun started the ranks anew, if any."""
        if not distributed.is_restart():
            return None
        files = [file for file in config.out.glob("*/launch.txt") if file.read_text() == distributed.launch_id()]
        newest = sorted(files, key=lambda file: file.stat().st_mtime, reverse=True)
        return next((run for run in map(cls, (file.parent for file in newest)) if run.load_config() == config), None)

    def load_config(self, **overrides: Any) -> TrainingConfig:
        """Returns the settings of the run, with ``overrides`` on top, such as ``device="cpu"`` for a run from CUDA.

        Raises:
            ValueError: ``config.json`` is damaged, or of another release.
        """
        path = self.path / "config.json"
        try:
            config = config_from_json(json.loads(path.read_text()))
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            why = (
                "is damaged, from another release, of a task that is not installed, or of an algorithm of your own "
                "that was not passed to training.train in this process"
            )
            if self.policy.is_file():
                why += f" (name {self.policy} to play, evaluate or export it)"
            raise ValueError(f"{path} {why}: {error}") from error
        return dataclasses.replace(config, **overrides)

    @property
    def task(self) -> str:
        """Where the class of its task is. As the user or its settings say, or in ``source/`` if that file is gone."""
        return self._named or known_files.place_of(self.load_config().task, self.path)

    def keep_source(self) -> None:
        """Copies the file of its task, and what belongs to it, into ``source/``, and remembers it as the user's."""
        path = Path(self.task.rpartition(":")[0])
        if path.suffix != ".py" or not path.is_file() or path.is_relative_to(self.path.resolve() / known_files.KEPT):
            return
        known_files.remember(path)
        cls, package, folder = resolve(self.task), Path(known_files.__file__).parent, self.path / known_files.KEPT
        cls.check_class()
        copies = {}
        for file in files_of(cls, path):
            if file.is_relative_to(path.parent) and not file.is_relative_to(package):
                copies[folder / file.relative_to(path.parent)] = file
        if copies.pop(folder / path.name, None):
            copies[folder / Path(self.load_config().task.rpartition(":")[0]).name] = path  # by which the run finds it
        for copy, file in copies.items():
            copy.parent.mkdir(parents=True, exist_ok=True)
            storage.replace_file(copy, file.read_bytes())
        for gone in set(folder.rglob("*.py")) - copies.keys():
            gone.unlink()

    def store_config(self, config: TrainingConfig) -> None:
        """Stores the settings that :meth:`load_config` returns from then on."""
        storage.replace_file(self.path / "config.json", _as_json(config))

    @property
    def given(self) -> tuple[str, ...]:
        """What was handed to the trainer as an object, such as ``"network"``: the folder does not hold it."""
        path = self.path / "given.json"
        return tuple(json.loads(path.read_text())) if path.exists() else ()

    def load_policy(self, device: str | None = None) -> Policy:
        """Returns the trained policy on ``device``; ``None`` takes CUDA if there is any.

        Raises:
            FileNotFoundError: the run has none yet; the message says how to get one.
            ValueError: it cannot be read, or is of another task.
        """
        if not self.policy.is_file():
            way = "continue it with torchrl-loco resume" if self.has_checkpoint else WITHOUT_CHECKPOINT
            raise FileNotFoundError(f"{self.path} has no policy yet: {way}")
        policy, task = Policy.load(self.policy, device), self.load_config().task
        if policy.info["task"] != task:
            raise ValueError(f"{self.policy} is a policy for {policy.info['task']}, but the run is of {task}")
        policy.info = in_task(policy.info, task, self.task)
        return policy

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is a checkpoint to resume from."""
        return self.checkpoint.is_file()

    @property
    def is_finished(self) -> bool:
        """Whether the trained policy had its last evaluation, after all frames that the run has by now."""
        if not self.policy.is_file():
            return False
        info, total = Policy.load(self.policy, "cpu").info, self.load_config().total_frames
        return "mean" in info and info.get("total_frames", total) == total

    def append_metrics(self, row: dict[str, Any]) -> None:
        """Adds ``row`` to ``metrics.csv``; what it has more than the rows before becomes a column, empty in those."""
        self._append("metrics.csv", row)

    def append_evaluation(self, row: dict[str, Any]) -> None:
        """Adds ``row`` to ``evaluations.csv``."""
        self._append("evaluations.csv", row)

    def read_metrics(self) -> dict[str, list[float]]:
        """Returns the columns of ``metrics.csv``, with NaN where a row does not have them.

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

    def read_logger_ids(self) -> dict[str, str]:
        """Returns the ids under which W&B and MLflow know the run, by logger."""
        path = self.path / "loggers.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def write_logger_ids(self, ids: dict[str, str]) -> None:
        """Keeps the ids that :meth:`read_logger_ids` returns."""
        if ids:
            storage.replace_file(self.path / "loggers.json", f"{json.dumps(ids)}\n".encode())

    def forget_after(self, frames: int, iteration: int) -> None:
        """Removes the lines of metrics and evaluations after a checkpoint: a resumed run writes them again.

        Args:
            frames: those of the checkpoint.
            iteration: its iteration, as many as there should be lines of metrics.
        """
        for name in ("metrics.csv", "evaluations.csv"):
            path = self.path / name
            columns, rows = _read_table(path)
            if columns:
                _write_table(path, columns, [row for row in rows if float(row["frames"]) <= frames])
            else:
                path.unlink(missing_ok=True)  # the disk was full when its first line was written
        if (count := len(self._read("metrics.csv"))) < iteration:
            logging.getLogger("torchrl_loco").warning(
                "%s has %d of the %d lines up to the checkpoint: the others are lost, and missing in its curve",
                self.path / "metrics.csv",
                count,
                iteration,
            )

    def _append(self, name: str, row: dict[str, Any]) -> None:
        path = self.path / name
        with path.open("a+", newline="", encoding="utf-8") as file:
            file.seek(0)
            columns = next(csv.reader(file), [])
            if row.keys() <= set(columns):
                csv.DictWriter(file, columns, lineterminator="\n").writerow(row)
                return
        columns, rows = _read_table(path)
        _write_table(path, [*dict.fromkeys([*columns, *row])], [*rows, row])

    def _read(self, name: str) -> list[dict[str, float]]:
        _, rows = _read_table(self.path / name)
        return [{key: float(value or "nan") for key, value in row.items()} for row in rows]

    def save_checkpoint(self, entries: dict[str, Any], keep: int = 1) -> None:
        """Writes ``entries`` as the checkpoint; a crash while writing leaves the previous one.

        Args:
            entries: tensors and numbers; ``frames`` is how far it is.
            keep: how many checkpoints stay: with more than one, each also lies in ``checkpoint-<frames>.pt``.

        Raises:
            OSError: it cannot be written, for example because the disk is full.
        """
        buffer = io.BytesIO()  # torch's own writer does not say what went wrong
        torch.save({"version": CHECKPOINT_VERSION, **entries}, buffer)
        storage.replace_file(self.checkpoint, buffer.getbuffer())
        if keep > 1:
            storage.replace_file(self.path / f"checkpoint-{entries['frames']}.pt", buffer.getbuffer())
            own = {path: path.stem.rpartition("-")[2] for path in self.path.glob("checkpoint-*.pt")}
            kept = sorted((path for path, of in own.items() if of.isdecimal()), key=lambda path: int(own[path]))
            for old in kept[:-keep]:  # others are the user's copies
                old.unlink()

    def remove_parts(self) -> None:
        """Removes what a process that was killed had written of a file; the lock must be taken."""
        for part in self.path.glob(f"*.{'[0-9a-f]' * 32}.part"):  # as storage.replace_file names them
            part.unlink()

    def load_checkpoint(self, device: torch.device | str, path: Path | None = None) -> dict[str, Any]:
        """Reads the checkpoint without executing code.

        Args:
            device: where its tensors are put.
            path: another of its checkpoints; ``None`` is the last one.

        Returns:
            Its entries, with tensors on ``device``.

        Raises:
            FileNotFoundError: the run has none yet.
            ValueError: it is damaged, or of another version.
        """
        path = self.checkpoint if path is None else path
        if not path.is_file():
            raise FileNotFoundError(f"{self.path} has no {path.name} yet: {WITHOUT_CHECKPOINT}")
        try:
            with zipfile.ZipFile(path) as file:
                if part := file.testzip():  # torch.load does not check
                    raise ValueError(f"the checksum of {part} is wrong")
            entries = torch.load(path, map_location=device, weights_only=True)
            version = entries["version"]
        except _UNREADABLE as error:
            why, *_ = str(error).splitlines() or [type(error).__name__]
            raise ValueError(f"{path} cannot be read as a checkpoint, it may be cut off or damaged: {why}") from error
        if version != CHECKPOINT_VERSION:
            raise ValueError(f"{path} has version {version}, this release reads {CHECKPOINT_VERSION}")
        return entries
