"""Commands on trained policies: eval, record, play, export and verify."""

import dataclasses
import ipaddress
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import tyro

import torchrl_loco
from torchrl_loco import training
from torchrl_loco.checks import SEED, check_device, check_float, check_int, check_output_file, check_run, is_run
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.cli.motions import Motions
from torchrl_loco.cli.options import Flat, OtherTask
from torchrl_loco.conditions import DEFAULT, Conditions
from torchrl_loco.known_files import place_of
from torchrl_loco.registry import label, resolve, task_name
from torchrl_loco.training.config import check_video
from torchrl_loco.viewer.settings import LOOPBACK, PORT, PORTS, SHARE, WORLDS, check_host, check_viewer

CONTAINERS = (".mp4", ".mkv", ".mov")  # suffixes of a video

RunOrTask = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="RUN_OR_TASK",
        help="a run folder, a policy file, or a task: the id of one for the policy of the package, or any, also "
        "FILE.py:CLASS, with --policy.",
    ),
]


@dataclasses.dataclass(frozen=True)
class Which(Motions):
    """Which policy plays, in which task, and by which motions."""

    protocol: Literal["playground", "dm_control"] = "playground"
    """Which policy of the package, by what it was trained under; any is played under its own."""
    policy: Path | None = None
    """A run folder or a policy file, to play in the task that is named."""
    task: OtherTask = None

    def load(
        self, run_or_task: str, device: str | None, *, tells_edits: bool = True
    ) -> tuple["torchrl_loco.Policy", Path]:
        """Returns a policy, and the path from which the default names of its video and of its export derive.

        Its task is the one that is named: ``task``, or ``run_or_task`` if ``policy`` says where the policy is.
        """
        policy, beside = self._load(run_or_task, device)
        from torchrl_loco.source import is_edited  # with torch, as a policy is

        if tells_edits and is_edited(policy.info, policy.info["task"]):
            print(f"{policy.info['task']} was edited since the training of this policy", file=sys.stderr)
        if given := self.given(policy.info["task"]):
            policy.info = torchrl_loco.policy.with_options(policy.info, given)
        return policy, beside

    def _load(self, run_or_task: str, device: str | None) -> tuple["torchrl_loco.Policy", Path]:
        """Returns a policy as its file has it, and the path beside which its files belong."""
        if self.task is not None and (self.policy is not None or not Path(run_or_task).exists()):
            raise ValueError(f"{run_or_task} names the task already: leave --task out")
        if self.policy is not None:
            try:
                named = _task(run_or_task)
            except ValueError:
                if not Path(run_or_task).exists():
                    raise
                why = "with --policy, the first word is the task to play in"
                raise ValueError(f"{run_or_task} is no task: {why}") from None
            policy, _ = _policy_at(self.policy, device, named)
            return policy, Path(label(policy.info["task"]))
        if Path(run_or_task).exists():
            return _policy_at(Path(run_or_task), device, None if self.task is None else _task(self.task))
        task = _task(run_or_task)
        if ":" in task:
            raise ValueError(
                f"the package has no policy for {task}: name one of yours with --policy, or its run folder"
            )
        return torchrl_loco.load_policy(task, device, self.protocol), Path(task)


def _policy_at(source: Path, device: str | None, task: str | None) -> tuple["torchrl_loco.Policy", Path]:
    """Returns the policy of a run folder or a file, and the path of its file.

    Of a run that was stopped before a policy was evaluated, it is that of the last checkpoint; a checkpoint can be
    named, too. The user may say the name of its task; else it is what the file says.
    """
    if source.suffix == ".pt" and is_run(source.parent):
        run = training.RunFolder(source.parent, task)
        if own := [name for name in run.given if name != "env"]:
            what = " and ".join(own)
            raise ValueError(f"{source} is of a run with {what} of your own, which it does not hold: name {run.policy}")
        return training.watching.last_policy(run, device, source), source
    if not source.is_dir():
        if source.suffix in torchrl_loco.export.SUFFIXES.values():
            raise ValueError(f"{source} is an exported policy: name what it was made of; verify plays .onnx files")
        policy = torchrl_loco.Policy.load(source, device)
        if missing := [name for name in ("task", "protocol", "action_repeat") if name not in policy.info]:
            raise ValueError(f"{source} lacks {' and '.join(missing)} in its info: save the policy with them")
        trained = policy.info["task"]
        policy.info = torchrl_loco.policy.in_task(policy.info, trained, task or place_of(trained, source.parent))
        return policy, source
    run = training.RunFolder(source, task)
    if run.policy.is_file() or run.given or not run.has_checkpoint:
        return run.load_policy(device), run.policy
    policy = training.watching.last_policy(run, device)
    after = f"after {policy.info['frames']:,} frames"
    print(f"{run.path}: no policy was evaluated yet, this is that of the last checkpoint, {after}", file=sys.stderr)
    return policy, run.policy


