"""mjlab's environments beside ours: the time of a step, resets included, and frames per second of its own training.

It runs in a process of its own, in which mjlab and the MuJoCo that it pins come first.
"""

import json
import sys
from pathlib import Path

import torch

from benchmarks.peers.mjlab_ppo import Curve, made
from benchmarks.tasks import MJLAB
from benchmarks.timing import WARM_UP, milliseconds, my_turn

ITERATIONS = 20


def main(task: str, worlds: int, device: str, motion: Path | None) -> None:
    """Prints the time of a step under random actions (ms), and frames per second of a training."""
    runner, rl = made(MJLAB[task], worlds, device, motion)
    env = runner.env

    def step() -> None:
        env.step(torch.empty(worlds, env.num_actions, device=device).uniform_(-1.0, 1.0))

    with torch.no_grad():
        step()
        my_turn()
        wait = torch.cuda.synchronize if device.startswith("cuda") else lambda: None
        ms = milliseconds(step, wait, blocks=5, steps=20, warm_up=WARM_UP)
    curve = Curve(runner, float("inf"), [])
    runner.learn(ITERATIONS, init_at_random_ep_len=True)
    print(json.dumps({"ms": ms, "frames/s": curve.rate(worlds * rl.num_steps_per_env)}))


if __name__ == "__main__":
    task, worlds, device, *motion = sys.argv[1:]
    main(task, int(worlds), device, Path(motion[0]) if motion else None)
