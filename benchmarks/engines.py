"""The compiled engine beside MuJoCo-Warp and, on the CPU, C MuJoCo: times of one control step of all worlds.

The base is the plain loop of ``mujoco_warp.step`` in a graph. States are those after 100 random control steps.
"""

import time
from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import torch

import torchrl_loco
from benchmarks.cases import bare_default, until_interrupted, waiter
from benchmarks.results import Row
from benchmarks.tasks import TASKS
from benchmarks.timing import milliseconds
from torchrl_loco.config import PROTOCOLS
from torchrl_loco.envs import State
from torchrl_loco.sim import models
from torchrl_loco.sim.simulation import memory

COLUMNS = {
    "body": "",
    "protocol": "",
    "worlds": "d",
    "engine": "",
    "mujoco_warp": ".3f",
    "C MuJoCo": ".3f",
    "compiled": ".3f",
    "with observation": ".3f",
    "ratio": ".1f",
    "to C": ".1f",
    "bytes a world": "d",
}
WARM_UP = 100
"""Control steps before a measurement: worlds then stand, fall and lie."""


@torch.no_grad()
def engines(bodies: Sequence[str], worlds: Sequence[int], device: torch.device, base_up_to: int) -> list[Row]:
    """Measures both engines for each body, protocol and number of worlds; returns a row for each.

    Args:
        bodies: names of bodies.
        worlds: numbers of worlds.
        device: where to measure.
        base_up_to: most worlds that MuJoCo-Warp is measured with.
    """
    rows: list[Row] = []
    runs = [(body, protocol, n) for body in bodies for protocol in PROTOCOLS for n in worlds]
    for body, protocol, n in until_interrupted(runs, "engines"):
        row = {"body": body, "protocol": protocol, "worlds": n, **_environment(body, protocol, n, device)}
        if n <= base_up_to:
            row["mujoco_warp"] = _time(bare_default(body, n, device, protocol), n, device)
            row["ratio"] = row["mujoco_warp"] / row["with observation"]
        if device.type == "cpu":
            row["C MuJoCo"] = _c_mujoco(body, protocol, n)
            row["to C"] = row["C MuJoCo"] / row["with observation"]
        rows.append(row)
        print(row, flush=True)  # a machine may be taken away before the table is made
    return rows


def _environment(body: str, protocol: str, n: int, device: torch.device) -> Row:
    """Measures an environment under the compiled engine, or under MuJoCo-Warp if the body needs that."""
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, protocol=protocol, stagger=True)
    env.reset()
    world, physics = env.world, env.sim.capture(env.sim.step)

    def step() -> None:
        env.sim.ctrl.uniform_(-1.0, 1.0)
        physics.replay()

    def control_step() -> None:
        world.step(world.action.torch.uniform_(-1.0, 1.0))

    for _ in range(WARM_UP):
        control_step()
    found = {"engine": env.engine, "with observation": _time(control_step, n, device)}
    if env.engine == "compiled":
        found["compiled"] = _time(step, n, device)
    found["bytes a world"] = memory(env.engine, env.mj_model, env.config, n, device) // n
    return found


def _time(step: Callable[[], None], n: int, device: torch.device) -> float:
    large = n > 20_000
    return milliseconds(step, waiter(device), blocks=3 if large else 5, steps=8 if large else 30)


def _c_mujoco(body: str, protocol: str, n: int) -> float:
    """Returns the time in which C MuJoCo steps so many worlds on one core, from states like those (ms)."""
    env = torchrl_loco.make(TASKS[body], 64, "cpu", seed=0, protocol=protocol, stagger=True)
    td = env.reset()
    for _ in range(WARM_UP):
        _, td = env.step_and_maybe_reset(td.set("action", env.action_spec.rand()))
    states, data, spent = env.get_state(), mujoco.MjData(env.mj_model), 0.0
    for world in range(64):
        for name in State.PHYSICS:
            if name in states:
                getattr(data, name)[:] = states[name][world].numpy()
        data.ctrl[:] = models.control(env.mj_model, np.random.default_rng(world).uniform(-1, 1, env.mj_model.nu))
        start = time.perf_counter()
        mujoco.mj_step(env.mj_model, data, env.config.substeps)
        spent += time.perf_counter() - start
    return spent / 64 * n * 1e3
