"""The training loop: what a small run leaves behind, how it stops, and how it continues."""

import contextlib
import csv
import dataclasses
import math
import signal
import threading

import imageio.v3 as imageio
import pytest
import torch
from compare import assert_same
from for_each import for_each
from small_runs import EPISODE, SMALL, WALKER, made, networks, small_walker, trained
from torchrl.envs import VecNormV2
from torchrl.envs.utils import ExplorationType, set_exploration_type

import torchrl_loco
from torchrl_loco import NonFiniteWarning, RolloutCollector, nan_dump
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.envs.transforms import state_of_transforms
from torchrl_loco.policy import Policy
from torchrl_loco.tasks.walker import Walker
from torchrl_loco.training import Given, RunFolder, Trainer, begin, evaluate_run, preset, train, trainer
from torchrl_loco.training.algorithm import Algorithm, settings_for_small_networks
from torchrl_loco.training.evaluation import Evaluator
from torchrl_loco.training.process import interruptible
from torchrl_loco.training.start import train_to_end
from torchrl_loco.training.trainer import ALGORITHMS

FILES = {
    "config.json",
    "metrics.csv",
    "evaluations.csv",
    "checkpoint.pt",
    "policy.safetensors",
    "learning_curve.png",
    "video.mp4",
    "tensorboard",
}


