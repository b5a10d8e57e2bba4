"""What repeats, and how exactly: everything on the CPU; on CUDA the starts, and with deterministic=True everything."""

import pytest
import torch
from mujoco_warp import DeterminismType

import torchrl_loco


def rollouts(task, protocol, device, moves, **options):
    """Plays the same rollout twice, over several episodes, and returns observations and rewards of each."""
    results = []
    for _ in range(2):
        env = torchrl_loco.make(task, len(moves[0]), device, 0, protocol, episode_length=40, stagger=True, **options)
        td, seen = env.reset(), []
        for action in moves:
            current, td = env.step_and_maybe_reset(td.set("action", action))
            seen.append(torch.cat([current["next", "observation"], current["next", "reward"]], dim=-1))
        results.append(torch.stack(seen))
        env.close()
    return results


def test_the_cpu_always_repeats(task, protocol):
    moves = torch.rand(60, 4, 6 if "walker" in task else 21, generator=torch.Generator().manual_seed(0)) * 2 - 1
    assert torch.equal(*rollouts(task, protocol, "cpu", moves))


def test_the_setting_reaches_the_physics():
    assert torchrl_loco.make("walker_walk", 1, "cpu").sim.model.opt.deterministic == 0
    env = torchrl_loco.make("walker_walk", 1, "cpu", deterministic=True)
    assert env.sim.model.opt.deterministic == DeterminismType.ALL


@pytest.mark.parametrize("task", ["walker_walk", "humanoid_walk"])
def test_the_setting_changes_the_physics_by_roundings_only(task):
    results = []
    for deterministic in (False, True):
        env = torchrl_loco.make(task, 3, "cpu", 0, deterministic=deterministic)
        td = env.reset()
        for _ in range(3):
            td = env.step(td.set("action", env.action_spec.zero()))["next"].exclude("reward")
        results.append(td["observation"])
    torch.testing.assert_close(*results, rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
def test_cuda_repeats_where_asked(task, protocol):
    size = 6 if "walker" in task else 21
    moves = torch.rand(60, 256, size, generator=torch.Generator().manual_seed(0)).cuda() * 2 - 1
    assert torch.equal(*rollouts(task, protocol, "cuda", moves, deterministic=True))


@pytest.mark.gpu
def test_cuda_repeats_starts_bit_for_bit_and_a_step_nearly(task, protocol):
    starts, steps = [], []
    for _ in range(2):
        env = torchrl_loco.make(task, 1024, "cuda", 0, protocol)
        td = env.reset()
        starts.append(td["observation"].clone())
        steps.append(env.step(td.set("action", env.action_spec.zero()))["next", "observation"])
    assert torch.equal(*starts)
    torch.testing.assert_close(*steps, rtol=1e-3, atol=1e-3)
