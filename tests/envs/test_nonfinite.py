"""Numbers that are not finite end the world that they appear in, and no other."""

import itertools
import math

import torch
import warp as wp
from cases import COARSE, ENGINES, coarse
from for_each import for_each
from tensordict import TensorDict

from torchrl_loco.envs.episode import FiniteCheck, Outputs, observer, zero_non_finite
from torchrl_loco.sim import WorldFunc, fill
from torchrl_loco.sim.world_func import WorldKernels

STATE = ("qpos", "qvel", "qacc_warmstart")
BAD = [math.nan, math.inf, -math.inf]


def step_all(env, td, action):
    return env.step(td.set("action", action))["next"]


def assert_goes_on_as(env, twin, after, expected, moves, exact):
    """Both reset the worlds that ended in ``env``; from then on all their worlds do the same."""
    mask = {"_reset": after["done"], "done": after["done"]}
    td = env.reset(after.exclude("reward").update(mask))
    twin_td = twin.reset(expected.exclude("reward").update(mask))
    torch.testing.assert_close(td["observation"], twin_td["observation"], **exact)
    for action in moves:
        td, twin_td = step_all(env, td, action), step_all(twin, twin_td, action)
        torch.testing.assert_close(td["observation"], twin_td["observation"], **exact)
        torch.testing.assert_close(td["reward"], twin_td["reward"], **exact)
        assert not td["terminated"].any()
        td, twin_td = td.exclude("reward"), twin_td.exclude("reward")


@for_each("task, protocol, engine", "kinds")
def test_a_bad_action_ends_only_its_world(shared, task, protocol, engine, device, actions):
    options = {"protocol": protocol, "engine": engine, "reward_terms": task != "walker_backwards", **coarse(task)}
    env, twin = (shared(task, 4, device, copy=copy, **options) for copy in (0, 1))
    exact = {"rtol": 0, "atol": 0} if device == "cpu" or engine == "compiled" else {"rtol": 1e-3, "atol": 1e-3}
    others = torch.tensor([0, 2, 3], device=device)
    ended = torch.tensor([[False], [True], [False], [False]], device=device)
    for bad in BAD:
        td, twin_td = env.reset(), twin.reset()
        good, *more = actions(env, 4)
        action = good.clone()
        action[1, 2] = bad
        after, expected = step_all(env, td, action), step_all(twin, twin_td, good)
        assert torch.equal(after["terminated"], ended)
        assert torch.equal(after["done"], ended)
        assert not after["truncated"].any()
        for value in (after["reward"], after["observation"], *after.get("reward_terms", {}).values()):
            assert (value[1] == 0).all()
        assert all(value.isfinite().all() for value in after.values(True, True))
        torch.testing.assert_close(after["observation"][others], expected["observation"][others], **exact)
        torch.testing.assert_close(after["reward"][others], expected["reward"][others], **exact)
        assert_goes_on_as(env, twin, after, expected, more, exact)


@for_each("kind", "kinds")
def test_a_bad_action_counts_as_zeros_and_a_large_one_is_clipped(shared, kind, actions):
    """All of a bad one, so that the state stays finite."""
    task, protocol, engine = kind
    options = {"protocol": protocol, "engine": engine, **coarse(task)}
    env, twin = (shared(task, copy=copy, reward_terms=True, **options) for copy in (0, 1))
    bad, expected = actions(env, 1)[0], actions(env, 1)[0]
    bad[1, 2], expected[1] = torch.nan, 0.0
    step_all(env, env.reset(), bad)
    step_all(twin, twin.reset(), expected)
    for field in ("qpos", "qvel"):
        assert torch.equal(getattr(env.sim, field), getattr(twin.sim, field))

    good, huge = actions(env, 1)[0], actions(env, 1)[0]
    huge[0, 1], huge[1, 2], huge[2, 0], huge[3, 3] = 1e10, -3e38, 1.5, 2e11
    good[0, 1], good[1, 2], good[2, 0], good[3, 3] = 1.0, -1.0, 1.0, 1.0
    after, expected = step_all(env, env.reset(), huge), step_all(twin, twin.reset(), good)
    assert not after["done"].any()
    assert torch.equal(after["observation"], expected["observation"])
    assert torch.equal(after["reward"], expected["reward"])


@for_each("task, protocol, engine", "kinds")
def test_a_state_that_is_not_finite_ends_only_its_world(shared, task, protocol, engine, actions):
    options = {"protocol": protocol, "engine": engine, "reward_terms": task != "walker_backwards", **coarse(task)}
    env, twin = (shared(task, copy=copy, **options) for copy in (0, 1))
    exact = {"rtol": 0, "atol": 0}
    for field in ("qpos", "qvel"):
        td, twin_td = env.reset(), twin.reset()
        getattr(env.sim, field)[0, -1] = math.nan
        good, *more = actions(env, 3)
        after, expected = step_all(env, td, good), step_all(twin, twin_td, good)
        assert after["terminated"].squeeze(-1).tolist() == [True, False, False, False]
        assert after["reward"][0] == 0
        assert after["observation"].isfinite().all()
        assert torch.equal(after["observation"][1:], expected["observation"][1:])
        assert_goes_on_as(env, twin, after, expected, more, exact)


