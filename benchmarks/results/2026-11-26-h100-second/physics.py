"""Physics alone of models in a folder, under actions that are drawn at random, ms a control step.

python physics.py FOLDER humanoid_walk:2048,8192 g1_simple:8192

FOLDER/NAME.mjb are the bodies of this package, and Go1 and G1 as about.txt says. It also runs at revision 13b5c25.
"""

import statistics
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import torch

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation

DEVICE, STEPS, ROUNDS = torch.device("cuda"), 10, 8
TIMES = {  # control step and physics step (s), iterations of the solver and of the line search
    "humanoid_walk": (0.025, 0.005, 4, 8),
    "walker_walk": (0.025, 0.0025, 2, 5),
    "go1_simple": (0.02, 0.005, 10, 20),
    "g1_simple": (0.02, 0.005, 10, 20),
}
HEIGHTS = {"go1_simple": 0.3, "g1_simple": 0.8}
HOME = {"go1_simple": [0.0, 0.9, -1.8] * 4}


def milliseconds(work: Callable[[], None]) -> float:
    """Returns the time that the device takes for some work."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    work()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end)


@torch.no_grad()
def measure(folder: Path, name: str, worlds: int) -> None:
    """Prints the time of a model: of 8 rounds of 10 steps, after 100 others, the median of all but the first."""
    m = mujoco.MjModel.from_binary_path(str(folder / f"{name}.mjb"))
    ctrl_dt, sim_dt, iterations, ls_iterations = TIMES[name]
    robot = name.endswith("simple")
    limits = {"iterations": iterations, "ls_iterations": ls_iterations, "naconmax": 1024, "njmax": 300}
    config = SimConfig(ctrl_dt=ctrl_dt, sim_dt=sim_dt, euler_damping=robot, engine="compiled", **limits)
    sim = Simulation(m, config, worlds, DEVICE)
    sim.qpos.copy_(torch.tensor(m.qpos0, dtype=torch.float32, device=DEVICE).expand_as(sim.qpos))
    if robot:
        sim.qpos[:, 2] = HEIGHTS[name]
    else:
        sim.qpos[:, 2 if m.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE else 0] += 0.1
    generator = torch.Generator(device=DEVICE).manual_seed(0)
    home, scale = torch.tensor(HOME.get(name, [0.0] * m.nu), device=DEVICE), 0.5 if robot else 1.0
    draws = [torch.rand(sim.ctrl.shape, generator=generator, device=DEVICE) for _ in range(STEPS)]
    ctrls = [home + scale * (2 * draw - 1) for draw in draws]
    graph = sim.capture(sim.step)
    for k in range(100):
        sim.ctrl.copy_(ctrls[k % STEPS])
        graph.replay()
    begin = {kept: getattr(sim, kept).clone() for kept in ("qpos", "qvel", "qacc_warmstart")}
    if not torch.isfinite(begin["qpos"]).all():
        raise ValueError(f"{name} is not finite")

    def physics() -> None:
        for ctrl in ctrls:
            sim.ctrl.copy_(ctrl)
            graph.replay()

    def copies() -> None:
        for ctrl in ctrls:
            sim.ctrl.copy_(ctrl)

    times = {}
    for work in (physics, copies):
        rounds = []
        for _ in range(ROUNDS):
            for kept, value in begin.items():
                getattr(sim, kept).copy_(value)
            rounds.append(milliseconds(work) / STEPS)
        times[work] = statistics.median(rounds[1:])
    print(f"{name} {worlds}: {times[physics] - times[copies]:.3f} ms", flush=True)


if __name__ == "__main__":
    for argument in sys.argv[2:]:
        model, sizes = argument.split(":")
        for count in map(int, sizes.split(",")):
            measure(Path(sys.argv[1]), model, count)
