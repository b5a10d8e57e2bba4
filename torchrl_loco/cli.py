"""The command ``torchrl-loco``: parse, call, exit.

Modules that take seconds to import are imported where they are used, so that help and errors appear at once.
"""

import contextlib
import dataclasses
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args

import tyro

import torchrl_loco
from torchrl_loco.checks import (
    SEED,
    check_choice,
    check_device,
    check_float,
    check_int,
    check_output_file,
    check_run,
    is_run,
    is_run_group,
)

if TYPE_CHECKING:
    from torchrl_loco import training

CONTAINERS = (".mp4", ".mkv", ".mov")
"""Suffixes of a video."""

EXTRA = ("matplotlib", "tensorboard", "imageio", "av")
"""Modules of the extra "train"."""

VALUES = tyro.constructors.ConstructorRegistry()
"""How values are parsed, where the parser's own rules are inconvenient."""


@VALUES.primitive_rule
def _integers_and_optionals(info: tyro.constructors.PrimitiveTypeInfo) -> Any:
    """Parses integers as people write them, and optional values without the word None."""
    kinds = get_args(info.type) if info.type_origin in (Union, UnionType) else (info.type,)
    named = [kind for kind in kinds if kind is not NoneType]
    if named != [int] and (len(named) != 1 or len(kinds) == 1):
        return None
    parse: Callable[[str], Any] = _integer if named == [int] else named[0]
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=named[0].__name__.upper(),
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda value: isinstance(value, tuple(kinds)),
        str_from_instance=lambda value: [str(value)],
    )


def _integer(word: str) -> int:
    with contextlib.suppress(ValueError):
        return int(word)
    with contextlib.suppress(ValueError):
        if (value := float(word)).is_integer():
            return int(value)
    raise ValueError(f"{word!r} is not an integer: write it as 100000, 100_000 or 1e5")


def list_tasks() -> None:
    """List the environments."""
    for name, words in _summaries().items():
        print(f"{name:<16} {words}")


def _summaries() -> dict[str, str]:
    """Returns what each environment asks for, by id."""
    from torchrl_loco.registry import list_envs, summary

    summaries = {}
    for name in list_envs():
        try:
            summaries[name] = summary(name)
        except ImportError as error:
            summaries[name] = f"NOT USABLE: {error}"
    return summaries


def diagnose(size: str | None = None, num_envs: int = 2048, device: str | None = None) -> None:
    """Print versions, devices and the kernel cache, and test the physics of each device against C MuJoCo.

    Args:
        size: a task: measure its njmax and naconmax instead.
        num_envs: number of worlds to measure with.
        device: where to measure; default: CUDA if there is any.
    """
    from torchrl_loco import doctor

    if size is not None:
        with _user_errors():
            for name, (needed, advised) in doctor.size(size, num_envs, device).items():
                print(f"{name:<9} up to {needed} needed under random actions, {advised} advised")
        return
    problems = []
    for finding in doctor.diagnose():
        print(f"{finding.subject:<20} {finding.text}", flush=True)
        if finding.problem:
            problems.append(finding.subject)
    if problems:
        print(f"verdict: problems with {', '.join(problems)}")
        raise SystemExit(1)
    print("verdict: everything works")


RunOrTask = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="RUN_OR_TASK", help="a run folder, a policy file, or the id of a task for the policy of the package."
    ),
]
Protocol = Annotated[
    Literal["playground", "dm_control"],
    tyro.conf.arg(help="which policy of the package, by what it was trained under; any is played under its own."),
]


def _policy(run_or_task: str, protocol: str, device: str | None) -> tuple["torchrl_loco.Policy", Path]:
    """Returns a policy, and the path from which the default names of its video and of its export derive."""
    if task := _shipped_task(run_or_task):
        return torchrl_loco.load_policy(task, device, protocol), Path(task)
    source = Path(run_or_task)
    if not source.is_dir():
        return torchrl_loco.Policy.load(source, device), source
    from torchrl_loco import training

    run = training.RunFolder(source)
    return run.load_policy(device), run.policy


def _shipped_task(name: str) -> str:
    """Returns the id of the task that was named instead of a file or a folder, or an empty string."""
    if Path(name).exists():
        return ""
    from torchrl_loco.registry import canonical_id

    try:
        return canonical_id(name)
    except ValueError as error:
        raise ValueError(f"there is no run folder or policy file {name!r}, and {error}") from None


