"""What was measured, as a table and as JSON that says how."""

import datetime
import json
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("torch", "torchrl", "tensordict", "warp-lang", "mujoco-warp", "mujoco")
Row = dict[str, Any]


def show(rows: Sequence[Row], columns: dict[str, str]) -> None:
    """Prints rows as a table.

    Args:
        rows: what was measured.
        columns: key of each column and how its values are formatted; what a row lacks stays empty.
    """
    lines = [list(columns)]
    lines += [["" if row.get(key) is None else f"{row[key]:{spec}}" for key, spec in columns.items()] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for first, *others in lines:
        print("  ".join([first.ljust(widths[0]), *map(str.rjust, others, widths[1:])]))


def save(rows: Sequence[Row], path: Path, device: torch.device, notes: Mapping[str, Any] | None = None) -> None:
    """Writes the rows and what a reader needs to judge them by as JSON, ``notes`` included."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({**circumstances(device), **(notes or {}), "rows": list(rows)}, indent=1) + "\n")


def circumstances(device: torch.device) -> dict[str, Any]:
    """Returns the command, without folders of this machine, the date, the revision, the device and the versions."""
    git = subprocess.run(
        ["git", "describe", "--always", "--abbrev=40", "--dirty"], capture_output=True, text=True, check=False
    )
    words = [Path(word).name if word.startswith("/") else word for word in sys.argv[1:]]
    return {
        "command": f"python -m benchmarks {shlex.join(words)}",
        "date": datetime.date.today().isoformat(),
        "revision": git.stdout.strip() if git.returncode == 0 else "unknown",
        "device": device_name(device),
        "versions": {name: metadata.version(name) for name in PACKAGES},
    }


def device_name(device: torch.device) -> str:
    """Returns what the GPU or the processor calls itself."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name()


def cpu_name() -> str:
    """Returns what the processor calls itself."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
