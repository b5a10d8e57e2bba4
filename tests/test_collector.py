"""Our collection loop against TorchRL's Collector."""

import pytest
import torch
from cases import coarse
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, RewardSum

import torchrl_loco
from torchrl_loco import RolloutCollector

QUICK = {"episode_length": 7, "on_overflow": "ignore"}
"""Coarse steps make a humanoid fly apart, with more contacts than there are places."""


@pytest.fixture
def make(shared):
    def make(task, wrap, device="cpu", num_envs=4, copy=0, **settings):
        env = shared(task, num_envs, device, stagger=True, copy=copy, **{**QUICK, **coarse(task), **settings})
        return torchrl_loco.TransformedEnv(env, Compose(InitTracker(), RewardSum())) if wrap else env

    return make


def policy(env):
    torch.manual_seed(0)
    layer = torch.nn.Linear(env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1])
    module = torch.nn.Sequential(layer.to(env.device), torch.nn.Tanh())
    return TensorDictModule(module, in_keys=["observation"], out_keys=["action"])


@pytest.mark.parametrize("wrap", [False, True])
def test_exchangeable_with_torchrls_collector(make, body_task, wrap):
    ours, theirs = (make(body_task, wrap, copy=copy) for copy in (0, 1))
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
            assert torch.equal(ours_batch[key], theirs_batch[key]), key
    assert not got[0].requires_grad


def test_endless_and_wrong_sizes(make):
    made = make("walker_run", False)
    batches = iter(RolloutCollector(made, policy(made), frames_per_batch=8))
    first, second = next(batches), next(batches)
    assert first["observation"].data_ptr() != second["observation"].data_ptr()
    going_on = ~first["next", "done"][:, -1].squeeze(-1)
    assert torch.equal(first["next", "observation"][:, -1][going_on], second["observation"][:, 0][going_on])
    for frames in (0, 6, -4):
        with pytest.raises(ValueError, match="positive multiple of the 4 worlds"):
            RolloutCollector(made, policy(made), frames_per_batch=frames)


def test_its_state_goes_on_in_another_collector(make):
    """To the bit; and before the first batch there is nothing to go on from."""
    envs = [make("walker_run", True, copy=copy) for copy in (0, 1)]
    first, second = (RolloutCollector(env, policy(env), frames_per_batch=12) for env in envs)
    second.load_state_dict(first.state_dict())
    first.rollout()
    second.load_state_dict(first.state_dict())
    assert (first.rollout() == second.rollout()).all()


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
@pytest.mark.parametrize("wrap", [False, True])
def test_no_synchronisation(make, task, wrap):
    made = make(task, wrap, "cuda", 256, episode_length=50)
    batches = iter(RolloutCollector(made, policy(made), frames_per_batch=256 * 10))
    next(batches)
    torch.cuda.synchronize()
    try:
        torch.cuda.set_sync_debug_mode("error")
        done = [next(batches)["next", "done"] for _ in range(10)]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert (torch.cat(done, dim=1).sum(dim=1) >= 2).all()


def test_a_closed_environment_begins_new_episodes():
    env = torchrl_loco.make("walker_walk", 2, "cpu", seed=0)
    collector = RolloutCollector(env, lambda td: td.set("action", torch.zeros(2, 6)), frames_per_batch=8)
    collector.rollout()
    env.close()
    batch = collector.rollout()
    assert (batch["observation"][:, 0, 15:] == 0).all()  # at rest