def evaluate(
    run_or_task: RunOrTask,
    /,
    episodes: int | None = None,
    seed: int | None = None,
    protocol: Protocol = "playground",
    device: str | None = None,
) -> None:
    """Evaluate a trained policy over full episodes, without exploration.

    Args:
        run_or_task: what to evaluate.
        episodes: number of episodes; default: as the policy was evaluated after its training.
        seed: seed of the episodes; default: those of that evaluation.
        protocol: which policy of the package.
        device: where to play them; default: CUDA if there is any.
    """
    with _user_errors():
        policy, _ = _policy(run_or_task, protocol, device)
        from torchrl_loco import training

        summary = training.evaluate_policy(policy, episodes, seed)
    print(training.describe(summary))


def resume(run: tyro.conf.Positional[Path], /, gpus: int | None = None, total_frames: int | None = None) -> None:
    """Continue a run that was stopped, from its last checkpoint, as if it had not been stopped.

    Args:
        run: folder of the run, or of the runs of several seeds, of which all that is missing is trained.
        gpus: as in train: pass the same number to continue exactly.
        total_frames: train one run to another number of frames, also if it is complete. The learning rate follows the
            new number from here on.
    """
    with _user_errors():
        check_run(run, or_group=True)
        from torchrl_loco import training

        if is_run_group(run):
            if total_frames is not None:
                raise ValueError(f"{run} holds the runs of several seeds: total_frames is for one of them")
            _refuse_seeds_of_ranks(gpus)
            group = training.RunGroup(run)
            group.check()
        else:
            folder = training.RunFolder(run)
            device = folder.load_config().device
            missing = _missing_processes(gpus, device)
    if is_run_group(run):
        _train_group(group)
    elif missing:
        more = [] if total_frames is None else [f"--total_frames={total_frames}"]
        training.distributed.launch(missing, ["resume", str(run), f"--gpus={gpus}", *more])
    else:
        with _joined(device):
            with _user_errors():
                if total_frames is not None:
                    if training.distributed.is_first():
                        folder.extend(total_frames)
                    training.distributed.wait_for_all()
                trainer = training.Trainer(folder, resume=True)
            _train(trainer)


@dataclasses.dataclass(frozen=True)
class Video:
    """Options of a video."""

    seconds: float = 10.0
    """Length of the video (s)."""
    camera: Literal["side", "back", "egocentric"] = "side"
    """Which of the model's cameras."""
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

    def make(self, policy: "torchrl_loco.Policy", default: Path) -> None:
        """Records the policy into ``out``, or into ``default`` or a numbered sibling of it, and prints the path."""
        from torchrl_loco import training

        out = check_output_file("out", training.unused_path(default)) if self.out is None else self.out
        print(f"recording {self.seconds:g} s; on a CPU this takes a while", file=sys.stderr)  # logs have no bar
        training.record(policy, self.env(policy), out, self.seconds, policy.info["action_repeat"], self.camera)
        print(out)

    def env(self, policy: "torchrl_loco.Policy") -> "torchrl_loco.LocoEnv":
        """Returns one world of the policy's task."""
        info = policy.info
        return torchrl_loco.make(info["task"], 1, self.device, self.seed, info["protocol"], world_offset=0)


VideoOptions = Annotated[Video, tyro.conf.arg(name="")]


def record(run_or_task: RunOrTask, /, protocol: Protocol = "playground", video: VideoOptions = Video()) -> None:
    """Record a video of a trained policy.

    Args:
        run_or_task: what to record.
        protocol: which policy of the package.
        video: which part of an episode is shown, and how.
    """
    with _user_errors():
        video.check()
        policy, beside = _policy(run_or_task, protocol, video.device)
        video.make(policy, _video_file(policy, beside))


