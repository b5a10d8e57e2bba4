"""Falls of policies of robots in many episodes, in the simulator of the training: half with fixed commands.

python falls.py EPISODES STEPS POLICY.safetensors ...

Fixed commands, delays, friction and pushes are those of `verify`; the other commands and the noise are those of the
training. Each policy meets the same draws.
"""

import sys
from pathlib import Path

import numpy as np
import torch

import torchrl_loco
from torchrl_loco.envs.vary import Vary
from torchrl_loco.policy import Policy
from torchrl_loco.registry import resolve
from torchrl_loco.tasks.velocity import commands


def fixed_commands(low, high):
    """Returns standing, each limit of a component alone, and both limits of all together."""
    alone = [np.eye(3)[k] * bound[k] for k in range(3) for bound in (high, low)]
    return [np.zeros(3), *alone, high, low]


DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@torch.no_grad()
def main(episodes: int, steps: int, paths: list[Path]) -> None:
    """Prints the falls of each policy."""
    policies = [Policy.load(path, DEVICE) for path in paths]
    info, vary = policies[0].info, Vary("geom_friction", 0.4, 1.2, how="set", once=True)
    task = type("Pushed", (resolve(info["task"]),), {"push_scale": 1.0})
    env = torchrl_loco.make(task, episodes, DEVICE, 11, info["protocol"], world_offset=0, randomize=[vary])
    low, high = (np.array(bounds) for bounds in commands.reached(task.curriculum, 0))
    fixed = torch.tensor(np.array(fixed_commands(low, high)), dtype=torch.float32, device=DEVICE)
    index = torch.arange(episodes, device=DEVICE)
    delay, kind, is_fixed = index // len(fixed) % 3, index % len(fixed), index < episodes // 2
    friction = 0.4 + 0.8 * torch.rand(episodes, 1, generator=torch.Generator().manual_seed(5)).to(DEVICE)
    for path, policy in zip(paths, policies, strict=True):
        env.set_seed(11)
        env.reset()
        state = env.get_state()
        state["model", "geom_friction"] = friction.expand_as(state["model", "geom_friction"])
        memory = state["memory"]
        memory["delay"] = delay.float()
        memory["command"] = torch.where(is_fixed[:, None], fixed[kind], memory["command"])
        memory["until_command"] = torch.where(is_fixed, 1e9, memory["until_command"])
        memory["holds_heading"] = torch.where(is_fixed, 0.0, memory["holds_heading"])
        td, fell = env.reset(state, set_state=True), torch.zeros_like(is_fixed)
        returns = torch.zeros(episodes, device=DEVICE)
        for _ in range(steps):
            after = env.step(policy(td))["next"]
            returns += after["reward"].squeeze(-1) * ~fell
            fell |= after["terminated"].squeeze(-1)
            td = after.exclude("reward", "done", "terminated", "truncated")
        late = [int(fell[delay == k].sum()) for k in range(3)]
        held = [int(fell[is_fixed & (kind == k)].sum()) for k in range(len(fixed))]
        print(path, int(fell.sum()), f"{returns.mean().item():.2f}", late, held, int(fell[~is_fixed].sum()), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), [Path(path) for path in sys.argv[3:]])
