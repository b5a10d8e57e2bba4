"""The environments inside TorchRL's own machinery; ParallelEnv is in test_offset.py."""

import functools

import pytest
import torch
from cases import COARSE
from for_each import for_each
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import (
    Compose,
    ConditionalSkip,
    InitTracker,
    MultiAction,
    RewardSum,
    StepCounter,
    TransformedEnv,
    VecNormV2,
)
from torchrl.record import CSVLogger, PixelRenderTransform, VideoRecorder

import torchrl_loco


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")  # for any batch
def test_transforms_count_and_sum_by_world(shared):
    transforms = Compose(InitTracker(), RewardSum(), StepCounter(), VecNormV2(["observation"]))
    env = TransformedEnv(shared("walker_run", 3, episode_length=6, **COARSE), transforms)
    td = env.rollout(14, break_when_any_done=False)
    assert td["is_init"].squeeze(-1)[0].nonzero().squeeze(-1).tolist() == [0, 6, 12]
    assert td["next", "step_count"].squeeze(-1)[0].tolist() == [1, 2, 3, 4, 5, 6, 1, 2, 3, 4, 5, 6, 1, 2]
    sums = td["next", "reward"][:, :6].sum(dim=1)
    torch.testing.assert_close(td["next", "episode_reward"][:, 5], sums)
    assert td["next", "observation"].isfinite().all()


@for_each("reward_terms", [False, True])
def test_worlds_that_a_transform_skips_stay_as_they_are(shared, actions, reward_terms):
    options = {"episode_length": 8, "stagger": True, "reward_terms": reward_terms, **COARSE}
    env, twin = (shared("walker_run", 3, copy=copy, **options) for copy in (0, 1))
    skips = TransformedEnv(env, ConditionalSkip(lambda _: torch.tensor([True, False, False])))
    start, before = skips.reset(), env.get_state()
    action = actions(env, 1)[0]
    expected = twin.step(twin.reset().set("action", action))["next"]
    action[0] = torch.nan  # of the world that is skipped
    after = skips.step(start.clone().set("action", action))["next"]
    assert torch.equal(after["observation"][0], start["observation"][0])
    assert after["reward"][0] == 0.0
    assert not after["done"][0]
    for key in expected.keys(True, True):
        assert torch.equal(after[key][1:], expected[key][1:]), key
    for key, value in env.get_state().items():
        assert torch.equal(value[0], before[key][0]), key
        assert torch.equal(value[1:], twin.get_state()[key][1:]), key
    assert env.health()["total", "non_finite"] == 0


def test_worlds_that_are_done_wait_for_the_end_of_a_chunk_of_actions(shared):
    env = shared("walker_run", 3, episode_length=4, stagger=True, **COARSE)
    chunks = TransformedEnv(env, MultiAction())
    td = chunks.reset()
    left = 4 - env.get_state()["elapsed_steps"]
    after = chunks.step(td.set("action", torch.zeros(3, 4, 6)))["next"]
    assert env.get_state()["elapsed_steps"].tolist() == [4, 4, 4]
    assert left.min() < 4
    assert after["truncated"].all()


@pytest.mark.filterwarnings("ignore:The default value of `auto_register_policy_transforms`")
@for_each("track", [True, False])
def test_collector_collects_what_rollout_does_and_closes(shared, track):
    """The environment that it closes at its end opens again at the next reset."""
    env, twin = (shared("walker_run", copy=copy, episode_length=6, **COARSE) for copy in (0, 1))
    options = {"track_traj_ids": track, "auto_register_policy_transforms": False}
    collector = Collector(env, None, frames_per_batch=32, total_frames=64, **options)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(4, 8), (4, 8)]
    data = torch.cat(batches, dim=1)
    td = twin.reset()
    for step in range(16):
        current, td = twin.step_and_maybe_reset(td.set("action", data["action"][:, step]))
        assert torch.equal(current["observation"], data["observation"][:, step])
        for key in ("observation", "reward", "truncated"):
            assert torch.equal(current["next", key], data["next", key][:, step]), key
    assert env.is_closed
    assert env.rollout(3).shape == (4, 3)


@pytest.mark.ci
def test_multi_sync_collector():
    make = functools.partial(torchrl_loco.make, "walker_walk", 2, "cpu", 0)
    collector = MultiSyncCollector(
        [functools.partial(make, world_offset=2 * k) for k in range(2)],
        None,
        frames_per_batch=16,
        total_frames=16,
        cat_results="stack",
        auto_register_policy_transforms=False,
    )
    try:
        (batch,) = list(collector)
    finally:
        collector.shutdown()
    assert batch.numel() == 16
    assert batch["next", "reward"].isfinite().all()
    first = batch["observation"].reshape(4, 4, 24)[:, 0]
    assert len(first.unique(dim=0)) == 4


def test_video_recorder(shared, tmp_path):
    logger = CSVLogger("run", log_dir=str(tmp_path), video_format="pt")
    recorder = VideoRecorder(logger, tag="walk", skip=1)
    env = TransformedEnv(
        shared("walker_run", 2, **COARSE), Compose(PixelRenderTransform(width=64, height=48), recorder)
    )
    td = env.rollout(4)
    assert td["pixels"].shape == (2, 4, 48, 64, 3)
    assert td["pixels"].dtype == torch.uint8
    recorder.dump()
    (video,) = tmp_path.rglob("*.pt")
    assert torch.load(video).shape[-3:] == (3, 48, 128)  # the worlds side by side