def _task(name: str) -> str:
    """Returns the name of a task, which stood where a file or a folder could be named too."""
    try:
        return task_name(name, by_user=True)
    except ValueError as error:
        raise ValueError(f"there is no run folder or policy file {name!r}, and {error}") from None


def evaluate(
    run_or_task: RunOrTask,
    /,
    episodes: int | None = None,
    seed: int | None = None,
    which: Flat[Which] = Which(),
    device: str | None = None,
) -> None:
    """Evaluate a trained policy over full episodes, without exploration.

    Args:
        run_or_task: what to evaluate.
        episodes: number of episodes; default: as the policy was evaluated after its training.
        seed: seed of the episodes; default: those of that evaluation.
        which: which policy, in which task.
        device: where to play them; default: CUDA if there is any.
    """
    with user_errors():
        played, _ = which.load(run_or_task, device)
        summary = training.evaluate_policy(played, episodes, seed)
    print(training.describe(summary))


@dataclasses.dataclass(frozen=True)
class Video:
    """Options of a video."""

    seconds: float = 10.0
    """Length of the video (s)."""
    camera: str = "side"
    """Name of one of the model's cameras."""
    seed: int = 0
    """Seed of the episode."""
    device: str | None = None
    """Where to play; default: CUDA if there is any."""
    out: Path | None = None
    """The video, a new file; default: a new file in the run folder, or TASK.mp4."""

    def check(self) -> None:
        """Checks all options before anything is printed or made."""
        check_float("seconds", self.seconds)
        check_int("seed", self.seed, SEED)
        if self.device is not None:  # looking for devices imports torch
            check_device(self.device)
        if self.out is not None:
            check_output_file("out", self.out, CONTAINERS)

    def make(self, policy: "torchrl_loco.Policy", beside: Path) -> None:
        """Records the policy into ``out``, or a new file ``beside`` that of the policy, and prints the path."""
        from torchrl_loco import storage

        default = beside.with_name("video.mp4" if is_run(beside.parent) else f"{label(policy.info['task'])}.mp4")
        out = check_output_file("out", storage.unused_path(default)) if self.out is None else self.out
        print(f"recording {self.seconds:g} s; on a CPU this takes a while", file=sys.stderr)  # logs have no bar
        training.record(policy, self.env(policy), out, self.seconds, policy.info["action_repeat"], self.camera)
        print(out)

    def env(self, policy: "torchrl_loco.Policy") -> "torchrl_loco.LocoEnv":
        """Returns one world of the policy's task."""
        return training.environments.make_for(policy, 1, self.device, self.seed, play=True)


@dataclasses.dataclass(frozen=True)
class Browser:
    """Options of the page in the browser."""

    num_envs: int = 4
    """Number of worlds side by side in the browser."""
    host: str = LOOPBACK
    """Address that the page is served at; by default this machine alone reaches it. There is no password."""
    port: int = PORT
    """Port of the page; the next free one if it is taken."""

    def check(self) -> None:
        """Checks all options before anything is printed or made."""
        check_viewer()
        check_host(self.host)
        check_int("num_envs", self.num_envs, WORLDS)
        check_int("port", self.port, PORTS)

    def show(
        self,
        env: "torchrl_loco.LocoEnv",
        policy: "torchrl_loco.Policy | None",
        newer: "Callable[[], torchrl_loco.Policy | None] | None" = None,
        cpu_share: float = 1.0,
    ) -> None:
        """Serves the page until it is interrupted, and prints its address."""
        from torchrl_loco.training.algorithm import settings_for_small_networks
        from torchrl_loco.viewer.viewer import Viewer

        with settings_for_small_networks():
            viewer = Viewer(env, policy, newer=newer, cpu_share=cpu_share, host=self.host, port=self.port)
            if not ipaddress.ip_address(check_host(self.host)).is_loopback:
                warning = f"warning: whoever reaches {self.host} can see and steer the worlds, without a password"
                print(warning, file=sys.stderr)
            print(f"open {viewer.url} in a browser; Ctrl-C ends it", flush=True)
            viewer.run()


