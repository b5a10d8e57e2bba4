"""Steps per second from the bare simulator to a collector, side by side on one device.

Times are of one control step of all worlds: the median over blocks of steps, each block timed from an idle device to an
idle device. Ratios are to the bare loop with mujoco_warp's defaults.
"""

import datetime
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path

import torch
from tqdm import tqdm

from benchmarks.cases import CASES

BLOCKS, STEPS = 7, 40


def throughput(bodies: Sequence[str], worlds: Sequence[int], cases: Sequence[str], device: torch.device) -> list[dict]:
    """Measures each case for each body and number of worlds; returns a row for each."""
    rows = []
    runs = [(body, n, case) for body in bodies for n in worlds for case in cases]
    for body, n, case in tqdm(runs, desc="throughput"):
        rows.append({"body": body, "worlds": n, "case": case, "ms": milliseconds(CASES[case](body, n, device), device)})
    for row in rows:
        base = [r["ms"] for r in rows if r["case"] == "bare_default" and (r["body"], r["worlds"]) == key(row)]
        row["ratio"] = row["ms"] / base[0] if base else None
    return rows


def key(row: dict) -> tuple[str, int]:
    """What a ratio is taken within."""
    return row["body"], row["worlds"]


@torch.no_grad()
def milliseconds(step: Callable[[], None], device: torch.device) -> float:
    """Returns the time of a step."""
    times = []
    for block in range(BLOCKS + 1):
        start = idle(device)
        for _ in range(STEPS):
            step()
        if block:  # the first warms up
            times.append((idle(device) - start) / STEPS * 1e3)
    return statistics.median(times)


def idle(device: torch.device) -> float:
    """Waits for the device and returns the time."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def show(rows: Sequence[dict]) -> None:
    """Prints the rows as a table."""
    print(f"{'body':<10}{'worlds':>8}  {'case':<26}{'ms':>9}{'ratio':>8}{'million steps/s':>17}")
    for row in rows:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.3f}"
        speed = row["worlds"] / row["ms"] / 1e3
        name = f"{row['body']:<10}{row['worlds']:>8}  {row['case']:<26}"
        print(f"{name}{row['ms']:>9.3f}{ratio:>8}{speed:>17.3f}")


def save(rows: Sequence[dict], path: Path, device: torch.device) -> None:
    """Writes the rows and what a reader needs to judge them by as JSON."""
    revision = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    results = {
        "command": " ".join(["python -m benchmarks", *sys.argv[1:]]),
        "date": datetime.date.today().isoformat(),
        "revision": revision or "unknown",
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine(),
        "versions": {n: metadata.version(n) for n in ("torch", "torchrl", "warp-lang", "mujoco-warp", "mujoco")},
        "rows": rows,
    }
    path.write_text(json.dumps(results, indent=1) + "\n")
