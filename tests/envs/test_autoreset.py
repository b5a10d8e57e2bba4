"""Resets by mask: the same data as TorchRL's way, without synchronisation with the host."""

import pytest
import torch
from cases import STAGGERED, coarse
from for_each import for_each
from tensordict import LazyStackedTensorDict
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, StepCounter, VecNormV2
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv

import torchrl_loco


def transforms():
    return Compose(InitTracker(), RewardSum(), StepCounter(max_steps=5))


def step_by_step(env, maybe_reset):
    """Returns a function like ``step_and_maybe_reset``, from its parts."""

    def step(td):
        td = env.step(td)
        return td, maybe_reset(env._step_mdp(td))

    return step


def play(env, moves, step_and_maybe_reset):
    """Steps and resets, and carries other outputs of the policy along, one with a name that states have, too."""
    td, trace = env.reset(), []
    for i, action in enumerate(moves):
        td = td.set("action", action).set("loc", torch.full_like(action, i + 1.0)).set("memory", action + i)
        td, after = step_and_maybe_reset(td)
        trace.append(td.clone().set("carried", after.clone()))
        td = after
    return torch.stack(trace)


@for_each("kind", "kinds")
def test_same_data_as_torchrl(shared, kind, actions):
    """Worlds end at different times: at the environment's limit, at a transform's, and by a NaN action."""
    task, protocol, engine = kind
    # Any two of the three options in all their combinations.
    for wrap, at_once, reward_terms in ((False, False, True), (False, True, False), (True, False, False), (True,) * 3):
        options = {"protocol": protocol, "engine": engine, **STAGGERED, **coarse(task)}
        options |= {"reward_terms": True} if reward_terms else {}
        theirs, ours = (shared(task, copy=copy, **options) for copy in (0, 1))
        if wrap:
            theirs = TorchRLTransformedEnv(theirs, transforms())
            ours = torchrl_loco.TransformedEnv(ours, transforms())
        moves = actions(ours, 20)
        moves[7, 3] = torch.nan
        expected = play(theirs, moves, step_by_step(theirs, lambda td, env=theirs: EnvBase.maybe_reset(env, td)))
        got = play(ours, moves, ours.step_and_maybe_reset if at_once else step_by_step(ours, ours.maybe_reset))
        assert set(expected.keys(True, True)) == set(got.keys(True, True))
        for key in expected.keys(True, True):
            message = f"{key}, wrapped {wrap}, at once {at_once}, terms {reward_terms}"
            torch.testing.assert_close(got[key], expected[key], rtol=0, atol=0, equal_nan=True, msg=message)
        ended = expected["next", "done"].squeeze(-1)
        assert ended.any(dim=1).sum() > 5
        assert not ended.all(dim=1).any()


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")  # for any batch
@for_each("nested", [False, True])
def test_statistics_count_what_torchrl_counts(shared, actions, nested):
    """A transform that learns from a reset may not be reset at a step after which no world is done."""
    traces, counts = [], []
    for copy, wrapper in enumerate((TorchRLTransformedEnv, torchrl_loco.TransformedEnv)):
        base = shared("walker_run", 4, copy=copy, episode_length=6, stagger=True, **coarse("walker_run"))
        norm = VecNormV2(in_keys=["observation"], reduce_batch_dims=True)
        env = wrapper(base, Compose(RewardSum(), norm))
        if nested:
            env = wrapper(env, StepCounter(), auto_unwrap=False)
        traces.append(play(env, actions(base, 20), env.step_and_maybe_reset))
        counts.append(norm._count["observation"].item())
    assert counts[0] == counts[1]
    assert (traces[0] == traces[1]).all()


def test_hooks_of_torchrl_are_called():
    env, called = torchrl_loco.make("walker_run", 2, "cpu", 0, **coarse("walker_run")), []
    env._post_step_mdp_hooks = lambda td, after: called.append(1) or (td, after)
    env.step_and_maybe_reset(env.rand_action(env.reset()))
    assert called == [1]


