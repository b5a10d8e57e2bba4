"""dm_control: the returns of an exported policy, one episode after the other."""

import json
import statistics
import sys
from importlib import metadata

import numpy as np
import torch
from dm_control import suite


def main(program: str, task: str, episodes: int, action_repeat: int) -> None:
    """Prints mean, standard deviation and extremes of the returns, and the versions that were used."""
    policy = torch.export.load(program).module()
    returns = [play(policy, task, seed, action_repeat) for seed in range(episodes)]
    summary = {"mean": statistics.mean(returns), "std": statistics.pstdev(returns), "min": min(returns)}
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("dm_control", "mujoco"))
    print(json.dumps({**summary, "max": max(returns), "versions": versions}))


def play(policy: torch.nn.Module, task: str, seed: int, action_repeat: int) -> float:
    """Returns the return of an episode."""
    env = suite.load(*task.split("_"), task_kwargs={"random": seed})
    step, total, frames = env.reset(), 0.0, 0
    while not step.last():
        if frames % action_repeat == 0:
            observation = np.concatenate([np.ravel(part) for part in step.observation.values()])
            with torch.no_grad():
                action = policy(torch.as_tensor(observation, dtype=torch.float32)[None])[0]
        step = env.step(action.double().numpy())
        total, frames = total + step.reward, frames + 1
    return total


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
