"""Where a run trains: what networks read there, actions that are held, and lengths of episodes."""

import dataclasses

import pytest
import torch
from small_runs import EPISODE, SMALL
from torchrl.data import Bounded, Unbounded
from torchrl.envs import (
    Compose,
    DTypeCastTransform,
    FrameSkipTransform,
    RewardSum,
    StepCounter,
    Transform,
    TransformedEnv,
    UnsqueezeTransform,
)

import torchrl_loco
from torchrl_loco import LocoEnv, WalkerWalk, source
from torchrl_loco.training import PPOConfig, Spaces, preset
from torchrl_loco.training.environments import ActionRepeat, Environments


class Stumble(torchrl_loco.WalkerStand):
    """Ends at its third step alone, after which it could go on; earns 1 in each."""

    def reward(self, s):
        return {"one": torch.ones_like(s.time), "nothing": torch.zeros_like(s.time)}

    def terminated(self, s):
        return (s.time > 2.5 * 0.025) & (s.time < 3.5 * 0.025)

    def observation(self, s):
        return torch.cat([s.qpos, s.time.unsqueeze(-1)], dim=-1)


class Free(torchrl_loco.WalkerStand):
    """Actions without bounds, something for the critic, a reward without terms."""

    action_range = (-float("inf"), float("inf"))

    def control(self, s, action):
        return action.tanh()

    def reward(self, s):
        return s.qvel[:, 0]

    def observation(self, s):
        return {"observation": s.qpos, "privileged": torch.cat([s.qpos, s.qvel], dim=-1)}


def test_sizes_are_those_of_the_environment():
    assert Spaces.of(torchrl_loco.make("walker_run", 3, "cpu")) == Spaces(24, 6)
    spaces = Spaces.of(Free(2, "cpu"))
    assert spaces == Spaces(9, 6, privileged=18, bounded=False)
    assert (spaces.critic_key, spaces.critic) == ("privileged", 18)
    assert (Spaces(9, 6).critic_key, Spaces(9, 6).critic) == ("observation", 9)


def test_what_cannot_be_trained_on():
    env = torchrl_loco.make("walker_run", 3, "cpu")
    images = TransformedEnv(env, UnsqueezeTransform(-1, in_keys=["observation"]))
    with pytest.raises(ValueError, match=r"'observation' must be a row of numbers.*\(24, 1\).*FlattenObservation"):
        Spaces.of(images)
    double = TransformedEnv(env, DTypeCastTransform(torch.float32, torch.float64, in_keys=["observation"]))
    with pytest.raises(ValueError, match=r"'observation' must be torch.float32 to train on, but is torch.float64"):
        Spaces.of(double)
    env.action_spec = Bounded(-2.0, 2.0, (3, 6))
    with pytest.raises(ValueError, match=r"bounded by \[-1, 1\], or by nothing"):
        Spaces.of(env)
    env.action_spec = Unbounded((3, 6))
    assert not Spaces.of(env).bounded
    with pytest.raises(ValueError, match="leave FrameSkipTransform out, and pass action_repeat=4"):
        Environments(PPOConfig("walker_run"), TransformedEnv(env, FrameSkipTransform(4)))


def test_a_held_action_ends_where_the_world_does():
    """Of four steps the third terminates: its reward, its observation and its end are what is returned."""
    env, held = Stumble(2, "cpu", seed=0, reward_terms=True), Stumble(2, "cpu", seed=0, reward_terms=True)
    expected = env.rollout(3, lambda td: td.set("action", torch.full((2, 6), 0.3)))[:, 2]["next"]
    twice = torchrl_loco.TransformedEnv(held, ActionRepeat(2))
    after = twice.step(twice.reset().set("action", torch.full((2, 6), 0.3)))["next"]
    assert (after["reward"] == 2.0).all()
    assert not after["done"].any()
    held.set_seed(0)
    held = torchrl_loco.TransformedEnv(held, ActionRepeat(4))
    after = held.step(held.reset().set("action", torch.full((2, 6), 0.3)))["next"]
    assert after["terminated"].all()
    assert after["done"].all()
    assert (after["reward"] == 3.0).all()
    assert (after["reward_terms", "one"] == 3.0).all()
    assert torch.equal(after["observation"], expected["observation"])
    short = torchrl_loco.TransformedEnv(Stumble(2, "cpu", seed=0, episode_length=2, reward_terms=True), ActionRepeat(4))
    after = short.step(short.reset().set("action", torch.full((2, 6), 0.3)))["next"]
    assert (after["truncated"] & ~after["terminated"]).all()
    assert (after["reward"] == 2.0).all()


def test_what_does_not_go_with_held_actions_is_said(caplog):
    with pytest.raises(TypeError, match="frame_skip must be an integer"):
        ActionRepeat(2.5)
    env = torchrl_loco.TransformedEnv(Stumble(2, "cpu", seed=0), Compose(RewardSum(), ActionRepeat(2)))
    env.rollout(2)
    assert caplog.text.count("RewardSum sums the last control step of each action alone") == 1
    with pytest.raises(ValueError, match="leave ActionRepeat out, and pass action_repeat"):
        env.view(lambda td: td)


