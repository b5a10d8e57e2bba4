"""The same step in other simulators, each in a process of its own, beside ours.

A peer is a module that is run with a body and a number of worlds and prints ``{"ms": ...}``: the time of one control
step of all worlds. Those that bring another MuJoCo import nothing of torchrl_loco.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.cases import INTERRUPTED, until_interrupted
from benchmarks.processes import MeasurementError, run_json
from benchmarks.results import Row
from benchmarks.throughput import throughput, time_of

OURS = ("bare_tuned", "env_step", "env_step_and_maybe_reset")
ON_CUDA = ("playground", "playground_torchrl")
OTHER_MUJOCO = ("playground", "playground_torchrl", "dm_control_suite")
"""Peers that bring a MuJoCo of their own."""
ON_CPU = ("c_mujoco", "c_mujoco_one_thread", "dm_control_suite")
COLUMNS = {"body": "", "worlds": "d", "case": "", "ms": ".3f", "thousand steps/s": ".1f", "ours is": "", "error": ""}


def peers(bodies: Sequence[str], worlds: Sequence[int], device: torch.device, path: Path | None) -> list[Row]:
    """Measures the peers of a device and ours; a peer that cannot run gets a row with the error.

    Args:
        bodies: names of bodies; a peer that lacks one has an error in its row.
        worlds: numbers of worlds.
        device: where ours runs; the peers are those of its kind.
        path: folder with the peers' packages, which take precedence there.
    """
    names = ON_CUDA if device.type == "cuda" else ON_CPU
    rows = throughput(bodies, worlds, OURS, device)
    runs = [(body, n, name) for name in names for body in bodies for n in worlds]
    for body, n, name in until_interrupted([] if INTERRUPTED.is_set() else runs, "peers"):
        row: Row = {"body": body, "worlds": n, "case": name}
        try:
            environment = environment_with(path if name in OTHER_MUJOCO else None)
            row |= run_json([f"benchmarks.peers.{name}", body, n], environment)
        except MeasurementError as error:
            row["error"] = str(error)
        rows.append(row)
    for row in rows:
        if "ms" in row:
            row["thousand steps/s"] = row["worlds"] / row["ms"]
            like = {"body": row["body"], "worlds": row.get("beside", row["worlds"])}
            ours = time_of(rows, like, "env_step_and_maybe_reset")
            if ours:
                row["ours is"] = f"{like['worlds'] / ours / row['thousand steps/s']:.2f} x"
    return rows


def environment_with(path: Path | None) -> dict[str, str]:
    """Returns the environment variables of a process in which the packages in a folder take precedence."""
    found = [str(p) for p in (path, os.environ.get("PYTHONPATH")) if p]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(found)}
