"""What repeats, and how exactly: everything on the CPU; on CUDA the starts, and a step to rounding."""

import pytest
import torch

import torchrl_loco


def rollouts(task, protocol, moves):
    """Plays the same rollout twice, over several episodes, and returns observations and rewards of each."""
    results = []
    for _ in range(2):
        env = torchrl_loco.make(task, len(moves[0]), "cpu", 0, protocol, episode_length=40, stagger=True)
        td, seen = env.reset(), []
        for action in moves:
            current, td = env.step_and_maybe_reset(td.set("action", action))
            seen.append(torch.cat([current["next", "observation"], current["next", "reward"]], dim=-1))
        results.append(torch.stack(seen))
        env.close()
    return results


def test_the_cpu_always_repeats(task, protocol):
    moves = torch.rand(60, 4, 6 if "walker" in task else 21, generator=torch.Generator().manual_seed(0)) * 2 - 1
    assert torch.equal(*rollouts(task, protocol, moves))


def test_the_cpu_takes_the_setting():
    assert torchrl_loco.make("walker_walk", 1, "cpu", deterministic=True).config.deterministic


@pytest.mark.gpu
def test_cuda_refuses_it():
    with pytest.raises(ValueError, match="deterministic=True holds on the CPU only"):
        torchrl_loco.make("walker_walk", 1, "cuda", deterministic=True)


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
