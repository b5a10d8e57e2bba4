"""All kernels are compiled before they are needed, and compiling launches none."""

import os
import select
import threading
import time
from pathlib import Path

import pytest
import torch
import warp as wp
from cases import CONFIGS, MODELS

from torchrl_loco.config import sim_config
from torchrl_loco.sim import Simulation, models
from torchrl_loco.sim.compilation import compile_kernels, one_process


@wp.kernel(module="unique", enable_backward=False)
def count(total: wp.array[int]):
    wp.atomic_add(total, 0, 1)


# MuJoCo-Warp without and with a condition in the solver.
@pytest.mark.parametrize(
    ("device", "body", "protocol", "engine", "launches"),
    [
        ("cpu", "walker", "playground", "compiled", 1),
        ("cpu", "humanoid", "dm_control", "mujoco_warp", 100),
        pytest.param("cuda", "humanoid", "dm_control", "mujoco_warp", 100, marks=pytest.mark.gpu),
    ],
)
def test_a_step_finds_every_kernel_compiled(body, protocol, engine, launches, device, monkeypatch):
    config = sim_config(CONFIGS[body], protocol, 2, {"engine": engine})
    sim = Simulation(models.load(MODELS[body]), config, 2, torch.device(device))
    sim.compile(sim.step)
    load, asked = wp.Module.load, []

    def spy(module, device, block_dim=None, *args, **kwargs):
        size = module.options["block_dim"] if block_dim is None else block_dim
        asked.append((device.context, size) in module.execs)
        return load(module, device, block_dim, *args, **kwargs)

    monkeypatch.setattr(wp.Module, "load", spy)
    sim.step()
    assert len(asked) >= launches
    assert all(asked)


def test_compiling_launches_nothing(device):
    total = wp.zeros(1, dtype=int, device=device)
    condition = wp.zeros(1, dtype=int, device=device)

    def launch():
        wp.launch(count, dim=5, outputs=[total], device=device)

    def conditional():
        wp.capture_if(condition, on_true=launch, on_false=launch)
        wp.capture_while(condition, while_body=launch)

    compile_kernels([launch, conditional], wp.get_device(device))
    assert total.numpy()[0] == 0
    launch()
    assert total.numpy()[0] == 5


def test_another_thread_goes_on_launching():
    total = wp.zeros(1, dtype=int, device="cpu")
    outside = wp.zeros(1, dtype=int, device="cpu")

    def launch():
        thread = threading.Thread(target=lambda: wp.launch(count, dim=3, outputs=[outside], device="cpu"))
        thread.start()
        thread.join()
        wp.launch(count, dim=3, outputs=[total], device="cpu")

    compile_kernels([launch], wp.get_device("cpu"))
    assert (total.numpy()[0], outside.numpy()[0]) == (0, 3)


def test_a_module_that_another_process_compiles_is_waited_for():
    reading, writing = os.pipe()
    with one_process("a"):
        if (child := os.fork()) == 0:
            for name in ("b", "a"):
                with one_process(name):
                    os.write(writing, name.encode())
            os._exit(0)
        assert os.read(reading, 1) == b"b"
        assert select.select([reading], [], [], 0.2)[0] == []
    assert os.read(reading, 1) == b"a"
    os.waitpid(child, 0)


def test_an_error_leaves_warp_as_it_was_and_a_damaged_cache_is_named():
    before = wp.Module.load, wp.capture_if, wp.capture_while, wp.get_suggested_block_size

    def launch():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        compile_kernels([launch], wp.get_device("cpu"))
    assert before == (wp.Module.load, wp.capture_if, wp.capture_while, wp.get_suggested_block_size)

    @wp.kernel(enable_backward=False, module="unique")
    def damaged(out: wp.array[int]):
        out[wp.tid()] = 7

    total, device = wp.zeros(1, dtype=int, device="cpu"), wp.get_device("cpu")
    launch = lambda: wp.launch(damaged, 1, outputs=[total], device="cpu")  # noqa: E731
    compile_kernels([launch], device)
    (meta,) = Path(wp.config.kernel_cache_dir).glob(f"wp_{damaged.module.name}_*/*.meta")
    kept = meta.read_bytes()
    damaged.module.unload()
    try:
        meta.write_bytes(b"")
        with pytest.raises(OSError, match=r"cache .* is damaged: delete that folder"):
            compile_kernels([launch], device)
    finally:
        meta.write_bytes(kept)


def test_two_threads_may_compile_at_once():
    """Neither restores what the other has replaced."""
    before, total = wp.Module.load, wp.zeros(1, dtype=int, device="cpu")
    entered = threading.Event()

    def slow():
        entered.set()
        time.sleep(0.1)

    one = threading.Thread(target=compile_kernels, args=([slow], wp.get_device("cpu")))
    other = threading.Thread(target=compile_kernels, args=([lambda: time.sleep(0.2)], wp.get_device("cpu")))
    one.start()
    entered.wait()
    other.start()
    one.join()
    other.join()
    assert wp.Module.load is before
    wp.launch(count, dim=3, outputs=[total], device="cpu")
    assert total.numpy()[0] == 3
