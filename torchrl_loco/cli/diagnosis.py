"""Commands about the installation and the physics: list, doctor, inspect and warm."""

import contextlib
import dataclasses
import io
import tempfile
import time
from pathlib import Path
from typing import Annotated

import tyro

from torchrl_loco import training
from torchrl_loco.checks import check_device, check_output_file
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.cli.options import OtherTask, summaries
from torchrl_loco.registry import list_envs, resolve


def list_tasks() -> None:
    """List the environments."""
    found = summaries()
    for name, words in found.items():
        print(f"{name:<{max(map(len, found))}} {words}")


def diagnose(
    body: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[BODY|TASK|FILE.py:CLASS|all]")] = "walker",
    /,
    size: str | None = None,
    num_envs: int | None = None,
    device: str | None = None,
) -> None:
    """Print versions, devices and the kernel cache, and test the physics of each device against C MuJoCo.

    Args:
        body: the body whose physics is compiled and tested, or a task; all for every body.
        size: a task: measure its njmax and naconmax instead.
        num_envs: number of worlds to measure with; default: 2048.
        device: where to measure; default: CUDA if there is any. The physics is tested on all devices.
    """
    from torchrl_loco import doctor

    if size is not None:
        with user_errors():
            for name, (needed, advised) in doctor.size(size, 2048 if num_envs is None else num_envs, device).items():
                print(f"{name:<9} up to {needed} needed under random actions, {advised} advised")
        return
    problems = []
    with user_errors(ValueError, ImportError, OSError):
        if (num_envs, device) != (None, None):
            raise ValueError("--num_envs and --device are for --size: without it all devices are tested")
        for finding in doctor.diagnose(body):
            print(f"{finding.subject:<20} {finding.text}", flush=True)
            if finding.problem:
                problems.append(finding.subject)
    if problems:
        print(f"verdict: problems with {', '.join(problems)}")
        raise SystemExit(1)
    print("verdict: everything works")


def inspect(
    what: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FILE|TASK")],
    /,
    task: OtherTask = None,
    device: str | None = None,
    terrain: Path | None = None,
) -> None:
    """Inspect a NaN dump: step its world again, substep by substep, in Warp and in C MuJoCo. Or the ground of a task.

    Args:
        what: the file that make(..., nan_dump=FILE) wrote, or the folder of a run; with --terrain, a task.
        task: the task that the file is of.
        device: where Warp computes; default: CUDA if there is any.
        terrain: a picture of the task's ground from above, which is written instead.
    """
    if terrain is not None:
        with user_errors():
            cls = resolve(what, by_user=True)
            if not hasattr(cls, "ground"):
                rough = ", ".join(name for name in list_envs() if name.endswith("_rough"))
                words = f"{what} has no attribute ground, a torchrl_loco.terrain.Terrain, as {rough} have"
                raise ValueError(f"{words}: add ground = ... to a class of yours")
            check_output_file("terrain", terrain)
            cls.ground.picture(terrain)
        print(terrain)
        return
    file = Path(what, "nan_dump.safetensors") if Path(what).is_dir() else Path(what)
    with user_errors():
        from torchrl_loco import nan_dump

        check_device(device)  # before the first line is printed
        for line in nan_dump.describe(nan_dump.load(file, task), device):
            print(line)


def warm(
    tasks: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TASK...")],
    /,
    algorithm: str | None = None,
    device: str | None = None,
) -> None:
    """Compile ahead what trainings of tasks need, for images and CI: two iterations of each, which leave no run.

    Args:
        tasks: the tasks, ids or FILE.py:CLASS.
        algorithm: as in train.
        device: as in train.
    """
    with user_errors():
        if not tasks:
            raise ValueError(f"name the tasks that are to be trained: {', '.join(summaries())}")
        check_device(device)
        configs = [training.preset(task, device, algorithm) for task in tasks]
    for task, config in zip(tasks, configs, strict=True):
        short = dataclasses.replace(config, total_frames=2 * config.control_steps_per_batch, trials=1)
        short = dataclasses.replace(short, eval_episodes=1, eval_interval=0, video_seconds=0.0)
        begin, unsaid = time.perf_counter(), contextlib.redirect_stdout(io.StringIO())  # what the policy earns
        with tempfile.TemporaryDirectory() as folder, user_errors(), unsaid:
            training.train(task, short, out=folder)
        print(f"{task}: its kernels are in the caches after {time.perf_counter() - begin:.0f} s", flush=True)
