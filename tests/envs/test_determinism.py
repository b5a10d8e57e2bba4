"""What repeats to the bit: everything on the CPU; on CUDA the starts, and with deterministic=True everything."""

import pytest
import torch

import torchrl_loco


def rollouts(task, device, protocol, num_envs, steps, **settings):
    """Plays the same rollout twice, over several episodes, and returns observations and rewards of each."""
    results = []
    for _ in range(2):
        env = torchrl_loco.make(task, num_envs, device, 0, protocol, episode_length=20, stagger=True, **settings)
        generator = torch.Generator().manual_seed(0)
        td, seen = env.reset(), []
        for _ in range(steps):
            action = torch.rand(env.action_spec.shape, generator=generator).to(env.device) * 2 - 1
            current, td = env.step_and_maybe_reset(td.set("action", action))
            seen.append(torch.cat([current["next", "observation"], current["next", "reward"]], dim=-1))
        results.append(torch.stack(seen))
        env.close()
    return results


@pytest.mark.parametrize(("task", "protocol"), [("walker_run", "playground"), ("humanoid_run", "dm_control")])
def test_the_cpu_always_repeats(shared, task, protocol, actions):
    """An environment that was used, and in which worlds were not finite, does what a new one does."""
    options = {"protocol": protocol, "episode_length": 20, "stagger": True}
    used, new = shared(task, **options), torchrl_loco.make(task, 4, "cpu", 0, **options)
    used.rollout(10)
    used.step(used.reset().set("action", torch.full(used.action_spec.shape, torch.nan)))
    used.set_seed(0)
    td, new_td = used.reset(), new.reset()
    assert torch.equal(td["observation"], new_td["observation"])
    for action in actions(new, 30):
        current, td = used.step_and_maybe_reset(td.set("action", action))
        expected, new_td = new.step_and_maybe_reset(new_td.set("action", action))
        assert (current == expected).all()


def test_the_setting_leaves_the_physics_as_it_is(shared):
    """The order of the constraints decides how sums are rounded, and nothing else."""
    steps = []
    for deterministic in (False, True):
        env = shared("humanoid_run", 8, protocol="dm_control", deterministic=deterministic)
        td = env.reset()
        for _ in range(5):
            td = env.step(td.set("action", env.action_spec.one()))["next"]
        steps.append(td["observation"])
    torch.testing.assert_close(*steps, rtol=1e-3, atol=1e-3)


@pytest.mark.gpu
def test_cuda_repeats_bit_for_bit_with_deterministic(body_task, protocol):
    assert torch.equal(*rollouts(body_task, "cuda", protocol, 1024, 60, deterministic=True))


@pytest.mark.gpu
def test_cuda_repeats_starts_bit_for_bit_and_a_step_nearly(body_task, protocol):
    starts, steps = [], []
    for _ in range(2):
        env = torchrl_loco.make(body_task, 1024, "cuda", 0, protocol)
        td = env.reset()
        starts.append(td["observation"].clone())
        steps.append(env.step(td.set("action", env.action_spec.zero()))["next", "observation"])
    assert torch.equal(*starts)
    torch.testing.assert_close(*steps, rtol=1e-3, atol=1e-3)
