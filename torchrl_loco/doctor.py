"""What is on this machine, and whether the physics computes correctly on it."""

import contextlib
import dataclasses
import os
import platform
import time
from collections.abc import Iterable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import mujoco
import torch
import warp as wp
from tqdm.auto import trange

import torchrl_loco
from torchrl_loco.checks import check_choice, why_no_cuda
from torchrl_loco.registry import env_class, is_place, list_envs, make, task_name
from torchrl_loco.sim.mujoco_warp import with_margin
from torchrl_loco.sim.simulation import free_memory
from torchrl_loco.sim.warp_init import init_warp

PACKAGES = ("torch", "torchrl", "tensordict", "warp-lang", "mujoco-warp", "mujoco")
DEEP = 5e-3  # depth from which a contact at the start of an episode is told (m)
TOLERANCE = 1e-4  # largest median error of qpos (m, rad) after a control step that counts as correct


@dataclasses.dataclass(frozen=True)
class Finding:
    """A line of the report."""

    subject: str
    text: str
    problem: bool = False


def diagnose(body: str = "walker") -> Iterator[Finding]:
    """Yields what it finds of versions, devices and the kernel cache, and of the physics of a body on each device.

    The self-test of a body plays 20 random control steps in 4 worlds, each step also in C MuJoCo, which computes in
    double precision, from the same state.

    Args:
        body: the body, or a task, which may be ``file.py:Class``; ``"all"`` takes every body, those of plug-ins too.

    Raises:
        ValueError: there is no such body or task.
    """
    tasks: dict[str, str] = {}
    broken = []
    for task in list_envs():
        try:
            tasks.setdefault(env_class(task).body or task, task)  # one of a body is enough
        except ImportError as error:
            broken.append(Finding(task, str(error), problem=True))
    if body in tasks:
        tasks = {body: tasks[body]}
    elif body != "all":
        if not is_place(body):
            check_choice("body or task", body, [*tasks, "all", *list_envs()])
        tasks = {body: task_name(body, by_user=True)}
    yield Finding("python", f"{platform.python_version()} on {platform.platform()}")
    yield Finding("torchrl-loco", torchrl_loco.__version__)
    for name in PACKAGES:
        yield Finding(name, metadata.version(name))
    devices = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    yield Finding("cpu", f"{platform.machine()}, {os.cpu_count()} cores, {_gib(free_memory(torch.device('cpu')))} free")
    for device in devices[1:]:
        name = torch.cuda.get_device_properties(device).name
        free = _gib(free_memory(torch.device(device)))
        yield Finding(device, f"{name}, {free} free, CUDA {torch.version.cuda}")
    if len(devices) == 1:
        yield Finding("cuda", f"none: {why_no_cuda()}")
    try:
        yield Finding("kernel cache", _describe_cache())
    except OSError as error:
        yield Finding("kernel cache", f"{error}: name a writable folder in WARP_CACHE_PATH", problem=True)
        return
    yield from broken
    yield Finding(
        "self-test",
        f"of {', '.join(tasks)}: compiles what the kernel cache lacks, for up to half a minute a body and device",
    )
    for device in devices:
        for body, task in tasks.items():
            try:
                seconds, deviation, engine = self_test(task, device)
            except Exception as reason:  # the other bodies are still worth testing
                yield Finding(f"{body} on {device}", f"FAILED: {type(reason).__name__}: {reason}", problem=True)
                continue
            right = deviation < TOLERANCE  # false for NaN
            verdict = f"{'ok' if right else 'WRONG'}: differs from C MuJoCo by {deviation:.1e} (limit {TOLERANCE:.0e})"
            words = f"{verdict}, made in {seconds:.1f} s; engine {engine}"
            yield Finding(f"{body} on {device}", words, problem=not right)


def _gib(size: float) -> str:
    return f"{size / 2**30:.0f} GiB"


