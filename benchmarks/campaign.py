"""Every task in every protocol with several seeds, as one script that can be stopped at any time and called again."""

import collections
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks import STARTED
from benchmarks.campaign_folder import CampaignFolder, Job
from benchmarks.pack import pack
from benchmarks.results import circumstances
from benchmarks.training import train_command
from torchrl_loco.checks import check_choice
from torchrl_loco.registry import OURS, env_class
from torchrl_loco.training.interrupts import interruptible

SETTINGS = {"eval_episodes": 128, "video_seconds": 0, "logger": "csv"}
"""What is set for every job, unless the caller sets it."""
OWN = ("protocol", "seed", "seeds", "device", "gpus", "out")
"""Settings that differ from job to job, or are not for a job."""
STOPPING = 30.0
"""Time before the end at which running jobs are told to stop (s): an evaluation may have to end first."""
WRITING = 10.0
"""Time before the end at which jobs that are still running are killed (s): the archive is written after that."""
PACKING = 60.0
"""Time between two archives (s)."""
POLL = 0.1
"""Time between two looks at a process and at its evaluations (s)."""
STOPPED = (130, -signal.SIGINT, -signal.SIGTERM, -signal.SIGKILL)
"""Return codes of a process that was stopped and did not fail."""
TUNED = tuple(task for task in OURS if env_class(task).presets)
"""Tasks that have a preset of their own."""


def campaign(
    path: Path,
    tasks: Sequence[str],
    protocols: Sequence[str],
    seeds: Sequence[int],
    settings: Mapping[str, str],
    devices: Sequence[str] | None = None,
    minutes: float | None = None,
    archive: Path | None = None,
) -> bool:
    """Trains every task in every protocol with every seed, or what is missing of it, and prints how it went.

    Args:
        path: the folder of the campaign.
        tasks: ids of environments.
        protocols: settings of the solver and of the reset.
        seeds: the seeds; every task is trained with the first one before any with the second.
        settings: settings of the jobs beside those of their presets, by name.
        devices: of :func:`available_devices`, one for each job that is trained at a time; ``None`` takes all GPUs, or
            the CPU if there are none. A device that is named twice trains two jobs at a time: together they end sooner,
            because one computes while the other starts, but their times are no longer those of a job alone.
        minutes: time from the start of the process until all is written; ``None`` for no limit.
        archive: where the folder is packed every minute and at the end.

    Returns:
        Whether a job failed.

    Raises:
        ValueError: an argument is not valid, or some of the jobs were begun with other settings.
        BlockingIOError: a campaign is at work in the folder.
    """
    available = available_devices()
    devices = devices or available[:-1] or available
    for device in devices:
        check_choice("device", device, available)
    if minutes is not None and 60 * minutes <= STOPPING:
        raise ValueError(f"minutes must be more than {STOPPING / 60:g}, which stopping and writing may take")
    if archive is not None and archive.resolve().is_relative_to(path.resolve()):
        raise ValueError(f"the archive must lie outside of the folder that it packs, {path}, got {archive}")
    end = math.inf if minutes is None else STARTED + 60 * minutes
    jobs = [Job(task, protocol, seed) for seed in seeds for protocol in protocols for task in tasks]
    with CampaignFolder(path) as folder:
        what_is_missing = Campaign(folder, jobs, settings)
        distinct = len(set(devices))
        about = {**circumstances(torch.device(devices[0])), "devices": distinct}
        if distinct < len(devices):
            about["note"] = "Jobs shared a device: their times are not those of a job alone."
        folder.add_about(about)
        what_is_missing.run(devices, end, archive)
        counts = collections.Counter(folder.record(job).status for job in jobs)
    print(f"{len(jobs)} jobs: {', '.join(f'{count} {status}' for status, count in counts.items())}; in {path}")
    return counts["failed"] > 0


def available_devices() -> list[str]:
    """Returns every CUDA device, then the CPU."""
    return [*(f"cuda:{index}" for index in range(torch.cuda.device_count())), "cpu"]


def parse_setting(word: str) -> tuple[str, str]:
    """Returns name and value of a setting that is written as ``NAME=VALUE``.

    Raises:
        ValueError: it is not, or the campaign sets it itself.
    """
    name, equals, value = word.partition("=")
    if not equals:
        raise ValueError(f"set takes NAME=VALUE, such as total_frames=20_000_000, got {word!r}")
    if name in OWN:
        raise ValueError(f"{name} is set for each job: choose tasks, protocols, seeds, devices and folder by options")
    return name, value


