"""The environment for TorchRL's planners in examples/planning_env.py."""

import functools

import pytest
import torch
from for_each import for_each
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
def planning_env():
    from examples.planning_env import PlanningEnv

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


@for_each("planner_class", [CEMPlanner, MPPIPlanner])
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
