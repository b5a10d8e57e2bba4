"""What numbers of the model that differ from world to world cost: control steps of the physics alone."""

import statistics
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from benchmarks.cases import until_interrupted
from benchmarks.results import Row
from torchrl_loco.config import SimConfig, sim_config
from torchrl_loco.envs.variation import Variation
from torchrl_loco.envs.vary import Vary
from torchrl_loco.registry import env_class
from torchrl_loco.sim import Simulation, models
from torchrl_loco.tasks.velocity import FOLDER

COLUMNS = {"model": "", "worlds": "d", "plain": ".3f", "own": ".3f", "drawn": ".3f", "own %": "+.1f", "drawn %": "+.1f"}
"""Milliseconds without variation, with the model's own numbers in every world (the same motion), with drawn numbers."""
SETTLE, STEPS, ROUNDS = 100, 50, 3
"""Control steps before the first round, of a round, and rounds, between which the simulations take turns."""


def price(names: Sequence[str], worlds: Sequence[int], device: torch.device) -> list[Row]:
    """Measures models under the compiled engine; returns a row for each and each number of worlds.

    Args:
        names: ``humanoid``, or robots of the velocity tasks, which are stepped with Euler, pyramids and condim 3.
        worlds: numbers of worlds.
        device: a CUDA device.
    """
    rows = []
    for name, n in until_interrupted([(name, n) for name in names for n in worlds], "price"):
        m, config = _model(name, n)
        variation = Variation(varied(m, device), m, device)
        drawn = torch.zeros(n, variation.varied.count, device=device)
        stream = {"seed": torch.ones(1, dtype=torch.long, device=device), "world": torch.arange(n, device=device)}
        episode, mask = (torch.ones(n, dtype=kind, device=device) for kind in (torch.int32, torch.bool))
        variation.vary({"numbers": drawn, **stream, "episode": episode, "mask": mask})
        sims = {
            "plain": _start(Simulation(m, config, n, device), None),
            "own": _start(Simulation(m, config, n, device, varied=variation), None),
            "drawn": _start(Simulation(m, config, n, device, varied=variation), drawn),
        }
        times, actions = {kind: [] for kind in sims}, _controls(m, n, device)
        for each in sims.values():
            _time(*each, actions, 0, SETTLE)
        for i in range(ROUNDS):
            for kind, each in sims.items():
                times[kind].append(_time(*each, actions, SETTLE + i * STEPS, STEPS))
        row = {kind: statistics.median(found) for kind, found in times.items()}
        more = {f"{kind} %": 100.0 * (row[kind] / row["plain"] - 1.0) for kind in ("own", "drawn")}
        rows.append({"model": name, "worlds": n, **row, **more})
    return rows


def _model(name: str, worlds: int) -> tuple[mujoco.MjModel, SimConfig]:
    if name == "humanoid":
        cls = env_class("humanoid_walk")
        return models.load(cls.model), sim_config(cls.config, "playground", worlds, {"engine": "compiled"})
    m = models.load(FOLDER / f"{name}.xml", sensors=[])
    m.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    m.geom_condim[m.geom_condim > 3] = 3
    return m, SimConfig(0.02, 0.005, iterations=10, ls_iterations=20, euler_damping=True, engine="compiled")


def varied(m: mujoco.MjModel, device: torch.device) -> list[Vary]:
    """Returns friction, mass and center of mass of the first body, armature, damping, gains and gears."""
    first, servo = m.body(1).name, bool(m.actuator_biastype.any())
    wanted = [
        Vary("geom_friction", 0.5, 1.25),
        Vary("body_mass", 0.8, 1.2, of=first),
        Vary("body_ipos", -0.02, 0.02, of=first, how="add"),
        Vary("dof_armature", 0.8, 1.2, shared=False),
        *(Vary(gain, 0.8, 1.2, shared=False) for gain in (("kp", "kv") if servo else ("actuator_gainprm",))),
        Vary("actuator_gear", 0.9, 1.1, shared=False),
    ]
    joints = m.dof_jntid[m.dof_damping > 0]
    return [*wanted, Vary("dof_damping", 0.8, 1.2, shared=False)] if len(joints) else wanted


def _start(sim: Simulation, numbers: torch.Tensor | None) -> tuple[Simulation, Any]:
    """Puts all worlds into the home pose, with their numbers."""
    everywhere = wp.ones(sim.num_envs, dtype=bool, device=sim.device)
    if numbers is not None:
        sim.numbers.copy_(numbers)
    sim.reset(everywhere)
    sim.qpos.copy_(torch.tensor(models.home_pose(sim.mj_model), device=sim.qpos.device).expand_as(sim.qpos))
    return sim, sim.capture(sim.step)


def _controls(m: mujoco.MjModel, worlds: int, device: torch.device) -> list[torch.Tensor]:
    """Returns random controls: of servos targets around the home pose (rad)."""
    low, high = m.actuator_ctrlrange.T
    if m.actuator_biastype.any():
        home = models.home_pose(m)[m.jnt_qposadr[m.actuator_trnid[:, 0]]]
        low, high = home - 0.5, home + 0.5
    least, most = torch.tensor(np.stack([low, high]), device=device).float()
    torch.manual_seed(0)
    return [least + (most - least) * torch.rand(worlds, m.nu, device=device) for _ in range(16)]


def _time(sim: Simulation, graph: Any, controls: Sequence[torch.Tensor], first: int, steps: int) -> float:
    """Returns the milliseconds of a control step, without the copy of its controls."""
    spans = []
    for k in range(first, first + steps):
        sim.ctrl.copy_(controls[k % len(controls)])
        spans.append([torch.cuda.Event(enable_timing=True) for _ in range(2)])
        spans[-1][0].record()
        graph.replay()
        spans[-1][1].record()
    torch.cuda.synchronize()
    return sum(start.elapsed_time(end) for start, end in spans) / steps
