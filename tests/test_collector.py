"""Our collection loop against TorchRL's Collector."""

import contextlib
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from cases import STAGGERED, coarse
from for_each import for_each
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch._subclasses import FakeTensorMode
from torchrl.collectors import Collector
from torchrl.envs import (
    CatFrames,
    Compose,
    FiniteTensorDictCheck,
    InitTracker,
    ObservationNorm,
    RewardSum,
    StepCounter,
    TransformedEnv,
    VecNormV2,
)
from torchrl.envs.utils import ExplorationType, exploration_type

import torchrl_loco
from torchrl_loco import RolloutCollector, collector
from torchrl_loco.collector import stack, stacks_slowly, what_forbids_recording
from torchrl_loco.tasks.walker import WalkerRun


@pytest.fixture
def make(shared):
    def make(task, wrap, num_envs=4, copy=0, **settings):
        env = shared(task, num_envs, copy=copy, **{**STAGGERED, **coarse(task), **settings})
        return torchrl_loco.TransformedEnv(env, Compose(InitTracker(), RewardSum())) if wrap else env

    return make


def policy(env):
    torch.manual_seed(0)
    layer = torch.nn.Linear(env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1])
    module = torch.nn.Sequential(layer.to(env.device), torch.nn.Tanh())
    return TensorDictModule(module, in_keys=["observation"], out_keys=["action"])


@for_each("kind", "kinds")
def test_exchangeable_with_torchrls_collector(make, kind):
    task, protocol, engine = kind
    for wrap in (False, True):
        ours, theirs = (make(task, wrap, copy=copy, protocol=protocol, engine=engine) for copy in (0, 1))
        settings = {"frames_per_batch": 20, "total_frames": 60}
        reference = Collector(
            theirs, policy(theirs), track_traj_ids=False, auto_register_policy_transforms=False, **settings
        )
        got = list(RolloutCollector(ours, policy(ours), **settings))
        expected = [batch.clone() for batch in reference]
        reference.shutdown()
        assert [batch.shape for batch in got] == [batch.shape for batch in expected] == [(4, 5)] * 3
        for ours_batch, theirs_batch in zip(got, expected, strict=True):
            assert set(ours_batch.keys(True, True)) == set(theirs_batch.keys(True, True))
            assert ours_batch.names == theirs_batch.names
            for key in theirs_batch.keys(True, True):
                assert torch.equal(ours_batch[key], theirs_batch[key]), (key, wrap)
        assert not got[0].requires_grad


def test_a_step_that_a_subclass_overrides_is_called():
    for name in ("step_and_maybe_reset", "_step_and_maybe_reset"):
        calls = []

        def override(self, tensordict, name=name, calls=calls):
            calls.append(name)
            return getattr(WalkerRun, name)(self, tensordict)

        counted = type("Counted", (WalkerRun,), {name: override})(2, "cpu", 0, **STAGGERED)
        RolloutCollector(counted, policy(counted), frames_per_batch=6).rollout()
        assert calls == [name] * 3


def test_a_policy_explores_as_was_asked_for(make):
    made, seen = make("walker_run", False, num_envs=2), []

    def choose(td):
        seen.append(exploration_type())
        return td.set("action", torch.zeros(2, 6))

    for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        RolloutCollector(made, choose, frames_per_batch=4, exploration_type=kind).rollout()
        assert seen[-2:] == [kind] * 2
    assert len(seen) == 4


def test_endless_and_wrong_sizes(make):
    made = make("walker_run", False)
    batches = iter(RolloutCollector(made, policy(made), frames_per_batch=8))
    first, second = next(batches), next(batches)
    assert first["observation"].data_ptr() != second["observation"].data_ptr()
    going_on = ~first["next", "done"][:, -1].squeeze(-1)
    assert torch.equal(first["next", "observation"][:, -1][going_on], second["observation"][:, 0][going_on])
    assert next(iter(RolloutCollector(made, policy(made), frames_per_batch=8, total_frames=0)), None) is None
    for frames in (0, 6, -4):
        with pytest.raises(ValueError, match="positive multiple of the 4 worlds"):
            RolloutCollector(made, policy(made), frames_per_batch=frames)
    with pytest.raises(TypeError, match="policy must be a function or module"):
        RolloutCollector(made, None, frames_per_batch=8)
    with pytest.raises(TypeError, match="policy must return the TensorDict with an action, got NoneType"):
        RolloutCollector(made, lambda td: None, frames_per_batch=8).rollout()


