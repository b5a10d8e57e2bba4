"""What repeats, and how exactly: everything on the CPU; on CUDA what asks for it, and else the starts."""

import pytest
import torch

import torchrl_loco


def rollouts(task, device, protocol, num_envs, steps, **settings):
    """Plays the same rollout twice, over several episodes, and returns observations and rewards of each."""
    results = []
    for _ in range(2):
        env = torchrl_loco.make(task, num_envs, device, 0, protocol, episode_length=40, stagger=True, **settings)
        generator = torch.Generator().manual_seed(0)
        td, seen = env.reset(), []
        for _ in range(steps):
            action = torch.rand(env.action_spec.shape, generator=generator).to(env.device) * 2 - 1
            current, td = env.step_and_maybe_reset(td.set("action", action))
            seen.append(torch.cat([current["next", "observation"], current["next", "reward"]], dim=-1))
        results.append(torch.stack(seen))
        env.close()
    return results


def test_the_cpu_always_repeats(task, protocol):
    assert torch.equal(*rollouts(task, "cpu", protocol, 4, 60))


@pytest.mark.parametrize("task", ["walker_run", "humanoid_run"])
def test_the_setting_leaves_the_physics_as_it_is(task):
    """The order of the constraints decides how sums are rounded, and nothing else."""
    steps = []
    for deterministic in (False, True):
        env = torchrl_loco.make(task, 8, "cpu", 0, "dm_control", deterministic=deterministic)
        td = env.reset()
        for _ in range(5):
            td = env.step(td.set("action", env.action_spec.one()))["next"]
        steps.append(td["observation"])
    torch.testing.assert_close(*steps, rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
def test_cuda_repeats_bit_for_bit_where_asked(task, protocol):
    assert torch.equal(*rollouts(task, "cuda", protocol, 1024, 60, deterministic=True))


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
