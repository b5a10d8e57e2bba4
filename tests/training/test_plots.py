"""What drawing must not do to the program that asks for it."""

import matplotlib
import pytest
from matplotlib import pyplot as plt

from torchrl_loco.training import RunFolder, plot_runs, preset


@pytest.fixture
def backend():
    before = matplotlib.get_backend()
    plt.switch_backend("svg")  # stands for a notebook's
    yield "svg"
    plt.switch_backend(before)


def test_the_callers_figures_stay_as_they_are(tmp_path, backend):
    """In a notebook, pictures still appear after a training."""
    run = RunFolder.create(preset("walker_stand", "cpu", out=tmp_path))
    for frames in (1, 2):
        run.append_metrics({"frames": frames, "seconds": 1.0, "return": 100.0 * frames})
    figures = plt.get_fignums()
    plot_runs([run], tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000
    assert (matplotlib.get_backend(), plt.get_fignums()) == (backend, figures)
