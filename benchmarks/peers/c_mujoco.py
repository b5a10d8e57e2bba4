"""C MuJoCo: ``mujoco.rollout`` of our models on all cores, in double precision, without observation or reward."""

import json
import os
import sys

import mujoco
import numpy as np
from mujoco import rollout

from benchmarks.tasks import TASKS
from benchmarks.timing import milliseconds, my_turn
from torchrl_loco.config import sim_config
from torchrl_loco.registry import env_class
from torchrl_loco.sim import models
from torchrl_loco.sim.simulation import set_options

CONTROL_STEPS = 20


def main(body: str, worlds: int, threads: int) -> None:
    """Prints the time of a control step."""
    cls = env_class(TASKS[body])
    config, model = sim_config(cls.config, "playground", worlds, {}), models.load(cls.model)
    set_options(model, config)
    data = [mujoco.MjData(model) for _ in range(threads)]
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros(size)
    mujoco.mj_getState(model, data[0], start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.tile(start, (worlds, 1))
    generator = np.random.default_rng(0)
    with rollout.Rollout(nthread=threads) as pool:

        def step() -> None:
            nonlocal state
            action = generator.uniform(-1.0, 1.0, (worlds, CONTROL_STEPS, model.nu))
            control = models.control(model, action).repeat(config.substeps, axis=1)
            states, _ = pool.rollout(model, data, state, control)
            state = states[:, -1]

        my_turn()
        ms = milliseconds(step, lambda: None, blocks=5, steps=2) / CONTROL_STEPS
    print(json.dumps({"ms": ms, "threads": threads}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), os.cpu_count() or 1)
