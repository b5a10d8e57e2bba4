"""What cameras cost: pictures alone, beside MuJoCo-Warp's renderer, and environment steps with and without pixels."""

import functools
import statistics
import time
from collections.abc import Callable, Sequence

import mujoco_warp as mjw
import torch
import warp as wp

import torchrl_loco
from benchmarks.cases import until_interrupted
from benchmarks.results import Row
from benchmarks.tasks import TASKS
from torchrl_loco.eyes.scene import to_the_horizon
from torchrl_loco.eyes.tracer import Eye

COLUMNS = {
    **{"body": "", "worlds": "d", "pixels": "d", "rgb": ".3f", "shadows": ".3f", "depth": ".3f", "mjwarp": ".3f"},
    **{"M frames/s": ".2f", "step": ".3f", "step with pixels": ".3f"},
}
"""Milliseconds, and million pictures a second of ``rgb``; ``mjwarp`` is MuJoCo-Warp's renderer of rgb, its BVH too."""
ROUNDS, CALLS, SETTLE = 3, 20, 30


def pixels(names: Sequence[str], worlds: Sequence[int], sizes: Sequence[int], device: torch.device) -> list[Row]:
    """Measures bodies; returns a row for each, each number of worlds and each side of square pictures."""
    rows = []
    cases = [(name, n, size) for name in names for n in worlds for size in sizes]
    for name, n, size in until_interrupted(cases, "pixels"):
        plain = torchrl_loco.make(TASKS[name], n, device, 0, on_overflow="ignore")
        seeing = torchrl_loco.make(TASKS[name], n, device, 0, on_overflow="ignore", from_pixels=True, size=(size, size))
        times = {"step": _time(_stepping(plain), device), "step with pixels": _time(_stepping(seeing), device)}
        sim = plain.sim
        settings = {"rgb": {}, "shadows": {"shadows": True}, "depth": {"kinds": ("depth",)}}
        for kind, options in settings.items():
            eye = Eye(plain.mj_model, sim.device, 0, size, size, n, **options)
            look = functools.partial(eye.launch, sim.data.xpos, sim.data.xmat)
            times[kind] = _time(_replayed(look, sim.device), device)
        times["mjwarp"] = _time(_peer(plain, size, n), device)
        rows.append({"body": name, "worlds": n, "pixels": size, **times, "M frames/s": n / times["rgb"] / 1e3})
        plain.close()
        seeing.close()
    return rows


def _time(work: Callable[[], object], device: torch.device) -> float:
    """Returns the time of a call (ms), the median of several rounds."""

    def wait() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
            wp.synchronize_device(str(device))
        return time.perf_counter()

    work()
    found = []
    for _ in range(ROUNDS):
        start = wait()
        for _ in range(CALLS):
            work()
        found.append((wait() - start) / CALLS * 1e3)
    return statistics.median(found)


def _stepping(env: torchrl_loco.LocoEnv) -> Callable[[], None]:
    """Returns a step of random actions that is taken again and again, after some."""
    td = env.reset()
    generator = torch.Generator(env.device).manual_seed(0)
    action = 2 * torch.rand(env.action_spec.shape, generator=generator, device=env.device) - 1

    def step() -> None:
        nonlocal td
        td = env.step_and_maybe_reset(td.set("action", action))[1]

    for _ in range(SETTLE):
        step()
    return step


def _replayed(launch: Callable[[], None], device: wp.Device) -> Callable[[], None]:
    """Returns launches of Warp's as a graph on CUDA, as they are on a CPU."""
    launch()
    if not device.is_cuda:
        return launch
    with wp.ScopedDevice(device), wp.ScopedCapture() as capture:
        launch()
    return lambda: wp.capture_launch(capture.graph)


def _peer(env: torchrl_loco.LocoEnv, size: int, worlds: int) -> Callable[[], None]:
    """Returns MuJoCo-Warp's renderer of the same camera, without shadows."""
    seen, data, device = to_the_horizon(env.mj_model), env.sim.mujoco_data(), env.sim.device
    with wp.ScopedDevice(device):
        model = mjw.put_model(seen)
        camera = seen.camera(0).name
        context = mjw.create_render_context(
            seen, nworld=worlds, cam_res=(size, size), render_rgb=True, use_shadows=False, cam_active=[camera]
        )
    wp.synchronize_device(device)

    def render() -> None:
        mjw.camlight(model, data)
        mjw.refit_bvh(model, data, context)
        mjw.render(model, data, context)

    return render  # its refit of bounds cannot be replayed
