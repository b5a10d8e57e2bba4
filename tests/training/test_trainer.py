"""A whole run, small: what it leaves behind, and what can be done with it."""

import contextlib
import csv
import itertools
import json
import math
import os
import shutil
import signal

import imageio.v3 as imageio
import pytest
import torch
from compare import assert_same
from matplotlib.axes import Axes
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torchrl_loco
from torchrl_loco import NonFiniteWarning, cli, replay
from torchrl_loco.policy import Policy
from torchrl_loco.training import RunFolder, Trainer, evaluate_run, plot_runs, preset, trainer
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.evaluation import Evaluator
from torchrl_loco.training.trainer import ALGORITHMS, evaluation_seed, interruptible

SMALL = {
    "num_envs": 4,
    "decisions": 8,
    "action_repeat": 4,
    "minibatch_size": 16,
    "epochs": 2,
    "total_frames": 256,
    "hidden": (16,),
    "eval_episodes": 3,
    "video_seconds": 0.5,
}
FILES = {
    *("config.json", "metrics.csv", "evaluations.csv", "checkpoint.pt", "policy.safetensors"),
    *("learning_curve.png", "video.mp4", "tensorboard"),
}


@pytest.fixture(autouse=True)
def ctrl_c():
    """Ctrl-C as in a terminal: a shell starts processes in the background with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module", params=["ppo", "reppo"])
def run(request, tmp_path_factory):
    return trained(tmp_path_factory.mktemp("runs"), request.param)


def made(out, algorithm="ppo", **overrides):
    return RunFolder.create(preset("walker_stand", "cpu", algorithm, out=out, **{**SMALL, **overrides}))


def trained(out, algorithm="ppo", **overrides):
    run = made(out, algorithm, **overrides)
    Trainer(run).train()
    return run


def test_run_folder_is_complete(run):
    config = run.load_config()
    assert {path.name for path in run.path.iterdir()} == FILES
    assert config == preset("walker_stand", "cpu", config.algorithm, out=run.path.parent, **SMALL)
    assert list((run.path / "tensorboard").iterdir())


def test_metrics(run):
    with (run.path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [128, 256]
    assert all(0 < float(row["return"]) < 1000 for row in rows)
    assert all(float(row["frames_per_second"]) > 0 for row in rows)
    assert all(math.isfinite(float(value)) for row in rows for value in row.values())


def test_pictures(run):
    video = imageio.imread(run.video, plugin="pyav")
    assert video.shape == (20, 360, 480, 3)  # half a second at 40 frames a second
    assert video.std() > 10
    assert (video[0] != video[-1]).any()
    assert imageio.improps(run.video, plugin="pyav").shape[0] == 20
    curve = imageio.imread(run.path / "learning_curve.png")
    assert min(curve.shape[:2]) > 400


def test_evaluation_can_be_repeated(run):
    first = Policy.load(run.policy, "cpu").info
    again = evaluate_run(run)
    assert again.items() <= first.items()
    assert again["episodes"] == 3
    assert again["min"] <= again["mean"] <= again["max"]
    other = evaluate_run(run, episodes=2, seed=5)
    assert other["episodes"] == 2
    assert other["mean"] != first["mean"]
    assert Policy.load(run.policy, "cpu").info == first


def test_evaluation_is_apart_from_training(run):
    """No evaluated episode begins as one of the training's did, not even for the largest seed."""
    for seed in (0, 2**32 - 1):
        config = run.load_config(seed=seed)
        seeds = (config.seed, evaluation_seed(config, 0), evaluation_seed(config, 1))
        starts = [torchrl_loco.make("walker_stand", 4, "cpu", seed=s).reset()["observation"] for s in seeds]
        for one, other in itertools.combinations(starts, 2):
            assert (one != other).any(dim=1).all()


