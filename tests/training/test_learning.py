"""The default settings learn, on the CPU and at full size."""

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
