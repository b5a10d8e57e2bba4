"""The command ``torchrl-loco``: parse, call, exit."""

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import torchrl_loco
from torchrl_loco import doctor, registry

try:
    import tyro

    from torchrl_loco import training
except ImportError as error:  # the environments work without the extra, the command does not
    raise SystemExit(f"torchrl-loco: {error}. Install what it needs: pip install 'torchrl-loco[train]'") from None


def list_tasks() -> None:
    """List the environments."""
    for name, env in registry.ENVS.items():
        print(f"{name:<16} {(env.__doc__ or '').splitlines()[0]}")


def diagnose() -> None:
    """Print versions, devices and the kernel cache, and test the physics of each device against C MuJoCo."""
    well = True
    for subject, finding, is_well in doctor.diagnose():
        print(f"{subject:<20} {finding}{'' if is_well else '  <- NOT RIGHT'}", flush=True)
        well &= is_well
    if not well:
        raise SystemExit(1)


def evaluate(
    run: tyro.conf.Positional[Path],
    /,
    episodes: int | None = None,
    seed: int | None = None,
    device: str | None = None,
) -> None:
    """Evaluate the policy of a run over full episodes, without exploration.

    Args:
        run: folder of the run.
        episodes: number of episodes; default: as the run was evaluated.
        seed: seed that the episodes are drawn from; default: the episodes of the run's own evaluation.
        device: where to play them; default: where the run was trained.
    """
    with _user_errors():
        summary = training.evaluate_run(training.RunFolder(run), episodes, seed, device)
    training.report(summary)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the command line; returns 0, exits with 2 for what the user can mend, returns 130 when interrupted."""
    args = sys.argv[1:] if args is None else list(args)
    with _user_errors():
        device = _value_of("--device", args)
        presets = {task: training.preset(task, device) for task in registry.list_envs()}
    task_config = tyro.extras.subcommand_type_from_defaults(
        presets,
        {task: f"Train {task}." for task in presets},
        prefix_names=False,
    )

    def train(config: Annotated[task_config, tyro.conf.arg(name="")]) -> None:  # type: ignore[valid-type]
        """Train a policy with PPO: evaluation, learning curve and video included."""
        with _user_errors():
            run = training.RunFolder.create(config)
        training.train(run)

    try:
        tyro.extras.subcommand_cli_from_dict(
            {"train": train, "eval": evaluate, "list": list_tasks, "doctor": diagnose},
            prog="torchrl-loco",
            description=torchrl_loco.__doc__,
            args=args,
            use_underscores=True,
        )
    except KeyboardInterrupt:
        print("torchrl-loco: interrupted; the run folder holds what there was", file=sys.stderr)
        return 130
    return 0


@contextlib.contextmanager
def _user_errors() -> Iterator[None]:
    """Turns errors about what the user passed into one line and exit status 2."""
    try:
        yield
    except (ValueError, TypeError, OSError) as error:
        print(f"torchrl-loco: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _value_of(flag: str, args: Sequence[str]) -> str | None:
    """Returns what follows ``flag``: the presets depend on the device, so it is read before the rest."""
    for i, arg in enumerate(args):
        if arg == flag and i + 1 < len(args):
            return args[i + 1]
        if arg.startswith(f"{flag}="):
            return arg.removeprefix(f"{flag}=")
    return None
