"""Measurements in processes of their own, which print their result as JSON in their last line."""

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.timing import READY


class MeasurementError(RuntimeError):
    """A process ended without a result; the message is the last line that it wrote."""


class Job(NamedTuple):
    """A process that measures.

    Attributes:
        name: is in the row of each result, as ``about`` is.
        arguments: what follows ``python -m``.
        path: a folder of packages that come first there.
    """

    name: str
    arguments: Sequence[Any]
    about: Mapping[str, Any] = {}
    path: Path | None = None


def run_json(arguments: Sequence[Any], environment: Mapping[str, str]) -> dict[str, Any]:
    """Runs ``python -m`` with the arguments and returns the result.

    Raises:
        MeasurementError: the process failed.
    """
    process = subprocess.run(_command(arguments), capture_output=True, text=True, env=environment, check=False)
    return _result(process.returncode, process.stdout, process.stderr)


def in_turn(jobs: Sequence[Job], limit: float, done: Callable[[Job, dict[str, Any]], None]) -> None:
    """Starts all processes, and when all of them have compiled, lets each measure while the others wait.

    Args:
        jobs: they call :func:`benchmarks.timing.my_turn` between the two.
        limit: seconds that a process may take to compile, and again to measure, before it is killed.
        done: gets the result of a process as soon as there is one, or ``{"error": ...}``.
    """
    all_ready, turn = threading.Barrier(max(len(jobs), 1)), threading.Lock()

    def run(job: Job) -> None:
        with tempfile.TemporaryFile("w+") as errors:
            pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors}
            process = subprocess.Popen(_command(job.arguments), text=True, env=environment_with(job.path), **pipes)
            assert process.stdout is not None
            with _killed_after(limit, process):
                for line in process.stdout:
                    if line.strip() == READY:
                        break
            all_ready.wait()
            with turn, _killed_after(limit, process):
                output, _ = process.communicate("go\n")
                errors.seek(0)
                try:
                    result = _result(process.returncode, output, errors.read())
                except MeasurementError as error:
                    result = {"error": str(error)}
                done(job, result)

    with ThreadPoolExecutor(max(len(jobs), 1)) as pool:
        for finished in [pool.submit(run, job) for job in jobs]:
            finished.result()


@contextlib.contextmanager
def _killed_after(seconds: float, process: subprocess.Popen[str]) -> Iterator[None]:
    """Kills a process if what is done meanwhile takes longer."""
    timer = threading.Timer(seconds, process.kill)
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def environment_with(path: Path | None) -> dict[str, str]:
    """Returns the environment variables of a process in which the packages in a folder take precedence."""
    found = [str(p) for p in (path, os.environ.get("PYTHONPATH")) if p]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(found)}


def _command(arguments: Sequence[Any]) -> list[str]:
    return [sys.executable, "-m", *map(str, arguments)]


def _result(status: int, output: str, errors: str) -> dict[str, Any]:
    if status < 0:
        raise MeasurementError(f"ended by signal {-status}, as what takes too long")
    if status:
        raise MeasurementError((errors.strip().splitlines() or [f"exit status {status}"])[-1])
    return json.loads(output.strip().splitlines()[-1])
