"""get_state, reset(set_state=True), state_dict."""

import pytest
import torch
from cases import coarse
from compare import assert_repeats
from for_each import for_each
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


def assert_same(one, other):
    assert set(one.keys()) == set(other.keys())
    assert set(State.KEYS) - set(one.keys()) <= {
        "act",
        "memory",
        "shared",
        "model",
        "pictures",
    }  # of bodies that have none
    assert (one == other).all()


@for_each("task, protocol, engine", "kinds")
def test_restores_the_continuation(shared, task, protocol, engine, device, actions):
    """Bitwise; across a time limit, so that step count and random counter take part; and under transforms."""
    options = {"protocol": protocol, "engine": engine, "reward_terms": task != "walker_backwards", **coarse(task)}
    base = shared(task, 4, device, episode_length=7, **options)
    for env in (base, TransformedEnv(base, Compose(InitTracker(), RewardSum(), StepCounter()))):
        moves = actions(env, 10)
        td = env.reset()
        _, td = env.step_and_maybe_reset(td.set("action", moves[0]))
        state = env.get_state()
        assert isinstance(state, State)
        kept = state.clone()
        first = walk(env, td, moves)
        assert first["truncated"].sum() == 4
        assert_same(state, kept)  # it is a copy
        for _ in range(2):  # a state can be restored again
            second = walk(env, env.reset(state, set_state=True), moves)
            for key in ("observation", "reward", "done", "truncated"):
                assert_repeats(first[key], second[key], engine)
            state = kept.clone()  # TransformedEnv writes into what it is given


@for_each("kind", "kinds")
def test_restores_the_worlds_of_a_mask_only(shared, kind):
    """What stands in the rows of the other worlds does not matter."""
    task, protocol, engine = kind
    env = shared(task, protocol=protocol, engine=engine, reward_terms=True)
    env.reset()
    old = env.get_state()
    last = env.rollout(5, auto_reset=False, tensordict=env.reset())[:, -1]["next"]
    now, passed = env.get_state(), old.clone()
    passed["qvel"][0] = torch.nan
    mask = torch.tensor([[False], [True], [False], [True]])
    seen = env.reset(passed.set("_reset", mask).set("done", mask), set_state=True)["observation"]
    assert torch.equal(seen[::2], last["observation"][::2])
    after = env.get_state()
    for key, value in old.items():
        assert (after[key][1::2] == value[1::2]).all(), key
        assert (after[key][::2] == now[key][::2]).all(), key


@for_each("wrap", [lambda env: env, lambda env: torchrl_loco.TransformedEnv(env, RewardSum())])
def test_what_a_reset_leaves_out_need_not_be_passed(wrap):
    env = wrap(torchrl_loco.make("walker_walk", 2, "cpu", seed=0))
    seen = env.rollout(3)[:, -1]["next", "observation"]
    mask = TensorDict({"_reset": torch.tensor([[True], [False]])}, batch_size=[2])
    after = env.reset(mask.clone())["observation"]
    assert torch.equal(after[1], seen[1])
    assert not torch.equal(after[0], seen[0])
    state = env.get_state().update(mask)
    assert torch.equal(env.reset(state, set_state=True)["observation"], after)


def test_qpos_and_qvel_are_enough(shared):
    env = shared()
    env.rollout(3)
    env.reset(TensorDict({"qpos": torch.zeros(4, 9), "qvel": torch.ones(4, 9)}, batch_size=[4]), set_state=True)
    state = env.get_state()
    assert (state["qpos"] == 0).all()
    assert (state["qvel"] == 1).all()
    assert (state["qacc_warmstart"] == 0).all()
    assert (state["elapsed_steps"] == 0).all()
    assert (state["episode"] == 1).all()  # the random counter goes on


def test_time_follows_the_elapsed_steps(shared):
    env = shared()
    env.rollout(4)
    state = env.get_state()
    env.reset()
    assert (env.sim.time == 0).all()
    env.reset(state, set_state=True)
    torch.testing.assert_close(env.sim.time, torch.full((4,), 4 * 0.025))


def test_a_restored_world_is_not_done(shared):
    env = shared("walker_run", 2, episode_length=2)
    td = env.reset()
    state = env.get_state()
    for _ in range(2):
        td = env.step(td.set("action", env.action_spec.zero()))["next"].exclude("reward")
    assert td["truncated"].all()
    td = env.reset(state, set_state=True)
    assert not any(td[name].any() for name in ("done", "terminated", "truncated"))


