"""TorchRL's collectors of several processes and machines with our environments, and the examples that use them."""

import importlib.util
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs the extra ray")


def run(script, *arguments):
    """Returns what a script prints; it finds the examples, also in processes that it starts."""
    paths = os.pathsep.join([str(ROOT), str(ROOT / "examples")])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, ROOT / script, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


def free_port():
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


@pytest.mark.ci
@pytest.mark.parametrize("collector", ["multi_sync", "distributed", pytest.param("ray", marks=needs_ray)])
def test_collectors(collector):
    """Worlds are numbered over all workers, actions are each worker's own, weights arrive; in Ray, a dead actor too."""
    said = run("tests/several_processes.py", collector, free_port())
    assert "as it should be" in said
    assert ("an actor died, all are started anew" in said) == (collector == "ray")


@pytest.mark.ci
@pytest.mark.parametrize("example", ["actors_and_learner", pytest.param("ray_ppo", marks=needs_ray)])
def test_examples(example):
    said = run(f"examples/{example}.py", "--batches", 2, "--num-envs", 8)
    assert "batch 2: " in said


@pytest.mark.ci
def test_the_example_of_off_policy_learning():
    assert "over 32 episodes" in run("examples/sac.py", "--total-frames", 8192)
