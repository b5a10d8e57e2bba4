"""Nothing grows."""

import pytest
import torch

import torchrl_loco


@pytest.mark.gpu
def test_device_memory_is_flat_over_10000_steps():
    env = torchrl_loco.make("walker_walk", 64, "cuda", seed=0, episode_length=100, stagger=True)
    td = env.reset()
    action = torch.rand(64, 6, device="cuda") * 2 - 1

    def used(steps):
        nonlocal td
        for _ in range(steps):
            _, td = env.step_and_maybe_reset(td.set("action", action))
        torch.cuda.synchronize()
        free, total = torch.cuda.mem_get_info()
        return total - free

    used(100)
    assert used(100) == used(9_900)