def test_a_wrong_state_is_refused_and_changes_nothing(shared):
    env = shared("walker_run", 3)
    env.reset()
    whole, before = env.get_state(), env.get_state()
    cases = [
        (None, "'qpos' and 'qvel'"),
        (whole.exclude("qpos"), "'qpos' and 'qvel'"),
        (whole.exclude("qvel"), "'qpos' and 'qvel'"),
    ]
    wrong = {
        "qpos": [torch.zeros(3, 8), torch.zeros(3, 9, 1), torch.full((3, 9), torch.nan)],
        "qvel": [torch.zeros(3, 10), torch.full((3, 9), torch.inf), torch.full((3, 9), 1e39, dtype=torch.double)],
        "qacc_warmstart": [torch.zeros(3, 8), torch.full((3, 9), -torch.inf)],
        "elapsed_steps": [torch.zeros(3, 1), torch.tensor([2**32, 0, 0]), torch.tensor([0, -1, 0])],
        "episode": [torch.zeros(3, 1), torch.tensor([0, -5, 0]), torch.tensor([0, 0, 2**31 - 1])],
    }
    for key, values in wrong.items():
        for value in values:
            state = State({**whole, key: value}, batch_size=[3])
            cases.append((state, f"{key} must (have shape|be finite|lie in)"))
    for state, message in cases:
        with pytest.raises(ValueError, match=message):
            env.reset(state, set_state=True)
        assert_same(env.get_state(), before)


def test_a_quaternion_of_zeros_is_refused(shared):
    env = shared("humanoid_run", 2, **coarse("humanoid_run"))
    env.reset()
    before, state = env.get_state(), env.get_state()
    state["qpos"][1, 3:7] = 0
    with pytest.raises(ValueError, match=r"the quaternion of joint root, qpos\[:, 3:7\], must not be zeros"):
        env.reset(state, set_state=True)
    assert_same(env.get_state(), before)


def test_a_state_dict_has_worlds_that_are_not_finite(shared):
    """Between a step and the reset that follows, as a collector's checkpoint may have them."""
    first, second = (shared("walker_run", 3, copy=copy) for copy in (0, 1))
    td = first.reset()
    first.sim.qpos[1] = torch.nan
    td = first.step(td.set("action", first.action_spec.zero()))["next"]
    assert td["terminated"].flatten().tolist() == [False, True, False]
    second.load_state_dict(first.state_dict())
    request = TensorDict({"_reset": td["terminated"]}, batch_size=[3])
    one, other = (env.reset(request.clone()) for env in (first, second))
    assert (one == other).all()
    one, other = (
        env.step(td.set("action", env.action_spec.one()))["next"] for env, td in ((first, one), (second, other))
    )
    assert one["observation"].isfinite().all()
    assert (one == other).all()


def test_torchrls_transformed_env_never_drops_a_state_silently(shared):
    env = TransformedEnv(shared(), InitTracker())
    entries = {"qpos": torch.zeros(4, 9), "qvel": torch.zeros(4, 9)}
    with pytest.raises(ValueError, match=r"torchrl_loco\.State"):
        env.reset(TensorDict(entries, batch_size=[4]), set_state=True)
    env.reset(State(entries, batch_size=[4]), set_state=True)
    assert (env.get_state()["qpos"] == 0).all()


def test_a_restored_state_is_not_returned(shared):
    """It would become stale in what the next steps return."""
    env = shared()
    env.reset()
    state = env.get_state()
    td = env.reset(state, set_state=True)
    assert not set(State.KEYS) & set(td.keys())
    assert set(state.keys()) == set(State.KEYS) - {"act", "memory", "shared", "model", "pictures"}
    assert env.reset(State(state.to_dict(), batch_size=[4]), set_state=True).device == env.device
    td = torchrl_loco.TransformedEnv(env, InitTracker()).reset(state, set_state=True)
    assert not set(State.KEYS) & set(td.keys())
    assert set(state.keys()) == set(State.KEYS) - {"act", "memory", "shared", "model", "pictures"}
    assert TransformedEnv(env, InitTracker()).reset(state, set_state=True) is state  # TorchRL's own


