"""From process start to the first step, with an empty kernel cache and with a filled one, and memory per world."""

import os
import tempfile
import time
from collections.abc import Sequence

from tqdm import tqdm

from benchmarks.processes import run_json
from benchmarks.results import Row

COLUMNS = {
    "body": "",
    "worlds": "d",
    "kernel cache": "",
    "import (s)": ".1f",
    "make (s)": ".1f",
    "to first step (s)": ".1f",
    "KiB/world": ".1f",
}


def startup(bodies: Sequence[str], worlds: Sequence[int], device: str) -> list[Row]:
    """Starts a process for each body and number of worlds; each body's first finds no compiled kernels."""
    rows = []
    with tqdm(total=len(bodies) * (len(worlds) + 1), desc="startup") as bar:
        for body in bodies:
            with tempfile.TemporaryDirectory() as cache:
                environment = {**os.environ, "WARP_CACHE_PATH": cache, "CUDA_CACHE_PATH": cache}
                for n, state in [(worlds[0], "empty"), *((n, "filled") for n in worlds)]:
                    arguments = ["benchmarks.first_step", body, n, device, time.time()]
                    rows.append({"body": body, "worlds": n, "kernel cache": state, **run_json(arguments, environment)})
                    bar.update()
    return rows
