"""Which runs share a curve, and what plotting leaves as it was."""

import json

import matplotlib
import pytest
from matplotlib import pyplot as plt
from small_runs import made

from torchrl_loco.training import plot_runs
from torchrl_loco.training.plots import grouped, is_whole, shared_curve


@pytest.fixture
def backend():
    before = matplotlib.get_backend()
    plt.switch_backend("svg")  # stands for a notebook's
    yield "svg"
    plt.switch_backend(before)


def measured(out, batches=2, device="cpu", **settings):
    """Returns a run with metrics, as if it had been trained."""
    run = made(out, **settings)
    path = run.path / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "device": device}))
    for i in range(1, batches + 1):
        run.append_metrics({"frames": i, "seconds": 1.0, "return": 100.0 * (i + settings.get("seed", 0))})
    return run


def test_runs_share_a_curve_unless_they_learn_differently(tmp_path):
    same = [{}, {"seed": 1}, {"device": "cuda:7"}, {"eval_interval": 128}, {"eval_episodes": 9}]
    same += [{"video_seconds": 3.0}, {"checkpoint_seconds": 5.0}, {"logger": "csv"}]
    other = [{"lr": 1e-4}, {"algorithm": "reppo"}]
    runs = [measured(tmp_path / str(i), **settings) for i, settings in enumerate([*same, *other])]
    assert [*grouped(runs).values()] == [runs[:8], runs[8:9], runs[9:]]


def test_a_curve_is_of_the_frames_that_all_runs_have(tmp_path):
    """A run on two GPUs collects twice the frames in an iteration, so it ends with fewer rows."""
    rows = [{"frames": [float(f) for f in range(step, 7 * 128, step)]} for step in (128, 256)]
    frames, returns = shared_curve([{**row, "return": [2.0 * f for f in row["frames"]]} for row in rows])
    assert frames.tolist() == [256.0, 512.0, 768.0]
    assert (returns == 2.0 * frames).all()


def test_a_run_that_was_stopped_early_does_not_count():
    frames = [128.0], [2.0], [128.0, 256.0], [200.0]
    assert [is_whole(rows, total=256) for rows in frames] == [False, False, True, True]


def test_nothing_to_plot(tmp_path):
    with pytest.raises(ValueError, match="no runs"):
        plot_runs([], tmp_path / "none.png")
    with pytest.raises(ValueError, match="has no metrics yet"):
        plot_runs([made(tmp_path)], tmp_path / "none.png")


def test_the_callers_figures_stay_as_they_are(tmp_path, backend):
    """In a notebook, pictures still appear after a training."""
    figures = plt.get_fignums()
    run = measured(tmp_path)
    run.append_evaluation({"frames": 2, "mean": 150.0, "std": 20.0})
    plot_runs([run], tmp_path / "curve.png")
    assert (tmp_path / "curve.png").exists()
    assert (matplotlib.get_backend(), plt.get_fignums()) == (backend, figures)
