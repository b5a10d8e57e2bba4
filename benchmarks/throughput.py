"""Steps per second from the bare simulator to a collector, side by side on one device.

    python -m benchmarks --worlds 2048 8192 --out benchmarks/results/throughput.json

Times are of one control step of all worlds, in milliseconds: the median over blocks of steps, each block timed from an
idle device to an idle device. Ratios are to the bare loop with mujoco_warp's defaults.
"""

import argparse
import datetime
import json
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import mujoco_warp as mjw
import torch
import warp as wp
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from tqdm import tqdm

import torchrl_loco
from torchrl_loco import models
from torchrl_loco.config import sim_config
from torchrl_loco.sim import Simulation, current_stream

TASKS = {"walker": "walker_walk", "humanoid": "humanoid_walk"}
BLOCKS, STEPS = 7, 40


def bare_default(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """A plain loop of ``mujoco_warp.step`` in a graph, with mujoco_warp's own settings but for the printing."""
    sim = Simulation(models.load(body), sim_config(body, "playground", n, {}), n, device)
    sim.model.opt.graph_conditional, sim.model.opt.run_qacc_smooth = True, True
    mask = wp.ones(n, dtype=bool, device=sim.device)
    with wp.ScopedDevice(sim.device):
        sim.reset(mask)
        mjw.step(sim.model, sim.data)
        with wp.ScopedCapture(device=sim.device) as capture:
            for _ in range(sim.substeps):
                mjw.step(sim.model, sim.data)
    wp.synchronize_device(sim.device)

    def step() -> None:
        sim.ctrl.uniform_(-1.0, 1.0)
        wp.capture_launch(capture.graph, stream=current_stream(sim.device))

    return step


def bare_tuned(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """Our simulation's recorded control step, without observation or reward."""
    sim = Simulation(models.load(body), sim_config(body, "playground", n, {}), n, device)
    mask = wp.ones(n, dtype=bool, device=sim.device)
    graph = sim.capture(sim.step)
    sim.capture(lambda: (sim.reset(mask), sim.forward(mask))).replay()

    def step() -> None:
        sim.ctrl.uniform_(-1.0, 1.0)
        graph.replay()

    return step


def env_step(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """``env._step`` on random actions."""
    env = torchrl_loco.make(TASKS[body], n, device, seed=0)
    td = env.reset()

    def step() -> None:
        env._step(td.set("action", torch.empty(env.action_spec.shape, device=device).uniform_(-1.0, 1.0)))

    return step


def env_step_and_maybe_reset(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """``env.step_and_maybe_reset`` on random actions, worlds at different points of their episodes."""
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, stagger=True)
    carried = [env.reset()]

    def step() -> None:
        action = torch.empty(env.action_spec.shape, device=device).uniform_(-1.0, 1.0)
        _, carried[0] = env.step_and_maybe_reset(carried[0].set("action", action))

    return step


def collector(body: str, n: int, device: torch.device) -> Callable[[], None]:
    """TorchRL's Collector with a 2x256 MLP, 20 steps a batch."""
    env = torchrl_loco.make(TASKS[body], n, device, seed=0, stagger=True)
    inputs, outputs = env.observation_size, env.action_spec.shape[-1]
    layers = [nn.Linear(inputs, 256), nn.SiLU(), nn.Linear(256, 256), nn.SiLU(), nn.Linear(256, outputs), nn.Tanh()]
    policy = TensorDictModule(nn.Sequential(*layers).to(device), in_keys=["observation"], out_keys=["action"])
    length = 20
    batches = iter(
        Collector(
            env,
            policy,
            frames_per_batch=n * length,
            total_frames=-1,
            device=device,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            trust_policy=True,
        )
    )
    ticks: Iterator[int] = iter(range(sys.maxsize))

    def step() -> None:  # a batch at every 20th call
        if next(ticks) % length == 0:
            next(batches)

    return step


CASES = [bare_default, bare_tuned, env_step, env_step_and_maybe_reset, collector]


def measure(step: Callable[[], None], device: torch.device) -> float:
    """Returns the time of a step in ms."""

    def wait() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    times = []
    for block in range(BLOCKS + 1):
        start = wait()
        for _ in range(STEPS):
            step()
        if block:  # the first warms up
            times.append((wait() - start) / STEPS * 1e3)
    return statistics.median(times)


def main() -> int:
    """Measures every case, prints a table and writes JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, nargs="+", default=[2048, 8192])
    parser.add_argument("--bodies", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--out", type=Path, help="file for the results as JSON")
    args = parser.parse_args()
    device = torch.device(args.device)
    rows = []
    runs = [(body, n, case) for body in args.bodies for n in args.worlds for case in CASES]
    with torch.no_grad():
        for body, n, case in tqdm(runs, desc="throughput"):
            rows.append(
                {"body": body, "worlds": n, "case": case.__name__, "ms": measure(case(body, n, device), device)}
            )
    base = {(row["body"], row["worlds"]): row["ms"] for row in rows if row["case"] == "bare_default"}
    print(f"{'body':<10}{'worlds':>8}  {'case':<26}{'ms':>9}{'ratio':>8}{'million steps/s':>17}")
    for row in rows:
        row["ratio"] = row["ms"] / base[row["body"], row["worlds"]]
        speed = row["worlds"] / row["ms"] / 1e3
        print(
            f"{row['body']:<10}{row['worlds']:>8}  {row['case']:<26}{row['ms']:>9.3f}{row['ratio']:>8.3f}{speed:>17.3f}"
        )
    if args.out:
        args.out.write_text(json.dumps({**environment(device), "rows": rows}, indent=1) + "\n")
    return 0


def environment(device: torch.device) -> dict[str, object]:
    """Returns what a reader needs to judge the figures by."""
    revision = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    return {
        "command": " ".join(["python -m benchmarks", *sys.argv[1:]]),
        "date": datetime.date.today().isoformat(),
        "revision": revision or "unknown",
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine(),
        "versions": {n: metadata.version(n) for n in ("torch", "torchrl", "warp-lang", "mujoco-warp", "mujoco")},
    }
