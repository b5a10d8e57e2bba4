"""TorchRL's MujocoPlaygroundEnv: ``step_and_maybe_reset`` on CUDA with random actions."""

import json
import os
import sys

os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.1")  # the peers of all bodies share a card

import torch
from torchrl.envs import MujocoPlaygroundEnv

from benchmarks.tasks import playground_name
from benchmarks.timing import WARM_UP, milliseconds, my_turn


@torch.no_grad()
def main(body: str, worlds: int) -> None:
    """Prints the time of a step."""
    env = MujocoPlaygroundEnv(playground_name(body), device="cuda", batch_size=torch.Size([worlds]))
    carried = env.reset()

    def step() -> None:
        nonlocal carried
        action = torch.empty(env.action_spec.shape, device="cuda").uniform_(-1.0, 1.0)
        _, carried = env.step_and_maybe_reset(carried.set("action", action))

    step()
    my_turn()
    print(json.dumps({"ms": milliseconds(step, torch.cuda.synchronize, warm_up=WARM_UP)}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
