"""The start of a training by phase, from Enter to the first iteration and to the end, by the command itself.

``python -m benchmarks.startup TIME train TASK ...`` is the process that is measured; TIME is that of its start (s).
"""

import functools
import importlib._bootstrap as bootstrap  # type: ignore[import-not-found]
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.processes import run_json

if TYPE_CHECKING:
    from benchmarks.results import Row

CACHES = "WARP_CACHE_PATH", "CUDA_CACHE_PATH", "TORCHINDUCTOR_CACHE_DIR", "TRITON_CACHE_DIR"
"""Variables that say where kernels are kept."""
PHASES = {
    "imports": "",  # and the interpreter's own start
    "other": "",  # command line, files
    "warp": "sim.warp_init:init_warp",
    "worlds": "training.environments:Environments.training",  # model and buffers
    "hooks": "envs.part:Part.compile envs.part:Part.record",  # traced, written as C++, compared
    "text": "sim.compiled.step:kept_source",  # of the physics' kernels
    "kernels": "sim.compilation:compile_kernels",  # NVRTC or the CPU's compiler, or loaded from the cache
    "recording": "sim.simulation:Simulation.capture",  # of launches; CUDA records batches in iterations 2 and 3
    "networks": "training.ppo:PPO.__init__ training.reppo:REPPO.__init__",
    "torch.compile": "training.algorithm:start_compiler training.algorithm:compiled envs.part:Part._compile_by_torch",
    "rollout 1": "collector:RolloutCollector.rollout",
    "update 1": "training.trainer:Trainer.iterate",
    "iterations": "",  # later ones
    "evaluation": "training.trainer:Trainer._summary",
    "pictures": "training.trainer:plot_runs training.trainer:record",
    "end": "",  # of the process
}
"""Where in torchrl_loco the time of phases is spent, less that of phases within."""
LATER = {"rollout 1": "", "update 1": "iterations"}
"""Phases of the first call alone, and those of later calls; an empty one is the caller's."""
WHOLE = "evaluation", "pictures"
"""Phases that keep what is within: worlds made for an evaluation count there."""
COLUMNS = {"task": "", "cache": "", **dict.fromkeys((*PHASES, "iteration 1", "total"), ".1f")}
"""Seconds of each phase; from Enter to the first finished iteration, and to the end of the process."""


def startup(tasks: Sequence[str], device: Any, iterations: int, repeats: int, settings: Sequence[str]) -> "list[Row]":
    """Trains each task for some iterations, first with empty caches, then ``repeats`` times with what that has left.

    Those of the ``settings`` of ``train``, as ``name=value``, that are no integers must not change the size of a batch.
    """
    from tqdm import tqdm

    from torchrl_loco.training import preset

    rows: list[Row] = []
    sizes = {name: int(value) for name, _, value in (each.partition("=") for each in settings) if value.isdecimal()}
    for task in tasks:
        frames = iterations * preset(task, device, **sizes).control_steps_per_batch
        with tempfile.TemporaryDirectory() as folder:
            fixed = f"device={device} total_frames={frames} eval_interval=0 video_seconds=0 trials=1 out={folder}"
            options = [f"--{setting}" for setting in (*fixed.split(), *settings)]
            environment = {**os.environ, **{name: f"{folder}/{name}" for name in CACHES}}
            for cache in tqdm(["empty", *["filled"] * repeats], desc=task):
                started = time.time()
                found = run_json(["benchmarks.startup", started, "train", task, *options], environment)
                ended = time.time()
                found |= {"end": ended - found.pop("ended"), "total": ended - started}
                rows.append({"task": task, "cache": cache, **found})
    return rows


def plot_startup(rows: "Sequence[Row]", picture: Path) -> None:
    """Draws a bar for each training, of its phases one after the other."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(10, 1.5 + 0.4 * len(rows)), layout="constrained")
    for number, phase in enumerate(PHASES):
        left = [sum(row[before] for before in list(PHASES)[:number]) for row in rows]
        color = plt.get_cmap("tab20")(number)
        axes.barh(range(len(rows)), [row[phase] for row in rows], left=left, label=phase, color=color)
    axes.plot([row["iteration 1"] for row in rows], range(len(rows)), "k|", markersize=16, label="iteration 1 is done")
    axes.set(xlabel="seconds from Enter", yticks=range(len(rows)))
    axes.set_yticklabels([f"{row['task']}, {row['cache']} cache" for row in rows])
    axes.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=6, fontsize="small")
    figure.savefig(picture, dpi=150)


class Clock:
    """Seconds of each phase of this process, in its main thread, from ``started`` (s since the epoch) on."""

    def __init__(self, started: float) -> None:
        self.started, self.since, self.running = started, started, ["imports"]
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)

    def turn(self) -> float:
        """Gives what has passed to the phase that runs. Returns the time."""
        before, self.since = self.since, time.time()
        self.seconds[self.running[-1]] += self.since - before
        return self.since

    def call(self, name: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Calls a function in a phase."""
        if not name or self.running[-1] in WHOLE or threading.current_thread() is not threading.main_thread():
            return function(*args, **kwargs)
        self.turn()
        self.running.append(name)
        try:
            result = function(*args, **kwargs)
            if name == "rollout 1" and (torch := sys.modules["torch"]).cuda.is_initialized():
                torch.cuda.synchronize()  # the end of an iteration waits by itself
            return result
        finally:
            if name == "update 1":
                self.seconds["iteration 1"] = self.turn() - self.started
            self.turn()
            self.running.pop()

    def timed(self, function: Callable[..., Any], first: str, later: str) -> Callable[..., Any]:
        """Returns a function whose first call is in one phase, and later calls in another."""
        names = [first]
        return functools.wraps(function)(lambda *a, **k: self.call(names.pop() if names else later, function, *a, **k))

    def watch(self, module: Any, path: str, name: str) -> None:
        """Lets calls of a function of a module be in a phase."""
        *owners, attribute = path.split(".")
        owner: Any = functools.reduce(getattr, owners, module)
        function = getattr(owner, attribute)
        timed = self.timed(function, name, LATER.get(name, name))
        if path == "compiled":  # torch.compile works when what this returns is first called
            timed = lambda *args, **kwargs: self.timed(function(*args, **kwargs), name, "")  # noqa: E731
        setattr(owner, attribute, timed)

    def watch_imports(self) -> None:
        """Lets imports be a phase, and functions be watched once their modules are imported."""
        awaited = {(*place.split(":"), name) for name, places in PHASES.items() for place in places.split()}
        load = bootstrap._find_and_load  # which the interpreter calls for a module that it does not have

        def find_and_load(name: str, *args: Any) -> Any:
            is_new, module = name not in sys.modules, self.call("imports", load, name, *args)
            for one in [one for one in awaited if is_new and name == f"torchrl_loco.{one[0]}"]:
                awaited.remove(one)
                self.watch(module, *one[1:])
            return module

        bootstrap._find_and_load = find_and_load


if __name__ == "__main__":
    clock = Clock(float(sys.argv.pop(1)))
    clock.turn()
    clock.running = ["other"]
    clock.watch_imports()
    from torchrl_loco.cli import main

    status, ended = main(), clock.turn()
    print(json.dumps({**clock.seconds, "ended": ended}))
    raise SystemExit(status)