def test_its_state_goes_on_in_another_collector(make):
    """To the bit; and before the first batch there is nothing to go on from."""
    envs = [make("walker_run", True, copy=copy) for copy in (0, 1)]
    first, second = (RolloutCollector(env, policy(env), frames_per_batch=12) for env in envs)
    second.load_state_dict(first.state_dict())
    first.rollout()
    second.load_state_dict(first.state_dict())
    assert (first.rollout() == second.rollout()).all()


def test_its_state_has_the_seed(shared):
    """On which the next episodes depend: where none is given, each process draws another."""
    envs = [shared("walker_run", 3, copy=copy, seed=7 + copy, episode_length=5) for copy in (0, 1)]
    first, second = (RolloutCollector(env, policy(env), frames_per_batch=30) for env in envs)
    first.rollout()
    second.load_state_dict(first.state_dict())
    assert (first.rollout() == second.rollout()).all()
    assert envs[1].seed == 7
    elsewhere = shared("walker_run", 3, world_offset=4)
    with pytest.raises(ValueError, match="the state is of 3 worlds from 0 on, not 3 from 4"):
        RolloutCollector(elsewhere, policy(elsewhere), frames_per_batch=30).load_state_dict(first.state_dict())


def test_after_an_interrupted_batch_the_next_begins_with_what_the_worlds_show(shared):
    """Whether the policy fails before a step, or the step itself in its midst, after which all worlds begin anew."""
    env = torchrl_loco.TransformedEnv(shared("walker_run", 4), StepCounter())
    calls, act = [], policy(env)

    def failing(td):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return act(td)

    collector = RolloutCollector(env, failing, frames_per_batch=4 * 5)
    with pytest.raises(KeyboardInterrupt):
        collector.rollout()
    assert (collector.state_dict()["carried"]["step_count"] == 3).all()
    assert (collector.rollout()["next", "step_count"][:, 0] == 4).all()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(env.base_env.world, "reset_masked", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            collector.rollout()
    assert (collector.rollout()["next", "step_count"][:, 0] == 1).all()


class Noisy(torch.nn.Module):
    """Writes a stochastic action, its mean, and a count of the steps that the world has been alive."""

    in_keys, out_keys = ("observation", "steps"), ("loc", "action", "steps")

    def __init__(self, env):
        super().__init__()
        torch.manual_seed(0)
        layer = torch.nn.Linear(env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1])
        self.layer = layer.to(env.device)

    def forward(self, td):
        loc = self.layer(td["observation"]).tanh()
        noise = torch.randn_like(loc) if exploration_type() == ExplorationType.RANDOM else 0
        steps = td.get("steps", None)
        td["steps"] = torch.ones_like(loc[..., :1]) if steps is None else steps + 1
        return td.set("loc", loc).set("action", (loc + noise).clamp(-1, 1))


class Counting(TensorDictModule):
    """Reads what it wrote a step before, and does not say so, as TorchRL's noise that is correlated in time."""

    def forward(self, td):
        before = td.get("count", None)
        return td.set("count", torch.ones(4, 1) if before is None else before + 1)


def test_what_the_policy_carries_along_starts_anew_with_an_episode_and_all_else_stays(make):
    made = make("walker_run", False)
    batch = RolloutCollector(made, Noisy(made), frames_per_batch=4 * 20).rollout()
    begins = torch.cat([torch.ones(4, 1, 1, dtype=torch.bool), batch["next", "done"][:, :-1]], dim=1)
    assert begins.sum() > 8
    assert ((batch["steps"] == 1) == begins).all()

    made.set_seed(0)
    counting = TensorDictSequential(Counting(torch.nn.Identity(), in_keys=[], out_keys=["count"]), policy(made))
    collector, other = (RolloutCollector(made, counting, frames_per_batch=4 * 20) for _ in range(2))
    batch = collector.rollout()
    assert ((batch["count"] == 1) == begins).all()
    state = collector.state_dict()
    expected = collector.rollout()["count"]
    assert (expected[:, 0] > 1).any()
    other.load_state_dict(state)
    assert torch.equal(other.rollout()["count"], expected)

    # Another returns the action alone.
    for wrap in (False, True):
        made = make("walker_run", wrap)
        act = policy(made)
        made.set_seed(0)
        expected = RolloutCollector(made, act, frames_per_batch=4 * 10).rollout()
        made.set_seed(0)
        alone = RolloutCollector(made, lambda td: act(td.clone()).select("action"), frames_per_batch=4 * 10)  # noqa: B023
        found = alone.rollout()
        assert set(found.keys(True, True)) == set(expected.keys(True, True))
        assert (found == expected).all()


