"""What a campaign knows, on disk: a file for each job, and the tables that are made of them."""

import contextlib
import csv
import dataclasses
import fcntl
import io
import json
import os
import shutil
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Self

from benchmarks.marks import threshold
from benchmarks.results import Row
from benchmarks.training import evaluations
from torchrl_loco.policy import Policy
from torchrl_loco.storage import replace_file
from torchrl_loco.training import RunFolder

SUMMARY = ("episodes", "mean", "std", "min", "max")
JOB = ("task", "protocol", "seed")
TABLES = {
    "jobs.csv": (*JOB, "status", "processes", "wall", "settings", "error"),
    "evaluations.csv": (*JOB, "frames", "seconds", "wall", *SUMMARY, "status"),
    "results.csv": (
        *(*JOB, "frames", "seconds", "wall", "frames_per_second"),
        *("threshold", "seconds_to_threshold", "wall_to_threshold", *SUMMARY, "processes", "device", "settings"),
    ),
}
"""Columns of the tables."""


@dataclasses.dataclass(frozen=True, order=True)
class Job:
    """A training run of a campaign."""

    task: str
    protocol: str
    seed: int

    def __str__(self) -> str:
        """Returns the name of its folder and of its policy."""
        return f"{self.task}-{self.protocol}-{self.seed}"


@dataclasses.dataclass
class Record:
    """What is known of a job."""

    status: str = "waiting"
    """waiting, running, stopped, failed or finished."""
    processes: int = 0
    """How many processes have trained it; more than one if it was stopped or failed."""
    wall: float = 0.0
    """Time that they ran (s), imports, evaluations and what was lost when they were stopped included."""
    settings: str = ""
    """What was set, beside the preset."""
    error: str = ""
    """What its last process said, if it failed."""
    evaluations: list[Row] = dataclasses.field(default_factory=list)
    """The evaluations of its run, with ``wall`` when each was seen."""
    result: Row | None = None
    """Its row in ``results.csv``, once it is finished."""