def test_a_step_of_no_world_changes_nothing_and_done_may_be_missing(shared):
    env = shared("walker_run", 2, **coarse("walker_run"))
    td = env.rand_action(env.reset()).set("_step", torch.zeros(2, dtype=torch.bool))
    before = env.get_state()
    current, _ = env.step_and_maybe_reset(td)
    assert (env.get_state() == before).all()
    assert torch.equal(current["next", "observation"], td["observation"])

    # What a rollout goes on from need not say what is done.
    for each in (env, torchrl_loco.TransformedEnv(env)):
        begin = each.reset().select("observation")
        assert each.rollout(3, auto_reset=False, tensordict=begin, break_when_any_done=False).shape == (2, 3)


def test_a_step_begins_without_the_last_reward_and_with_names(shared):
    """A loop may go on with what is under ``next``, where a reward is. Names of dimensions stay."""
    env = shared("walker_run", 3)
    td = env.rand_action(env.reset()).set("reward", torch.ones(3, 1))
    td.names = ["world"]
    td, after = env.step_and_maybe_reset(td)
    assert after.names == ["world"]
    assert "reward" not in after
    assert "reward" in td["next"]


@for_each("kind", "kinds")
def test_an_empty_mask_changes_nothing(shared, kind):
    task, protocol, engine = kind
    env = shared(task, protocol=protocol, engine=engine, reward_terms=True)
    td = env.rollout(3)[:, -1]["next"]
    before = env.get_state()
    after = env.reset(td.clone().set("_reset", torch.zeros(4, 1, dtype=torch.bool)))
    assert torch.equal(after["observation"], td["observation"])
    assert (env.get_state() == before).all()


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
@for_each("wrap", [False, True])
@for_each("task", ["walker_run", "humanoid_run", "quadruped_run"])
def test_no_synchronisation_over_100_steps_with_resets(task, wrap):
    env = torchrl_loco.make(task, 256, "cuda", seed=0, episode_length=50, stagger=True)
    env = torchrl_loco.TransformedEnv(env, transforms()) if wrap else env
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


def test_worlds_go_on_beside_one_that_is_not_finite():
    """Which is held as it is, until it is reset."""
    env = torchrl_loco.make("walker_walk", 3, "cpu", 0)
    td = env.reset()
    env.sim.qvel[1] = torch.inf
    after = env.step(td.set("action", torch.zeros(3, 6)))["next"]
    assert after["done"].flatten().tolist() == [False, True, False]
    part = after.exclude("reward").set("action", torch.zeros(3, 6)).set("_step", ~after["done"])
    held = env.step(part)["next"]
    assert held["done"].flatten().tolist() == [False, True, False]
    assert not torch.equal(held["observation"][0], after["observation"][0])


class Steadied(torchrl_loco.WalkerWalk):
    """Its controls follow the forces of the ground in the last step."""

    def control(self, s, action):
        force = s.contact_force("(torso|.*_(thigh|leg|foot))", history=True)[..., 2]
        return action + 1e-3 * force.flatten(1).mean(-1, keepdim=True)


def test_a_world_that_waits_goes_on_under_the_forces_of_its_last_step():
    env = Steadied(2, "cpu", 0)
    actions = 2 * torch.rand(60, 2, 6, generator=torch.Generator().manual_seed(0)) - 1
    reached = []
    for waits in (False, True):
        env.set_seed(0)
        td = env.reset()
        for i, action in enumerate(actions):
            if waits and i % 5 == 4:
                part = td.select("done").set("action", action).set("_step", torch.tensor([[True], [False]]))
                after = env.step(part)["next"]
                assert torch.equal(after["observation"][1], td["observation"][1])  # which was not passed
                td = after
            td = env.step(td.set("action", action))["next"]
        reached.append(td["observation"][1])
    assert torch.equal(*reached)


def test_worlds_of_a_lazy_stack(shared):
    """As TorchRL stacks TensorDicts of single worlds."""
    ends = []
    for stack in (torch.stack, LazyStackedTensorDict.lazy_stack):
        env = shared("walker_run", 3, episode_length=2)
        td = env.reset()
        for _ in range(2):
            td = stack(list(td.set("action", torch.full((3, 6), 0.3)).unbind(0)))
            _, td = env.step_and_maybe_reset(td)
        ends.append(td)
    assert (ends[0].exclude("action") == ends[1].exclude("action")).all()
