"""The memory of a simulation is known, and refused if it is too much, before anything is allocated."""

import dataclasses
import types

import mujoco
import pytest
import torch
import warp as wp
from cases import CONFIGS, MODELS
from for_each import for_each

import torchrl_loco
from torchrl_loco.config import SimConfig, sim_config
from torchrl_loco.sim import Simulation, compiled, models, mujoco_warp, simulation
from torchrl_loco.sim.compiled import step
from torchrl_loco.sim.engine import Setup
from torchrl_loco.sim.graph import ScratchPool


def allocated(thing):
    """The memory of all arrays in a nesting of dataclasses (bytes), each counted once."""
    if isinstance(thing, wp.array):
        return {thing.ptr: thing.capacity}
    found = {}
    if dataclasses.is_dataclass(thing):
        for value in vars(thing).values():
            found.update(allocated(value))
    return found


@for_each(
    ("body", "num_envs", "overrides", "geoms", "rows"),
    [
        ("walker", 1, {}, (), 1),
        ("walker", 40, {"naconmax": 3}, (4, 0, 2), 10),
        ("humanoid", 100, {"njmax": 77}, (1,), 1),
    ],
)
def test_the_estimate_is_what_is_allocated(body, num_envs, overrides, geoms, rows):
    config = sim_config(CONFIGS[body], "playground", num_envs, overrides)
    model, device = models.load(MODELS[body]), wp.get_device("cpu")
    setup = Setup(model, config, num_envs, device, geoms, contact_rows=rows)
    engine = mujoco_warp.MujocoWarpEngine(setup)
    needed = sum(allocated(engine.data).values())
    if geoms:
        arrays = [array for array in vars(engine.contact_forces).values() if isinstance(array, wp.array)]
        needed += sum(array.capacity for array in arrays)
    assert mujoco_warp.data_bytes(setup) == needed
    data = compiled.CompiledEngine(setup).data
    arrays = [array for array in vars(data).values() if isinstance(array, wp.array)]
    assert compiled.CompiledEngine.memory(setup) == sum(array.capacity for array in arrays)


def test_scratch_memory_is_used_again():
    pool = ScratchPool(wp.get_device("cpu"))
    first, other = pool.allocate(64), pool.allocate(64)
    pool.deallocate(first, 64)
    assert first not in (other, pool.allocate(32))
    assert pool.allocate(64) == first
    assert pool.allocate(64) not in (first, other)


def test_too_many_worlds_are_refused_before_they_are_allocated(engine, monkeypatch):
    """A billion not for contacts, which the compiled step does not list; under MuJoCo-Warp they would exceed 2**31."""
    monkeypatch.setattr(simulation.ENGINES[engine], "__init__", None)
    for num_envs in (10**7, 10**9):
        monkeypatch.setattr(simulation, "free_memory", lambda device, free=107 * num_envs: free)
        with pytest.raises(MemoryError, match=rf"num_envs={num_envs} needs about \d+\.\d GiB on cpu.* \d+ worlds fit"):
            torchrl_loco.make("walker_walk", num_envs, "cpu", engine=engine)


def test_ground_that_does_not_fit_is_refused_before_it_is_allocated(monkeypatch):
    """A field of 4 MB under a ball, where 3 are free."""
    field = '<asset><hfield name="f" nrow="2000" ncol="500" size="1 1 1 1"/></asset>'
    ball = '<geom type="hfield" hfield="f"/><body pos="0 0 3"><freejoint/><geom size=".1"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{field}<worldbody>{ball}</worldbody></mujoco>")
    monkeypatch.setattr(simulation.ENGINES["compiled"], "__init__", None)
    monkeypatch.setattr(simulation, "free_memory", lambda device: 3e6)
    with pytest.raises(MemoryError, match="free: about 0 worlds fit"):
        simulation.Simulation(model, SimConfig(ctrl_dt=0.02, sim_dt=0.002), 2, torch.device("cpu"))


def test_more_worlds_than_warp_can_address_are_refused():
    """On CUDA: the bytes from a body's orientations to the next body's, and threads, are 32-bit numbers."""
    for body, most in (("walker", 2**31 // 36), ("humanoid", 2**26 - 1)):
        model, cuda = models.load(MODELS[body]), types.SimpleNamespace(is_cuda=True)
        step.check_worlds(model, most, cuda)
        step.check_worlds(model, 2**31 - 1, wp.get_device("cpu"))
        with pytest.raises(ValueError, match=f"num_envs={most + 1} is too large: Warp addresses {most} worlds"):
            step.check_worlds(model, most + 1, cuda)


def test_as_many_as_fit_are_made(engine, monkeypatch):
    config = sim_config(CONFIGS["walker"], "playground", 8, {"engine": engine})
    model = models.load(MODELS["walker"])
    needed = simulation.ENGINES[engine].memory(Setup(model, config, 8, wp.get_device("cpu")))
    for free, fits in ((needed + 1, True), (needed / 2, False)):
        monkeypatch.setattr(simulation, "free_memory", lambda device, free=free: free)
        if fits:
            Simulation(models.load(MODELS["walker"]), config, 8, torch.device("cpu"))
        else:
            with pytest.raises(MemoryError, match=r"about [34] worlds fit"):
                Simulation(models.load(MODELS["walker"]), config, 8, torch.device("cpu"))


def test_free_memory_is_what_the_machine_and_its_control_group_leave(tmp_path, monkeypatch):
    monkeypatch.setattr(simulation, "Path", lambda path: tmp_path / str(path).lstrip("/"))
    group = tmp_path / "sys/fs/cgroup"
    group.mkdir(parents=True)
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc/meminfo").write_text("MemTotal: 99 kB\nMemAvailable:   50 kB\n")
    found = []
    for limit in (None, "max", "40000", "90000"):
        if limit is not None:
            (group / "memory.max").write_text(f"{limit}\n")
            (group / "memory.current").write_text("30000\n")
            (group / "memory.stat").write_text("anon 9000\ninactive_file 20000\n")  # the page cache is free
        found.append(simulation.free_memory(torch.device("cpu")))
    assert found == [51200, 51200, 30000, 51200]
