"""num_envs=None: one world without a batch dimension, otherwise as num_envs=1."""

import pytest
import torch
from cases import coarse
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, check_env_specs

import torchrl_loco
from torchrl_loco import RolloutCollector


@pytest.fixture
def made(shared, device):
    """Makes environments of one task with every hook, of any number of worlds."""
    task = "walker_unsteady"
    return lambda num_envs: shared(task, num_envs, device, episode_length=5, reward_terms=True, **coarse(task))


@pytest.fixture
def env(made):
    return made(None)


def test_specs(env):
    assert env.batch_size == ()
    assert env.num_envs == 1
    assert "num_envs=None" in repr(env)
    check_env_specs(env)
    check_env_specs(torchrl_loco.TransformedEnv(env, Compose(InitTracker(), RewardSum(), StepCounter())))


def play(moves):
    return TensorDictModule(lambda observation: next(moves), in_keys=["observation"], out_keys=["action"])


def test_same_data_as_one_world_in_a_batch(env, made, actions):
    """To the bit, across the end of an episode, with rendering and health."""
    one, moves, results = made(1), actions(env, 12), []
    for each, action in ((env, moves), (one, moves.unsqueeze(1))):
        steps = iter(action)
        td = each.rollout(12, play(steps), break_when_any_done=False)
        results.append(td.reshape(12))
    assert results[0].shape == (12,)
    assert results[0]["next", "truncated"].sum() == 2
    for key in results[0].keys(True, True):
        assert torch.equal(*(td[key] for td in results)), key
    pixels = env.render(width=16, height=12)
    assert pixels.shape == (12, 16, 3)
    assert env.device.type == "cuda" or torch.equal(pixels, one.render(width=16, height=12)[0])
    assert env.health()["worlds"].batch_size == (1,)


def test_rollout_and_collector(env):
    assert env.rollout(20).shape == (5,)
    zero = env.action_spec.zero()
    batches = RolloutCollector(env, lambda td: td.set("action", zero), frames_per_batch=8, total_frames=16)
    assert [batch.shape for batch in batches] == [(8,), (8,)]


def test_what_a_policy_adds_may_have_no_dimensions(env):
    """As the log-probability of an action has none; it is zero where an episode begins."""
    td = env.reset().set("action", env.action_spec.zero()).set("log_prob", torch.tensor(1.0, device=env.device))
    for _ in range(3):
        after, td = env.step_and_maybe_reset(td.set("action", env.action_spec.zero()))
        assert after["log_prob"].shape == td["log_prob"].shape == ()
        assert td["log_prob"] == (0.0 if after["next", "done"] else 1.0)
        td["log_prob"] = torch.tensor(1.0, device=env.device)


def test_states_and_masks(env, made):
    td = env.rollout(2)[-1]["next"].exclude("reward", "reward_terms")
    state = env.get_state()
    assert state.batch_size == ()
    env.reset()
    env.reset(state, set_state=True)
    assert (env.get_state() == state).all()
    env.load_state_dict(env.state_dict())
    many = made(3)
    many.reset(state.branch(0, 3), set_state=True)
    assert torch.equal(many.get_state()["qpos"], state["qpos"].expand(3, -1))

    kept = env.reset(td.clone().set("_reset", torch.zeros(1, dtype=torch.bool, device=env.device)))
    assert torch.equal(kept["observation"], td["observation"])
    assert (env.get_state() == state).all()
    env.reset(td.clone().set("_reset", torch.ones(1, dtype=torch.bool, device=env.device)))
    assert env.get_state()["elapsed_steps"] == 0
