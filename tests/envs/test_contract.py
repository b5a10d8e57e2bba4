"""One contract for every registered task, in both protocols, on every device."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv, check_env_specs

import torchrl_loco


def repeatable(device):
    """How well a rollout repeats: bitwise on the CPU; on CUDA sums are taken in changing order."""
    return {"rtol": 0, "atol": 0} if device == "cpu" else {"rtol": 2e-2, "atol": 2e-2}


@pytest.fixture
def env(task, protocol, device):
    return torchrl_loco.make(task, 5, device, seed=0, protocol=protocol)


def test_specs(env):
    check_env_specs(env)


def test_specs_in_transformed_env(env):
    check_env_specs(TransformedEnv(env, Compose(InitTracker(), RewardSum(), StepCounter())))


def test_rollout_keeps_to_the_contract(env):
    td = env.rollout(20, break_when_any_done=False)
    observation, reward = td["next", "observation"], td["next", "reward"]
    assert observation.shape == (5, 20, env.observation_size)
    assert observation.isfinite().all()
    assert ((reward >= 0) & (reward <= 1)).all()
    assert reward.shape == td["next", "done"].shape == td["next", "terminated"].shape == (5, 20, 1)
    assert not td["next", "done"].any()
    assert env.action_spec.contains(td["action"][:, 0])


def test_what_a_step_returns_is_no_live_buffer(env, actions):
    """A rollout holds what a loop with copies holds, and no two steps share memory."""
    moves = actions(env, 6)
    env.reset()
    state = env.get_state()
    td = env.reset(state, set_state=True)
    copies, originals = [], []
    for action in moves:
        td = env.step(td.set("action", action))["next"]
        originals.append(td)
        copies.append(td.clone())
        td = td.exclude("reward")
    for original, copy in zip(originals, copies, strict=True):
        assert (original == copy).all()
    pointers = [td[key].data_ptr() for td in originals for key in ("observation", "reward", "done", "truncated")]
    assert len(set(pointers)) == len(pointers)

    iterator = iter(moves)
    rollout = env.rollout(
        6,
        policy=lambda td: td.set("action", next(iterator)),
        tensordict=env.reset(state, set_state=True),
        auto_reset=False,
    )
    for key in ("observation", "reward"):
        loop = torch.stack([td[key] for td in copies], dim=1)
        torch.testing.assert_close(rollout["next", key], loop, **repeatable(env.device.type))


def test_same_seed_same_rollout(task, protocol, device, actions):
    def rollout(seed):
        env = torchrl_loco.make(task, 3, device, seed=seed, protocol=protocol)
        td, rewards = env.reset(), []
        for action in actions(env, 10):
            td = env.step(td.set("action", action))["next"].exclude("action")
            rewards.append(td.pop("reward"))
        return td["observation"], torch.stack(rewards)

    for first, second in zip(rollout(7), rollout(7), strict=True):
        torch.testing.assert_close(first, second, **repeatable(device))


def test_truncation_is_exact_and_the_terminal_observation_true(task, protocol, device):
    env = torchrl_loco.make(task, 4, device, seed=3, protocol=protocol, episode_length=7)
    twin = torchrl_loco.make(task, 4, device, seed=3, protocol=protocol)  # never truncated here
    carried, td = env.reset(), twin.reset()
    for step in range(1, 8):
        action = env.action_spec.zero()
        current, carried = env.step_and_maybe_reset(carried.set("action", action))
        td = twin.step(td.set("action", action))["next"].exclude("reward")
        after = current["next"]
        torch.testing.assert_close(after["observation"], td["observation"], rtol=0, atol=1e-5)
        assert (after["truncated"] == (step == 7)).all()
        assert (after["done"] == (step == 7)).all()
        assert not after["terminated"].any()
    assert not carried["done"].any()
    fresh = twin.reset()["observation"]  # the same second episode
    torch.testing.assert_close(carried["observation"], fresh)
    if env.body == "walker" or env.protocol == "dm_control":
        assert (carried["observation"] != after["observation"]).any()


def test_default_episode_is_1000_steps():
    env = torchrl_loco.make("walker_stand", 1, "cpu", seed=0)
    td = env.rollout(1200, policy=lambda td: td.set("action", env.action_spec.zero()))
    assert td.shape == (1, 1000)
    assert td["next", "truncated"].sum() == 1
    assert td["next", "truncated"][0, -1]
    assert not td["next", "terminated"].any()


@pytest.mark.parametrize("num_envs", [1, 16, 1000])
def test_batches(task, num_envs):
    env = torchrl_loco.make(task, num_envs, "cpu", seed=0)
    td = env.rollout(3)
    assert td.shape == (num_envs, 3)
    assert td["next", "observation"].isfinite().all()
    assert env.health()["total", "constraint_overflow"] == env.health()["total", "contact_overflow"] == 0


def test_a_policy_with_gradients_leaves_no_graph_behind():
    env = torchrl_loco.make("walker_walk", 4, "cpu", seed=0)
    layer = torch.nn.Linear(24, 6)
    env.rollout(3, TensorDictModule(layer, in_keys=["observation"], out_keys=["action"]))
    assert not env._views["action"].requires_grad


def test_torch_defaults_of_the_caller_do_not_matter():
    torch.set_default_dtype(torch.float64)
    try:
        with torch.inference_mode():
            env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0, reward_terms=True)
        check_env_specs(env)
        assert env.rollout(2)["next", "reward"].dtype == torch.float32
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("elsewhere", ["meta", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_the_callers_default_device_does_not_matter(elsewhere, protocol):
    """An environment on the CPU stays whole where tensors are made on another device by default."""
    action = torch.zeros(3, 21)
    expected = torchrl_loco.make("humanoid_walk", 3, "cpu", seed=0, protocol=protocol).reset()["observation"]
    with torch.device(elsewhere):
        env = torchrl_loco.make("humanoid_walk", 3, "cpu", seed=0, protocol=protocol, stagger=True, reward_terms=True)
        td = env.reset()
        torch.testing.assert_close(td["observation"], expected, rtol=0, atol=0)
        for _ in range(101):
            _, td = env.step_and_maybe_reset(td.set("action", action))
        env._health.check()
        env.reset(env.get_state().branch(1), set_state=True)
        env.load_state_dict(env.state_dict())
        assert env.render(width=8, height=8).device == env.health()["total"].device == torch.device("cpu")


def test_reward_terms_are_zero_at_a_reset(task):
    env = torchrl_loco.make(task, 2, "cpu", seed=0, reward_terms=True)
    env.rollout(2)
    assert all((term == 0).all() for term in env.reset()["reward_terms"].values())


def test_making_an_environment_leaves_no_overflow_behind():
    """Recording steps through states that nobody asked for; what overflowed there is not the user's."""
    env = torchrl_loco.make("humanoid_run", 4, "cpu", seed=0, protocol="dm_control", iterations=1)
    assert (env.sim.overflow == 0).all()
    assert all(count == 0 for count in env.health()["total"].values())
    env.rollout(40)
    assert env.health()["total", "iteration_limit"] > 0


def test_it_says_what_it_is():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=3)
    assert repr(env) == "WalkerWalk(num_envs=2, device='cpu', protocol='playground', seed=3)"
