"""Measurements in processes of their own, which print their result as JSON in their last line."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any


class MeasurementError(RuntimeError):
    """A process ended without a result; the message is the last line that it wrote."""


def run_json(arguments: Sequence[Any], environment: Mapping[str, str]) -> dict[str, Any]:
    """Runs ``python -m`` with the arguments and returns the result.

    Raises:
        MeasurementError: the process failed.
    """
    command = [sys.executable, "-m", *map(str, arguments)]
    process = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if process.returncode:
        raise MeasurementError((process.stderr.strip().splitlines() or [f"exit status {process.returncode}"])[-1])
    return json.loads(process.stdout.strip().splitlines()[-1])
