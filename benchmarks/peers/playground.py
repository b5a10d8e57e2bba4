"""MuJoCo Playground: its jitted step in JAX, physics by MuJoCo-Warp, random actions."""

import json
import os
import sys

os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.1")  # the peers of all bodies share a card

import jax
from mujoco_playground import dm_control_suite

from benchmarks.tasks import playground_name
from benchmarks.timing import WARM_UP, milliseconds, my_turn


def main(body: str, worlds: int) -> None:
    """Prints the time of a step."""
    env = dm_control_suite.load(playground_name(body))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), worlds))
    key = jax.random.PRNGKey(1)

    @jax.jit
    def advance(state, key):
        key, now = jax.random.split(key)
        action = jax.random.uniform(now, (worlds, env.action_size), minval=-1.0, maxval=1.0)
        return jax.vmap(env.step)(state, action), key

    def step() -> None:
        nonlocal state, key
        state, key = advance(state, key)

    step()
    my_turn()
    print(json.dumps({"ms": milliseconds(step, lambda: jax.block_until_ready(state.reward), warm_up=WARM_UP)}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
