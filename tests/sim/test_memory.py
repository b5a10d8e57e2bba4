"""The memory of a simulation is known, and refused if it is too much, before anything is allocated."""

import dataclasses

import pytest
import torch
import warp as wp

import torchrl_loco
from torchrl_loco import models
from torchrl_loco.config import DEFAULTS, sim_config
from torchrl_loco.sim import Simulation, simulation
from torchrl_loco.sim.mujoco_warp import MujocoWarpEngine, data_bytes


def allocated(thing):
    """The memory of all arrays in a nesting of dataclasses (bytes), each counted once."""
    if isinstance(thing, wp.array):
        return {thing.ptr: thing.capacity}
    found = {}
    if dataclasses.is_dataclass(thing):
        for value in vars(thing).values():
            found.update(allocated(value))
    return found


def test_the_estimate_is_what_is_allocated():
    for body, num_envs, overrides in [
        ("walker", 1, {}),
        ("walker", 40, {"naconmax": 3}),
        ("humanoid", 100, {"njmax": 77}),
    ]:
        config = sim_config(DEFAULTS[body], "playground", num_envs, overrides)
        model = models.load(models.PATHS[body])
        engine = MujocoWarpEngine(model, config, num_envs, wp.get_device("cpu"))
        assert data_bytes(model, config, num_envs) == sum(allocated(engine.data).values())


def test_too_many_worlds_are_refused_before_they_are_allocated(monkeypatch):
    monkeypatch.setattr(simulation, "MujocoWarpEngine", None)
    with pytest.raises(MemoryError, match=r"num_envs=10000000 needs about \d+\.\d GiB on cpu.* \d+ worlds fit"):
        torchrl_loco.make("walker_walk", 10**7, "cpu")


def test_as_many_as_fit_are_made(monkeypatch):
    config = sim_config(DEFAULTS["walker"], "playground", 8, {})
    needed = simulation.SCRATCH * data_bytes(models.load(models.PATHS["walker"]), config, 8)
    for free, fits in ((needed + 1, True), (needed / 2, False)):
        monkeypatch.setattr(simulation, "free_memory", lambda device, free=free: free)
        if fits:
            Simulation(models.load(models.PATHS["walker"]), config, 8, torch.device("cpu"))
        else:
            with pytest.raises(MemoryError, match=r"about [34] worlds fit"):
                Simulation(models.load(models.PATHS["walker"]), config, 8, torch.device("cpu"))


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
