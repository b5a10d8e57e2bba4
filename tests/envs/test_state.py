"""get_state and reset(set_state=True)."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv

import torchrl_loco
from torchrl_loco import State


def walk(env, td, moves):
    trace = []
    for action in moves:
        current, td = env.step_and_maybe_reset(td.set("action", action))
        trace.append(current["next"].select("observation", "reward", "done", "truncated"))
    return torch.stack(trace)


@pytest.mark.parametrize("transformed", [False, True])
def test_restores_the_continuation(task, protocol, device, actions, transformed):
    """Bitwise on the CPU; across a time limit, so that step count and random counter take part."""
    env = torchrl_loco.make(task, 4, device, seed=0, protocol=protocol, episode_length=9)
    if transformed:
        env = TransformedEnv(env, Compose(InitTracker(), RewardSum(), StepCounter()))
    moves = actions(env, 10)
    td = env.reset()
    _, td = env.step_and_maybe_reset(td.set("action", moves[0]))
    state = env.get_state()
    assert isinstance(state, State)
    first = walk(env, td, moves)
    assert first["truncated"].sum() == 4
    for _ in range(2):  # a state can be restored again
        second = walk(env, env.reset(state, set_state=True), moves)
        tolerance = {"rtol": 0, "atol": 0} if device == "cpu" else {"rtol": 1e-2, "atol": 1e-2}
        for key in ("observation", "reward", "done", "truncated"):
            torch.testing.assert_close(first[key], second[key], **tolerance)


def test_restores_a_masked_world_only(task):
    env = torchrl_loco.make(task, 3, "cpu", seed=0)
    env.reset()
    old = env.get_state()
    env.rollout(5, auto_reset=False, tensordict=env.reset())
    now = env.get_state()
    mask = torch.tensor([[False], [True], [False]])
    env.reset(old.clone().set("_reset", mask).set("done", mask), set_state=True)
    after = env.get_state()
    for key in State.KEYS:
        assert torch.equal(after[key][1], old[key][1]), key
        assert torch.equal(after[key][::2], now[key][::2]), key


def test_qpos_and_qvel_are_enough():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    env.rollout(3)
    td = TensorDict({"qpos": torch.zeros(2, 9), "qvel": torch.ones(2, 9)}, batch_size=[2])
    env.reset(td, set_state=True)
    state = env.get_state()
    assert (state["qpos"] == 0).all()
    assert (state["qvel"] == 1).all()
    assert (state["qacc_warmstart"] == 0).all()
    assert (state["elapsed_steps"] == 0).all()
    assert (state["episode"] == 1).all()  # the random counter goes on


def test_branching_copies_one_world_into_all(actions):
    env = torchrl_loco.make("humanoid_walk", 4, "cpu", seed=0)
    td = env.reset()
    for action in actions(env, 3):
        td = env.step(td.set("action", action))["next"].exclude("reward")
    state = env.get_state()
    td = env.reset(state[2].expand(4), set_state=True)
    assert (td["observation"] == td["observation"][0]).all()
    same = env.step(td.set("action", actions(env, 1)[0][:1].expand(4, -1)))["next", "observation"]
    assert (same == same[0]).all()


def test_a_state_is_a_copy():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    env.reset()
    state = env.get_state()
    before = state.clone()
    env.rollout(3)
    for key in State.KEYS:
        assert torch.equal(state[key], before[key])


@pytest.mark.parametrize(
    ("td", "message"),
    [
        (None, "'qpos' and 'qvel'"),
        ({"qpos": torch.zeros(2, 9)}, "'qpos' and 'qvel'"),
        ({"qpos": torch.zeros(2, 9), "qvel": torch.zeros(2, 8)}, r"qvel must have shape \(2, 9\), got \(2, 8\)"),
        ({"qpos": torch.full((2, 9), torch.nan), "qvel": torch.zeros(2, 9)}, "qpos must be finite"),
    ],
)
def test_a_wrong_state_changes_nothing(td, message):
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    env.reset()
    before = env.get_state()
    with pytest.raises(ValueError, match=message):
        env.reset(None if td is None else TensorDict(td, batch_size=[2]), set_state=True)
    after = env.get_state()
    assert all(torch.equal(before[key], after[key]) for key in State.KEYS)


def test_transformed_env_never_drops_a_state_silently():
    env = TransformedEnv(torchrl_loco.make("walker_walk", 2, "cpu", seed=0), InitTracker())
    entries = {"qpos": torch.zeros(2, 9), "qvel": torch.zeros(2, 9)}
    with pytest.raises(ValueError, match=r"torchrl_loco\.State"):
        env.reset(TensorDict(entries, batch_size=[2]), set_state=True)
    env.reset(State(entries, batch_size=[2]), set_state=True)
    assert (env.get_state()["qpos"] == 0).all()


@pytest.mark.parametrize("transformed", [False, True])
def test_a_restored_state_does_not_travel_on(transformed):
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    if transformed:
        env = TransformedEnv(env, InitTracker())
    env.reset()
    state = env.get_state()
    td = env.reset(state, set_state=True)
    assert set(td.select("observation").keys()) == {"observation"}
    if transformed:  # TorchRL's own: it returns what it was given
        assert td is state
    else:
        assert not set(State.KEYS) & set(td.keys())
        assert set(state.keys()) == set(State.KEYS)


def test_restoring_makes_an_ended_world_well_again(actions):
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    td = env.reset()
    good = env.get_state()
    bad = actions(env, 1)[0]
    bad[1] = torch.nan
    env.step(td.set("action", bad))
    td = env.reset(good, set_state=True)
    assert not td["done"].any()
    assert not td["terminated"].any()
    assert (td["observation"][1] != 0).any()


def test_a_masked_restore_ignores_the_rows_it_leaves():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    env.reset()
    state = env.get_state()
    state["qvel"][0] = torch.nan
    mask = torch.tensor([[False], [True]])
    env.reset(state.set("_reset", mask).set("done", ~mask & False), set_state=True)
    assert env.get_state()["qvel"].isfinite().all()


def test_time_follows_the_elapsed_steps():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    env.rollout(4)
    state = env.get_state()
    env.reset()
    assert (env.sim.time == 0).all()
    env.reset(state, set_state=True)
    torch.testing.assert_close(env.sim.time, torch.full((2,), 4 * 0.025))


def test_branches_are_copies(task, actions):
    """All worlds go on from one world's moment: the same actions lead to the same steps, different ones do not."""
    env = torchrl_loco.make(task, 4, "cpu", seed=0)
    td = env.reset()
    for action in actions(env, 5):
        td = env.step(td.set("action", action))["next"]
    state = env.get_state()
    branch = state.branch(2)
    td = env.reset(branch, set_state=True)
    assert all(torch.equal(env.get_state()[key], state[key][2].expand_as(state[key])) for key in State.KEYS)
    same = actions(env, 3)[:, :1].expand(3, 4, -1)
    trace = walk(env, td, same)
    assert (trace["observation"] == trace["observation"][:, :1]).all()
    trace = walk(env, env.reset(branch, set_state=True), actions(env, 3, seed=1))
    assert (trace["observation"][-1, 0] != trace["observation"][-1, 1]).any()
    other = torchrl_loco.make(task, 7, "cpu", seed=0)
    other.reset(state.branch(-1, 7), set_state=True)
    assert torch.equal(other.get_state()["qpos"], state["qpos"][-1:].expand(7, -1))
    branch["qpos"][0] += 1.0  # a future of its own
    assert (branch["qpos"][0] != branch["qpos"][1]).all()
    with pytest.raises(IndexError):
        state.branch(4)


