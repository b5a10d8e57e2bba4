"""Commands about the installation and the physics: list, doctor and inspect."""

from pathlib import Path

import tyro

from torchrl_loco.checks import check_device
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.cli.options import OtherTask, summaries


def list_tasks() -> None:
    """List the environments."""
    for name, words in summaries().items():
        print(f"{name:<16} {words}")


def diagnose(
    body: tyro.conf.Positional[str] = "walker",
    /,
    size: str | None = None,
    num_envs: int = 2048,
    device: str | None = None,
) -> None:
    """Print versions, devices and the kernel cache, and test the physics of each device against C MuJoCo.

    Args:
        body: the body whose physics is compiled and tested, or a task; all for every body.
        size: a task: measure its njmax and naconmax instead.
        num_envs: number of worlds to measure with.
        device: where to measure; default: CUDA if there is any.
    """
    from torchrl_loco import doctor

    if size is not None:
        with user_errors():
            for name, (needed, advised) in doctor.size(size, num_envs, device).items():
                print(f"{name:<9} up to {needed} needed under random actions, {advised} advised")
        return
    problems = []
    with user_errors(ValueError):
        for finding in doctor.diagnose(body):
            print(f"{finding.subject:<20} {finding.text}", flush=True)
            if finding.problem:
                problems.append(finding.subject)
    if problems:
        print(f"verdict: problems with {', '.join(problems)}")
        raise SystemExit(1)
    print("verdict: everything works")


def inspect(
    what: tyro.conf.Positional[str],
    /,
    task: OtherTask = None,
    device: str | None = None,
    terrain: Path | None = None,
) -> None:
    """Inspect a NaN dump: step its world again, substep by substep, in Warp and in C MuJoCo. Or the ground of a task.

    Args:
        what: the file that make(..., nan_dump=FILE) or a training run wrote; with --terrain, a task.
        task: the task that the file is of.
        device: where Warp computes; default: CUDA if there is any.
        terrain: a picture of the task's ground from above, which is written instead.
    """
    if terrain is not None:
        with user_errors():
            _draw_ground(what, terrain)
        return
    file = Path(what)
    with user_errors():
        from torchrl_loco import nan_dump

        check_device(device)  # before the first line is printed
        for line in nan_dump.describe(nan_dump.load(file, task), device):
            print(line)


def _draw_ground(task: str, picture: Path) -> None:
    """Writes a picture of the ground of a task.

    Raises:
        ValueError: the task is on a floor.
    """
    from torchrl_loco.registry import list_envs, resolve

    cls = resolve(task, by_user=True)
    if not hasattr(cls, "ground"):
        rough = ", ".join(name for name in list_envs() if name.endswith("_rough"))
        raise ValueError(f"{task} has no attribute ground, a torchrl_loco.terrain.Terrain, as {rough} have")
    cls.ground.picture(picture)
    print(picture)