def play(run_or_task: RunOrTask, /, protocol: Protocol = "playground", video: VideoOptions = Video()) -> None:
    """Show a trained policy: in a window if there is a display, else as a video.

    Args:
        run_or_task: what to play.
        protocol: which policy of the package.
        video: which part of an episode is shown, and how; --out always records a video.
    """
    with _user_errors():
        from torchrl_loco import training

        video.check()
        policy, beside = _policy(run_or_task, protocol, video.device)
        info, shown = policy.info, ("algorithm", "protocol", "seed", "frames", "seconds", "trained_on")
        print(info["task"], *(f"{key} {info[key]}" for key in shown if key in info), sep=", ")
        if "mean" in info:
            print(training.describe(info))
        if video.out is None and training.has_display():
            training.view(policy, video.env(policy), info["action_repeat"])
        else:
            video.make(policy, _video_file(policy, beside))


def _video_file(policy: "torchrl_loco.Policy", beside: Path) -> Path:
    """Returns the default file of a video: that of a run folder; elsewhere it is named after the task."""
    return beside.with_name("video.mp4" if is_run(beside.parent) else f"{policy.info['task']}.mp4")


def export(
    run_or_task: RunOrTask,
    /,
    format: Literal["onnx", "torch"] = "onnx",
    out: Path | None = None,
    protocol: Protocol = "playground",
) -> None:
    """Write a policy as a file for programs without this package, and compare it with the policy.

    Args:
        run_or_task: what to export.
        format: onnx, or torch for a program of torch.export (.pt2).
        out: the file, a new one; default: a new file beside the policy, or TASK.onnx for a policy of the package.
        protocol: which policy of the package.
    """
    with _user_errors(ValueError, TypeError, OSError, ImportError, RuntimeError):
        policy, beside = _policy(run_or_task, protocol, "cpu")
        from torchrl_loco import training
        from torchrl_loco.export import SUFFIXES, TOLERANCE, export_policy

        suffix = SUFFIXES[format]
        if out is not None:
            check_output_file("out", out, (suffix,))
        out = training.unused_path(beside.with_suffix(suffix)) if out is None else out
        error = export_policy(policy, out)
    print(f"largest difference from the policy, on random observations: {error:.1e} (at most {TOLERANCE:.0e})")
    print(out)


def inspect(file: tyro.conf.Positional[Path], /, device: str | None = None) -> None:
    """Inspect a NaN dump: step its world again, substep by substep, in Warp and in C MuJoCo.

    Args:
        file: the file that make(..., nan_dump=FILE) or a training run wrote.
        device: where Warp computes; default: CUDA if there is any.
    """
    with _user_errors():
        from torchrl_loco import nan_dump

        check_device(device)  # before the first line is printed
        for line in nan_dump.describe(nan_dump.load(file), device):
            print(line)


