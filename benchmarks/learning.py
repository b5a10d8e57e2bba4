"""A process of its own that trains a task with its preset for some seconds; prints frames per second as JSON.

python -m benchmarks.learning TASK DEVICE FRAMES [NAME=VALUE ...]
"""

import json
import sys
import tempfile
from pathlib import Path

import torch

from benchmarks.robots import row, train
from benchmarks.timing import my_turn

KEPT = ("algorithm", "worlds", "frames", "seconds", "first iteration (s)", "frames/s")


def main(task: str, device: torch.device, frames: int, settings: list[str]) -> None:
    """Trains for a tenth of the frames, which compiles, waits, trains for all of them, and prints the row of that."""
    settings = [*settings, "eval_episodes=64"]
    with tempfile.TemporaryDirectory() as folder:
        train(Path(folder, "compiled"), task, 0, device, [*settings, f"total_frames={frames // 10}"])
        my_turn()
        train(Path(folder, "measured"), task, 0, device, [*settings, f"total_frames={frames}"])
        found = row(next(Path(folder, "measured").glob("*/")))
    print(json.dumps({key: found[key] for key in KEPT}))


if __name__ == "__main__":
    main(sys.argv[1], torch.device(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
