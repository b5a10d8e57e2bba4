"""Bad numbers end the world they appear in, and no other."""

import pytest
import torch
import warp as wp
from tensordict import TensorDict

import torchrl_loco
from torchrl_loco.envs.episode import quench

BAD = [float("nan"), float("inf"), -float("inf"), 1e11]


def step_all(env, td, action):
    return env.step(td.set("action", action))["next"]


@pytest.mark.parametrize("bad", BAD)
def test_bad_action_ends_only_its_world(task, protocol, device, actions, bad):
    env, twin = (torchrl_loco.make(task, 4, device, seed=2, protocol=protocol, reward_terms=True) for _ in range(2))
    td, twin_td = env.reset(), twin.reset()
    good, *more = actions(env, 4)
    action = good.clone()
    action[1, 2] = bad
    after, expected = step_all(env, td, action), step_all(twin, twin_td, good)

    others = torch.tensor([0, 2, 3], device=device)
    ended = torch.tensor([[False], [True], [False], [False]], device=device)
    assert torch.equal(after["terminated"], ended)
    assert torch.equal(after["done"], ended)
    assert not after["truncated"].any()
    assert after["reward"][1] == 0
    assert all(value.isfinite().all() for value in after.values(True, True))
    exact = {"rtol": 0, "atol": 0} if device == "cpu" else {"rtol": 1e-3, "atol": 1e-3}
    torch.testing.assert_close(after["observation"][others], expected["observation"][others], **exact)
    torch.testing.assert_close(after["reward"][others], expected["reward"][others], **exact)

    # Reset, the world is as well as one that was never ill.
    mask = {"_reset": ended, "done": ended}
    td = env.reset(after.exclude("reward").update(mask))
    twin_td = twin.reset(expected.exclude("reward").update(mask))
    torch.testing.assert_close(td["observation"], twin_td["observation"], **exact)
    for action in more:
        td, twin_td = step_all(env, td, action), step_all(twin, twin_td, action)
        torch.testing.assert_close(td["observation"], twin_td["observation"], **exact)
        torch.testing.assert_close(td["reward"], twin_td["reward"], **exact)
        assert not td["terminated"].any()
        td, twin_td = td.exclude("reward"), twin_td.exclude("reward")


def test_a_bad_action_is_stepped_with_zeros(task, actions):
    """All of it, so that the state stays one that can be looked at."""
    env, twin = (torchrl_loco.make(task, 3, "cpu", seed=2) for _ in range(2))
    good, expected = actions(env, 1)[0], actions(env, 1)[0]
    good[1, 2], expected[1] = torch.nan, 0.0
    step_all(env, env.reset(), good)
    step_all(twin, twin.reset(), expected)
    for field in ("qpos", "qvel"):
        assert torch.equal(getattr(env.sim, field), getattr(twin.sim, field))


@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_exploding_state_ends_only_its_world(task, protocol, actions, field):
    env, twin = (torchrl_loco.make(task, 3, "cpu", seed=4, protocol=protocol) for _ in range(2))
    td, twin_td = env.reset(), twin.reset()
    getattr(env.sim, field)[0, -1] = float("nan")
    good = actions(env, 3)
    after, expected = step_all(env, td, good[0]), step_all(twin, twin_td, good[0])
    assert after["terminated"].squeeze(-1).tolist() == [True, False, False]
    assert after["reward"][0] == 0
    assert after["observation"].isfinite().all()
    assert torch.equal(after["observation"][1:], expected["observation"][1:])

    ended = after["done"]
    mask = {"_reset": ended, "done": ended}
    td = env.reset(after.exclude("reward").update(mask))
    twin_td = twin.reset(expected.exclude("reward").update(mask))
    for action in good[1:]:
        td, twin_td = step_all(env, td, action), step_all(twin, twin_td, action)
        assert torch.equal(td["observation"], twin_td["observation"])
        td, twin_td = td.exclude("reward"), twin_td.exclude("reward")


@pytest.mark.parametrize("field", ["J", "D"])
def test_a_reset_leaves_nothing_of_constraints_that_were_not_finite(protocol, field):
    """The solver multiplies rows that are not in use by zero: a NaN would stay one."""
    env, twin = (torchrl_loco.make("walker_walk", 4, "cpu", seed=0, protocol=protocol) for _ in range(2))
    wp.to_torch(getattr(env.sim.data.efc, field)).fill_(torch.nan)
    td, twin_td = env.reset(), twin.reset()
    for _ in range(3):
        td, twin_td = (step_all(e, t, e.action_spec.one() / 2) for e, t in ((env, td), (twin, twin_td)))
        assert torch.equal(td["observation"], twin_td["observation"])


def test_a_world_left_ill_stays_ended_and_harms_nobody(actions):
    env, twin = (torchrl_loco.make("humanoid_walk", 3, "cpu", seed=4) for _ in range(2))
    td, twin_td = env.reset(), twin.reset()
    env.sim.qvel[1] = float("nan")
    for action in actions(env, 4):
        td, twin_td = step_all(env, td, action), step_all(twin, twin_td, action)
        assert td["terminated"].squeeze(-1).tolist() == [False, True, False]
        assert torch.equal(td["observation"][::2], twin_td["observation"][::2])
        td, twin_td = td.exclude("reward"), twin_td.exclude("reward")
    mask = torch.tensor([[True], [False], [True]])
    others = TensorDict({"_reset": mask, **td.select("done", "terminated", "truncated")}, batch_size=[3])
    assert env.reset(others)["observation"].isfinite().all()


def test_rollout_goes_on_past_a_bad_action():
    env = torchrl_loco.make("walker_run", 4, "cpu", seed=0)
    calls = iter(range(100))

    def policy(td):
        action = env.action_spec.rand()
        if next(calls) == 5:
            action[2] = float("nan")
        return td.set("action", action)

    td = env.rollout(12, policy, break_when_any_done=False)
    assert td["next", "terminated"].squeeze(-1).nonzero().tolist() == [[2, 5]]
    assert td["next", "observation"].isfinite().all()
    assert not td["done"][2, 6]


@pytest.mark.parametrize("spoilt", ["qpos", "qvel", "observation", "reward", None])
def test_quench_looks_at_everything_it_should(spoilt):
    arrays = {
        "qpos": torch.ones(2, 3),
        "qvel": torch.ones(2, 3),
        "observation": torch.ones(2, 4),
        "reward": torch.ones(2),
    }
    if spoilt is not None:
        arrays[spoilt].view(2, -1)[1, -1] = 2e10
    mask, bad, terms = torch.ones(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool), torch.ones(2, 1)
    with wp.ScopedDevice("cpu"):
        outputs = [bad, arrays["observation"], arrays["reward"], terms]
        views = [wp.from_torch(array) for array in [mask, arrays["qpos"], arrays["qvel"], *outputs]]
        wp.launch(quench, dim=2, inputs=views[:3], outputs=views[3:])
    ill = spoilt is not None
    assert bad.tolist() == [False, ill]
    for array in outputs[1:]:
        assert (array[0] == 1).all()
        assert (array[1] == (0 if ill else 1)).all()