def record(run_or_task: RunOrTask, /, which: Flat[Which] = Which(), video: Flat[Video] = Video()) -> None:
    """Record a video of a trained policy.

    Args:
        run_or_task: what to record.
        which: which policy, in which task.
        video: which part of an episode is shown, and how.
    """
    with user_errors():
        video.check()
        check_video()
        played, beside = which.load(run_or_task, video.device)
        video.make(played, beside)


def play(
    run_or_task: RunOrTask,
    /,
    viewer: Annotated[
        Literal["auto", "window", "browser", "video"],
        tyro.conf.arg(help="where it is shown; auto is a window if there is a display, else the browser."),
    ] = "auto",
    which: Flat[Which] = Which(),
    browser: Flat[Browser] = Browser(),
    video: Flat[Video] = Video(),
) -> None:
    """Show a trained policy: in a window, in the browser or as a video.

    Args:
        run_or_task: what to play.
        viewer: where it is shown.
        which: which policy, in which task.
        browser: how many worlds the browser shows, and at which address.
        video: which part of an episode is shown, and how; --out always records a video.
    """
    with user_errors():
        video.check()
        if video.out is not None:
            viewer = "video"
        if viewer == "browser":
            browser.check()
        if viewer == "window" and not training.has_display():
            raise ValueError("there is no display for a window: pass --viewer browser or --viewer video")
        if viewer == "video":
            check_video()
        played, beside = which.load(run_or_task, video.device)
        if viewer == "auto":
            viewer = _default_viewer(browser)
        info, about = played.info, ("algorithm", "protocol", "seed", "frames", "seconds", "trained_on")
        print(info["task"], *(f"{key} {info[key]}" for key in about if key in info), sep=", ")
        if "mean" in info:
            print(training.describe(info))
        if viewer == "window":
            training.view(played, video.env(played), info["action_repeat"])
        elif viewer == "browser":
            place = browser.num_envs, video.device, video.seed
            shown = training.environments.make_for(played, *place, reward_terms=True, play=True)
            browser.show(shown, played)
        else:
            video.make(played, beside)


def _default_viewer(browser: Browser) -> Literal["window", "browser", "video"]:
    """Returns where a policy is shown: in a window if there is a display, else in the browser, if that is installed."""
    if training.has_display():
        return "window"
    try:
        browser.check()
    except ImportError as error:
        print(f"torchrl-loco: there is no display for a window, and {error}. A video is recorded.", file=sys.stderr)
        check_video()
        return "video"
    return "browser"


def watch(
    run: tyro.conf.Positional[Path],
    /,
    device: str = "cpu",
    seed: int = 0,
    cpu_share: float = 0.02,
    task: OtherTask = None,
    browser: Flat[Browser] = Browser(),
) -> None:
    """Show a running training in the browser: its newest policy, swapped in as it appears.

    It reads the files of the run and nothing else, and computes with what other processes leave of the CPU.

    Args:
        run: folder of the run.
        device: where the worlds that are shown compute; on CUDA they would share the GPU with the training.
        seed: seed of the worlds.
        cpu_share: how much of the machine's CPU time it may take; pictures come slower where that is little.
        task: where its task is now.
        browser: how many worlds are shown, and at which address.
    """
    with user_errors():
        check_run(run)
        browser.check()
        check_int("seed", seed, SEED)
        check_float("cpu_share", cpu_share, SHARE)
        check_device(device)
        os.nice(19)  # the lowest priority that there is, also of threads that are made from here on
        if hasattr(os, "SCHED_IDLE"):  # of Linux: a fifth of the share of nice 19
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        folder = training.RunFolder(run, None if task is None else _task(task))
        watched = training.watching.Watched(folder, browser.num_envs, device, seed)
        browser.show(watched.env, watched.newer(), watched.newer, cpu_share)