class Campaign:
    """Trains jobs on several devices side by side, each in a process of its own.

    A finished job is left alone. One that was stopped is resumed from its last checkpoint, or begun again if it has
    none, and so is one that failed. What happens is written to the folder while it happens.

    Args:
        folder: where everything is written.
        jobs: the jobs, in the order of training.
        settings: settings of the jobs beside those of their presets, by name.

    Raises:
        ValueError: some of the jobs have been begun with other settings.
    """

    def __init__(self, folder: CampaignFolder, jobs: Iterable[Job], settings: Mapping[str, str]) -> None:
        self.folder = folder
        self.jobs = list(dict.fromkeys(jobs))
        self._settings = {**SETTINGS, **settings}
        self._words = " ".join(f"{name}={value}" for name, value in sorted(settings.items()))
        for job in self.jobs:
            record = folder.record(job)
            begun = record.status == "finished" or folder.run(job) is not None
            if begun and record.settings != self._words:
                raise ValueError(
                    f"{job} in {folder.path} was begun with --set {record.settings or '(nothing)'}, now it is --set "
                    f"{self._words or '(nothing)'}: pass the same settings, or choose another folder"
                )
            if record.status != "finished":  # unless its end was not seen, because this script was killed before
                folder.finish(job, wall=None)
        self._waiting = collections.deque(job for job in self.jobs if folder.record(job).status != "finished")
        self._ended = collections.deque(job for job in self.jobs if folder.record(job).status == "finished")
        self._stop = threading.Event()
        self._kill = threading.Event()

    def run(self, devices: Sequence[str], end: float = math.inf, archive: Path | None = None) -> None:
        """Trains the jobs that are not finished, until all have ended, or SIGINT or SIGTERM arrives, or time is over.

        Args:
            devices: where to train, one job at a time on each.
            end: when everything must be written, on the clock of ``time.monotonic()``.
            archive: where the folder is packed now and then, and at the end.

        Raises:
            ExceptionGroup: something went wrong here, such as a full disk, and not in a job.
        """
        with (
            interruptible() as interrupted,
            ThreadPoolExecutor(len(devices)) as pool,
            tqdm(total=len(self.jobs), initial=len(self._ended), desc="campaign", unit="job") as bar,
        ):
            workers = [pool.submit(self._work, device) for device in devices]
            packed = time.monotonic()
            try:
                while not all(worker.done() for worker in workers):
                    now = time.monotonic()
                    if interrupted() or now > end - STOPPING:
                        self._stop.set()
                    if now > end - WRITING:
                        self._kill.set()
                    if archive is not None and now - packed > PACKING:
                        self.pack(archive)
                        packed = now
                    if len(self._ended) > bar.n:  # any update redraws the bar
                        bar.update(len(self._ended) - bar.n)
                    time.sleep(POLL)
            except KeyboardInterrupt:  # the second
                self._kill.set()
                raise
            finally:
                self._stop.set()
            bar.update(len(self._ended) - bar.n)
            if archive is not None:
                for name in self.pack(archive):
                    tqdm.write(f"{archive} has no room for {name}")
        if errors := [error for worker in workers if (error := worker.exception()) is not None]:
            raise ExceptionGroup("the campaign itself failed", errors)

    def pack(self, archive: Path) -> list[str]:
        """Writes the folder as an archive; returns which checkpoints had no room in it."""
        return pack(archive, *self.folder.contents())

    def _work(self, device: str) -> None:
        """Trains one job after the other on a device."""
        while self._waiting and not self._stop.is_set():
            try:
                job = self._waiting.popleft()
            except IndexError:  # another device took the last one
                return
            self._train(job, device)
            if self.folder.record(job).status != "stopped":
                self._ended.append(job)

    def _train(self, job: Job, device: str) -> None:
        """Trains a job in a process, until it ends or is stopped."""
        folder, home = self.folder, self.folder.home(job)
        if (run := folder.run_to_resume(job)) is not None:
            command = [sys.executable, "-m", "torchrl_loco", "resume", str(run.path)]
        else:
            own = {"protocol": job.protocol, "seed": job.seed, "device": device.partition(":")[0], "out": home}
            command = train_command(job.task, {**self._settings, **own})
        record = folder.record(job)
        folder.note_evaluations(job, wall=None)  # of a process that went on when this script was killed
        folder.update(job, status="running", processes=record.processes + 1, settings=self._words, error="")
        log = home / "log.txt"
        start, told = time.monotonic() - record.wall, False
        with log.open("ab") as output:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **child_environment(device)},
                process_group=0,  # else Ctrl-C would reach it too, and a second signal stops it without a checkpoint
                pass_fds=[folder.lock],  # the folder is locked while it lives, even if this process does not
            )
        try:
            while process.poll() is None:
                folder.note_evaluations(job, time.monotonic() - start)
                if self._stop.is_set() and not told:
                    process.terminate()
                    told = True
                if self._kill.is_set():
                    process.kill()
                time.sleep(POLL)
        finally:
            process.kill()  # after an error here; to a process that has ended it does nothing
        wall = time.monotonic() - start
        if folder.finish(job, wall):
            result = folder.record(job).result
            tqdm.write(f"{job}: {result['mean']:.1f} after {result['seconds']:.0f} s of training")
            return
        folder.note_evaluations(job, wall)
        if process.returncode in STOPPED:
            folder.update(job, status="stopped", wall=wall)
        else:
            code = process.returncode
            error = signal.Signals(-code).name if code < 0 else last_error(log.read_text(errors="replace"))
            folder.update(job, status="failed", wall=wall, error=error)
        tqdm.write(f"{job}: {folder.record(job).status} {folder.record(job).error}")


def child_environment(device: str) -> dict[str, str]:
    """Returns what a process has in its environment that sees one device, and whose output goes to a file."""
    _, _, index = device.partition(":")
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")  # of those that this process sees
    if index:
        index = visible[int(index)] if visible != [""] else index
    return {"CUDA_VISIBLE_DEVICES": index, "PYTHONUNBUFFERED": "1", "TQDM_MININTERVAL": "10", "COLUMNS": "1000"}


def last_error(log: str) -> str:
    """Returns the last line of a log; of the parser's last frame, the line that says what is wrong."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    if lines and lines[-1].startswith("╰"):
        top = max(number for number, line in enumerate(lines) if line.startswith("╭"))
        return lines[top + 1].strip("│ ")
    return lines[-1] if lines else ""
