"""Steps per second from the bare simulator to a collector, side by side on one device.

Times are of one control step of all worlds. Ratios are to the bare loop with mujoco_warp's defaults. As a process of
its own (``python -m benchmarks.throughput DEVICE RUNS``, which are body, worlds and case each, as JSON) it compiles
what it measures before it waits for its turn.
"""

import gc
import json
import sys
from collections.abc import Sequence

import torch

from benchmarks.cases import BATCH_STEPS, CASES, VARIANTS, until_interrupted, waiter
from benchmarks.results import Row
from benchmarks.timing import WARM_UP, milliseconds, my_turn

COLUMNS = {"body": "", "worlds": "d", "case": "", "ms": ".3f", "ratio": ".3f", "million steps/s": ".3f"}
PHASES = {
    "physics": ("bare_compiled", None),
    "observation, reward, time limit": ("env_step", "bare_compiled"),
    "resets, TensorDicts": ("env_step_and_maybe_reset", "env_step"),
    "policy, storage": ("rollout_collector", "env_step_and_maybe_reset"),
}
"""Part of a collected step, and the cases whose difference it is."""


@torch.no_grad()
def throughput(bodies: Sequence[str], worlds: Sequence[int], cases: Sequence[str], device: torch.device) -> list[Row]:
    """Measures each case for each body and number of worlds; returns a row for each."""
    rows: list[Row] = []
    runs = [(body, n, case) for body in bodies for n in worlds for case in cases]
    rows += [measure(*run, device) for run in until_interrupted(runs, "throughput")]
    for row in rows:
        base = time_of(rows, row, "bare_default")
        row["ratio"] = row["ms"] / base if base else None
    return rows


def measure(body: str, n: int, case: str, device: torch.device) -> Row:
    """Measures a case; the more worlds, the less often."""
    step = {**CASES, **VARIANTS}[case](body, n, device)
    few = {"blocks": 3, "steps": BATCH_STEPS} if n > 20_000 else {}
    ms = milliseconds(step, waiter(device), warm_up=WARM_UP, **few)
    return {"body": body, "worlds": n, "case": case, "ms": ms, "million steps/s": n / ms / 1e3}


def phases(rows: Sequence[Row]) -> list[Row]:
    """Returns the time of each part of a collected step, as far as the rows tell: a row for body and worlds."""
    table = []
    for row in rows:
        if row["case"] != "bare_compiled":
            continue
        parts: Row = {"body": row["body"], "worlds": row["worlds"]}
        for phase, (case, before) in PHASES.items():
            ms, less = time_of(rows, row, case), 0.0 if before is None else time_of(rows, row, before)
            parts[phase] = None if ms is None or less is None else ms - less
        table.append(parts)
    return table


def time_of(rows: Sequence[Row], like: Row, case: str) -> float | None:
    """Returns the time of a case with the body and worlds of another row."""
    found = [r["ms"] for r in rows if (r["body"], r["worlds"], r["case"]) == (like["body"], like["worlds"], case)]
    return found[0] if found else None


@torch.no_grad()
def main(device: torch.device, runs: Sequence[tuple[str, int, str]]) -> None:
    """Compiles, waits and prints a row for each run."""
    for body, case in dict.fromkeys((body, case) for body, _, case in runs):
        first = next(n for b, n, c in runs if (b, c) == (body, case))
        {**CASES, **VARIANTS}[case](body, first, device)()
        release(device)
    my_turn()
    rows = []
    for run in runs:
        rows.append(measure(*run, device))
        release(device)
    print(json.dumps({"rows": rows}))


def release(device: torch.device) -> None:
    """Gives back the memory of worlds that are done: 131,072 humanoids of several cases at once fill an H200."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main(torch.device(sys.argv[1]), json.loads(sys.argv[2]))
