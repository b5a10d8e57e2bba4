"""A robot's first step with an empty kernel cache, its physics with contact sensors, and a reset of all its worlds.

python speed.py TREE TASK WORLDS

TREE is a folder with the revision's torchrl_loco. The physics is stepped under the controls that a reset leaves.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable

tree, task, worlds = sys.argv[1], sys.argv[2], int(sys.argv[3])
sys.path.insert(0, tree)

import torch  # noqa: E402
import warp as wp  # noqa: E402

import torchrl_loco  # noqa: E402


def milliseconds(work: Callable[[], object], count: int) -> float:
    """Returns the time of the device for some work, mean of ``count``."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    for _ in range(count):
        work()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end) / count


wp.config.kernel_cache_dir = tempfile.mkdtemp()
torch.zeros(1, device="cuda")
wp.init()
started = time.time()
env = torchrl_loco.make(task, worlds, "cuda", seed=0)
env.rand_step(env.reset())
torch.cuda.synchronize()
first = time.time() - started
graph = env.sim.capture(env.sim.step)
env.reset()
for _ in range(100):
    graph.replay()
physics = statistics.median(milliseconds(graph.replay, 10) for _ in range(9))
reset = statistics.median(milliseconds(env.reset, 3) for _ in range(5))
print(f"{tree} {task}: first step after {first:.2f} s, physics {physics:.3f} ms, reset of all {reset:.3f} ms")