@for_each("kind", "kinds")
def test_branches_are_copies(shared, kind, actions):
    """All worlds go on from one world's moment: the same actions lead to the same steps, different ones do not."""
    task, protocol, engine = kind
    if task == "walker_unsteady":  # a task in torch may draw other numbers in each world
        return
    env = shared(task, protocol=protocol, engine=engine, reward_terms=True)
    td = env.reset()
    for action in actions(env, 5):
        td = env.step(td.set("action", action))["next"]
    state = env.get_state()
    branch = state.branch(2)
    td = env.reset(branch, set_state=True)
    assert_same(env.get_state(), {key: value[2].expand_as(value) for key, value in state.items()})
    assert (td["observation"] == td["observation"][0]).all()
    same = actions(env, 3)[:, :1].expand(3, 4, -1)
    trace = walk(env, td, same)
    assert (trace["observation"] == trace["observation"][:, :1]).all()
    trace = walk(env, env.reset(branch, set_state=True), actions(env, 3, seed=1))
    assert (trace["observation"][-1, 0] != trace["observation"][-1, 1]).any()
    other = shared(task, 3, protocol=protocol, engine=engine)
    other.reset(state.branch(-1, 3), set_state=True)
    assert torch.equal(other.get_state()["qpos"], state["qpos"][-1:].expand(3, -1))
    branch["qpos"][0] += 1.0  # each has its own memory
    assert (branch["qpos"][0] != branch["qpos"][1]).all()
    with pytest.raises(IndexError, match="the worlds 0 to 3"):
        state.branch(4)
    with pytest.raises(ValueError, match="num_envs must lie in"):
        state.branch(0, 0)


def test_a_file_is_read_without_executing_code(shared, tmp_path):
    env = shared("walker_unsteady", protocol="playground", engine="compiled", reward_terms=True)
    env.reset()
    torch.save(env.get_state(), tmp_path / "state.pt")
    assert (torch.load(tmp_path / "state.pt") == env.get_state()).all()


@for_each("kind", "kinds")
def test_state_dict_goes_on_in_another_environment(shared, kind, actions):
    """With the seed: what is drawn at the next resets is the same too."""
    task, protocol, engine = kind
    options = {"protocol": protocol, "engine": engine, "reward_terms": True, "episode_length": 7, **coarse(task)}
    first, second = (
        torchrl_loco.TransformedEnv(shared(task, seed=5 + copy, copy=copy, **options), StepCounter()) for copy in (0, 1)
    )
    moves = actions(first, 10)
    td = first.reset()
    _, td = first.step_and_maybe_reset(td.set("action", moves[0]))
    second.load_state_dict(first.state_dict())
    assert second.seed == 5
    one, other = walk(first, td, moves), walk(second, td.clone(), moves)
    assert (one == other).all()
    assert one["truncated"].sum() > 3


def test_a_state_dict_of_another_environment_is_refused(shared):
    state = shared("walker_run", 3).state_dict()
    for options, message in [
        ({"num_envs": 4}, r"batch_size=\[3\], this environment has \[4\]"),
        ({"protocol": "dm_control"}, "protocol='playground', this environment has 'dm_control'"),
        ({"task": "humanoid_run"}, "body='walker', this environment has 'humanoid'"),
    ]:
        env = shared(**{"task": "walker_run", "num_envs": 3, **options})
        with pytest.raises(ValueError, match=message):
            env.load_state_dict(state)


def test_a_state_dict_with_numbers_of_other_elements_is_refused():
    settings = {"num_envs": 2, "device": "cpu", "engine": "mujoco"}
    one, other = (
        torchrl_loco.make("walker_walk", randomize=[torchrl_loco.Vary("body_mass", 0.9, 1.1, of=of)], **settings)
        for of in ("torso", "left_foot")
    )
    with pytest.raises(ValueError, match="the state has numbers of other elements that vary, of body_mass"):
        other.load_state_dict(one.state_dict())


def test_a_lenient_state_dict_leaves_the_worlds_alone(shared):
    """EnvCreator loads its shadow environment's into every environment that it makes, whatever their size."""
    env = shared("walker_run", 3, seed=5)
    env.reset()
    before = env.get_state()
    env.load_state_dict(shared("walker_run", 4, seed=6).state_dict(), strict=False)
    env.load_state_dict({})  # what TorchRL's Collector saves of it
    torchrl_loco.TransformedEnv(env).load_state_dict(shared("walker_run", 4).state_dict(), strict=False)
    assert_same(env.get_state(), before)
    with pytest.warns(UserWarning, match="set_state=True"):
        env.reset(before)
    assert env.seed == 5


@pytest.mark.gpu
def test_a_state_from_another_device_is_taken():
    env, other = (torchrl_loco.make("walker_walk", 2, device, seed=0) for device in ("cuda", "cpu"))
    other.rollout(3)
    mask = torch.tensor([[True], [False]])
    other_state = other.get_state()
    env.reset(other_state.clone().set("_reset", mask), set_state=True)
    assert torch.equal(env.get_state()["qpos"][0].cpu(), other_state["qpos"][0])
