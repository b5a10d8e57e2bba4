"""How a time is taken, the same for us and for the peers."""

import statistics
import time
from collections.abc import Callable

BLOCKS, STEPS = 7, 40


def milliseconds(
    step: Callable[[], object], wait: Callable[[], object], blocks: int = BLOCKS, steps: int = STEPS
) -> float:
    """Returns the time of a call of ``step``: the median over blocks of calls, each from idle device to idle device.

    Args:
        step: may return before its work is done.
        wait: returns when all work is done.
        blocks: number of blocks that are timed; one more goes before them.
        steps: calls in a block.
    """
    times = []
    for block in range(blocks + 1):
        wait()
        start = time.perf_counter()
        for _ in range(steps):
            step()
        wait()
        if block:  # the first warms up
            times.append((time.perf_counter() - start) / steps * 1e3)
    return statistics.median(times)