def plot(runs: tyro.conf.Positional[tuple[Path, ...]], /, out: Path = Path("learning_curves.png")) -> None:
    """Plot the learning curves of runs; runs that differ only in their seed become a mean and a band.

    Args:
        runs: folders of the runs, or of the runs of several seeds.
        out: the picture; an existing one is replaced.
    """
    with _user_errors():
        from torchrl_loco import training

        folders: list[training.RunFolder] = []
        for run in runs:
            check_run(run, or_group=True)
            folders += training.RunGroup(run).plotted if is_run_group(run) else [training.RunFolder(run)]
        training.plot_runs(folders, out)
    print(out)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the command line. Returns 0, or 130 when interrupted; exits with 2 for errors of the user."""
    try:
        _run(sys.argv[1:] if args is None else list(args))
    except KeyboardInterrupt:
        print(f"{_name()}: interrupted", file=sys.stderr)
        return 130
    return 0


def _run(args: list[str]) -> None:
    """Runs one command."""
    complete = list(args)
    task_config = _task_config(args) if args[:1] == ["train"] else None

    def train(config: Annotated[task_config, tyro.conf.arg(name="")]) -> None:  # type: ignore[valid-type]
        """Train a policy: evaluation, learning curve and video included. All settings: train TASK --help."""
        with _user_errors():
            if {"--seed", "--seeds"} <= {arg.partition("=")[0] for arg in args}:
                raise ValueError("--seed trains one seed, --seeds several: pass one of them")
            plain, seeds, gpus = _settings(config)
            if seeds:
                _refuse_seeds_of_ranks(gpus)
                group = _begin_group(plain, seeds)
            missing = _missing_processes(gpus, plain.device)
        if seeds:
            _train_group(group)
        elif missing:
            from torchrl_loco.training import distributed

            distributed.launch(missing, complete)
        else:
            with _joined(plain.device):
                with _user_errors():
                    trainer = _begin(plain)
                _train(trainer)

    commands: dict[str, Callable[..., None]] = {
        "train": train,
        "resume": resume,
        "eval": evaluate,
        "record": record,
        "play": play,
        "plot": plot,
        "export": export,
        "inspect": inspect,
        "list": list_tasks,
        "doctor": diagnose,
    }
    if args and not args[0].startswith("-"):
        with _user_errors():
            check_choice("command", args[0], commands)
        commands = {args[0]: commands[args[0]]}  # alone, so that the parser's hints are about this command
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="torchrl-loco",
        description=torchrl_loco.__doc__,
        args=args,
        use_underscores=True,
        registry=VALUES,
    )


def _task_config(args: list[str]) -> Any:
    """Returns the type of a task's settings; removes from ``args`` the options that choose the preset."""
    from torchrl_loco.registry import canonical_id
    from torchrl_loco.training.config import CONFIGS, TrainingConfig
    from torchrl_loco.training.presets import preset, tuning_note

    about = _summaries()
    device, algorithm = (_take(flag, args) for flag in ("--device", "--algorithm"))
    if len(args) > 1 and not args[1].startswith("-"):
        with _user_errors():
            task = args[1] = canonical_id(args[1])
            config = _options(preset(task, device, algorithm))
        about[task] += f" {tuning_note(config)}\n\n--algorithm, {' or '.join(CONFIGS)} (here {config.algorithm}), and"
        about[task] += " --device choose the\nsettings and their defaults."
        configs = {task: config}
    else:  # the list of tasks need not wait for the imports of presets
        configs = {task: TrainingConfig(task) for task in about}
    return tyro.extras.subcommand_type_from_defaults(configs, about, prefix_names=False)


GPUS = Annotated[
    int | None,
    tyro.conf.arg(
        help="Train on so many GPUs of this machine, each with num_envs worlds; on a CPU, in so many processes."
    ),
]
SEEDS = Annotated[tuple[int, ...], tyro.conf.arg(help="Train these seeds one after the other, into one folder.")]


def _options(config: "training.TrainingConfig") -> "training.TrainingConfig":
    """Returns the settings as options: with their task fixed, as a preset belongs to one, several seeds and GPUs."""
    hidden = Annotated[str, tyro.conf.Suppress, tyro.conf.Fixed]
    kind = type(config)
    fields = [("task", hidden, config.task), ("seeds", SEEDS, ()), ("gpus", GPUS, None)]
    cls = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True)
    return cls(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})


def _settings(options: Any) -> tuple["training.TrainingConfig", tuple[int, ...], int | None]:
    """Returns the settings, the seeds and the number of GPUs of what :func:`_options` returned."""
    (kind,) = type(options).__bases__
    settings = kind(**{field.name: getattr(options, field.name) for field in dataclasses.fields(kind)})
    return settings, options.seeds, options.gpus


def _begin(config: "training.TrainingConfig") -> "training.Trainer":
    """Makes the run folder and the trainer of a run; in place of a process that died, those of its run."""
    from torchrl_loco import training

    trainer, distributed = training.Trainer, training.distributed  # imports the extra: else no folder is made
    path = Path()
    if distributed.is_first():
        began = training.RunFolder.of_launch(config) if distributed.is_restart() else None
        if began is None and (note := training.tuning_note(config)):
            print(note)
        path = (began or training.RunFolder.create(config)).path
        print(f"run folder: {path}{', which torchrun continues after a failure' if began else ''}", flush=True)
    run = training.RunFolder(distributed.from_first(path))
    had_checkpoint = run.has_checkpoint
    try:
        return trainer(run, resume=had_checkpoint)
    except BaseException:
        if distributed.ranks() == 1 and not had_checkpoint:  # an empty run folder is of no use
            shutil.rmtree(run.path)
        raise


def _refuse_seeds_of_ranks(gpus: int | None) -> None:
    """Checks that several seeds are trained by one process.

    A seed that fails must not end the others, but ranks that wait for a failed one cannot go on.
    """
    if (gpus or 1) > 1 or int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError("several seeds are trained one after the other by one process: pass --seed with several GPUs")


