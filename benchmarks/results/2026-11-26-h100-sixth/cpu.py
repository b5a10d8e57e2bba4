"""Physics alone on a CPU: microseconds a world and control step, under actions that are drawn at random.

python cpu.py TREE MODELS NAME ...

TREE is a folder with the revision's torchrl_loco; MODELS/NAME.mjb are those of ../2026-11-26-h100-second/physics.py.
"""

import sys
import time

sys.path.insert(0, sys.argv[1])

import mujoco
import torch

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation

WORLDS, BEFORE, STEPS = 128, 20, 100
LIMITS = {"naconmax": 1024, "njmax": 300, "engine": "compiled"}

for name in sys.argv[3:]:
    m = mujoco.MjModel.from_binary_path(f"{sys.argv[2]}/{name}.mjb")
    robot = name.endswith("simple")
    times = (0.02, 0.005, 10, 20) if robot else (0.025, 0.005, 4, 8)
    named = dict(zip(("ctrl_dt", "sim_dt", "iterations", "ls_iterations"), times, strict=True))
    sim = Simulation(m, SimConfig(euler_damping=robot, **named, **LIMITS), WORLDS, torch.device("cpu"))
    sim.qpos.copy_(torch.tensor(m.qpos0, dtype=torch.float32).expand_as(sim.qpos))
    sim.qpos[:, 2] = 0.8 if robot else 1.4
    generator = torch.Generator().manual_seed(0)
    total = 0.0
    for step in range(BEFORE + STEPS):
        sim.ctrl.copy_((0.5 if robot else 1.0) * (2 * torch.rand(sim.ctrl.shape, generator=generator) - 1))
        begin = time.perf_counter()
        sim.step()
        total += time.perf_counter() - begin if step >= BEFORE else 0.0
    print(f"{name}: {total / STEPS / WORLDS * 1e6:.1f} us")
