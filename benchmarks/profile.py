"""Where the time of a step goes, kernel by kernel."""

from collections.abc import Sequence

import torch

from benchmarks.cases import CASES, LEARNING, VARIANTS
from benchmarks.results import Row

COLUMNS = {"kernel": "", "body": "", "case": "", "launches": ".0f", "us each": ".2f", "us": ".1f", "share": ".1%"}
WARMUP, STEPS = 60, 20


@torch.no_grad()
def profile(bodies: Sequence[str], worlds: int, cases: Sequence[str], device: torch.device) -> list[Row]:
    """Returns a row for each kernel, the dearest first, for each body and case."""
    rows: list[Row] = []
    for body in bodies:
        for case in cases:
            step = {**CASES, **VARIANTS, **LEARNING}[case](body, worlds, device)
            for _ in range(WARMUP):
                step()
            torch.cuda.synchronize(device)
            with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA], acc_events=True) as profiler:
                for _ in range(STEPS):
                    step()
                torch.cuda.synchronize(device)
            events = sorted(profiler.key_averages(), key=lambda event: -event.self_device_time_total)
            total = sum(event.self_device_time_total for event in events)
            rows += [
                {
                    "kernel": event.key.removesuffix("_cuda_kernel_forward").replace("__locals__", ".")[:70],
                    "body": body,
                    "case": case,
                    "launches": event.count / STEPS,
                    "us each": event.self_device_time_total / event.count,
                    "us": event.self_device_time_total / STEPS,
                    "share": event.self_device_time_total / total,
                }
                for event in events
            ]
    return rows
