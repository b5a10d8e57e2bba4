"""The adapters in examples/adapters deliver what ``step_and_maybe_reset`` of a twin with the same seed delivers."""

import copy
import functools

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import check_env_specs
from torchrl.modules import CEMPlanner, MPPIPlanner

import torchrl_loco

pytestmark = pytest.mark.ci

NUM_ENVS, LENGTH, STEPS = 4, 5, 12
settings = {"device": "cpu", "seed": 3, "episode_length": LENGTH, "reward_terms": True}
make = functools.partial(torchrl_loco.make, "walker_stand", NUM_ENVS, **settings)


@pytest.fixture
def steps(actions):
    """What the twin delivers: actions, then its pairs (step, TensorDict after the resets).

    The worlds are truncated at different steps, and world 1 is terminated by a NaN in the third.
    """
    twin = make(stagger=True)
    drawn = actions(twin, STEPS)
    drawn[2, 1, 0] = torch.nan
    td, pairs = twin.reset(), []
    for action in drawn:
        step, td = twin.step_and_maybe_reset(td.set("action", action))
        pairs.append((step, td))
    after = torch.stack([step["next"] for step, _ in pairs])
    assert after["terminated"].nonzero().tolist() == [[2, 1, 0]]
    assert after["truncated"].any(dim=0).all()
    assert not after["truncated"].all(dim=1).any()
    return pairs


def test_rsl_rl(steps):
    pytest.importorskip("rsl_rl")
    from examples.adapters.rsl_rl_env import RslRlEnv

    env = RslRlEnv(make(stagger=True))
    assert torch.equal(env.get_observations()["observation"], steps[0][0]["observation"])
    for step, td in steps:
        after = step["next"]
        observations, rewards, dones, extras = env.step(step["action"])
        assert torch.equal(observations["observation"], td["observation"])
        assert torch.equal(env.get_observations()["observation"], td["observation"])
        assert torch.equal(rewards, after["reward"].squeeze(-1))
        assert torch.equal(dones, after["done"].squeeze(-1))
        assert torch.equal(extras["time_outs"], (after["truncated"] & ~after["terminated"]).squeeze(-1))
        assert torch.equal(extras["final_observations"]["observation"], after["observation"])


def test_rsl_rl_clamps_actions():
    pytest.importorskip("rsl_rl")
    from examples.adapters.rsl_rl_env import RslRlEnv

    env, twin = RslRlEnv(make()), make()
    action = torch.linspace(-2, 2, NUM_ENVS * env.num_actions).reshape(NUM_ENVS, env.num_actions)
    expected = twin.step(twin.reset().set("action", action.clamp(-1, 1)))["next", "observation"]
    assert torch.equal(env.step(action)[0]["observation"], expected)


def test_rsl_rl_sets_episode_lengths():
    pytest.importorskip("rsl_rl")
    from examples.adapters.rsl_rl_env import RslRlEnv

    env = RslRlEnv(make())
    env.episode_length_buf = torch.tensor([0, 1, 3, 4])
    assert env.episode_length_buf.tolist() == [0, 1, 3, 4]
    for expected in ([3], [2], [], [1], [0], [3]):
        _, _, _, extras = env.step(torch.zeros(NUM_ENVS, env.num_actions))
        assert extras["time_outs"].nonzero().flatten().tolist() == expected


