"""dm_control: one environment on one core, observation and reward included, random actions."""

import json
import sys

import numpy as np
from dm_control import suite

from benchmarks.tasks import TASKS
from benchmarks.timing import milliseconds


def main(body: str, worlds: int) -> None:
    """Prints the time of a step of one world; ``beside`` says which row of ours it is compared with."""
    env = suite.load(*TASKS[body].split("_"), task_kwargs={"random": 0})
    spec, generator = env.action_spec(), np.random.default_rng(0)
    env.reset()
    ms = milliseconds(lambda: env.step(generator.uniform(spec.minimum, spec.maximum)), lambda: None, steps=200)
    print(json.dumps({"worlds": 1, "beside": worlds, "ms": ms}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