def test_a_run_from_another_device_can_be_evaluated(run, tmp_path):
    folder = tmp_path / "from_cuda"
    shutil.copytree(run.path, folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "device": "cuda:7"}))
    assert evaluate_run(RunFolder(folder), device="cpu") == evaluate_run(run)
    with pytest.raises(ValueError, match="choose one of cpu"):
        evaluate_run(RunFolder(folder))
    with pytest.raises(ValueError, match="choose one of cpu"):
        RunFolder.create(RunFolder(folder).load_config())
    plot_runs([RunFolder(folder)], folder / "curve.png")


@pytest.mark.parametrize("action_repeat", [1, 7])
def test_evaluation_plays_full_episodes(action_repeat):
    """A policy that does nothing earns what the environment pays for doing nothing over 1000 steps."""
    env = torchrl_loco.make("walker_stand", 2, "cpu", seed=11)
    rollout = env.rollout(1000, lambda td: td.set("action", env.action_spec.zero()))
    evaluator = Evaluator("walker_stand", 2, "cpu", 11, action_repeat=action_repeat)
    returns = evaluator(lambda td: td.set("action", torch.zeros(2, 6)))
    torch.testing.assert_close(evaluator(lambda td: td.set("action", torch.zeros(2, 6))), returns, rtol=0, atol=0)
    torch.testing.assert_close(returns, rollout["next", "reward"].sum(dim=1).squeeze(-1), rtol=1e-4, atol=0)


def parameters(run):
    return run.load_checkpoint("cpu")["algorithm"]["networks"]


def test_same_seed_same_run(run, tmp_path):
    twin = trained(tmp_path, run.load_config().algorithm, video_seconds=0.0)
    first, second = parameters(run), parameters(twin)
    assert all(torch.equal(first[key], second[key]) for key in first)
    assert not twin.video.exists()