class CampaignFolder:
    """The folder of a campaign, in use within a ``with`` block.

    All that is written is replaced as a whole, and threads may write side by side.

    It holds ``jobs/JOB/`` (the run folder, ``log.txt`` of its processes, and ``job.json``), ``policies/``,
    ``about.json``, and the tables, which are made of the ``job.json``.

    Args:
        path: the folder; it is made if it does not exist.

    Raises:
        BlockingIOError: a campaign, or a process that it left behind, is at work in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        self.lock = os.open(path / "lock", os.O_CREAT | os.O_RDWR)
        """File descriptor; a process that inherits it keeps the folder locked while it lives."""
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self.lock)
            raise BlockingIOError(
                f"a campaign is at work in {path}: wait for its end, or choose another folder"
            ) from None
        self._writing = threading.Lock()
        self._records: dict[Job, Record] = {}
        for file in sorted(path.glob("jobs/*/job.json")):
            values = json.loads(file.read_text())
            self._records[Job(**values["job"])] = Record(**values["record"])
        self._write_tables()

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leaves the folder to others."""
        os.close(self.lock)

    def home(self, job: Job) -> Path:
        """Returns the folder of a job."""
        return self.path / "jobs" / str(job)

    def record(self, job: Job) -> Record:
        """Returns what is known of a job."""
        return self._records.get(job, Record())

    def update(self, job: Job, **changes: Any) -> None:
        """Changes the record of a job, and writes it and the tables."""
        with self._writing:
            self._records[job] = dataclasses.replace(self.record(job), **changes)
            home = self.home(job)
            home.mkdir(parents=True, exist_ok=True)
            values = {"job": dataclasses.asdict(job), "record": dataclasses.asdict(self._records[job])}
            replace_file(home / "job.json", f"{json.dumps(values, indent=1)}\n".encode())
            self._write_tables()

    def note_evaluations(self, job: Job, wall: float | None) -> None:
        """Takes over the evaluations of a job's run.

        Args:
            job: the job.
            wall: when those are seen that were not seen before; ``None`` if they were written while nobody looked.
        """
        record = self.record(job)
        seen = {(row["frames"], row["seconds"]): row["wall"] for row in record.evaluations}
        rows = []
        for row in evaluations(self.home(job)):
            when = seen.get((row["frames"], row["seconds"]), wall)
            rows.append(_rounded({**row, "wall": when}))
        if rows != record.evaluations:
            self.update(job, evaluations=rows, wall=record.wall if wall is None else wall)

    def run(self, job: Job) -> RunFolder | None:
        """Returns the run of a job, if it was begun."""
        return next((RunFolder(file.parent) for file in self.home(job).glob("*/config.json")), None)

    def run_to_resume(self, job: Job) -> RunFolder | None:
        """Returns the run of a job if it has a sound checkpoint, else removes what there is of it."""
        run = self.run(job)
        if run is None:
            return None
        try:
            run.load_checkpoint("cpu")
        except (FileNotFoundError, ValueError):
            with self._writing:
                shutil.rmtree(run.path)
            return None
        return run

    def finish(self, job: Job, wall: float | None) -> bool:
        """Takes over result and policy of a job if its run is finished.

        Args:
            job: the job.
            wall: when it ended; ``None`` if nobody looked.

        Returns:
            Whether it is finished.
        """
        run = self.run(job)
        if run is None or not run.is_finished:
            return False
        self.note_evaluations(job, wall)
        record, metrics = self.record(job), run.read_metrics()
        frames, seconds = int(metrics["frames"][-1]), metrics["seconds"][-1]
        passed = threshold(job.task, job.protocol)
        first = next((row for row in record.evaluations if passed is not None and row["mean"] >= passed), None)
        info = Policy.load(run.policy, "cpu").info
        result = {
            **{"frames": frames, "seconds": seconds, "wall": wall, "frames_per_second": round(frames / seconds)},
            "threshold": passed,
            "seconds_to_threshold": None if first is None else first["seconds"],
            "wall_to_threshold": None if first is None else first["wall"],
            **{name: info[name] for name in SUMMARY},
        }
        result = {**_rounded(result), "device": info["trained_on"]}
        policies = self.path / "policies"
        policies.mkdir(exist_ok=True)
        replace_file(policies / f"{job}.safetensors", run.policy.read_bytes())
        self.update(job, status="finished", result=result, wall=record.wall if wall is None else wall, error="")
        return True

    def add_about(self, circumstances: Row) -> None:
        """Adds the circumstances of a call to ``about.json``."""
        path = self.path / "about.json"
        calls = json.loads(path.read_text()) if path.exists() else []
        replace_file(path, f"{json.dumps([*calls, circumstances], indent=1)}\n".encode())

    def contents(self) -> tuple[dict[str, bytes], dict[str, bytes]]:
        """Returns the files of the campaign by name, and apart from them the checkpoints of unfinished jobs.

        The tables come first, the policies last. Checkpoints and second copies of policies of finished jobs are left
        out. Checkpoints of jobs that have trained for longest come first.
        """
        with self._writing:
            by_wall = sorted(self._records.items(), key=lambda item: item[1].wall, reverse=True)
            unfinished = [self.home(job) for job, record in by_wall if record.status != "finished"]
            # Read before the tables of their runs: what is newer there, a resumed run removes.
            checkpoints = self._read(file for home in unfinished for file in home.glob("*/checkpoint.pt"))
            files = [Path(folder, name) for folder, _, names in os.walk(self.path) for name in names]
            kept = [file for file in files if file.name != "lock" and file.suffix not in (".pt", ".part")]
            policies = [file for file in kept if file.suffix == ".safetensors"]
            needed = [file for file in policies if file.parent.name == "policies" or file.parents[1] in unfinished]
            return self._read([*sorted(set(kept) - set(policies)), *sorted(needed)]), checkpoints

    def _read(self, files: Iterable[Path]) -> dict[str, bytes]:
        contents = {}
        for file in files:
            with contextlib.suppress(FileNotFoundError):  # a process has removed it since
                contents[str(file.relative_to(self.path))] = file.read_bytes()
        return contents

    def _write_tables(self) -> None:
        rows: dict[str, list[Row]] = {name: [] for name in TABLES}
        for job, record in sorted(self._records.items(), key=lambda item: item[0]):
            own = {**dataclasses.asdict(job), **dataclasses.asdict(record)}
            own["wall"] = round(record.wall, 3)
            rows["jobs.csv"].append(own)
            rows["evaluations.csv"] += [{**own, **row} for row in record.evaluations]
            if record.result is not None:
                rows["results.csv"].append({**own, **record.result})
        for name, columns in TABLES.items():
            replace_file(self.path / name, _as_csv(rows[name], columns).encode())


def _rounded(row: Row) -> Row:
    """Returns numbers with three digits, and whole ones as integers."""
    rounded = {name: value and round(value, 3) for name, value in row.items()}
    return {name: int(value) if value and value == int(value) else value for name, value in rounded.items()}


def _as_csv(rows: Iterable[Row], columns: Sequence[str]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
