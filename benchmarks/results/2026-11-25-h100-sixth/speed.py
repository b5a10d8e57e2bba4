"""Physics alone, and the step with hooks and resets from the same states under the same actions, ms a control step.

python speed.py 2048,8192,32768 go1_velocity,g1_velocity
"""

import statistics
import sys
from collections.abc import Callable

import torch

import torchrl_loco

DEVICE, STEPS, ROUNDS = torch.device("cuda"), 10, 8


def milliseconds(work: Callable[[], None]) -> float:
    """Returns the time that the device takes for some work."""
    begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    begin.record()
    work()
    end.record()
    torch.cuda.synchronize()
    return begin.elapsed_time(end)


@torch.no_grad()
def measure(task: str, worlds: int) -> None:
    """Prints the times of a task: of 8 rounds of 10 steps, the median of all but the first."""
    env = torchrl_loco.make(task, worlds, DEVICE, seed=0, stagger=True)
    td, sim = env.reset(), env.sim
    actions = [torch.randn(env.action_spec.shape, device=DEVICE) for _ in range(STEPS)]
    for k in range(100):
        td = env.step_and_maybe_reset(td.set("action", actions[k % STEPS]))[1]
    begin = {name: getattr(sim, name).clone() for name in ("qpos", "qvel", "qacc_warmstart")}
    graph, ctrls = sim.capture(sim.step), []

    def restore() -> None:
        for name, value in begin.items():
            getattr(sim, name).copy_(value)

    restore()
    for action in actions:
        td = env.step_and_maybe_reset(td.set("action", action))[1]
        ctrls.append(sim.ctrl.clone())

    def physics() -> None:
        for ctrl in ctrls:
            sim.ctrl.copy_(ctrl)
            graph.replay()

    def copies() -> None:
        for ctrl in ctrls:
            sim.ctrl.copy_(ctrl)

    def world() -> None:
        for action in actions:
            env.world.step(action)
            env.world.reset_masked()

    times = {}
    for work in (physics, copies, world):
        rounds = []
        for _ in range(ROUNDS):
            restore()
            rounds.append(milliseconds(work) / STEPS)
        times[work] = statistics.median(rounds[1:])
    alone = times[physics] - times[copies]
    print(f"{task} {worlds}: physics {alone:.3f} ms, with hooks and resets {times[world]:.3f}", flush=True)
    env.close()


if __name__ == "__main__":
    for name in sys.argv[2].split(","):
        for count in map(int, sys.argv[1].split(",")):
            measure(name, count)
