"""What a task in plain torch costs beside the physics, and beside a task whose fused functions do next to nothing."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

from benchmarks.cases import until_interrupted, waiter
from benchmarks.results import Row
from benchmarks.timing import milliseconds
from torchrl_loco import LocoEnv, registry
from torchrl_loco.collector import RolloutCollector
from torchrl_loco.envs.world import World
from torchrl_loco.sim import fill, models

COLUMNS = {
    "task": "",
    "worlds": "d",
    "physics": ".3f",
    "world": ".3f",
    "env": ".3f",
    "collector": ".3f",
    "compile (s)": ".1f",
}
"""Milliseconds of a control step of all worlds: physics alone; with hooks and resets; as TorchRL's
``step_and_maybe_reset``; in ``RolloutCollector`` with a policy of two layers of 256."""


@wp.struct
class Nothing:
    """What :func:`observe_nothing` reads."""

    qvel: wp.array2d[float]


@wp.func
def observe_nothing(world: int, inputs: Nothing, observation: wp.array[float], terms: wp.array[float]) -> float:
    for i in range(observation.shape[0]):
        observation[i] = inputs.qvel[world, i]
    return 0.0


def bare(task: type[LocoEnv]) -> type[LocoEnv]:
    """Returns a task of the same body whose fused functions observe velocities and reward nothing."""
    spec = models.specification(task.model, Path(sys.modules[task.__module__].__file__ or "").parent)
    for actuator in spec.actuators:
        actuator.ctrllimited = 1  # as the default control wants it

    class Bare(LocoEnv):
        model, config = spec, task.config
        body, observation_size, term_names = task.__name__, 6, ()

        def observation_func(self, world: World) -> tuple[wp.Function, Any]:
            return observe_nothing, fill(Nothing, world.sim.data)

    return Bare


@torch.no_grad()
def hooks(name: str, worlds: Sequence[int], device: torch.device) -> list[Row]:
    """Measures a task and its bare twin for each number of worlds; returns a row for each."""
    task = registry.resolve(name, by_user=True)
    runs = [(cls, n) for n in worlds for cls in (bare(task), task)]
    return [
        {"task": cls.__name__, "worlds": n, **measure(cls, n, device)} for cls, n in until_interrupted(runs, "hooks")
    ]


def measure(cls: type[LocoEnv], n: int, device: torch.device) -> Row:
    """Returns the times of a task."""
    wait, env = waiter(device), cls(n, device, seed=0, stagger=True)
    physics = env.sim.capture(env.sim.step)
    action = torch.zeros(env.action_spec.shape, device=device).uniform_(-1.0, 1.0)

    def world() -> None:
        env.world.step(action)
        env.world.reset_masked()

    state = [env.reset()]

    def step() -> None:
        state[0] = env.step_and_maybe_reset(state[0].set("action", action))[1]

    for _ in range(150):
        step()
    times = {"world": milliseconds(world, wait), "env": milliseconds(step, wait)}
    times["physics"] = milliseconds(physics.replay, wait)
    env.reset()
    policy = torch.nn.Sequential(
        torch.nn.Linear(env.observation_size, 256),
        torch.nn.SiLU(),
        torch.nn.Linear(256, 256),
        torch.nn.SiLU(),
        torch.nn.Linear(256, env.mj_model.nu),
        torch.nn.Tanh(),
    ).to(device)

    class Actor(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = policy

        def forward(self, td: Any) -> Any:
            return td.set("action", self.network(td["observation"]))

    collector = RolloutCollector(env, Actor(), frames_per_batch=24 * n)
    for _ in range(4):
        collector.rollout()
    times["collector"] = milliseconds(collector.rollout, wait, blocks=5, steps=4) / 24
    return {**times, "step by step": collector.step_by_step, "engine": env.engine}
