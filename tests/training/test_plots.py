"""Which runs share a curve, and what plotting leaves as it was."""

import json

import matplotlib
import pytest
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from small_runs import made

from torchrl_loco.training import plot_runs


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


def test_runs_share_a_curve_unless_they_learn_differently(tmp_path, monkeypatch):
    drawn, plot = [], Axes.plot

    def note(self, x, y, **options):
        drawn.append((list(y), options.get("label")))
        return plot(self, x, y, **options)

    monkeypatch.setattr(Axes, "plot", note)
    same = [{}, {"seed": 1, "batches": 3}, {"device": "cuda:7"}]
    same += [
        {"eval_interval": 128},
        {"eval_episodes": 9},
        {"video_seconds": 3.0},
        {"checkpoint_seconds": 5.0},
        {"logger": "csv"},
    ]
    other = [{"lr": 1e-4}, {"algorithm": "reppo"}]
    runs = [measured(tmp_path / str(i), **settings) for i, settings in enumerate([*same, *other])]
    plot_runs(runs, tmp_path / "curves.png")
    faint = [curve for curve, label in drawn if label is None]
    assert faint == [[100.0, 200.0], [200.0, 300.0, 400.0], *[[100.0, 200.0]] * 6]  # each seed in full
    drawn = [(curve, label) for curve, label in drawn if label is not None]
    curves = [curve for curve, _ in drawn]
    assert curves == [[100.0 + 100 / 8, 200.0 + 100 / 8], [100.0, 200.0], [100.0, 200.0]]
    assert ["8 seeds" in label for _, label in drawn] == [True, False, False]


def test_a_run_that_was_stopped_early_does_not_cut_the_mean_of_the_others(tmp_path, monkeypatch):
    drawn, plot = [], Axes.plot
    monkeypatch.setattr(Axes, "plot", lambda *args, **options: drawn.append((args, options)) or plot(*args, **options))
    runs = [measured(tmp_path, seed=seed, total_frames=256) for seed in (0, 2, 5)]
    for run in runs[:2]:
        run.append_metrics({"frames": 256, "seconds": 1.0, "return": 900.0})
    plot_runs(runs, tmp_path / "curves.png")
    ((_, _, mean), options), *faint = drawn
    assert list(mean) == [200.0, 300.0, 900.0]
    assert ", 2 of 3 seeds" in options["label"]
    assert [list(args[2]) for args, _ in faint][2] == [600.0, 700.0]


def test_runs_of_several_ranks_are_averaged_where_they_have_as_many_frames(tmp_path, monkeypatch):
    """A run on two GPUs collects twice the frames in an iteration, so it ends with fewer rows."""
    drawn, plot = [], Axes.plot
    monkeypatch.setattr(Axes, "plot", lambda *args, **options: drawn.append((args, options)) or plot(*args, **options))
    runs = [made(tmp_path / str(ranks), total_frames=7 * 128) for ranks in (1, 2)]
    for run, step, end in zip(runs, (128, 256), (7 * 128, 6 * 128), strict=True):
        for frames in range(step, end + 1, step):
            run.append_metrics({"frames": frames, "seconds": 1.0, "return": float(frames)})
    plot_runs(runs, tmp_path / "curves.png")
    (_, millions, mean), options = drawn[0]
    assert list(millions * 1e6) == list(mean) == [256.0, 512.0, 768.0]
    assert ", 2 seeds" in options["label"]


def test_axes_show_all_of_any_return(tmp_path, monkeypatch):
    limits, savefig = [], Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda self, *args, **more: limits.append(self.axes[0].get_ylim()) or savefig(self, *args, **more),
    )
    for scale in (-3000.0, 0.01):
        run = made(tmp_path)
        for i in (1, 2):
            run.append_metrics({"frames": i, "seconds": 1.0, "return": scale * i})
        plot_runs([run], tmp_path / "curve.png")
        low, high = limits[-1]
        assert low <= min(scale, 2 * scale) <= max(scale, 2 * scale) <= high
        assert high - low < 2 * abs(scale)


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
    assert (tmp_path / "curve.png").stat().st_size > 10_000
    assert (matplotlib.get_backend(), plt.get_fignums()) == (backend, figures)
