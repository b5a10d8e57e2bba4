"""The shipped policies of protocol ``dm_control`` in dm_control itself: what they earn there, and here."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.cases import until_interrupted
from benchmarks.processes import MeasurementError, environment_with, run_json
from benchmarks.results import Row
from torchrl_loco import load_policy
from torchrl_loco.export import export_policy
from torchrl_loco.training import evaluate_policy

PROTOCOL = "dm_control"
SEED = 100
"""Seed of the episodes here: neither that of a training run nor of its evaluations."""
COLUMNS = {"task": "", "where": "", "episodes": "d", "mean": ".1f", "std": ".1f", "min": ".1f", "max": ".1f"}
COLUMNS |= {"versions": "", "error": ""}


def suite(tasks: Sequence[str], episodes: int, device: torch.device, path: Path | None) -> list[Row]:
    """Plays each task's policy in dm_control, in a process of its own, and in our environment.

    Args:
        tasks: ids of tasks with a policy for the protocol.
        episodes: number of episodes in each.
        device: where ours are played.
        path: folder with dm_control and its MuJoCo.
    """
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for task in until_interrupted(tasks, "suite"):
            policy, program = load_policy(task, device, PROTOCOL), Path(folder, f"{task}.pt2")
            export_policy(policy, program)
            held = policy.info["action_repeat"]
            theirs: Row = {"task": task, "where": "dm_control", "episodes": episodes}
            try:
                theirs |= run_json(
                    ["benchmarks.peers.dm_control_returns", program, task, episodes, held], environment_with(path)
                )
            except MeasurementError as error:
                theirs["error"] = str(error)
            rows += [theirs, {"task": task, "where": "torchrl_loco", **evaluate_policy(policy, episodes, SEED)}]
    return rows