def test_state_dict_goes_on_in_another_environment(task, actions):
    """With the seed: what is drawn at the next resets is the same too."""
    first = torchrl_loco.make(task, 3, "cpu", seed=5, episode_length=4)
    second = torchrl_loco.make(task, 3, "cpu", seed=6, episode_length=4)
    moves = actions(first, 10)
    td = first.reset()
    _, td = first.step_and_maybe_reset(td.set("action", moves[0]))
    second.load_state_dict(first.state_dict())
    assert second.seed == 5
    one, other = walk(first, td, moves), walk(second, td.clone(), moves)
    assert (one == other).all()
    assert one["truncated"].sum() > 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 4}, "num_envs=3, this environment of 4"),
        ({"protocol": "dm_control"}, "protocol='playground', this environment of 'dm_control'"),
        ({"id": "humanoid_run"}, "body='walker', this environment of 'humanoid'"),
    ],
)
def test_state_dict_of_another_kind(options, message):
    state = torchrl_loco.make("walker_run", 3, "cpu", seed=5).state_dict()
    env = torchrl_loco.make(**{"id": "walker_run", "num_envs": 3, "device": "cpu", **options})
    with pytest.raises(ValueError, match=message):
        env.load_state_dict(state)


def test_a_lenient_state_dict_leaves_the_worlds_alone():
    """EnvCreator loads its shadow environment's into every environment that it makes, whatever their size."""
    env = torchrl_loco.make("walker_walk", 3, "cpu", seed=5)
    env.reset()
    before = env.get_state()
    env.load_state_dict(torchrl_loco.make("walker_walk", 4, "cpu", seed=6).state_dict(), strict=False)
    assert (env.get_state() == before).all()
    assert env.seed == 5


@pytest.mark.gpu
def test_a_state_from_another_device_is_taken():
    env, other = (torchrl_loco.make("walker_walk", 2, device, seed=0) for device in ("cuda", "cpu"))
    other.rollout(3)
    mask = torch.tensor([[True], [False]])
    other_state = other.get_state()
    env.reset(other_state.clone().set("_reset", mask), set_state=True)
    assert torch.equal(env.get_state()["qpos"][0].cpu(), other_state["qpos"][0])


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("qvel", torch.full((2, 9), 1e39, dtype=torch.double)),
        ("elapsed_steps", torch.tensor([2**32, 0])),
        ("episode", torch.tensor([-5, 0])),
    ],
    ids=["qvel", "elapsed_steps", "episode"],
)
def test_numbers_that_do_not_fit_are_refused(key, value):
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    state, before = env.get_state(), env.get_state()
    with pytest.raises(ValueError, match=rf"{key} must (be finite|lie in)"):
        env.reset(State({**state, key: value}, batch_size=[2]), set_state=True)
    assert all(torch.equal(env.get_state()[name], before[name]) for name in State.KEYS)