def test_why_batches_are_not_recorded(make):
    made = make("walker_run", False)
    chosen = policy(made)
    assert "CUDA" in RolloutCollector(made, chosen, frames_per_batch=8).step_by_step
    summed = torchrl_loco.TransformedEnv(made, RewardSum())
    checked = torchrl_loco.TransformedEnv(made, Compose(RewardSum(), FiniteTensorDictCheck()))
    of_env = {"device": torch.device("cuda"), "engine": "compiled", "compile_hooks": True}
    changes = ({}, {"engine": "mujoco_warp"}, {"compile_hooks": False})
    cuda, slow, printing = (SimpleNamespace(**of_env | change) for change in changes)
    assert what_forbids_recording(made, cuda, chosen) is what_forbids_recording(summed, cuda, chosen) is None
    assert "'mujoco_warp'" in what_forbids_recording(made, slow, chosen)
    assert "hooks at every step" in what_forbids_recording(made, printing, chosen)
    assert "no nn.Module" in what_forbids_recording(made, cuda, lambda td: td)
    for env in (checked, torchrl_loco.TransformedEnv(checked, RewardSum())):
        assert "FiniteTensorDictCheck may keep" in what_forbids_recording(env, cuda, chosen)


class Remembering(torch.nn.Module):
    """Counts its steps in the TensorDict."""

    def forward(self, td):
        steps = td.get("steps", torch.zeros(*td.batch_size, 1)) + 1
        return td.update({"steps": steps, "action": torch.zeros(*td.batch_size, 6)})


@for_each("recorded", [False, True])
def test_worlds_that_begin_anew_forget_what_a_policy_keeps(make, recorded, monkeypatch):
    """With a stand-in for CUDA's graphs, which computes again what they replay."""
    if recorded:
        monkeypatch.setattr(collector, "what_forbids_recording", lambda *_: None)
        monkeypatch.setattr(collector, "noted_synchronisation", lambda: contextlib.nullcontext([]))
        monkeypatch.setattr(collector, "TorchGraph", lambda work, *_, **__: work)
    made = RolloutCollector(make("walker_stand", False, stagger=False), Remembering(), frames_per_batch=4 * 5)
    for _ in range(4):
        made.rollout()
    assert made.replays == recorded
    made.load_state_dict({})
    assert made.rollout()["steps"][0, :, 0].tolist() == [1, 2, 3, 4, 5]


def on_cuda(task, wrap=False, num_envs=64, **settings):
    options = {"seed": 0, "stagger": True, "episode_length": 13, **settings}
    env = torchrl_loco.make(task, num_envs, "cuda", **options)
    return torchrl_loco.TransformedEnv(env, Compose(InitTracker(), RewardSum())) if wrap else env


two_bodies = for_each("task", ["walker_run", "humanoid_run"])  # traced, and by lanes
RANDOM, DETERMINISTIC = ExplorationType.RANDOM, ExplorationType.DETERMINISTIC


