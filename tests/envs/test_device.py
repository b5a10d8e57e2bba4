"""The loop stays on its device: graphs, synchronisation, streams, memory, and agreement of CUDA with the CPU."""

import gc

import pytest
import torch
import warp as wp
from cases import KINDS
from for_each import for_each

import torchrl_loco
from torchrl_loco.sim import TorchGraph


@for_each("task", ["walker_run", "quadruped_run"])  # with hooks there are more
def test_each_graph_is_recorded_once(task, device, actions, monkeypatch):
    """And while it is, garbage waits: an environment in it would free memory, which loses a recording on CUDA."""
    captures, capture = [], wp.ScopedCapture
    with monkeypatch.context() as patch:
        patch.setattr(wp, "ScopedCapture", lambda **options: captures.append(gc.isenabled()) or capture(**options))
        recorded_once(task, device, actions, captures)


def recorded_once(task, device, actions, captures):
    env = torchrl_loco.make(task, 3, device, seed=0, episode_length=4)
    assert len(captures) == 2  # step and reset
    td = env.reset()
    for action in actions(env, 10):
        _, td = env.step_and_maybe_reset(td.set("action", action))
    assert len(captures) == 2
    for _ in range(2):
        env.reset(env.get_state(), set_state=True)
    env.set_seed(3)
    env.reset()
    assert captures == 3 * [False]  # the third is what follows set_state


@for_each(
    "task, count, guarded, of_step",
    cpu=[("walker_run", 3, False, 1), ("walker_run", 3, True, 1)],
    cuda=[("walker_run", 3, False, 1), ("walker_run", 20_000, True, 3), ("humanoid_run", 3, True, 3)],
)
def test_launches_of_the_compiled_engine(monkeypatch, tmp_path, task, device, count, guarded, of_step):
    """A control step, with observation, reward, time limit, counters and NaN guard, and the resets after it."""
    launches, launch = [], wp.launch
    nan_dump = tmp_path / "dump.safetensors" if guarded else None
    with monkeypatch.context() as patch:
        patch.setattr(
            wp, "launch", lambda kernel, *args, **options: launches.append(kernel) or launch(kernel, *args, **options)
        )
        env = torchrl_loco.make(task, count, device, seed=0, engine="compiled", episode_length=1, nan_dump=nan_dump)
        assert len(set(launches)) == guarded + of_step + 1  # what the guard keeps is kept before
        launches.clear()
        env.world._launch_step()
        assert len(launches) == of_step
        env.world._launch_reset()
        assert len(launches) == of_step + 1
    assert (env.world.elapsed_steps.torch == 0).all()  # they were reset


@pytest.mark.gpu
@for_each(
    ("task", "protocol", "engine"),
    [*KINDS[:3], ("hopper_hop", "dm_control", "compiled"), ("humanoid_run", "playground", "mujoco_warp")],
)
def test_cuda_agrees_with_the_cpu_after_one_step(task, protocol, engine, actions):
    options = {"seed": 6, "protocol": protocol, "engine": engine}
    envs = [torchrl_loco.make(task, 64, device, **options) for device in ("cpu", "cuda")]
    results = []
    for env in envs:
        td = env.reset()
        after = env.step(td.set("action", actions(env, 1)[0]))["next"]
        state = env.get_state()
        results.append([x.cpu() for x in (after["observation"], after["reward"], state["qpos"], state["qvel"])])
    differs = torch.zeros(64, dtype=torch.bool)
    for cpu, cuda in zip(*results, strict=True):
        differs |= ~torch.isclose(cpu, cuda, rtol=1e-4, atol=1e-4).view(64, -1).all(dim=1)
    # A hopper begins in a pose that the contact solver tears apart: there rounding decides.
    assert differs.sum() <= (task == "hopper_hop")


@pytest.mark.gpu
def test_replays_on_the_current_stream(actions):
    """On a side stream that is kept busy, the step waits for the work queued before it."""
    env, twin = (torchrl_loco.make("walker_walk", 64, "cuda", seed=0) for _ in range(2))
    td, expected = env.reset(), twin.reset()
    moves = actions(env, 5)
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for action in moves:
            late = torch.zeros_like(action)
            torch.cuda._sleep(50_000_000)
            late.copy_(action)
            td = env.step(td.set("action", late))["next"].exclude("reward")
    torch.cuda.current_stream().wait_stream(stream)
    for action in moves:
        expected = twin.step(expected.set("action", action))["next"].exclude("reward")
    torch.testing.assert_close(td["observation"], expected["observation"], rtol=1e-2, atol=1e-2)


@pytest.mark.gpu
def test_device_memory_is_flat_over_10000_steps(cuda_memory):
    env = torchrl_loco.make("walker_walk", 64, "cuda", seed=0, episode_length=100, stagger=True)
    td = env.reset()
    action = torch.rand(64, 6, device="cuda") * 2 - 1

    def used(steps):
        nonlocal td
        for _ in range(steps):
            _, td = env.step_and_maybe_reset(td.set("action", action))
        return cuda_memory()

    used(100)
    assert used(100) == used(9_900)


@pytest.mark.gpu
def test_garbage_is_not_collected_while_torch_records():
    """The memory of an environment in it could not be freed, and the recording would be lost."""
    recording, numbers = [], torch.zeros(1, device="cuda")

    class Lost:
        def __init__(self):
            self.itself = self

        def __del__(self):
            recording.append(torch.cuda.is_current_stream_capturing())

    thresholds = gc.get_threshold()
    gc.set_threshold(1)
    try:
        TorchGraph(lambda: [numbers.add_(1.0) for _ in range(10) if Lost()], torch.device("cuda"))()
    finally:
        gc.set_threshold(*thresholds)
    gc.collect()
    assert recording == 10 * [False]