@pytest.mark.parametrize("algorithm", ["ppo", "reppo"])
@pytest.mark.parametrize("action_repeat", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_resumed_equals_uninterrupted(algorithm, action_repeat, tmp_path, monkeypatch):
    """Stopped by Ctrl-C after two of five batches and resumed, a run ends bit for bit where one without a stop does."""
    settings = {"total_frames": 5 * 4 * 8 * action_repeat, "action_repeat": action_repeat, "episode_length": 23}
    whole = trained(tmp_path / "whole", algorithm, video_seconds=0.0, **settings)

    stopped = made(tmp_path / "stopped", algorithm, video_seconds=0.0, **settings)
    update, calls = Algorithm.update, iter(range(10))

    def press_at_the_second(self, batch, progress):
        if next(calls) == 1:
            signal.raise_signal(signal.SIGINT)
        return update(self, batch, progress)

    with monkeypatch.context() as patch:
        patch.setattr(Algorithm, "update", press_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            Trainer(stopped).train()
    assert stopped.load_checkpoint("cpu")["iteration"] == 2
    assert {"checkpoint.pt", "metrics.csv", "learning_curve.png"} <= {path.name for path in stopped.path.iterdir()}

    torch.manual_seed(99)  # whatever else went on in between
    stopped.append_metrics(stopped.read_metrics() and dict.fromkeys(stopped.read_metrics(), 1e9))  # and was not saved
    Trainer(stopped, resume=True).train()
    first, second = whole.load_checkpoint("cpu"), stopped.load_checkpoint("cpu")
    assert_same(first["algorithm"], second["algorithm"])
    assert_same(first["collector"], second["collector"])
    for name in ("frames", "return", "grad_norm" if algorithm == "ppo" else "loss_critic"):
        assert whole.read_metrics()[name] == stopped.read_metrics()[name]
    assert whole.read_evaluations()[0]["mean"] == stopped.read_evaluations()[0]["mean"]
    with pytest.raises(ValueError, match="is complete"):
        Trainer(stopped, resume=True)


def test_a_second_interrupt_does_not_wait(tmp_path, monkeypatch):
    def press_twice(self, batch, progress):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the second one was swallowed")

    monkeypatch.setattr(Algorithm, "update", press_twice)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_where_it_is_ignored_it_stays_ignored(tmp_path):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruptible() as interrupted:
        signal.raise_signal(signal.SIGINT)
        assert not interrupted()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_the_command_says_how_to_go_on(kind, tmp_path, monkeypatch, capsys):
    """SIGTERM is how a cluster, or kill, asks a process to end."""
    run = made(tmp_path)
    update = Algorithm.update
    monkeypatch.setattr(Algorithm, "update", lambda *args, **more: signal.raise_signal(kind) or update(*args, **more))
    before = signal.getsignal(kind)
    trainer = Trainer(run)
    with pytest.raises(KeyboardInterrupt):
        cli._train(trainer)
    assert run.load_checkpoint("cpu")["iteration"] == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"to go on: torchrl-loco resume {run.path}"
    assert signal.getsignal(kind) is before


@pytest.mark.slow
def test_evaluations_during_training(tmp_path):
    run = trained(tmp_path, total_frames=1024, eval_interval=256, video_seconds=0.0)
    assert [row["frames"] for row in run.read_evaluations()] == [256, 512, 768, 1024]


def test_the_best_policy_is_kept(tmp_path, monkeypatch, capsys):
    """Of three evaluations the second is the best: its policy is what the run leaves, evaluated in new episodes."""
    means, seeds = iter([10.0, 30.0, 20.0, 25.0]), []
    make_evaluator = trainer.make_evaluator

    def fake(config, episodes=None, seed=None):
        make_evaluator(config, episodes, seed)
        seeds.append(evaluation_seed(config, 1) if seed is None else seed)
        return lambda policy: torch.full((3,), next(means))

    monkeypatch.setattr(trainer, "make_evaluator", fake)
    run = trained(tmp_path, total_frames=768, eval_interval=256, video_seconds=0.0)
    info = Policy.load(run.policy, "cpu").info
    assert (info["frames"], info["mean"]) == (512, 25.0)
    assert seeds[0] != seeds[1]
    assert "best policy, evaluated anew: return 25.0" in capsys.readouterr().out


def test_policy_of_a_run_is_its_actor(run):
    """Up to half precision, it does what the actor does without exploration."""
    policy = Policy.load(run.policy, "cpu")
    config = run.load_config()
    assert (policy.info["task"], policy.info["frames"]) == ("walker_stand", 256)
    algorithm = ALGORITHMS[config.algorithm](config)
    algorithm.networks.load_state_dict(parameters(run))
    td = torchrl_loco.make("walker_stand", 50, "cpu", seed=0).rollout(5)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = algorithm.actor(td.select("observation"))["action"]
    torch.testing.assert_close(policy(td.select("observation"))["action"], expected, atol=2e-3, rtol=0)
    assert expected.std() > 1e-3


@pytest.mark.slow
def test_plot_of_several_runs(run, tmp_path):
    runs = [run, trained(tmp_path, run.load_config().algorithm, seed=1, video_seconds=0.0)]
    plot_runs(runs, tmp_path / "curves.png")
    picture = imageio.imread(tmp_path / "curves.png")
    assert picture.std() > 10
    with pytest.raises(ValueError, match="has no metrics yet"):
        plot_runs([made(tmp_path)], tmp_path / "none.png")


@pytest.mark.slow
def test_runs_that_differ_in_more_than_the_seed_are_apart(tmp_path, monkeypatch):
    drawn, plot = [], Axes.plot
    monkeypatch.setattr(Axes, "plot", lambda self, x, y, **k: drawn.append(len(x)) or plot(self, x, y, **k))
    runs = [trained(tmp_path, video_seconds=0.0, seed=seed, lr=lr) for seed, lr in ((0, 1e-3), (1, 1e-3), (0, 1e-4))]
    drawn.clear()
    plot_runs(runs, tmp_path / "curves.png")
    assert drawn == [2, 2]
    with pytest.raises(ValueError, match="no runs"):
        plot_runs([], tmp_path / "none.png")


@pytest.mark.slow
def test_what_was_interrupted_at_the_very_end_can_be_finished(tmp_path, monkeypatch):
    def press(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "record", press)
        with pytest.raises(KeyboardInterrupt):
            trained(tmp_path)
    (path,) = tmp_path.iterdir()
    run = RunFolder(path)
    before = run.read_metrics()
    Trainer(run, resume=True).train()
    assert run.video.exists()
    assert run.read_metrics() == before
    assert "mean" in Policy.load(run.policy, "cpu").info
    with pytest.raises(ValueError, match="is complete"):
        Trainer(run, resume=True)


@pytest.mark.gpu
@pytest.mark.parametrize("algorithm", ["ppo", "reppo"])
def test_a_run_on_cuda(algorithm, tmp_path):
    """Recorded gradient steps learn, the run can be stopped and resumed, and its policy plays on the CPU."""
    config = preset("walker_stand", "cuda", algorithm, out=tmp_path, **{**SMALL, "total_frames": 640})
    run = RunFolder.create(config)
    first = Trainer(run)
    before = {name: value.clone() for name, value in first.algorithm.networks.state_dict().items()}
    for _ in range(3):
        first._iterate()
    first.save()
    second = Trainer(run, resume=True)
    assert_same(first.algorithm.networks.state_dict(), second.algorithm.networks.state_dict())
    second.train()
    after = second.algorithm.networks.state_dict()
    assert all(value.isfinite().all() for value in after.values())
    assert any((value != before[name]).any() for name, value in after.items() if "weight" in name)
    assert evaluate_run(run, device="cpu")["mean"] > 0


def test_a_torn_line_does_not_keep_a_run_from_going_on(tmp_path):
    run = made(tmp_path)
    for frames in (128, 256, 384):
        run.append_metrics({"iteration": frames // 128, "frames": frames, "return": 1.5})
    path = run.path / "metrics.csv"
    path.write_text(path.read_text() + "4,5")
    run.forget_after(256)
    assert path.read_text() == "iteration,frames,return\n1,128,1.5\n2,256,1.5\n"


@pytest.mark.slow
def test_evaluating_draws_nothing_that_training_draws(tmp_path):
    often = trained(tmp_path / "often", "reppo", eval_interval=128, video_seconds=0.0)
    once = trained(tmp_path / "once", "reppo", video_seconds=0.0)
    assert_same(parameters(often), parameters(once))


@pytest.mark.slow
def test_every_update_begins_with_the_policy_that_collected(tmp_path, monkeypatch):
    """The ratio of new to old probabilities starts at one, and the norm sees all there is."""
    update, batches = Algorithm.update, []

    def check(self, batch, progress):
        with torch.no_grad():
            log_prob = self.actor.get_dist(batch).log_prob(batch["action"])
        torch.testing.assert_close(log_prob, batch["action_log_prob"], atol=2e-4, rtol=2e-4)
        batches.append(batch["observation"].clone())
        return update(self, batch, progress)

    monkeypatch.setattr(Algorithm, "update", check)
    run = trained(tmp_path, total_frames=1024, episode_length=60, num_envs=8)
    assert len(batches) == 4
    actor = parameters(run)
    (count,) = (value for key, value in actor.items() if key.startswith("actor") and key.endswith("0.count"))
    (mean,) = (value for key, value in actor.items() if key.startswith("actor") and key.endswith("0.mean"))
    seen = torch.cat([batch.flatten(0, 1) for batch in batches])
    assert count == len(seen)
    torch.testing.assert_close(mean, seen.mean(0), atol=1e-4, rtol=1e-4)


@pytest.mark.slow
def test_training_worlds_are_staggered(tmp_path, monkeypatch):
    update, dones = Algorithm.update, []
    monkeypatch.setattr(
        Algorithm, "update", lambda self, b, progress: dones.append(b["next", "done"]) or update(self, b, progress)
    )
    trained(tmp_path, total_frames=2048, episode_length=60, num_envs=16)
    done_together = torch.cat(dones, dim=1).sum(dim=0)
    assert done_together.sum() > 8
    assert done_together.max() < 16


@pytest.mark.slow
def test_command_line(run, capsys, tmp_path):
    assert cli.main(["list"]) == 0
    assert capsys.readouterr().out.count("\n") == 6
    assert cli.main(["eval", str(run.path), "--episodes", "2"]) == 0
    said = capsys.readouterr()
    assert "over 2 episodes" in said.out
    assert "evaluation" not in said.err  # a bar that vanishes has no place where lines stay
    algorithm = run.load_config().algorithm
    small = [f"--{key}={value}" for key, value in SMALL.items() if key not in ("hidden", "video_seconds")]
    arguments = ["train", "walker_walk", *small, "--hidden", "16", "--video_seconds", "0", "--out", str(tmp_path)]
    assert cli.main([*arguments, "--device", "cpu", "--algorithm", algorithm]) == 0
    (path,) = tmp_path.iterdir()
    assert capsys.readouterr().out.endswith(f": {path}\n")
    config = RunFolder(path).load_config()
    assert (config.algorithm, config.task, config.num_envs, config.hidden) == (algorithm, "walker_walk", 4, (16,))
    assert RunFolder(path).read_evaluations()
    assert cli.main(["plot", str(path), str(run.path), "--out", str(tmp_path / "both.png")]) == 0
    assert (tmp_path / "both.png").exists()
    assert (
        cli.main(["record", str(path), "--seconds", "0.1", "--camera", "back", "--out", str(tmp_path / "x.mp4")]) == 0
    )
    assert imageio.imread(tmp_path / "x.mp4", plugin="pyav").shape[0] == 4
    capsys.readouterr()
    shown = ["--policy", str(path), "--seconds", "0.1", "--out", str(tmp_path / "y.mp4")]  # a run, or a file
    assert cli.main(["play", "walker_walk", *shown]) == 0
    head, returns, video = capsys.readouterr().out.splitlines()
    assert (head.split(",")[0], returns.split()[0], video) == ("walker_walk", "return", shown[-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "walker_wlak"], "did you mean 'walker_walk'"),
        (["train", "walker-walk"], "did you mean 'walker_walk'"),
        (["train", "mjx/walker_walk-v0", "--gamma", "2"], "gamma must lie in (0, 1]"),
        (["train", "walker_walk", "--gamma", "2"], "gamma must lie in (0, 1]"),
        (["train", "walker_walk", "--gama", "0.9"], "--gamma"),
        (["train", "walker_walk", "--device", "cuda:9"], "choose one of cpu"),
        (["train", "walker_walk", "--task", "walker_run"], "Unrecognized options: --task"),
        (["train", "walker_walk", "--algorithm", "pppo"], "did you mean 'ppo'"),
        (["eval", "no/such/run"], "is no run folder"),
        (["resume", "no/such/run"], "is no run folder"),
        (["resume", "{run}"], "is complete"),
        (["record", "no/such/run"], "is no run folder"),
        (["record", "{run}", "--seconds", "0"], "seconds must be positive"),
        (["play", "walker_walk", "--out", "x.mp4", "--seconds", "-1"], "seconds must be positive"),
        (["plot"], "no runs"),
        (["play", "walker_wlak"], "did you mean 'walker_walk'"),
        (["fly"], "train, resume, eval"),
        (["eval", "{run}", "--episodes", "0"], "episodes must be an integer of at least 1"),
    ],
)
def test_command_line_errors(run, arguments, message, capsys):
    arguments = [argument.format(run=run.path) for argument in arguments]
    try:
        status = cli.main(arguments)
    except SystemExit as error:  # how tyro ends
        status = error.code
    assert status == 2
    captured = capsys.readouterr()
    assert message in " ".join((captured.out + captured.err).replace("│", " ").split())


@pytest.mark.slow
def test_a_run_without_a_policy_names_the_way_to_one(tmp_path, capsys):
    run = RunFolder.create(preset("walker_stand", "cpu", out=tmp_path, **SMALL))
    for way in ("nor a checkpoint, train anew", "torchrl-loco resume goes on with the run"):
        with pytest.raises(SystemExit):
            cli.main(["eval", str(run.path)])
        assert f"has no policy yet: {way}" in capsys.readouterr().err
        run.save_checkpoint({})


@pytest.mark.parametrize(("error", "shown"), [(OSError("no space left"), True), (TypeError("a bug"), False)])
def test_errors_while_training(error, shown, tmp_path, monkeypatch, capsys):
    """What the machine lacks is told in a line; a bug keeps its traceback."""

    def fail(self, batch, progress):
        raise error

    monkeypatch.setattr(Algorithm, "update", fail)
    with pytest.raises(SystemExit if shown else TypeError):
        cli.main(["train", "walker_walk", "--device", "cpu", "--out", str(tmp_path)])
    assert ("torchrl-loco: no space left" in capsys.readouterr().err) == shown


def test_a_run_needs_a_checkpoint_of_this_version(run, tmp_path):
    folder = tmp_path / "old"
    folder.mkdir()
    (folder / "config.json").write_text((run.path / "config.json").read_text())
    with pytest.raises(FileNotFoundError, match="has no policy yet"):
        evaluate_run(RunFolder(folder))
    with pytest.raises(FileNotFoundError, match="has no checkpoint"):
        Trainer(RunFolder(folder), resume=True)
    (folder / "checkpoint.pt").write_bytes(b"no checkpoint at all")
    with pytest.raises(ValueError, match="cannot be read as a checkpoint"):
        Trainer(RunFolder(folder), resume=True)
    torch.save({"version": 0}, folder / "checkpoint.pt")
    with pytest.raises(ValueError, match="has version 0, this release reads 2"):
        Trainer(RunFolder(folder), resume=True)


def test_a_checkpoint_executes_nothing(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    run = made(tmp_path)
    run.save_checkpoint({"frames": 0, "rng": Trap()})
    with pytest.raises(ValueError, match="cannot be read as a checkpoint"):
        Trainer(run, resume=True)
    assert not (tmp_path / "executed").exists()


def test_a_run_keeps_its_first_bad_world(tmp_path):
    run, found = made(tmp_path, action_repeat=1), []
    for told in (pytest.warns(NonFiniteWarning), contextlib.nullcontext()):  # the second time as when resumed
        env = Trainer(run).env
        env.step(env.reset().set("action", torch.full((4, 6), torch.nan)))
        with told:
            env.close()
        found.append(run.bad_world.read_bytes())
    assert found[0] == found[1]
    assert replay.load(run.bad_world).settings["num_envs"] == 4


def test_unwritable_folder_is_reported_before_training(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        trained(tmp_path / "file" / "runs")


def test_a_full_disk_is_reported_before_training(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=2**20))
    with pytest.raises(OSError, match="has 1 MiB left"):
        made(tmp_path)


@pytest.mark.slow
def test_learns_to_stand(tmp_path):
    """Half of the default run lifts the walker well above what an untrained policy gets.

    Seen: 120 to 142 untrained (six seeds), 611 trained; 340 and 882 of 150,000 frames (two seeds).
    """
    untrained = trained(tmp_path, total_frames=128, hidden=(128, 128), lr=1e-9, eval_episodes=32, video_seconds=0.0)
    run = RunFolder.create(preset("walker_stand", "cpu", out=tmp_path, total_frames=180_000, video_seconds=0.0))
    Trainer(run).train()
    assert evaluate_run(untrained)["mean"] < 180
    assert evaluate_run(run)["mean"] > 300


def test_torchs_settings_are_put_back(tmp_path, monkeypatch):
    threads, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        trainer = Trainer(RunFolder.create(preset("walker_stand", "cpu", "ppo", out=tmp_path, **SMALL)))
        monkeypatch.setattr(trainer, "_iterate", lambda: seen.append(torch.get_num_threads()) or 1 / 0)
        with pytest.raises(ZeroDivisionError):
            trainer.train()
        assert (seen, torch.get_num_threads(), torch.get_float32_matmul_precision()) == ([1], 2, "highest")
    finally:
        torch.set_num_threads(threads)
