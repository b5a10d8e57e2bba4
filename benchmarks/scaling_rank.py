"""One of the ranks that :mod:`benchmarks.scaling` starts; the first prints the result."""

import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.cases import waiter
from torchrl_loco import RolloutCollector
from torchrl_loco.sim import TorchGraph
from torchrl_loco.training import distributed, preset
from torchrl_loco.training.actor import Spaces
from torchrl_loco.training.algorithm import Algorithm, settings_for_small_networks
from torchrl_loco.training.environments import Environments
from torchrl_loco.training.trainer import ALGORITHMS

WARMUP, ITERATIONS, EXCHANGES = 4, 10, 100
"""Iterations before the first that counts (in the third, graphs are recorded), and how many of each count."""


def seconds(work: Callable[[], object], times: int, device: torch.device) -> float:
    """Returns how long a call of ``work`` takes on the slowest rank; all begin together."""
    wait = waiter(device)
    wait()
    distributed.wait_for_all()
    start = time.perf_counter()
    for _ in range(times):
        work()
    wait()
    distributed.wait_for_all()
    return (time.perf_counter() - start) / times


def measure(task: str, algorithm: str, device: str, settings: dict[str, Any]) -> dict[str, float]:
    """Returns frames per second over all ranks, and milliseconds of an iteration and of an exchange of gradients."""
    config = preset(task, distributed.own_device(device), algorithm, **settings)
    torch.manual_seed(config.seed)
    with tempfile.TemporaryDirectory() as folder:
        env = Environments(config).training(Path(folder, "nan_dump"))
        learner = ALGORITHMS[algorithm](config, Spaces.of(env))
        collector = RolloutCollector(env, learner.acting(), frames_per_batch=config.frames_per_batch)

        def iterate() -> None:
            learner.update(collector.rollout(), progress=0.0)

        for _ in range(WARMUP):
            iterate()
        iteration = seconds(iterate, ITERATIONS, learner.device)
        collecting = seconds(collector.rollout, ITERATIONS, learner.device)
        frames = config.control_steps_per_batch * distributed.ranks()
        found = {
            "collection": frames / collecting,
            "training": frames / iteration,
            "iteration": 1e3 * iteration,
            "gradient_steps": config.epochs * (config.frames_per_batch // config.minibatch_size),
            **exchange(learner),
        }
        learner.release()
        env.close()
    return found


def exchange(learner: Algorithm) -> dict[str, float]:
    """Returns the milliseconds that averaging all gradients over the ranks takes, directly and recorded on CUDA."""
    if distributed.ranks() == 1:
        return {"exchange": 0.0, "exchange, recorded": 0.0}
    groups = [[torch.zeros_like(p) for g in o.param_groups for p in g["params"]] for o in learner.optimizers.values()]

    def average() -> None:
        for gradients in groups:
            distributed.average(gradients)

    direct = seconds(average, EXCHANGES, learner.device)
    recorded = direct
    if learner.device.type == "cuda":
        graph = TorchGraph(average, learner.device, warmup=3)
        for _ in range(4):
            graph()
        recorded = seconds(graph, EXCHANGES, learner.device)
        graph.release()
    return {"exchange": 1e3 * direct, "exchange, recorded": 1e3 * recorded}


if __name__ == "__main__":
    _, task, device, settings, *algorithms = sys.argv
    with distributed.joined(device), settings_for_small_networks():
        results = {name: measure(task, name, device, json.loads(settings)) for name in algorithms}
        if distributed.is_first():
            print(json.dumps(results))
