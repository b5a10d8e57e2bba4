"""A process of its own that makes an environment and takes a step; prints what that cost as JSON.

    python -m benchmarks.first_step BODY WORLDS DEVICE STARTED

STARTED is the time (s since the epoch) at which the process was started.
"""

import json
import resource
import sys
import time

import torch
import warp as wp

import torchrl_loco
from benchmarks.cases import waiter
from benchmarks.tasks import TASKS


def used_bytes(device: torch.device) -> int:
    """Returns the memory in use: all of the device's, or the most that this process ever had on the CPU."""
    if device.type == "cuda":
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


body, worlds, device, started = sys.argv[1], int(sys.argv[2]), torch.device(sys.argv[3]), float(sys.argv[4])
imported = time.time()
torch.zeros(1, device=device)
wp.init()
before = used_bytes(device)
env = torchrl_loco.make(TASKS[body], worlds, device, seed=0)
made = time.time()
env.rollout(1)
waiter(device)()
stepped = time.time()
with torch.no_grad():
    env.rollout(10)
print(
    json.dumps(
        {
            "import (s)": imported - started,
            "make (s)": made - imported,
            "to first step (s)": stepped - started,
            "KiB/world": (used_bytes(device) - before) / worlds / 1024,
        }
    )
)
