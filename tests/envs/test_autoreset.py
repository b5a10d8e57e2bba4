"""Resets without the host: the same data as TorchRL's own way, and no synchronisation."""

import pytest
import torch
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, StepCounter
from torchrl.envs import TransformedEnv as StockTransformedEnv

import torchrl_loco


def transforms():
    return Compose(InitTracker(), RewardSum(), StepCounter(max_steps=9))


def play(env, moves, maybe_reset):
    """Steps and resets, with a policy's other outputs travelling along."""
    td, trace = env.reset(), []
    for i, action in enumerate(moves):
        td = td.set("action", action).set("loc", torch.full_like(action, i + 1.0))
        td = env.step(td)
        after = maybe_reset(env._step_mdp(td))
        trace.append(td.clone().set("carried", after.clone()))
        td = after
    return torch.stack(trace)


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: StockTransformedEnv(env, transforms())])
def test_same_data_as_torchrl(task, protocol, actions, wrap):
    """Worlds end at different times, at the environment's limit, a transform's and by a bad action."""
    settings = {"seed": 0, "protocol": protocol, "episode_length": 12, "stagger": True, "reward_terms": True}
    stock = wrap(torchrl_loco.make(task, 6, "cpu", **settings))
    ours = torchrl_loco.make(task, 6, "cpu", **settings)
    if isinstance(stock, StockTransformedEnv):
        ours = torchrl_loco.TransformedEnv(ours, transforms())
    moves = actions(ours, 30)
    moves[7, 3] = torch.nan
    expected = play(stock, moves, lambda td: EnvBase.maybe_reset(stock, td))
    got = play(ours, moves, ours.maybe_reset)
    assert set(expected.keys(True, True)) == set(got.keys(True, True))
    for key in expected.keys(True, True):
        torch.testing.assert_close(got[key], expected[key], rtol=0, atol=0, equal_nan=True, msg=str(key))
    ended = expected["next", "done"].squeeze(-1)
    assert ended.any(dim=1).sum() > 5
    assert not ended.all(dim=1).any()


def test_collectors_and_rollouts_take_it(task):
    env = torchrl_loco.TransformedEnv(torchrl_loco.make(task, 3, "cpu", seed=0, episode_length=5), transforms())
    td = env.rollout(12, break_when_any_done=False)
    assert td["next", "done"].squeeze(-1)[0].nonzero().squeeze(-1).tolist() == [4, 9]
    assert td["is_init"].squeeze(-1)[0].nonzero().squeeze(-1).tolist() == [0, 5, 10]


def test_a_reset_of_nobody_changes_nothing(task):
    env = torchrl_loco.make(task, 3, "cpu", seed=0)
    td = env.rollout(3)[:, -1]["next"]
    before = env.get_state()
    mask = torch.zeros(3, 1, dtype=torch.bool)
    after = env.reset(td.clone().set("_reset", mask))
    assert torch.equal(after["observation"], td["observation"])
    state = env.get_state()
    assert all(torch.equal(before[key], state[key]) for key in torchrl_loco.State.KEYS)


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: torchrl_loco.TransformedEnv(env, transforms())])
def test_no_synchronisation_over_100_steps_with_resets(task, wrap):
    env = wrap(torchrl_loco.make(task, 256, "cuda", seed=0, episode_length=50, stagger=True))
    td = env.reset()
    action = torch.rand(256, env.action_spec.shape[-1], device="cuda") * 2 - 1
    _, td = env.step_and_maybe_reset(td.set("action", action))
    ended = torch.zeros(256, 1, device="cuda", dtype=torch.int32)
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("error")
        for _ in range(100):
            current, td = env.step_and_maybe_reset(td.set("action", action))
            ended += current["next", "done"]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert (ended >= 2).all()
