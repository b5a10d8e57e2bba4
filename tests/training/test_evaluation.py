"""Evaluations: full episodes, the same ones again, apart from those of training."""

import copy
import itertools
import json
import math
import shutil

import imageio.v3 as imageio
import pytest
import torch
from for_each import for_each
from small_runs import EPISODE, SMALL, made
from torch import nn
from torchrl.envs.utils import ExplorationType, exploration_type

import torchrl_loco
from torchrl_loco.policy import ObservationNorm, Policy
from torchrl_loco.training import RunFolder, evaluate_run, preset, train
from torchrl_loco.training.evaluation import Evaluator, describe, evaluation_seed, record, shipped_return, summarize


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


@pytest.mark.filterwarnings("ignore::torchrl_loco.NonFiniteWarning")
def test_evaluation_plays_full_episodes():
    """A policy that does nothing earns what the environment pays for that until the time limit or termination."""
    env = torchrl_loco.make("walker_stand", 2, "cpu", seed=11)
    expected = env.rollout(10 * EPISODE, lambda td: td.set("action", env.action_spec.zero()))["next", "reward"].sum(1)
    own = torchrl_loco.make("walker_stand", 2, "cpu")
    for action_repeat in (1, 7):
        evaluated = lambda policy: Evaluator(policy, own, action_repeat).returns(11)  # noqa: B023, E731
        returns, again = (evaluated(lambda td: td.set("action", torch.zeros(2, 6))) for _ in range(2))
        assert torch.equal(returns, again)
        torch.testing.assert_close(returns, expected.squeeze(-1), rtol=1e-4, atol=0)

    def policy(td):
        """Ends some worlds at the first step."""
        assert exploration_type() is ExplorationType.DETERMINISTIC
        action = torch.zeros(2, 6)
        action[:ended] = math.nan if calls == [] else 0.0
        calls.append(1)
        return td.set("action", action)

    ended, calls = 1, []
    returns = evaluated(policy)
    assert returns[0] == 0.0
    torch.testing.assert_close(returns[1], expected[1, 0], rtol=1e-4, atol=0)
    ended, calls = 2, []
    assert (evaluated(policy) == 0.0).all()
    assert len(calls) < EPISODE / 7  # it does not go on when all have ended


def test_the_episodes_of_a_users_own_environment_are_as_long_in_later_evaluations(tmp_path, capsys):
    env = torchrl_loco.make("walker_stand", 4, "cpu", seed=0, episode_length=16)
    settings = {name: SMALL[name] for name in SMALL if name not in ("num_envs", "action_repeat")}
    run = train(env, algorithm="ppo", out=tmp_path, **settings)
    assert evaluate_run(run)["mean"] == Policy.load(run.policy, "cpu").info["mean"]
    assert "the policy shipped" not in capsys.readouterr().out


def test_an_episode_that_the_task_cuts_off_counts_as_a_whole_one():
    """It would earn less by what it did well; one that is terminated has nothing more to earn."""

    class Crosses(torchrl_loco.WalkerStand):
        def reward(self, s):
            return {"first": torch.ones_like(s.time), "second": 0.5 * torch.ones_like(s.time)}

        def truncated(self, s):
            return (s.env_index == 0) & (s.time > 0.095)

        def terminated(self, s):
            return (s.env_index == 1) & (s.time > 0.095)

    env = Crosses(3, "cpu", episode_length=40, reward_terms=True, engine="mujoco", compile_hooks=False)
    evaluator = Evaluator(lambda td: td.set("action", torch.zeros(3, 6)), env)
    torch.testing.assert_close(evaluator.returns(0), torch.tensor([60.0, 6.0, 60.0]))
    torch.testing.assert_close(evaluator.metrics["reward/first"], (40 + 4 + 40) / 3)