def test_a_restored_state_beyond_all_bounds_is_not_observed(shared):
    for engine in ENGINES:
        env = shared("walker_run", 2, engine=engine, **COARSE)
        env.reset()
        state = env.get_state()
        state["qvel"][0, 0] = 2e10  # NaN is refused
        td = env.reset(state, set_state=True)
        assert (td["observation"][0] == 0).all()
        assert (td["observation"][1] != 0).any()
        assert env.world.non_finite.torch.tolist() == [True, False]


def test_a_reset_clears_constraints_that_are_not_finite(shared):
    """The solver multiplies unused rows by zero: a NaN would remain."""
    options = {"engine": "mujoco_warp", **COARSE}
    env, twin = (shared("walker_run", copy=copy, **options) for copy in (0, 1))
    for field in ("J", "D"):
        wp.to_torch(getattr(env.sim.data.efc, field)).fill_(torch.nan)
        td, twin_td = env.reset(), twin.reset()
        for _ in range(3):
            td, twin_td = (step_all(e, t, e.action_spec.one() / 2) for e, t in ((env, td), (twin, twin_td)))
            assert torch.equal(td["observation"], twin_td["observation"])


def test_a_world_that_is_not_reset_stays_ended_and_harms_no_other(shared, engine, actions):
    env, twin = (shared("humanoid_run", 3, copy=copy, engine=engine, **COARSE) for copy in (0, 1))
    td, twin_td = env.reset(), twin.reset()
    env.sim.qvel[1] = math.nan
    for action in actions(env, 4):
        td, twin_td = step_all(env, td, action), step_all(twin, twin_td, action)
        assert td["terminated"].squeeze(-1).tolist() == [False, True, False]
        assert torch.equal(td["observation"][::2], twin_td["observation"][::2])
        td, twin_td = td.exclude("reward"), twin_td.exclude("reward")
    mask = torch.tensor([[True], [False], [True]])
    others = TensorDict({"_reset": mask, **td.select("done", "terminated", "truncated")}, batch_size=[3])
    assert env.reset(others)["observation"].isfinite().all()


@wp.struct
class Given:
    observation: wp.array2d[float]
    reward: wp.array[float]


@wp.func
def observe_given(world: int, given: Given, observation: wp.array[float], terms: wp.array[float]) -> float:
    for i in range(observation.shape[0]):
        observation[i] = given.observation[world, i]
    terms[0] = 1.0
    return given.reward[world]


def test_everything_that_can_be_not_finite_is_looked_at():
    for coalesced, spoilt in itertools.product([False, True], [*STATE, "observation", "reward", None]):
        given = {**dict.fromkeys(STATE, (3, 3)), "observation": (3, 4), "reward": (3,)}
        given = {name: torch.ones(shape) for name, shape in given.items()}
        if spoilt is not None:
            given[spoilt].view(3, -1)[1:, -1] = 2e10
        given = {name: wp.from_torch(array) for name, array in given.items()}
        written = {"observation": (3, 4), "reward": (3,), "terms": (3, 1)}
        written = {name: torch.full(shape, 7.0) for name, shape in written.items()}
        outputs = fill(Outputs, **{name: wp.from_torch(array) for name, array in written.items()})
        mask, bad = torch.tensor([True, True, False]), torch.zeros(3, dtype=torch.bool)
        marked, state = wp.from_torch(bad), {name: given.pop(name) for name in STATE}
        observe = observer(observe_given, fill(Given, **given), outputs, marked, 4, coalesced=coalesced)
        check = WorldFunc(zero_non_finite, fill(FiniteCheck, **state, outputs=outputs, non_finite=marked))
        WorldKernels().launch([observe, check], wp.from_torch(mask))
        assert bad.tolist() == [False, spoilt is not None, False]
        for array in written.values():
            assert (array[0] == 1).all()
            assert (array[1] == (spoilt is None)).all()
            assert (array[2] == 7).all()  # beyond the mask


def test_an_ended_world_is_well_again_after_its_state_is_restored(shared, actions):
    env = shared(**COARSE)
    td = env.reset()
    good = env.get_state()
    bad = actions(env, 1)[0]
    bad[1] = torch.nan
    env.step(td.set("action", bad))
    td = env.reset(good, set_state=True)
    assert not td["done"].any()
    assert not td["terminated"].any()
    assert (td["observation"][1] != 0).any()