def test_rsl_rl_bootstraps_from_the_final_observation(tmp_path):
    pytest.importorskip("rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    from examples.adapters.rsl_rl_env import CONFIG, RslRlEnv

    env = RslRlEnv(make(stagger=True))
    runner = OnPolicyRunner(env, copy.deepcopy(CONFIG) | {"num_steps_per_env": 8}, log_dir=str(tmp_path))
    alg, ended = runner.alg, 0
    with torch.inference_mode():
        observations = env.get_observations()
        for i in range(8):
            observations, rewards, dones, extras = env.step(alg.act(observations))
            alg.process_env_step(observations, rewards, dones, extras)
            value = alg.critic(extras["final_observations"]).squeeze(-1)
            expected = torch.where(extras["time_outs"], rewards + alg.gamma * value, rewards)
            assert torch.equal(alg.storage.rewards[i].squeeze(-1), expected)
            ended += dones.sum().item()
    assert ended >= NUM_ENVS
    alg.storage.clear()
    runner.learn(1, init_at_random_ep_len=True)


def test_stable_baselines3(steps):
    pytest.importorskip("stable_baselines3")
    from examples.adapters.stable_baselines3_env import StableBaselines3Env

    env = StableBaselines3Env(make(stagger=True))
    assert np.array_equal(env.reset(), steps[0][0]["observation"])
    for step, td in steps:
        after = step["next"]
        observations, rewards, dones, infos = env.step(step["action"].numpy())
        assert np.array_equal(observations, td["observation"])
        assert np.array_equal(rewards, after["reward"].squeeze(-1))
        assert np.array_equal(dones, after["done"].squeeze(-1))
        for world, info in enumerate(infos):
            if not dones[world]:
                assert info == {}
                continue
            assert np.array_equal(info["terminal_observation"], after["observation"][world])
            assert info["TimeLimit.truncated"] != after["terminated"][world].item()


def test_stable_baselines3_seeds_and_trains():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecMonitor

    from examples.adapters.stable_baselines3_env import StableBaselines3Env

    env = StableBaselines3Env(make())
    env.seed(7)
    assert np.array_equal(env.reset(), torchrl_loco.make("walker_stand", NUM_ENVS, "cpu", 7).reset()["observation"])
    assert not np.array_equal(env.reset(), env.reset())
    model = PPO("MlpPolicy", VecMonitor(env), n_steps=16, batch_size=32, n_epochs=1, seed=0, device="cpu")
    model.learn(total_timesteps=128)
    assert {episode["l"] for episode in model.ep_info_buffer} == {LENGTH}


def test_gymnasium(steps):
    pytest.importorskip("gymnasium")
    from examples.adapters.gymnasium_env import GymnasiumEnv

    env = GymnasiumEnv(make(stagger=True))
    observations, info = env.reset()
    assert torch.equal(observations, steps[0][0]["observation"])
    assert info == {}
    for step, td in steps:
        after = step["next"]
        observations, rewards, terminations, truncations, info = env.step(step["action"])
        assert torch.equal(observations, td["observation"])
        assert torch.equal(rewards, after["reward"].squeeze(-1))
        assert torch.equal(terminations, after["terminated"].squeeze(-1))
        assert torch.equal(truncations, after["truncated"].squeeze(-1))
        assert torch.equal(info["_final_obs"], after["done"].squeeze(-1))
        assert torch.equal(info["final_obs"], after["observation"])


def test_gymnasium_checks_and_wrappers():
    """Its check of seeds (others are for single environments), and a wrapper that goes by the autoreset mode."""
    gymnasium = pytest.importorskip("gymnasium")
    pytest.importorskip("array_api_compat")
    from gymnasium.utils import env_checker
    from gymnasium.wrappers.vector import ArrayConversion, RecordEpisodeStatistics

    from examples.adapters.gymnasium_env import GymnasiumEnv

    gymnasium.register("WalkerStand-v0", vector_entry_point=lambda num_envs: GymnasiumEnv(make()))
    env = gymnasium.make_vec("WalkerStand-v0", NUM_ENVS, vectorization_mode="vector_entry_point")
    env = ArrayConversion(env, env_xp=torch, target_xp=np)
    env_checker.check_reset_seed_determinism(env)
    env = RecordEpisodeStatistics(env)
    observations, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(2 * LENGTH):
        assert env.observation_space.contains(observations)
        observations, rewards, terminations, truncations, info = env.step(env.action_space.sample())
    assert {type(x) for x in (observations, rewards, terminations, truncations, info["final_obs"])} == {np.ndarray}
    assert list(env.length_queue) == [LENGTH] * 2 * NUM_ENVS


@pytest.fixture
def planning_env():
    from examples.adapters.planning_env import PlanningEnv

    return PlanningEnv(functools.partial(torchrl_loco.make, "walker_stand", **settings))


def test_planning_env_keeps_the_contract_of_torchrl(planning_env):
    check_env_specs(planning_env)
    assert planning_env.reset(TensorDict(batch_size=[2, 3]))["observation"].shape == (2, 3, 24)
    first, second = (planning_env.set_seed(5) and planning_env.reset()["observation"] for _ in range(2))
    assert torch.equal(first, second)


def test_planning_env_steps_from_the_state_it_is_given(planning_env, actions):
    """In another batch shape, at other moments of the episode, and in the reverse order."""
    twin = make(stagger=True)
    td, moments = twin.reset(), []
    for action in actions(twin, STEPS):
        state = twin.get_state()
        step, td = twin.step_and_maybe_reset(td.set("action", action))
        moments.append((state, step))
    for state, step in reversed(moments):
        after = planning_env.step(step.exclude("next").set("state", state).reshape(2, 2))["next"].reshape(NUM_ENVS)
        for key in ("observation", "reward", "done", "terminated", "truncated"):
            assert torch.equal(after[key], step["next", key])


def test_planning_env_resets_the_worlds_that_are_done(planning_env):
    td = planning_env.reset(TensorDict(batch_size=[NUM_ENVS]))
    td["state", "elapsed_steps"] = torch.tensor([0, LENGTH - 1, 1, LENGTH - 1], dtype=torch.int32)
    td["action"] = torch.zeros(NUM_ENVS, 6)
    step, td = planning_env.step_and_maybe_reset(td)
    after, done = step["next"], torch.tensor([False, True, False, True])
    assert torch.equal(after["truncated"].squeeze(-1), done)
    assert after["state", "elapsed_steps"].tolist() == [1, LENGTH, 2, LENGTH]
    assert td["state", "elapsed_steps"].tolist() == [1, 0, 2, 0]
    for key in ("observation", ("state", "qpos")):
        assert torch.equal((td[key] == after[key]).all(dim=-1), ~done)


def sum_of_rewards():
    return TensorDictModule(lambda r: r.sum(-2, True).expand_as(r), [("next", "reward")], ["advantage"])


@pytest.mark.parametrize("planner_class", [CEMPlanner, MPPIPlanner])
def test_plans_beat_random_actions(planning_env, planner_class):
    horizon = LENGTH - 1
    size = {"planning_horizon": horizon, "optim_steps": 3, "num_candidates": 32, "top_k": 4}
    if planner_class is MPPIPlanner:
        size |= {"temperature": 5.0, "advantage_module": sum_of_rewards()}
    planner = planner_class(planning_env, **size)
    env = make()
    planned = env.rollout(horizon, lambda td: planner(td.set("state", env.get_state())))["next", "reward"].sum(dim=1)
    still = make().rollout(horizon, lambda td: td.set("action", torch.zeros(NUM_ENVS, 6)))["next", "reward"].sum(dim=1)
    random = make().rollout(horizon)["next", "reward"].sum(dim=1)
    assert planned.mean() > max(still.mean(), random.mean())
