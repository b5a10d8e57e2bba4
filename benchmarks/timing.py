"""How a time is taken, the same for us and for the peers."""

import statistics
import sys
import time
from collections.abc import Callable

BLOCKS, STEPS = 7, 40
WARM_UP = 100
"""Control steps before those that are timed: worlds then stand, fall and lie."""
READY = "ready to measure"
"""The line by which a process says that it has compiled and waits for its turn."""


def my_turn() -> None:
    """Waits until :func:`benchmarks.processes.in_turn`, or who started this process by hand, sends a line."""
    print(READY, flush=True)
    if not sys.stdin.readline():
        raise SystemExit("nobody waits for the measurement")


def milliseconds(
    step: Callable[[], object],
    wait: Callable[[], object],
    blocks: int = BLOCKS,
    steps: int = STEPS,
    warm_up: int | None = None,
) -> float:
    """Returns the time of a call of ``step``: the median over blocks of calls, each from idle device to idle device.

    Args:
        step: may return before its work is done.
        wait: returns when all work is done.
        blocks: number of blocks that are timed.
        steps: calls in a block.
        warm_up: calls before the first block, as many as in a block by default.
    """
    times = []
    for _ in range(steps if warm_up is None else warm_up):
        step()
    for _ in range(blocks):
        wait()
        start = time.perf_counter()
        for _ in range(steps):
            step()
        wait()
        times.append((time.perf_counter() - start) / steps * 1e3)
    return statistics.median(times)
