"""The default settings learn, on the CPU and at full size."""

import subprocess
import sys

import pytest

from torchrl_loco.training import RunFolder, Trainer, evaluate_run, preset


@pytest.fixture(autouse=True)
def small():
    """Takes the place of the fixture that makes the walker small."""


@pytest.mark.ci
def test_learns_to_stand(tmp_path):
    """A quarter of the default run lifts the walker well above what an untrained policy gets.

    Seen: 120 to 142 untrained (six seeds), 611 trained; 340 and 882 of 150,000 frames (two seeds).
    """

    def mean(**settings):
        run = RunFolder.create(preset("walker_stand", "cpu", out=tmp_path, video_seconds=0.0, **settings))
        Trainer(run).train()
        return evaluate_run(run)["mean"]

    assert mean(total_frames=8192, lr=1e-9) < 200
    assert mean(total_frames=800_000) > 400


@pytest.mark.ci
def test_two_ranks_learn_to_stand(tmp_path):
    """With the same total batch, as soon as one process does."""
    half = {"num_envs": 64, "minibatch_size": 512, "total_frames": 800_000, "video_seconds": 0, "out": tmp_path}
    settings = (word for name, value in half.items() for word in (f"--{name}", str(value)))
    command = [sys.executable, "-m", "torchrl_loco", "train", "walker_stand", "--device", "cpu", "--gpus", "2"]
    subprocess.run([*command, *settings], check=True, timeout=600)
    assert evaluate_run(RunFolder(next(tmp_path.iterdir())))["mean"] > 400