@pytest.mark.gpu
@for_each(
    ("task", "protocol", "wrap", "exploration"),
    [
        ("walker_run", "playground", False, RANDOM),
        ("walker_run", "playground", True, DETERMINISTIC),
        ("humanoid_run", "dm_control", True, RANDOM),
        ("hopper_hop", "dm_control", False, DETERMINISTIC),
    ],
)
def test_recorded_batches_equal_steps_taken_one_by_one(task, protocol, wrap, exploration):
    """To the bit: across resets, with noise, and while the weights change in place."""
    batches = []
    for recorded in (True, False):
        env = on_cuda(task, wrap, protocol=protocol)
        chosen = Noisy(env)
        collector = RolloutCollector(env, chosen, frames_per_batch=64 * 5, exploration_type=exploration)
        assert collector.step_by_step is None
        if not recorded:
            collector.step_by_step = "as asked"
        torch.cuda.manual_seed(3)
        found = []
        for _ in range(5):
            found.append(collector.rollout())
            chosen.layer.weight.data.add_(0.01)
        assert (collector.step_by_step is None) == recorded
        batches.append(torch.cat(found, dim=1))
        env.close()
    got, expected = batches
    assert expected["next", "done"].sum() > 64
    assert set(got.keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        assert torch.equal(got[key], expected[key]), key


def test_what_is_stacked_slowly():
    """Rows of 16 to 128 bytes that are no multiple of 16, on CUDA."""
    with FakeTensorMode():
        for numbers, slow in ((4, False), (5, True), (6, True), (8, False), (31, True), (32, False), (33, False)):
            assert stacks_slowly(torch.empty(5, 2, numbers, device="cuda"), 2) == slow, numbers
    assert not stacks_slowly(torch.zeros(5, 6), 1)
    assert not stacks_slowly("a text", 1)


@pytest.mark.gpu
def test_steps_are_stacked_as_tensordict_does():
    def a_step(**entries):
        entries = {"action": torch.randn(5, 6), "note": "a text", **entries}
        after = {"observation": torch.randn(5, 67), "velocity": torch.randn(5, 9)}
        return TensorDict({**entries, "next": after}, batch_size=[5], device="cuda")

    steps = [a_step() for _ in range(3)]
    got, expected = stack(steps), TensorDict.stack(steps, dim=-1)
    assert got.batch_size == expected.batch_size == (5, 3)
    assert set(got.keys(True)) == set(expected.keys(True))
    assert got["note"] == expected["note"]
    for key in ("action", ("next", "observation"), ("next", "velocity")):
        assert torch.equal(got[key], expected[key])
        assert got[key].is_contiguous()
    with pytest.raises(RuntimeError, match="sets of keys"):
        stack([*steps, a_step(more=torch.zeros(5))])


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
@for_each(("task", "wrap"), [("walker_run", False), ("humanoid_run", True), ("quadruped_run", True)])
def test_no_synchronisation(task, wrap):
    env = on_cuda(task, wrap, 256, episode_length=50)
    batches = iter(RolloutCollector(env, policy(env), frames_per_batch=256 * 10))
    for _ in range(3):  # two step by step, one to record
        next(batches)
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("error")
        done = [next(batches)["next", "done"] for _ in range(10)]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert (torch.cat(done, dim=1).sum(dim=1) >= 2).all()


@pytest.mark.gpu
@two_bodies
def test_recorded_batches_share_no_memory_and_need_no_more_of_it(task):
    env = on_cuda(task)
    collector = RolloutCollector(env, policy(env), frames_per_batch=64 * 5)
    first, second, third = (collector.rollout() for _ in range(3))
    kept = third.clone()
    assert len({batch["observation"].data_ptr() for batch in (first, second, third)}) == 3
    used = None
    for i in range(1000):
        collector.rollout()
        if i == 10:
            torch.cuda.synchronize()
            used = torch.cuda.memory_allocated(), torch.cuda.memory_reserved()
    torch.cuda.synchronize()
    assert (torch.cuda.memory_allocated(), torch.cuda.memory_reserved()) == used
    assert (third == kept).all()


@pytest.mark.gpu
@two_bodies
def test_a_recording_goes_on_from_a_state_and_from_a_closed_environment(task):
    env, other = on_cuda(task), on_cuda(task)
    collector, second = (RolloutCollector(made, policy(made), frames_per_batch=64 * 5) for made in (env, other))
    for _ in range(4):
        collector.rollout()
        second.rollout()
    state = collector.state_dict()
    expected = collector.rollout()
    second.load_state_dict(state)
    assert (second.rollout() == expected).all()
    collector.load_state_dict(state)
    assert (collector.rollout() == expected).all()
    env.close()
    again = [collector.rollout() for _ in range(4)]
    assert (again[0]["observation"][:, 0, -9:] == 0).all()  # at rest
    assert collector.step_by_step is None
    for before, after in pairwise(again):
        going_on = ~before["next", "done"][:, -1].squeeze(-1)
        assert torch.equal(before["next", "observation"][:, -1][going_on], after["observation"][:, 0][going_on])


@pytest.mark.gpu
def test_what_cannot_be_recorded_is_told_and_runs_step_by_step(caplog):
    class Waits(Noisy):
        def forward(self, td):
            td = super().forward(td)
            assert td["action"].isfinite().all()
            return td

    class Surprises(Noisy):
        """Waits for the device at its twelfth call, when it is being recorded."""

        calls = 0

        def forward(self, td):
            self.calls += 1
            td = super().forward(td)
            assert self.calls != 12 or td["action"].isfinite().all()
            return td

    def collected(chosen, env):
        caplog.clear()
        collector = RolloutCollector(env, chosen, frames_per_batch=64 * 5)
        torch.cuda.manual_seed(3)
        return collector, torch.cat([collector.rollout() for _ in range(4)], dim=1)

    env = on_cuda("walker_walk")
    expected = collected(Noisy(env), env)[1]
    for kind, told in ((Waits, "waits for the device"), (Surprises, "cannot be recorded")):
        env = on_cuda("walker_walk")
        collector, batch = collected(kind(env), env)
        assert told in collector.step_by_step
        assert told in caplog.text
        assert (batch == expected).all()
        assert torch.cuda.current_stream() == torch.cuda.default_stream()

    env = on_cuda("walker_walk")
    chosen = Noisy(env)
    collector, _ = collected(chosen, env)
    assert collector.step_by_step is None
    chosen.layer.weight = torch.nn.Parameter(torch.zeros_like(chosen.layer.weight))
    assert (collector.rollout()["loc"] == chosen.layer.bias.tanh()).all()
    assert "weights were replaced" in collector.step_by_step


def test_a_closed_environment_begins_new_episodes():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    collector = RolloutCollector(env, lambda td: td.set("action", torch.zeros(2, 6)), frames_per_batch=8)
    collector.rollout()
    env.close()
    batch = collector.rollout()
    assert (batch["observation"][:, 0, 15:] == 0).all()  # at rest


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")  # for any batch
def test_what_transforms_have_learned_goes_on(make):
    """To the bit, from a state that is a copy: the collector that it was taken from does not change it."""

    def collector(copy):
        parts = CatFrames(2, dim=-1, in_keys=["observation"]), VecNormV2(["observation"], reduce_batch_dims=True)
        env = torchrl_loco.TransformedEnv(make("walker_run", False, copy=copy), Compose(*parts))
        return RolloutCollector(env, policy(env), frames_per_batch=12)

    first, second = collector(0), collector(1)
    for _ in range(3):
        first.rollout()
    state, expected = first.state_dict(), first.rollout()
    for _ in range(2):
        second.load_state_dict(state)
        assert (second.rollout() == expected).all()


def test_transforms_without_a_state_are_named(make, caplog):
    env = torchrl_loco.TransformedEnv(make("walker_run", False), ObservationNorm(0.0, 1.0, in_keys=["observation"]))
    collector = RolloutCollector(env, policy(env), frames_per_batch=12)
    collector.rollout()
    collector.load_state_dict({**collector.state_dict(), "transforms": {}})
    assert caplog.messages == ["transforms that begin anew: ObservationNorm"]


def test_its_state_goes_on_where_the_reward_has_other_terms():
    def collector(*names):
        reward = lambda self, s: {name: s.qpos[:, 0] * 0 + len(name) for name in names}  # noqa: E731
        env = type("Task", (WalkerRun,), {"reward": reward})(2, "cpu", 0, reward_terms=True, **STAGGERED)
        return RolloutCollector(env, policy(env), frames_per_batch=6)

    first = collector("a", "bb")
    first.rollout()
    state, expected = first.state_dict(), first.rollout()["next", "observation"]
    for names in (("bb", "a"), ("a", "bb", "ccc"), ("ccc",)):
        other = collector(*names)
        other.load_state_dict(state)
        after = other.rollout()["next"]
        assert torch.equal(after["observation"], expected)
        found = {name: term.unique().item() for name, term in after["reward_terms"].items()}
        assert found == {name: len(name) for name in names}


def test_a_state_does_not_stay_in_batches_of_torchrls_transforms():
    """Whose ``reset`` returns it, and a batch would repeat it at every step."""
    collectors = []
    for _ in range(2):
        env = TransformedEnv(torchrl_loco.make("walker_stand", 2, "cpu", 0), RewardSum())
        collectors.append(RolloutCollector(env, env.rand_action, frames_per_batch=8))
    before = collectors[0].rollout()
    collectors[1].load_state_dict(collectors[0].state_dict())
    assert set(collectors[1].rollout().keys(True)) == set(before.keys(True))