def test_lengths_of_episodes(tmp_path):
    """In training that of the settings, or the task's own; evaluations always play the latter."""
    config = PPOConfig("walker_stand", episode_length=23)
    for length, expected in ((23, 23), (0, EPISODE)):
        environments = Environments(dataclasses.replace(config, episode_length=length))
        assert environments.training(tmp_path / "none").config.episode_length == expected
        assert environments.evaluation(2, seed=0).config.episode_length == environments.full_length == EPISODE


def test_terms_of_the_reward_are_returned_where_a_task_has_them(tmp_path):
    for task, terms in ((Stumble, {"one", "nothing"}), (Free, set()), ("walker_stand", set())):
        config = PPOConfig(task, num_envs=2, num_steps=4, minibatch_size=8, total_frames=100)
        spec = Environments(config).training(tmp_path / "none").observation_spec
        assert set(spec.get("reward_terms", {}).keys()) == terms


class Counted(Transform):
    """Counts steps, in place."""

    def __init__(self):
        super().__init__()
        self.steps = torch.zeros(3)

    def _step(self, tensordict, next_tensordict):
        self.steps += 1
        return next_tensordict


def test_evaluations_are_behind_the_transforms_of_an_environment_that_was_handed_in():
    """What those learn from evaluations stays apart."""
    base = torchrl_loco.make("walker_stand", 3, "cpu", seed=5, protocol="dm_control", sim_dt=0.025)
    env = torchrl_loco.TransformedEnv(torchrl_loco.TransformedEnv(base, StepCounter()), Counted())
    env.rollout(3)
    config = PPOConfig("walker_stand", **{**SMALL, "num_envs": 3, "minibatch_size": 8, "logger": ("csv",)})
    environments = Environments(config, env)
    other = environments.evaluation(2, seed=7)
    assert (other.num_envs, other.seed, other.protocol, other.config.sim_dt) == (3, 7, "dm_control", 0.025)
    assert "step_count" in other.reset().keys()  # noqa: SIM118
    assert environments.own["transforms"] == ["StepCounter", "Counted"]
    other.rollout(3)
    assert env.transform.steps.tolist() == [3, 3, 3]
    assert env.base_env.base_env is base
    assert Environments(config, base).evaluation(2, seed=7).num_envs == 2


class Named(torchrl_loco.WalkerStand):
    """Has terms of the observation, with noise."""

    noise = {"pose": 0.1}

    def observation(self, s):
        return {"observation": {"pose": s.qpos, "speed": s.qvel}}


def test_evaluations_begin_alike_whatever_the_ones_before_have_left(tmp_path):
    class Counts(LocoEnv):
        body, model, config = "walker", WalkerWalk.model, WalkerWalk.config
        shared = {"steps": torch.full((), 5.0)}
        memory = {"episodes": ()}

        def reward(self, s):
            return s.steps + s.episodes

        def adapt(self, s):
            return {"steps": s.steps + 1.0}

        def begin(self, s):
            return {"episodes": s.episodes + 1.0}

        def observation(self, s):
            return s.qpos

    environments = Environments(preset(Counts, "cpu", num_envs=2, num_steps=4, minibatch_size=8, out=tmp_path))
    seen = [environments.evaluation(3, seed=4).rollout(6)["next", "reward"] for _ in range(2)]
    assert torch.equal(*seen)
    assert seen[0][0, 0] == 6.0  # of both once at the start


def test_evaluations_return_what_an_environment_returns_that_was_handed_in():
    """All that its transforms may read, such as depth, with the same noise."""
    seen = {"from_pixels": True, "depth": 5.0, "camera": "back", "size": (8, 6), "frame_stack": 2, "pixels_only": False}
    for options in ({"depth": 5.0}, {**seen, "observation_terms": True, "noise_scale": 0.5, "compile_hooks": False}):
        base = Named(3, "cpu", seed=5, metrics=True, **options)
        other = Environments(PPOConfig(Named), base).evaluation(3, seed=7)
        assert other.observation_spec == base.observation_spec
        assert other.pixels == base.pixels
        assert (other.noise_scale, other.compile_hooks) == (base.noise_scale, base.compile_hooks)


def test_evaluations_that_read_other_attributes_are_told_of_and_edits_of_a_notebook_noticed(caplog, monkeypatch):
    monkeypatch.setattr(source.inspect, "getsourcefile", lambda cls: None)  # as of a cell

    def made(factor):
        return type(
            "Gains", (torchrl_loco.WalkerStand,), {"gain": 1.0, "reward": lambda self, s: self.gain * factor * s.time}
        )

    env = made(1.0)(2, "cpu", seed=0, engine="mujoco", compile_hooks=False)
    env.close()
    env.gain = 5.0
    env.reset()
    config = PPOConfig("walker_stand", num_envs=2, num_steps=4, minibatch_size=8, total_frames=100)
    Environments(config, env).evaluation(2, seed=0)
    assert "hooks read gain, which is 5.0 in the environment that trains and 1.0 in its evaluations" in caplog.text
    names = [torchrl_loco.registry.task_name(made(1.0)) for _ in range(2)]
    first, second = (source.content_of(name, env) for name in names)
    assert first == second
    other = type("Gains", (torchrl_loco.WalkerStand,), {"gain": 1.0, "reward": lambda self, s: 2.0 * s.time})
    assert source.content_of(torchrl_loco.registry.task_name(other), env) != first
