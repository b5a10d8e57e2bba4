"""The command ``torchrl-loco``: parse, call, exit.

Modules that take seconds to import are imported where they are used, so that help and errors appear at once.
"""

import atexit
import gc
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import tyro

import torchrl_loco
from torchrl_loco.checks import check_choice
from torchrl_loco.cli import runs
from torchrl_loco.cli.diagnosis import diagnose, inspect, list_tasks, warm
from torchrl_loco.cli.errors import process_name, tolerate_broken_streams, user_errors
from torchrl_loco.cli.motions import motion
from torchrl_loco.cli.options import VALUES, task_options
from torchrl_loco.cli.policies import evaluate, export, play, record, verify, watch
from torchrl_loco.garbage import OWN_PROCESS, importing


def main(args: Sequence[str] | None = None) -> int:
    """Runs the command line. Returns 0, or 130 when interrupted; exits with 2 for errors of the user."""
    if args is None:  # the process ends: collecting garbage among all that was imported would take seconds
        atexit.register(gc.freeze)
        OWN_PROCESS.set()
        if sys.stderr is None or sys.argv[1:2] in (["train"], ["resume"]):
            tolerate_broken_streams()
    try:
        _run(sys.argv[1:] if args is None else list(args))
    except KeyboardInterrupt:
        if args is None:  # the process ends: another Ctrl-C must not disturb that
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print(f"{process_name()}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # as of `torchrl-loco list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _run(args: list[str]) -> None:
    if args == ["--version"]:
        print(torchrl_loco.__version__)
        return
    complete = list(args)
    with importing():  # garbage collection takes a third of the time
        options_type = task_options(args) if args[:1] == ["train"] else None

    def train(options: Annotated[options_type, tyro.conf.arg(name="")]) -> None:  # type: ignore[valid-type]
        """Train a policy, with evaluation, curve and video. All settings: train TASK, or FILE.py:CLASS, --help."""
        runs.train(options, complete)

    commands: dict[str, Callable[..., None]] = {
        "train": train,
        "resume": runs.resume,
        "eval": evaluate,
        "record": record,
        "play": play,
        "watch": watch,
        "plot": runs.plot,
        "export": export,
        "verify": verify,
        "motion": motion,
        "inspect": inspect,
        "list": list_tasks,
        "doctor": diagnose,
        "warm": warm,
    }
    if args and not args[0].startswith("-"):
        with user_errors():
            command = commands[check_choice("command", args[0], commands)]
        prog = f"torchrl-loco {args[0]}"  # to which the parser's hints refer
        tyro.cli(command, prog=prog, args=args[1:], use_underscores=True, registry=VALUES)
        return
    tyro.extras.subcommand_cli_from_dict(
        commands, prog="torchrl-loco", description=torchrl_loco.__doc__, args=args, use_underscores=True
    )