@for_each("action_repeat", [1, 2])
def test_an_evaluator_follows_the_weights_of_its_policy(device, action_repeat):
    """On CUDA what was recorded with other weights is replayed; a policy that is no module is played step by step."""
    env = torchrl_loco.make("walker_stand", 3, device)
    made = [Policy(nn.Sequential(ObservationNorm(24), nn.Linear(24, 6), nn.Tanh()).to(device), {}) for _ in range(2)]
    expected = [Evaluator(lambda td, one=one: one(td), env, action_repeat).returns(5) for one in made]
    assert (expected[0] != expected[1]).all()
    evaluator = Evaluator(copy.deepcopy(made[0]), env, action_repeat)
    for one, returns in 3 * list(zip(made, expected, strict=True)):
        evaluator.policy.load_state_dict(one.state_dict())
        assert torch.equal(evaluator.returns(5), returns)


def test_actions_are_held_in_evaluations_and_videos(tmp_path):
    calls = []

    def policy(td):
        calls.append(1)
        return td.set("action", torch.zeros(1, 6))

    env = torchrl_loco.make("walker_stand", 1, "cpu", 0)
    Evaluator(policy, env, 7).returns(0)
    assert len(calls) == 6  # of 40 frames
    calls.clear()
    record(policy, env, tmp_path / "video.mp4", 0.05, action_repeat=2)
    assert len(calls) == 1  # of 2
    record(policy, env, tmp_path / "short.mp4", 1e-9, action_repeat=2)  # a picture at least
    assert (tmp_path / "short.mp4").stat().st_size
    slow = torchrl_loco.make("walker_stand", 1, "cpu", 0, ctrl_dt=0.4)
    calls.clear()
    record(policy, slow, tmp_path / "slow.mp4", 2.0)
    assert len(calls) == 5
    assert imageio.immeta(tmp_path / "slow.mp4", plugin="pyav")["duration"] == pytest.approx(2.0)
    for wrong, match in (({"seconds": -1.0}, "seconds must"), ({"action_repeat": 0}, "action_repeat must")):
        with pytest.raises(ValueError, match=match):
            record(policy, env, **{"path": tmp_path / "no.mp4", "seconds": 1.0, **wrong})
    with pytest.raises(ValueError, match="unknown camera 'nope'"):
        record(policy, env, tmp_path / "no.mp4", 1.0, camera="nope")
    with pytest.raises(ValueError, match="no batch of worlds"):
        record(policy, torchrl_loco.make("walker_stand", None, "cpu"), tmp_path / "no.mp4", 1.0)


def test_a_video_that_is_cut_off_leaves_no_file(tmp_path):
    calls = []

    def policy(td):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return td.set("action", torch.zeros(1, 6))

    with pytest.raises(KeyboardInterrupt):
        record(policy, torchrl_loco.make("walker_stand", 1, "cpu", 0), tmp_path / "video.mp4", 0.2)
    assert list(tmp_path.iterdir()) == []


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
    for way in ("wait for one if it is being trained, else start a new run", "continue it with torchrl-loco resume"):
        with pytest.raises(FileNotFoundError, match=f"has no policy yet: {way}"):
            evaluate_run(run)
        run.save_checkpoint({})


def test_the_return_of_the_shipped_policy_is_said(monkeypatch):
    config = preset("walker_stand", "cpu")
    shipped = torchrl_loco.load_policy("walker_stand", "cpu").info["mean"]
    assert shipped_return(config) == f"the policy shipped for walker_stand earns {shipped:.1f}"
    monkeypatch.setattr("torchrl_loco.policy.SHIPPED", config.out / "none")
    assert shipped_return(config) == ""


def test_episodes_that_are_all_alike_are_said_to_be():
    alike = describe(summarize(torch.full((3,), 995.8)))
    assert alike == "return 995.8 in each of 3 episodes, which start and end alike"
    assert describe(summarize(torch.tensor([1.0, 3.0]))) == "return 2.0 +- 1.0 over 2 episodes (min 1.0, max 3.0)"
