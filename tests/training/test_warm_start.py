"""Networks that begin with other weights, other physics than the task's, and checkpoints that stay."""

import pytest
import torch
from compare import assert_same
from for_each import for_each
from hook_tasks import Unsteady
from small_runs import SMALL, made, networks, small_walker, trained
from torch import nn

import torchrl_loco
from torchrl_loco import Go1Velocity, cli, load_policy
from torchrl_loco.cli import policies
from torchrl_loco.collector import rewritten_by
from torchrl_loco.policy import Policy
from torchrl_loco.training import Given, Trainer, begin, preset, train
from torchrl_loco.training.environments import Environments, make_for


@for_each("algorithm", ["ppo", "reppo"])
def test_a_run_begins_with_the_weights_of_another_or_of_a_policy(algorithm, tmp_path):
    with small_walker():
        first = trained(tmp_path / "first", algorithm)
        run = made(tmp_path / "second", algorithm, init=str(first.path))
        begun = Trainer(run).algorithm
        new = Trainer(made(tmp_path / "new", algorithm)).algorithm.networks.state_dict()
        of_method = {name: value for name, value in new.items() if name.startswith("dual.")}  # which settings begin
        assert_same(begun.networks.state_dict(), networks(first) | of_method)
        again = Trainer(made(tmp_path / "again", algorithm, init=str(first.checkpoint))).algorithm
        assert_same(again.networks.state_dict(), networks(first) | of_method)
        assert "action" in rewritten_by(again.acting())  # which collectors need not zero
        with pytest.raises(ValueError, match=r"do not fit this run: hidden \(16,\), here \(8,\)$"):
            Trainer(made(tmp_path / "third", algorithm, init=str(first.path), hidden=(8,)))
        begun = Trainer(made(tmp_path / "fourth", algorithm, init=str(first.policy))).algorithm
        policy = Policy.load(first.policy, "cpu")
        seen = torch.randn(5, 24)
        with torch.no_grad():
            actor = begun.actor[0].module(seen)[0]
        torch.testing.assert_close(actor.tanh(), policy(observation=seen))
        with pytest.raises(
            ValueError, match=r"init: the policy of .* has weight of shape \(16, 24\), this run \(8, 24\)"
        ):
            Trainer(made(tmp_path / "fifth", algorithm, init=str(first.policy), hidden=(8,)))
        with pytest.raises(FileNotFoundError):
            Trainer(made(tmp_path / "sixth", algorithm, init=str(tmp_path / "none.safetensors")))


def test_layers_of_another_kind_are_refused(tmp_path):
    """Their weights may fit."""
    elu = lambda size, out: nn.Sequential(nn.Linear(size, 16), nn.ELU(), nn.Linear(16, out))  # noqa: E731
    with small_walker():
        own = train("walker_stand", device="cpu", algorithm="ppo", network=elu, out=tmp_path, **SMALL)
        for init in (own.path, own.policy, own.checkpoint):
            with pytest.raises(ValueError, match=r"has layers ObservationNorm, Linear, ELU, Linear, this run"):
                Trainer(made(tmp_path / init.stem, init=str(init)))
        with pytest.raises(ValueError, match=r"run with network of your own, which it does not hold: name .*policy"):
            policies.Which().load(str(own.checkpoint), "cpu")


class Fewer(torchrl_loco.WalkerStand):
    """Observes the pose alone."""

    def observation(self, s):
        return s.qpos


def test_what_does_not_fit_is_named_and_a_shipped_policy_by_its_id(tmp_path, monkeypatch):
    with small_walker():
        first = trained(tmp_path / "first")
        with pytest.raises(ValueError, match=r"do not fit this run: observation 24, here 9$"):
            Trainer(made(tmp_path / "second", task=Fewer, init=str(first.path)))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "walker_walk").mkdir()  # which is no run
    for name in ("walker_walk", "mjx/walker_walk-v0"):
        assert preset("walker_stand", "cpu", init=name).init.endswith("playground/walker_walk.safetensors")
    (tmp_path / "walker_walk" / "config.json").touch()
    assert preset("walker_stand", "cpu", init="walker_walk").init == str(tmp_path / "walker_walk")
    assert load_policy("walker_walk", "cpu").info["task"] == "walker_walk"
    (tmp_path / "walker_walk").rename(tmp_path / "mine")
    with pytest.raises(ValueError, match=r"RunFolder\('mine'\).load_policy\(\)"):
        load_policy("mine", "cpu")


@for_each("kept", [{"elementwise_affine": False}, {"bias": False}])
def test_norms_without_weights_are_what_a_file_has_for_them(kept, tmp_path):
    def network(inputs, outputs):
        return nn.Sequential(nn.Linear(inputs, 8), nn.LayerNorm(8, **kept), nn.Linear(8, outputs))

    with small_walker():
        own = train("walker_stand", device="cpu", algorithm="ppo", network=network, out=tmp_path, **SMALL)
        begun = begin(own.load_config(init=own.policy, out=tmp_path / "next"), Given(network=network)).algorithm
        seen = torch.randn(5, 24)
        with torch.no_grad():
            torch.testing.assert_close(begun.actor[0].module(seen)[0].tanh(), own.load_policy("cpu")(observation=seen))


def test_settings_of_the_simulation_are_those_of_the_run(tmp_path):
    """In training, evaluations and where its policy is played; they are kept with it."""
    with small_walker():
        run = train("walker_stand", device="cpu", out=tmp_path, sim={"iterations": 7, "engine": "mujoco"}, **SMALL)
        config = run.load_config()
        assert config.of_env == {"iterations": 7, "engine": "mujoco"}
        policy = run.load_policy("cpu")
        assert make_for(policy, 1, "cpu", 0).config.iterations == 7
        assert make_for(policy, 1, "cpu", 0, iterations=3).config.iterations == 3
    with pytest.raises(ValueError, match="unknown field of sim 'iteration', did you mean 'iterations'"):
        preset("walker_stand", "cpu", sim={"iteration": 7})
    with pytest.raises(TypeError, match="sim must be a dict of fields"):
        preset("walker_stand", "cpu", sim=7)
    small = {"num_envs": 2, "num_steps": 4, "minibatch_size": 8, "total_frames": 8, "randomize": False}
    config = preset("go1_velocity", "cpu", **small)
    assert Environments(config).evaluation(2, 0).randomize == ()
    assert len(Go1Velocity.randomize) > 0


def test_several_checkpoints_stay_and_are_played(tmp_path, capsys, monkeypatch):
    with small_walker():
        run = made(tmp_path, keep=2, checkpoint_seconds=1e-6, total_frames=512)
        Trainer(run).train()
        assert {path.name for path in run.path.glob("*.pt")} == {
            "checkpoint.pt",
            "checkpoint-384.pt",
            "checkpoint-512.pt",
        }
        for path, frames in (("checkpoint-384.pt", 384), ("checkpoint.pt", 512)):
            assert run.load_checkpoint("cpu", run.path / path)["frames"] == frames
            assert cli.main(["eval", str(run.path / path), "--episodes", "2", "--device", "cpu"]) == 0
        assert capsys.readouterr().out.count("over 2 episodes") == 2


def test_terms_of_the_reward_are_evaluated_by_episode(tmp_path):
    with small_walker():
        run = train(Unsteady, device="cpu", out=tmp_path, **{**SMALL, "action_repeat": 1})
        row = run.read_evaluations()[-1]
        terms = [value for name, value in row.items() if name.startswith("reward/")]
        assert len(terms) > 1
        assert sum(terms) == pytest.approx(row["mean"], rel=1e-4)
