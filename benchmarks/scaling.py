"""Several GPUs beside one: frames per second of collection and training, and the time that exchanging gradients takes.

Each rank has the worlds that one GPU has, so that N of them could collect N times the frames.
"""

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from benchmarks.processes import MeasurementError, run_json
from benchmarks.results import Row

COLUMNS = {
    "task": "",
    "algorithm": "",
    "gpus": "d",
    "collection": ",.0f",
    "training": ",.0f",
    "collection, ratio": ".2f",
    "training, ratio": ".2f",
    "predicted": ".2f",
    "exchange": ".3f",
    "exchange, recorded": ".3f",
    "error": "",
}
"""Frames per second; ratios to one GPU; what the cost model predicts for training; ms of an exchange of gradients."""


def scaling(
    tasks: Sequence[str],
    gpus: Sequence[int],
    device: torch.device,
    algorithms: Sequence[str] = ("ppo", "reppo"),
    settings: Mapping[str, Any] | None = None,
) -> list[Row]:
    """Measures each task with each algorithm on so many GPUs, or in so many processes on the CPU.

    Args:
        tasks: ids of environments.
        gpus: numbers of ranks; the ratios are those to the first.
        device: its kind says where the ranks compute.
        algorithms: by name.
        settings: training settings on top of the presets.
    """
    rows: list[Row] = []
    for task in tasks:
        first: dict[str, Row] = {}
        for count in gpus:
            launcher = ["torch.distributed.run", "--standalone", "--nproc-per-node", count, "-m"] if count > 1 else []
            what = task, device.type, json.dumps(settings or {}), *algorithms
            arguments = [*launcher, "benchmarks.scaling_rank", *what]
            try:
                found = run_json(arguments, os.environ)
            except MeasurementError as error:
                rows.append({"task": task, "gpus": count, "error": str(error)})
                continue
            for algorithm, measured in found.items():
                row = {"task": task, "algorithm": algorithm, "gpus": count, **measured}
                rows.append(row | compared(row, first.setdefault(algorithm, row)))
    return rows


def compared(row: Row, first: Row) -> Row:
    """Returns a row's ratios to the first, and the ratio of training that the cost model predicts.

    The model (docs/guides/several-gpus.md): N ranks take as long as one for an iteration, and for the exchange of
    gradients, as often as there are gradient steps.
    """
    ratios = {f"{what}, ratio": row[what] / first[what] for what in ("collection", "training")}
    alone = first["iteration"]
    waiting = row["gradient_steps"] * row["exchange, recorded"]
    return {**ratios, "predicted": row["gpus"] / first["gpus"] * alone / (alone + waiting)}