def _missing_processes(gpus: int | None, device: str) -> int:
    """Checks the number of processes that is asked for. Returns how many are still to be started."""
    if gpus is None:
        return 0
    check_int("gpus", gpus)
    if "RANK" in os.environ:  # of torchrun
        if gpus != int(os.environ["WORLD_SIZE"]):
            raise ValueError(f"torchrun has started {os.environ['WORLD_SIZE']} processes: leave --gpus {gpus} out")
        return 0
    if gpus > 1 and device != "cpu":
        import torch

        if gpus > (count := torch.cuda.device_count()):
            raise ValueError(f"gpus must be at most the {count} GPUs of this machine, got {gpus}")
    return gpus if gpus > 1 else 0


@contextlib.contextmanager
def _joined(device: str) -> Iterator[None]:
    """Connects the ranks of torchrun, if there are several, while the block lasts."""
    from torchrl_loco.training import distributed

    with contextlib.ExitStack() as ranks:
        with _user_errors():
            ranks.enter_context(distributed.joined(device))
        yield


def _name() -> str:
    """Returns what the lines of this process begin with."""
    return f"torchrl-loco, rank {os.environ['RANK']}" if "RANK" in os.environ else "torchrl-loco"


def _begin_group(config: "training.TrainingConfig", seeds: tuple[int, ...]) -> "training.RunGroup":
    """Makes the folder for the runs of several seeds."""
    from torchrl_loco import training

    group = training.RunGroup.create(config, seeds)
    if note := training.tuning_note(config):
        print(note)
    print(f"folder of the runs: {group.path}")
    return group


def _train_group(group: "training.RunGroup") -> None:
    """Trains the seeds that are missing and prints where the results are; exits with 1 if some failed."""
    way = f"to continue: torchrl-loco resume {group.path}"
    try:
        with _user_errors(OSError):  # as of a run
            failed = group.train()
    except (KeyboardInterrupt, SystemExit):
        print(way, file=sys.stderr)
        raise
    if failed:
        print(way, file=sys.stderr)
        raise SystemExit(1)
    print(f"policies, curves, videos and logs: {group.path}")


def _train(trainer: "training.Trainer") -> None:
    """Trains to the last frame and prints where the results are."""
    from torchrl_loco.training import distributed

    ranks, first = distributed.ranks(), distributed.is_first()
    try:
        with _user_errors(OSError):  # such as a full disk; other errors are bugs and keep their traceback
            trainer.train()
    except (KeyboardInterrupt, SystemExit):
        if first and trainer.run.has_checkpoint:
            print(f"to continue: {_way_to_resume(trainer.run.path, ranks)}", file=sys.stderr)
        raise
    if first:
        print(f"policy, curve, video and logs: {trainer.run.path}")


def _way_to_resume(run: Path, ranks: int) -> str:
    """Returns the command that continues a run with the same number of ranks."""
    if ranks > 1 and os.environ.get("LOCAL_WORLD_SIZE") != str(ranks):
        return f"torchrun, with the options of this launch, -m torchrl_loco resume {run}"
    return f"torchrl-loco resume {run}" + (f" --gpus {ranks}" if ranks > 1 else "")


@contextlib.contextmanager
def _user_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Prints errors of the user, or errors of the given kinds, in one line and exits with status 2."""
    kinds = kinds or (ValueError, TypeError, OSError, ImportError, MemoryError)
    try:
        yield
    except kinds as error:
        print(f"{_name()}: {error}", file=sys.stderr)
        if isinstance(error, ModuleNotFoundError) and error.name in EXTRA:
            print("install it with: pip install 'torchrl-loco[train]', or pip install '.[train]'", file=sys.stderr)
        raise SystemExit(2) from None


def _take(flag: str, args: list[str]) -> str | None:
    """Removes ``flag`` and its value from ``args`` and returns the value, by which the other options are chosen."""
    for i, arg in enumerate(args):
        if arg == flag and i + 1 < len(args):
            value = args[i + 1]
            del args[i : i + 2]
            return value
        if arg.startswith(f"{flag}="):
            del args[i]
            return arg.removeprefix(f"{flag}=")
    return None