def _describe_cache() -> str:
    init_warp()  # else there is no folder yet
    folder = Path(wp.config.kernel_cache_dir)
    modules, size = set(), 0
    for name, _, files in os.walk(folder):
        for path in (Path(name, file) for file in files):
            with contextlib.suppress(FileNotFoundError):  # another process is compiling
                size += path.stat().st_size
            if path.suffix in (".o", ".cubin", ".ptx"):
                modules.add(path.parent)
    return f"{folder}, {len(modules)} modules, {size / 1e6:.0f} MB"


def size(task: str, num_envs: int, device: str | None = None, steps: int = 300) -> dict[str, tuple[int, int]]:
    """Returns the most ``njmax`` and ``naconmax`` that a task needs under MuJoCo-Warp, and the advised values.

    Actions are random, the same in every call. Other actions, a trained policy's for one, may need more.
    """
    limits = {"njmax": 1000, "naconmax": 200 * num_envs}
    env = make(task, num_envs, device, seed=0, world_offset=0, on_overflow="raise", engine="mujoco_warp", **limits)
    with torch.no_grad():
        td = env.reset()
        for action in random_actions(env, trange(steps, desc=f"{task}, {num_envs} worlds", leave=False, disable=None)):
            _, td = env.step_and_maybe_reset(td.set("action", action.to(env.device)))
    env.world.health.check()
    peak = env.health()["peak"]
    needed = {"njmax": int(peak["constraints"]), "naconmax": int(peak["contacts"])}
    return {name: (value, with_margin(value)) for name, value in needed.items()}


def random_actions(env: torchrl_loco.LocoEnv, steps: Iterable[int]) -> Iterator[torch.Tensor]:
    """Yields an action on the CPU for each step, ``(num_envs, nu)``, the same in every call."""
    generator = torch.Generator().manual_seed(0)
    for _ in steps:
        yield torch.rand(env.action_spec.shape, generator=generator) * 2 - 1


def self_test(task: str, device: str, steps: int = 20) -> tuple[float, float, str]:
    """Returns the seconds that making the environment took, the error of ``steps`` control steps, and the engine.

    The engine is in words, with a deep contact at the start if there is one. Actions are random.
    The error is the median over worlds and steps of the largest deviation of qpos from C MuJoCo (m, rad); NaN if
    anything was not finite.
    """
    start = time.perf_counter()
    settings: dict[str, Any] = {"seed": 0, "protocol": "dm_control", "world_offset": 0}
    env = make(task, 4, device, **settings)
    seconds = time.perf_counter() - start
    engine = env.engine if env.engine == "compiled" else f"{env.engine}: {env.engine_reason}"
    oracle, td, errors = make(task, 4, "cpu", engine="mujoco", **settings), env.reset(), []
    engine += starting_contact(env)
    for action in random_actions(env, range(steps)):
        state = oracle.reset(env.get_state().to("cpu"), set_state=True)
        oracle.step(state.set("action", action))
        td = env.step(td.set("action", action.to(env.device)))["next"]
        if env.world.non_finite.torch.any():
            return seconds, float("nan"), engine
        errors.append((env.sim.qpos.cpu() - oracle.sim.qpos).abs().amax(1))
    return seconds, float(torch.cat(errors).median()), engine


def starting_contact(env: torchrl_loco.LocoEnv) -> str:
    """Returns in words the deepest contact of the present poses, if it is deeper than ``DEEP``, else nothing."""
    m, deepest = env.mj_model, (-DEEP, "")
    d = mujoco.MjData(m)
    for pose in env.sim.qpos.cpu().numpy():
        d.qpos[:] = pose
        mujoco.mj_forward(m, d)
        for contact in d.contact:
            first, second = (m.geom(geom).name or m.body(m.geom_bodyid[geom]).name for geom in contact.geom)
            words = f"; its episodes begin with {first} and {second} {-1e3 * contact.dist:.0f} mm in each other"
            deepest = min(deepest, (float(contact.dist), words))
    return deepest[1]
