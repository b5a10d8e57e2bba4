"""Velocities of a Go2 after a physics step beside those of C MuJoCo, by the impedance of its contacts.

python stiff.py compiled 0.9,0.99,0.999
"""

import sys
from pathlib import Path

import mujoco
import numpy as np
import torch
import warp as wp

import torchrl_loco
from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation, models

MODEL, WORLDS = Path(torchrl_loco.__file__).parent / "tasks" / "velocity" / "go2.xml", 64
STATE = "qpos", "qvel", "qacc_warmstart", "ctrl"


def in_c(model: mujoco.MjModel, state: dict[str, np.ndarray], world: int) -> np.ndarray:
    """Returns the velocities of a world after a physics step with a solver that converges, ``(nv,)``."""
    data, kept = mujoco.MjData(model), (model.opt.tolerance, model.opt.iterations)
    for name, values in state.items():
        getattr(data, name)[:] = values[world]
    model.opt.tolerance, model.opt.iterations = 1e-14, 200
    mujoco.mj_step(model, data)
    model.opt.tolerance, model.opt.iterations = kept
    return data.qvel


def measure(engine: str, impedance: float) -> None:
    """Prints the largest error of each world's velocities: median, 90 % quantile and maximum."""
    model = models.load(MODEL)
    model.geom_solimp[:, :2] = impedance
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-8
    sizes = {"naconmax": 64 * WORLDS, "njmax": 256} if engine == "mujoco_warp" else {}
    options = {"iterations": 100, "ls_iterations": 50, "engine": engine, **sizes}
    config = SimConfig(ctrl_dt=model.opt.timestep, sim_dt=model.opt.timestep, **options)
    sim, home = Simulation(model, config, WORLDS, torch.device("cpu")), torch.tensor(model.key("home").qpos).float()
    sim.reset(wp.ones(WORLDS, dtype=bool, device="cpu"))
    sim.qpos[:] = home
    generator = torch.Generator().manual_seed(0)
    for step in range(150):
        if step % 20 == 0:
            sim.ctrl[:] = home[7:] + 0.5 * torch.randn(WORLDS, model.nu, generator=generator)
        sim.step()
    state = {name: getattr(sim, name).double().numpy().copy() for name in STATE}
    sim.step()
    errors = [np.abs(sim.qvel[world].numpy() - in_c(model, state, world)).max() for world in range(WORLDS)]
    print(engine, impedance, *(f"{np.quantile(errors, part):.1e}" for part in (0.5, 0.9, 1.0)))


for each in sys.argv[2].split(","):
    measure(sys.argv[1], float(each))