def export(
    run_or_task: RunOrTask,
    /,
    format: Literal["onnx", "torch"] = "onnx",
    out: Path | None = None,
    which: Flat[Which] = Which(),
) -> None:
    """Write a policy as a file for programs without this package, and compare it with the policy.

    Args:
        run_or_task: what to export.
        format: onnx, or torch for a program of torch.export (.pt2).
        out: the file, a new one; default: a new file beside the policy, or TASK.onnx for a policy of the package.
        which: which policy, in which task.
    """
    with user_errors(ValueError, TypeError, OSError, ImportError, RuntimeError):
        written, beside = which.load(run_or_task, "cpu")
        from torchrl_loco import storage

        suffix = torchrl_loco.export.SUFFIXES[format]
        if out is not None:
            check_output_file("out", out, (suffix,))
        out = storage.unused_path(beside.with_suffix(suffix)) if out is None else out
        error = torchrl_loco.export_policy(written, out)
    if reason := torchrl_loco.export.why_not(written):
        print(f"the file holds the network alone: {reason}")
    most = torchrl_loco.export.TOLERANCE
    print(f"largest difference from the policy, on random observations: {error:.1e} (at most {most:.0e})")
    print(out)


def verify(
    run_task_or_file: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="RUN_TASK_OR_FILE",
            help="an exported policy (.onnx), or what export takes, which is exported for it: a run folder, a policy "
            "file, or the id of a task for the policy of the package.",
        ),
    ],
    /,
    which: Flat[Which] = Which(),
    device: str | None = None,
    alone: bool = False,
    out: Path | None = None,
    conditions: Flat[Conditions] = DEFAULT,
) -> None:
    """Play a policy, as exported, in its task in C MuJoCo, by the model's own options; status 1 if it does not hold.

    Falls, return, terms of the reward and metrics, beside those of the same episodes in the simulator of the training.
    The task says what it asks for, and under which late actions, friction, noise and pushes; options change it.

    Args:
        run_task_or_file: what to verify.
        which: which policy, exported or not, in which task.
        device: where the simulator of the training computes; default: CUDA if there is any.
        alone: whether to play it in C MuJoCo alone, which is quicker on a CPU.
        out: figures as JSON, a new file; default: a new verify.json in the run folder, none elsewhere.
        conditions: what the policy must hold in.
    """
    with user_errors(), tempfile.TemporaryDirectory() as folder:
        conditions.check()
        from torchrl_loco import storage
        from torchrl_loco import verify as verification

        out = None if out is None else check_output_file("out", out, (".json",))
        path = Path(run_task_or_file) if which.policy is None else which.policy
        if path.suffix == ".onnx":
            named = which.task if which.policy is None else run_task_or_file
            named = None if named is None else _task(named)
        else:
            exported, beside = which.load(run_task_or_file, "cpu", tells_edits=False)  # verify itself does
            if reason := torchrl_loco.export.why_not(exported):
                raise ValueError(f"{run_task_or_file} cannot be verified: {reason}")
            if alone:  # before the export, which takes seconds
                verification.check_alone(resolve(exported.info["task"]), conditions)
            path, named = Path(folder) / "policy.onnx", None
            with user_errors(RuntimeError):  # of the export alone
                torchrl_loco.export_policy(exported, path)
            if out is None and is_run(beside.parent):
                out = storage.unused_path(beside.with_name("verify.json"))
        print(f"verifying: {conditions.episodes} episodes, which take minutes on a CPU", file=sys.stderr, flush=True)
        report = verification.verify(path, conditions, device, alone=alone, task=named, options=which.given)
        print(*report.lines, sep="\n")
        if out is not None:
            try:
                storage.replace_file(out, f"{json.dumps(report.figures, indent=2)}\n".encode())
                print(out)
            except OSError as error:  # which says nothing of the policy
                print(f"torchrl-loco: the figures were not written: {error}", file=sys.stderr)
    if not report.holds:
        raise SystemExit(1)
