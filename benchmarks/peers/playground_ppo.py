"""Brax's PPO on Playground with the settings that Playground tuned for the task, evaluated ten times."""

import functools
import json
import sys
import time

import jax
import jax.numpy as jnp
from brax.training.agents.ppo import train as ppo
from mujoco_playground import dm_control_suite, wrapper
from mujoco_playground.config import dm_control_suite_params

if not hasattr(jax, "device_put_replicated"):  # Brax 0.14 calls what JAX 0.11 no longer has
    jax.device_put_replicated = lambda x, devices: jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), x)


def main(task: str, started: float) -> None:
    """Prints the evaluations, each with the seconds since the process was started."""
    name = "".join(part.capitalize() for part in task.split("_"))
    settings = dict(dm_control_suite_params.brax_ppo_config(name))
    evaluations = []

    def note(frames: int, metrics: dict) -> None:
        mean = float(metrics["eval/episode_reward"])
        evaluations.append({"frames": int(frames), "seconds": time.time() - started, "mean": mean})

    train = functools.partial(ppo.train, **settings, progress_fn=note, seed=0, deterministic_eval=True)
    train(environment=dm_control_suite.load(name), wrap_env_fn=wrapper.wrap_for_brax_training)
    print(json.dumps({"evaluations": evaluations}))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
