"""Evaluations: full episodes, the same ones again, apart from those of training."""

import dataclasses
import itertools
import json
import math
import shutil

import pytest
import torch
from small_runs import EPISODE, made
from torchrl.envs.utils import ExplorationType, exploration_type

import torchrl_loco
from torchrl_loco.policy import Policy
from torchrl_loco.training import RunFolder, evaluate_run, preset
from torchrl_loco.training.evaluation import (
    Evaluator,
    evaluation_seed,
    fallen_return,
    poor_return,
    summarize,
)
from torchrl_loco.training.playback import record


def test_evaluation_can_be_repeated(ppo_run):
    first = Policy.load(ppo_run.policy, "cpu").info
    again = evaluate_run(ppo_run)
    assert again.items() <= first.items()
    assert again["episodes"] == 3
    assert again["min"] <= again["mean"] <= again["max"]
    other = evaluate_run(ppo_run, episodes=2, seed=5)
    assert other["episodes"] == 2
    assert other["mean"] != first["mean"]
    assert Policy.load(ppo_run.policy, "cpu").info == first


def test_evaluation_is_apart_from_training(ppo_run, shared):
    """No evaluated episode begins as one of the training's did, not even for the largest seed."""
    for seed in (0, 2**32 - 1):
        seeds = (seed, evaluation_seed(seed, final=False), evaluation_seed(seed, final=True))
        starts = [shared("walker_stand", 4, "cpu", s).reset()["observation"] for s in seeds]
        for one, other in itertools.combinations(starts, 2):
            assert (one != other).any(dim=1).all()


def test_evaluation_plays_full_episodes():
    """A policy that does nothing earns what the environment pays for that until the time limit or termination."""
    env = torchrl_loco.make("walker_stand", 2, "cpu", seed=11)
    expected = env.rollout(10 * EPISODE, lambda td: td.set("action", env.action_spec.zero()))["next", "reward"].sum(1)
    for action_repeat in (1, 7):
        evaluator = Evaluator("walker_stand", 2, "cpu", 11, action_repeat=action_repeat)
        returns, again = (evaluator(lambda td: td.set("action", torch.zeros(2, 6))) for _ in range(2))
        assert torch.equal(returns, again)
        torch.testing.assert_close(returns, expected.squeeze(-1), rtol=1e-4, atol=0)

    def policy(td):
        """Ends the first world at its first step."""
        assert exploration_type() is ExplorationType.DETERMINISTIC
        action = torch.zeros(2, 6)
        action[0] = math.nan if calls == [] else 0.0
        calls.append(1)
        return td.set("action", action)

    calls = []
    returns = evaluator(policy)
    assert returns[0] == 0.0
    torch.testing.assert_close(returns[1], expected[1, 0], rtol=1e-4, atol=0)


def test_actions_are_held_in_evaluations_and_videos(tmp_path):
    calls = []

    def policy(td):
        calls.append(1)
        return td.set("action", torch.zeros(1, 6))

    Evaluator("walker_stand", 1, "cpu", 0, action_repeat=7)(policy)
    assert len(calls) == 6  # of 40 frames
    calls.clear()
    record(policy, torchrl_loco.make("walker_stand", 1, "cpu", 0), tmp_path / "video.mp4", 0.1, action_repeat=2)
    assert len(calls) == 2  # of 4


def test_a_spread_is_that_of_the_episodes_themselves():
    assert summarize(torch.tensor([1.0, 3.0]))["std"] == 1.0
    assert summarize(torch.tensor([2.0]))["std"] == 0.0


def test_a_run_from_another_device(ppo_run, tmp_path):
    """It can be evaluated where its device is not, if another one is named."""
    folder = tmp_path / "from_cuda"
    shutil.copytree(ppo_run.path, folder)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**config, "device": "cuda:7"}))
    assert evaluate_run(RunFolder(folder), device="cpu") == evaluate_run(ppo_run)
    with pytest.raises(ValueError, match="choose one of cpu"):
        evaluate_run(RunFolder(folder))
    with pytest.raises(ValueError, match="choose one of cpu"):
        RunFolder.create(RunFolder(folder).load_config())


def test_a_run_without_a_policy(tmp_path):
    run = made(tmp_path)
    for way in ("start a new run", "continue it with torchrl-loco resume"):
        with pytest.raises(FileNotFoundError, match=f"has no policy yet: {way}"):
            evaluate_run(run)
        run.save_checkpoint({})


def test_a_poor_return_is_said(monkeypatch):
    """Poor is less than 0.92 of what the shipped policy earns; without a shipped policy nothing can be said."""
    config = preset("walker_stand", "cpu", seed=7)
    shipped = torchrl_loco.load_policy("walker_stand", "cpu").info["mean"]
    note = poor_return(config, {"mean": 0.91 * shipped})
    assert f"poor: the policy shipped for walker_stand earns {shipped:.0f}" in note
    assert "--seed 8" in note
    assert "--seed 10" in poor_return(config, {"mean": 0.0}, seeds=(9, 3))
    assert "--total_frames 6000000" in note
    short = poor_return(dataclasses.replace(config, total_frames=100_000), {"mean": 0.0})
    assert "100,000 frames, and the settings for the task take 3,000,000" in short
    assert poor_return(config, {"mean": 0.93 * shipped}) == ""
    monkeypatch.setattr("torchrl_loco.policy.SHIPPED", config.out / "none")
    assert poor_return(config, {"mean": 0.0}) == ""


@pytest.mark.parametrize(("last", "falls"), [(100.0, False), (91.0, False), (89.0, True), (-5.0, True)])
def test_a_fall_below_the_best_evaluation_is_said(last, falls):
    rows = [{"frames": 10 * i, "mean": mean} for i, mean in enumerate([20.0, 100.0, last])]
    note = fallen_return(preset("walker_stand", "cpu", seed=7, episode_length=300), rows, seeds=[7, 9])
    assert ("from 100.0 after 10 frames" in note) == falls
    assert ("--seed 10" in note) == ("--episode_length 150" in note) == falls


def test_a_run_of_reppo_that_fell_is_told_of_the_setting_that_steadies_it():
    rows = [{"frames": 0, "mean": 900.0}, {"frames": 10, "mean": 300.0}]
    note = fallen_return(preset("walker_stand", "cpu", "reppo"), rows)
    assert "--init_kl_weight 0.02 --min_kl_weight 0.02" in note
    assert "--episode_length" not in note
    heavy = preset("walker_stand", "cpu", "reppo", init_kl_weight=0.05)
    assert "(--min_kl_weight 0.02)" in fallen_return(heavy, rows)
    steady = preset("walker_stand", "cpu", "reppo", init_kl_weight=0.02, min_kl_weight=0.02)
    assert "--episode_length 500" in fallen_return(steady, rows)


@pytest.mark.parametrize(
    ("means", "falls"),
    [
        ([-10.0, -30.0], False),  # nothing was gained before
        ([-1000.0, -50.0, -60.0], False),
        ([-1000.0, -50.0, -400.0], True),
        ([-1000.0, 5.0, 4.0], False),  # little of what was gained, though a fifth of the return
    ],
)
def test_where_returns_are_negative_a_fall_is_one_of_what_was_gained(means, falls):
    rows = [{"frames": i, "mean": mean} for i, mean in enumerate(means)]
    assert bool(fallen_return(preset("walker_stand", "cpu"), rows)) == falls