def test_run_folder_is_complete(run):
    config = run.load_config()
    assert {path.name for path in run.path.iterdir()} == FILES
    expected = preset("walker_stand", "cpu", config.algorithm, out=run.path.parent, **{**SMALL, "video_seconds": 0.05})
    assert config == expected
    assert list((run.path / "tensorboard").iterdir())
    with (run.path / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [128, 256]
    assert all(0 < float(row["return"]) < Walker.config.episode_length for row in rows)
    assert all(float(row["frames_per_second"]) > 0 for row in rows)
    assert all(math.isfinite(float(value)) for row in rows for value in row.values())


@pytest.mark.slow
def test_pictures(ppo_run):
    video = imageio.imread(ppo_run.video, plugin="pyav")
    assert video.shape == (2, 48, 64, 3)  # a twentieth of a second at 40 frames a second
    assert video.std() > 10
    assert (video[0] != video[-1]).any()
    assert min(imageio.imread(ppo_run.path / "learning_curve.png").shape[:2]) > 400


def test_policy_of_a_run_is_its_actor(run):
    """It does what the actor does without exploration."""
    policy = Policy.load(run.policy, "cpu")
    config = run.load_config()
    assert (policy.info["task"], policy.info["frames"]) == ("walker_stand", 256)
    algorithm = ALGORITHMS[config.algorithm](config, WALKER)
    algorithm.networks.load_state_dict(networks(run))
    td = torchrl_loco.make("walker_stand", 50, "cpu", seed=0).rollout(5)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = algorithm.actor(td.select("observation"))["action"]
    torch.testing.assert_close(policy(td.select("observation"))["action"], expected, atol=1e-6, rtol=0)
    assert expected.std() > 1e-3


def test_resumed_equals_uninterrupted(tmp_path, monkeypatch):
    resume(tmp_path, monkeypatch, "ppo", action_repeat=4, trials=1)


@pytest.mark.slow
@for_each("algorithm, action_repeat, trials", [("reppo", 1, 1), ("ppo", 4, 3)])
def test_others_resumed_equal_those_uninterrupted(algorithm, action_repeat, trials, tmp_path, monkeypatch):
    resume(tmp_path / algorithm, monkeypatch, algorithm, action_repeat, trials)


@pytest.mark.slow
@for_each("trials", [1, 3])
def test_batches_that_are_collected_ahead_change_nothing(trials, tmp_path, monkeypatch):
    """As CUDA collects them: none goes beyond a trial, and one that waits at Ctrl-C is learned from before the end."""
    ahead, pressed = [], []

    class GoesOn(Trainer):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.collector.__class__ = Replays

        def iterate(self, *args, **kwargs):
            row = super().iterate(*args, **kwargs)
            ahead.append(self._ahead is not None)
            if ahead == [True]:  # the second batch waits for its update
                pressed.append(signal.raise_signal(signal.SIGINT))
            return row

    class Replays(RolloutCollector):
        replays = True

    resume(tmp_path / str(trials), monkeypatch, "ppo", 4, trials, GoesOn, pressed)
    # Ctrl-C comes before or in the second update. A trial ends after each of the first three.
    assert ahead == ([True, False, True, True, False] if trials == 1 else [False] * 3 + [True, False])


def resume(tmp_path, monkeypatch, algorithm, action_repeat, trials, trainer=Trainer, pressed=()):
    """Stopped by Ctrl-C after two of five batches and resumed, a run ends bit for bit where one without a stop does."""
    settings = {"total_frames": 5 * 4 * 8 * action_repeat, "action_repeat": action_repeat, "episode_length": 23}
    settings |= {"trials": trials, "trial_fraction": 0.3}  # each a batch, so that it is stopped after the second
    whole = trained(tmp_path / "whole", algorithm, **settings)

    stopped = made(tmp_path / "stopped", algorithm, **settings)
    update, calls = Algorithm.update, iter(range(10))

    def press_at_the_second(self, batch, progress):
        if next(calls) == 1 and not pressed:  # a second time would end it at once
            signal.raise_signal(signal.SIGINT)
        return update(self, batch, progress)

    with monkeypatch.context() as patch:
        patch.setattr(Algorithm, "update", press_at_the_second)
        with pytest.raises(KeyboardInterrupt):
            trainer(stopped).train()
    assert stopped.load_checkpoint("cpu")["iteration"] == 2
    assert {"metrics.csv", "learning_curve.png"} <= {path.name for path in stopped.path.iterdir()}

    torch.manual_seed(99)  # whatever else went on in between
    stopped.append_metrics(dict.fromkeys(stopped.read_metrics(), 1e9))  # and was not saved
    trainer(stopped, resume=True).train()
    first, second = whole.load_checkpoint("cpu"), stopped.load_checkpoint("cpu")
    assert_same(first["algorithm"], second["algorithm"])
    assert_same(first["collector"], second["collector"])
    assert_same(first["trials"], second["trials"])
    for name in ("frames", "return", "grad_norm" if algorithm == "ppo" else "loss_critic"):
        assert whole.read_metrics()[name] == stopped.read_metrics()[name]
    assert whole.read_evaluations()[0]["mean"] == stopped.read_evaluations()[0]["mean"]
    with pytest.raises(ValueError, match="is complete"):
        Trainer(stopped, resume=True)


@pytest.mark.slow
def test_interrupted_at_the_very_end(tmp_path, monkeypatch):
    """What is missing, here the video, is made when the run is resumed."""
    run = made(tmp_path, video_seconds=0.025)
    with monkeypatch.context() as patch:
        patch.setattr(trainer, "record", lambda *_: signal.raise_signal(signal.SIGINT))
        with pytest.raises(KeyboardInterrupt):
            Trainer(run).train()
    before = run.read_metrics()
    monkeypatch.setattr(trainer, "record", lambda policy, env, path, *_: path.touch())
    Trainer(run, resume=True).train()
    assert run.video.exists()
    assert run.read_metrics() == before
    assert "mean" in Policy.load(run.policy, "cpu").info
    with pytest.raises(ValueError, match="is complete"):
        Trainer(run, resume=True)


def test_a_second_interrupt_does_not_wait(tmp_path, monkeypatch):
    """Also where it arrives in code that turns it into an error, as tensordict's ``with`` does."""

    def press_twice(self, batch, progress):
        signal.raise_signal(signal.SIGINT)
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("Converting a tensordict to boolean value is not permitted") from None
        raise AssertionError("the second one was swallowed")

    monkeypatch.setattr(Algorithm, "update", press_twice)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_signals_that_are_left_alone():
    """Ignored ones, as under nohup, and all of them outside the main thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruptible() as interrupted:
        signal.raise_signal(signal.SIGINT)
        assert not interrupted()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    seen = []

    def in_thread():
        with interruptible() as interrupted:
            seen.append((interrupted(), signal.getsignal(signal.SIGTERM)))

    thread = threading.Thread(target=in_thread)
    thread.start()
    thread.join()
    assert seen == [(False, signal.SIG_DFL)]


def test_the_command_says_how_to_continue(tmp_path, monkeypatch, capsys):
    """Ctrl-C, SIGTERM, by which a cluster asks a process to end, or SIGHUP, by which a terminal does."""
    update = Algorithm.update
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        run = made(tmp_path)
        press = lambda *args, kind=kind, **more: signal.raise_signal(kind) or update(*args, **more)  # noqa: E731
        monkeypatch.setattr(Algorithm, "update", press)
        before = signal.getsignal(kind)
        with pytest.raises(KeyboardInterrupt):
            train_to_end(Trainer(run), Given(), user_errors)
        assert run.load_checkpoint("cpu")["iteration"] == 1
        assert capsys.readouterr().err.splitlines()[-1] == f"to continue: torchrl-loco resume {run.path}"
        assert signal.getsignal(kind) is before


def test_the_best_policy_is_kept(tmp_path, monkeypatch, capsys):
    """Of three evaluations the second is the best: its policy is what the run leaves, evaluated in new episodes."""
    means, seeds = iter([10.0, 30.0, 20.0, 25.0]), []

    def fake(self, seed):
        seeds.append(seed)
        return torch.full((3,), next(means))

    monkeypatch.setattr(Evaluator, "returns", fake)
    run = trained(tmp_path, total_frames=768, eval_interval=256)
    assert [row["frames"] for row in run.read_evaluations()] == [256, 512, 768]
    info = Policy.load(run.policy, "cpu").info
    assert (info["frames"], info["mean"]) == (512, 25.0)
    assert seeds[0] == seeds[1] == seeds[2] != seeds[3]
    out = capsys.readouterr().out
    assert "best policy, in new episodes: return 25.0" in out
    assert "the policy shipped for walker_stand earns 9" in out


def test_returns_that_the_critic_cannot_represent_are_said(tmp_path, capsys):
    """Once while the run goes on, and of the whole run at its end."""
    run = trained(tmp_path, "reppo", total_frames=512, max_value=0.5, num_bins=6)
    said = capsys.readouterr().out
    metrics = run.read_metrics()
    assert max(metrics["return_clipped"]) > 0.0
    assert said.count("after 128 frames: Returns from ") == 1
    assert said.count("Returns from ") == 2
    largest = max(metrics["return_max"])
    assert f" to {largest:.4g} occurred" in said.splitlines()[-1]
    assert f"--max_value {math.ceil(1.5 * largest)}" in said.splitlines()[-1]


def test_a_resumed_run_keeps_the_policy_of_a_better_evaluation_after_the_checkpoint(tmp_path, monkeypatch):
    """The evaluation is repeated, and on CUDA not exactly."""
    means = iter([10.0, 30.0, 20.0])
    monkeypatch.setattr(Evaluator, "returns", lambda *args: torch.full((3,), next(means)))
    run = made(tmp_path, total_frames=768, eval_interval=256)
    first = Trainer(run)
    for save in (True, False):
        first.iterate()
        first.evaluate()
        if save:
            first.save()
    again = Trainer(run, resume=True)
    assert (again.frames, again.iteration) == (128, 1)
    assert 0.0 < again.seconds < first.seconds
    again.iterate()
    again.evaluate()
    assert [row["mean"] for row in run.read_evaluations()] == [10.0, 20.0]
    assert Policy.load(run.policy, "cpu").info["selected_by"] == 30.0


def test_a_run_is_resumed_without_its_policy_or_to_the_frames_that_it_has(tmp_path):
    """The policy that was moved away is selected anew; one that no evaluation has seen is evaluated."""
    run = made(tmp_path, total_frames=768, eval_interval=128)
    first = Trainer(run)
    for _ in range(2):
        run.append_metrics(first.iterate())
        first.save()
        if not run.policy.exists():
            first.evaluate()
    run.policy.unlink()
    Trainer(run, resume=True, total_frames=256).train()
    assert [row["frames"] for row in run.read_evaluations()] == [128, 256]
    assert Policy.load(run.policy, "cpu").info["frames"] == 256
    run.policy.unlink()  # of a run that is complete
    Trainer(run, resume=True).train()
    assert Policy.load(run.policy, "cpu").info["frames"] == 256


@pytest.mark.slow
def test_evaluating_draws_nothing_that_training_draws(tmp_path):
    often = trained(tmp_path / "often", "reppo", eval_interval=128)
    once = trained(tmp_path / "once", "reppo")
    assert len(often.read_evaluations()) == 2
    assert_same(networks(often), networks(once))


@pytest.mark.slow
def test_every_update_begins_with_the_policy_that_collected(tmp_path, monkeypatch):
    """The ratio of new to old probabilities starts at one, the norm sees all there is, and worlds are staggered."""
    update, batches = Algorithm.update, []

    def check(self, batch, progress):
        with torch.no_grad():
            log_prob = self.actor.get_dist(batch).log_prob(batch["action"])
        torch.testing.assert_close(log_prob, batch["action_log_prob"], atol=2e-4, rtol=2e-4)
        batches.append(batch.clone())
        return update(self, batch, progress)

    monkeypatch.setattr(Algorithm, "update", check)
    run = trained(tmp_path, total_frames=2048, episode_length=60, num_envs=16)
    assert len(batches) == 4
    actor = networks(run)
    (count,) = (value for key, value in actor.items() if key.startswith("actor") and key.endswith("0.count"))
    (mean,) = (value for key, value in actor.items() if key.startswith("actor") and key.endswith("0.mean"))
    seen = torch.cat([batch["observation"].flatten(0, 1) for batch in batches])
    assert count == len(seen)
    torch.testing.assert_close(mean, seen.mean(0), atol=1e-4, rtol=1e-4)
    done_together = torch.cat([batch["next", "done"] for batch in batches], dim=1).sum(dim=0)
    assert done_together.sum() > 8
    assert done_together.max() < 16


def test_a_run_keeps_its_first_nan_dump(tmp_path):
    run, found = made(tmp_path, action_repeat=1), []
    for expected in (pytest.warns(NonFiniteWarning), contextlib.nullcontext()):  # the second time as when resumed
        env = Trainer(run).env
        env.step(env.reset().set("action", torch.full((4, 6), torch.nan)))
        with expected:
            env.close()
        found.append(run.nan_dump.read_bytes())
    assert found[0] == found[1]
    assert nan_dump.load(run.nan_dump).settings["num_envs"] == 4


class Undefined(torchrl_loco.WalkerStand):
    """Earns NaN after a tenth of a second."""

    def reward(self, s):
        return torch.where(s.time > 0.1, torch.nan, 1.0)


@pytest.mark.filterwarnings("ignore::torchrl_loco.NonFiniteWarning")
def test_episodes_that_a_reward_has_ended_are_said_once(tmp_path, capsys):
    run = RunFolder.create(preset(Undefined, "cpu", out=tmp_path, **SMALL))
    Trainer(run).train()
    said = capsys.readouterr()
    assert (said.out + said.err).count("because a state, an observation or a reward was not finite") == 1
    assert run.read_metrics()["episode_length"][-1] == 8


def test_torchs_settings_are_restored(tmp_path, monkeypatch):
    threads, seen = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        trainer = Trainer(made(tmp_path))
        monkeypatch.setattr(trainer, "iterate", lambda **_: seen.append(torch.get_num_threads()) or 1 / 0)
        with pytest.raises(ZeroDivisionError):
            trainer.train()
        assert (seen, torch.get_num_threads(), torch.get_float32_matmul_precision()) == ([1], 2, "highest")
    finally:
        torch.set_num_threads(threads)


@pytest.mark.gpu
@for_each("bf16", [False, True])
@for_each("algorithm", ["ppo", "reppo"])
def test_a_run_on_cuda(algorithm, bf16, tmp_path):
    """Recorded gradient steps learn, the run can be stopped and resumed, and its policy plays on the CPU."""
    settings = {**SMALL, "total_frames": 640, "hidden": (32,), "bf16": bf16}
    settings |= {"compile": bf16} if algorithm == "reppo" else {}
    config = preset("walker_stand", "cuda", algorithm, out=tmp_path, **settings)
    run = RunFolder.create(config)
    first = Trainer(run)
    before = {name: value.clone() for name, value in first.algorithm.networks.state_dict().items()}
    with settings_for_small_networks():
        for _ in range(3):
            first.iterate()
    assert first.collector.step_by_step is None
    first.save()
    second = Trainer(run, resume=True)
    assert_same(first.algorithm.networks.state_dict(), second.algorithm.networks.state_dict())
    second.train()
    after = second.algorithm.networks.state_dict()
    assert all(value.isfinite().all() for value in after.values())
    assert any((value != before[name]).any() for name, value in after.items() if "weight" in name)
    assert evaluate_run(run, device="cpu")["mean"] > 0


@pytest.mark.gpu
@for_each("algorithm", ["ppo", "reppo"])
def test_batches_that_cuda_collects_ahead_change_nothing(algorithm, tmp_path):
    found = []
    for ahead in (False, True):
        config = preset("walker_stand", "cuda", algorithm, out=tmp_path / str(ahead), **{**SMALL, "hidden": (32,)})
        trainer = Trainer(RunFolder.create(dataclasses.replace(config, total_frames=10_000)))
        with settings_for_small_networks():
            rows = [trainer.iterate(ahead=ahead) for _ in range(8)]
        assert (trainer._ahead is not None) == ahead
        rows = [{name: value for name, value in row.items() if "second" not in name} for row in rows]
        found.append({"rows": rows, "networks": trainer.algorithm.networks.state_dict()})
        trainer.algorithm.release()
    assert_same(*found)


class Levels(Walker):
    """A level of each world rises with its episodes; what all have done is shared, and both are logged."""

    target_speed = 0.0
    memory = {"level": ()}
    shared = {"steps": ()}

    def metrics(self, s):
        return {"level": s.level, "steps": s.steps.expand(s.num_envs)}

    def adapt(self, s):
        return {"steps": s.steps + 1.0}

    def observation(self, s):
        return {"observation": {"walker": super().observation(s), "level": s.level}}

    def begin(self, s):
        return {**super().begin(s), "level": s.level + 1.0}


def test_metrics_are_logged_and_a_curriculum_is_judged_where_it_is(tmp_path):
    with small_walker():
        run = train(Levels, out=tmp_path, device="cpu", eval_interval=128, logger=("csv",), **SMALL)
        rows, evaluations, policy = run.read_metrics(), run.read_evaluations(), run.load_policy("cpu")
        steps = 2 * 8 * SMALL["action_repeat"]
        # In the last of the four frames of each action: means of 32, of which 3 and 1 are missing where episodes ended.
        assert rows["metric/steps"] == [16.90625, 48.96875]
        assert rows["metric/level"][0] < rows["metric/level"][1]
        reached = policy.info["stage"]["memory"]["level"]
        assert len(reached) == SMALL["num_envs"]
        assert policy.info["stage"]["shared"]["steps"] in (steps / 2, steps)
        # Each episode begins with a reset, which raises the level of a world of the training that it goes on from.
        least = [evaluation["metric/level"] for evaluation in evaluations]
        assert 2.0 <= least[0] <= least[1]
        assert evaluations[1]["metric/steps"] == pytest.approx(steps + (EPISODE - 1) / 2)
        longer = train(Levels, resume=run, total_frames=512)
        assert longer.read_metrics()["metric/steps"][2] == 81.0


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")  # for any batch
def test_a_policy_is_compared_behind_the_transforms_of_its_time(tmp_path, monkeypatch):
    """Where a curriculum has gone on, and transforms have learned more since its evaluation."""
    played, summary = [], Trainer._summary

    def watched(self, policy, final):
        played.append((policy.info["frames"], state_of_transforms(self.env)))
        return summary(self, policy, final)

    monkeypatch.setattr(Trainer, "_summary", watched)
    with small_walker():
        base = Levels(4, "cpu", seed=0)
        env = torchrl_loco.TransformedEnv(base, VecNormV2(["observation"], reduce_batch_dims=True))
        settings = {name: value for name, value in SMALL.items() if name not in ("num_envs", "action_repeat")}
        config = preset(Levels, "cpu", "ppo", out=tmp_path, num_envs=4, protocol=base.protocol, **settings)
        run = begin(config, Given(env=env))
        for _ in range(2):
            run.iterate()
            run.evaluate()
        (first, learned), (again, behind), (last, more) = played
        assert first == again < last
        assert_same(behind, learned)
        assert_same(state_of_transforms(env), more)
        assert str(more) != str(learned)
