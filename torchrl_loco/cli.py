"""The command ``torchrl-loco``: parse, call, exit.

What takes seconds to import is imported where it is used: help and wrong options appear at once.
"""

import contextlib
import dataclasses
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args

import torchrl_loco
from torchrl_loco.checks import check_device, check_folder, check_run, check_seed
from torchrl_loco.config import suggestion

if TYPE_CHECKING:
    from torchrl_loco import training

try:
    import tyro
except ImportError as error:  # the environments work without the extra, the command does not
    hint = "pip install 'torchrl-loco[train]', or in a checkout pip install '.[train]'"
    raise SystemExit(f"torchrl-loco: {error}. Install what it needs: {hint}") from None

CONTAINERS = (".mp4", ".mkv", ".mov")
"""What the file of a video can be."""

VALUES = tyro.constructors.ConstructorRegistry()
"""How values are written, where the parser's own way is hard on the user."""


@VALUES.primitive_rule
def _whole_numbers_and_what_may_be_none(info: tyro.constructors.PrimitiveTypeInfo) -> Any:
    """Takes whole numbers as people write them, and what may be None as what it is else: nobody types None."""
    kinds = get_args(info.type) if info.type_origin in (Union, UnionType) else (info.type,)
    named = [kind for kind in kinds if kind is not NoneType]
    if named != [int] and (len(named) != 1 or len(kinds) == 1):
        return None
    parse: Callable[[str], Any] = _whole_number if named == [int] else named[0]
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=named[0].__name__.upper(),
        instance_from_str=lambda words: parse(words[0]),
        is_instance=lambda value: isinstance(value, tuple(kinds)),
        str_from_instance=lambda value: [str(value)],
    )


def _whole_number(word: str) -> int:
    with contextlib.suppress(ValueError):
        return int(word)
    with contextlib.suppress(ValueError):
        if (value := float(word)).is_integer():
            return int(value)
    raise ValueError(f"{word!r} is no whole number: write it as 100000, 100_000 or 1e5")


def list_tasks() -> None:
    """List the environments."""
    from torchrl_loco.ids import OURS, plugins

    about = dict(OURS)
    for name in plugins():
        from torchrl_loco.registry import env_class  # takes seconds, which most users' list need not

        try:
            about[name] = (env_class(name).__doc__ or "").strip().split("\n")[0]
        except ImportError as error:
            about[name] = f"NOT USABLE: {error}"
    for name, words in about.items():
        print(f"{name:<16} {words}")


def diagnose(size: str | None = None, num_envs: int = 2048, device: str | None = None) -> None:
    """Print versions, devices and the kernel cache, and test the physics of each device against C MuJoCo.

    Args:
        size: instead, measure what njmax and naconmax this task needs.
        num_envs: number of worlds to measure with.
        device: where to measure; default: CUDA if there is any.
    """
    from torchrl_loco import doctor

    if size is not None:
        with _user_errors():
            for name, (needed, advised) in doctor.size(size, num_envs, device).items():
                print(f"{name:<9} at most {needed} needed under random actions, {advised} advised")
        return
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
        from torchrl_loco import training

        check_run(run)
        summary = training.evaluate_run(training.RunFolder(run), episodes, seed, device)
    print(training.describe(summary))


def resume(run: tyro.conf.Positional[Path], /) -> None:
    """Go on with a run that was stopped, from its last checkpoint, as if it had not been.

    Args:
        run: folder of the run.
    """
    with _user_errors():
        from torchrl_loco import training

        check_run(run)
        trainer = training.Trainer(training.RunFolder(run), resume=True)
    _train(trainer)


@dataclasses.dataclass(frozen=True)
class Video:
    """What of an episode is shown."""

    seconds: float = 10.0
    """Length of the video (s)."""
    camera: Literal["side", "back", "egocentric"] = "side"
    """Which of the model's cameras."""
    seed: int = 0
    """Seed that the episode is drawn from."""
    device: str | None = None
    """Where to play; default: CUDA if there is any."""
    out: Path | None = None
    """The video; default: video.mp4 in the run's folder (record), TASK.mp4 where there is no display (play)."""

    def check(self) -> None:
        """Refuses what cannot be shown, before anything is printed or made."""
        if not 0 < self.seconds < math.inf:
            raise ValueError(f"seconds must be positive and finite, got {self.seconds}")
        check_seed(self.seed)
        if self.device is not None:  # to look for devices imports torch
            check_device(self.device)
        if self.out is not None:
            if self.out.suffix not in CONTAINERS:
                raise ValueError(f"out must end in one of {', '.join(CONTAINERS)}, got {self.out}")
            check_folder("out", self.out)

    def make(self, policy: "torchrl_loco.Policy", default: Path) -> None:
        """Records the policy into ``out`` or the default, and prints which."""
        from torchrl_loco import training

        out = default if self.out is None else self.out
        print(f"recording {self.seconds:g} s; on a CPU this takes a while", file=sys.stderr)  # in a log there is no bar
        training.record(policy, self.env(policy), out, self.seconds, policy.info["action_repeat"], self.camera)
        print(out)

    def env(self, policy: "torchrl_loco.Policy") -> "torchrl_loco.LocoEnv":
        """Returns one world of the policy's task."""
        return torchrl_loco.make(policy.info["task"], 1, self.device, self.seed, policy.info["protocol"])


VideoOptions = Annotated[Video, tyro.conf.arg(name="")]


def record(run: tyro.conf.Positional[Path], /, video: VideoOptions = Video()) -> None:
    """Record a video of the trained policy of a run.

    Args:
        run: folder of the run.
        video: what is shown.
    """
    with _user_errors():
        from torchrl_loco import training

        video.check()
        check_run(run)
        folder = training.RunFolder(run)
        video.make(torchrl_loco.Policy.load(folder.policy, video.device), folder.video)


def play(task: tyro.conf.Positional[str], /, policy: Path | None = None, video: VideoOptions = Video()) -> None:
    """Show a trained policy: in a window if there is a display, else as a video.

    Args:
        task: id of the environment.
        policy: a run, or the file of a policy; default: the one that comes with the package.
        video: what is shown; with --out, a video in any case.
    """
    with _user_errors():
        from torchrl_loco import training
        from torchrl_loco.ids import canonical_id

        name = canonical_id(task)
        if policy is not None and policy.is_dir():
            policy = training.RunFolder(check_run(policy)).policy
        video.check()
        if policy is None:
            trained = torchrl_loco.load_policy(task, video.device)
        else:
            trained = torchrl_loco.Policy.load(policy, video.device)
            if trained.info["task"] != name:
                raise ValueError(f"{policy} is a policy for {trained.info['task']}, not for {task}")
        shown = ("algorithm", "protocol", "seed", "frames", "seconds", "trained_on")
        print(task, *(f"{key} {trained.info[key]}" for key in shown if key in trained.info), sep=", ")
        if "mean" in trained.info:
            print(training.describe(trained.info))
        if video.out is None and training.has_display():
            training.view(trained, video.env(trained), trained.info["action_repeat"])
        else:
            video.make(trained, Path(f"{trained.info['task']}.mp4"))


def replay(file: tyro.conf.Positional[Path], /, device: str | None = None) -> None:
    """Step a world that was no longer finite again, substep by substep, in Warp and in C MuJoCo.

    Args:
        file: what make(..., bad_world_file=FILE) wrote.
        device: where Warp computes; default: CUDA if there is any.
    """
    with _user_errors():
        from torchrl_loco import replay as replays

        check_device(device)  # before the first line
        for line in replays.describe(replays.load(file), device):
            print(line)


def plot(runs: tyro.conf.Positional[tuple[Path, ...]], /, out: Path = Path("learning_curves.png")) -> None:
    """Draw the learning curves of runs; runs that differ in nothing but their seed become a mean and a band.

    Args:
        runs: folders of the runs.
        out: the picture.
    """
    with _user_errors():
        from torchrl_loco import training

        for run in runs:
            check_run(run)
        training.plot_runs([training.RunFolder(run) for run in runs], out)
    print(out)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the command line; returns 0, exits with 2 for what the user can mend, returns 130 when interrupted."""
    try:
        _run(sys.argv[1:] if args is None else list(args))
    except KeyboardInterrupt:
        print("torchrl-loco: interrupted", file=sys.stderr)
        return 130
    return 0


def _run(args: list[str]) -> None:
    """Runs one command."""
    task_config = _task_config(args) if args[:1] == ["train"] else None

    def train(config: Annotated[task_config, tyro.conf.arg(name="")]) -> None:  # type: ignore[valid-type]
        """Train a policy: evaluation, learning curve and video included. All settings: train TASK --help."""
        with _user_errors():
            trainer = _begin(config)
        _train(trainer)

    commands: dict[str, Callable[..., None]] = {
        "train": train,
        "resume": resume,
        "eval": evaluate,
        "record": record,
        "play": play,
        "plot": plot,
        "replay": replay,
        "list": list_tasks,
        "doctor": diagnose,
    }
    if args and args[0] in commands:  # alone, so that hints speak of it and not of the others
        commands = {args[0]: commands[args[0]]}
    elif args and not args[0].startswith("-"):
        with _user_errors():
            hint = suggestion(args[0], list(commands))
            raise ValueError(f"unknown command {args[0]!r}{hint}: choose one of {', '.join(commands)}")
    tyro.extras.subcommand_cli_from_dict(
        commands,
        prog="torchrl-loco",
        description=torchrl_loco.__doc__,
        args=args,
        use_underscores=True,
        registry=VALUES,
    )


def _task_config(args: list[str]) -> Any:
    """Returns the type that stands for a task and its settings; takes from ``args`` what decides on the preset."""
    from torchrl_loco.ids import OURS, canonical_id, list_envs
    from torchrl_loco.training.config import CONFIGS, TrainingConfig
    from torchrl_loco.training.presets import preset, untuned

    about = {task: OURS.get(task, "Of another distribution.") for task in list_envs()}
    device, algorithm = (_take(flag, args) for flag in ("--device", "--algorithm"))
    if len(args) > 1 and not args[1].startswith("-"):
        with _user_errors():
            task = args[1] = canonical_id(args[1])
            config = _fixed_task(preset(task, device, algorithm))
        about[task] += f" {untuned(config)}\n\n--algorithm, {' or '.join(CONFIGS)} (here {config.algorithm}), and"
        about[task] += " --device decide which\nsettings there are, and how they are preset."
        configs = {task: config}
    else:  # this is going to show what tasks there are, which need not wait for what presets take to import
        configs = {task: TrainingConfig(task) for task in about}
    return tyro.extras.subcommand_type_from_defaults(configs, about, prefix_names=False)


def _fixed_task(config: "training.TrainingConfig") -> "training.TrainingConfig":
    """Returns the settings with all but their task open to options: the preset is for no other."""
    hidden = Annotated[str, tyro.conf.Suppress, tyro.conf.Fixed]
    kind = type(config)
    cls = dataclasses.make_dataclass(kind.__name__, [("task", hidden, config.task)], bases=(kind,), frozen=True)
    return cls(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})


def _begin(config: "training.TrainingConfig") -> "training.Trainer":
    """Makes the folder of a run and what trains into it."""
    from torchrl_loco import training

    run = training.RunFolder.create(config)
    if note := training.untuned(config):
        print(note)
    print(f"run folder: {run.path}")
    return training.Trainer(run)


def _train(trainer: "training.Trainer") -> None:
    """Trains to the last frame and prints where everything lies."""
    try:
        with _user_errors(OSError):  # a full disk; anything else in here is a bug and keeps its traceback
            trainer.train()
    except KeyboardInterrupt:
        if trainer.run.has_checkpoint:
            print(f"to go on: torchrl-loco resume {trainer.run.path}", file=sys.stderr)
        raise
    print(f"policy, curve and all else: {trainer.run.path}")


@contextlib.contextmanager
def _user_errors(*kinds: type[Exception]) -> Iterator[None]:
    """Turns errors about what the user passed, or those of some kinds, into one line and exit status 2."""
    told = kinds or (ValueError, TypeError, OSError, ImportError)
    try:
        yield
    except told as error:
        print(f"torchrl-loco: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _take(flag: str, args: list[str]) -> str | None:
    """Removes ``flag`` and its value from ``args`` and returns the value: it decides what the other options are."""
    for i, arg in enumerate(args):
        if arg == flag and i + 1 < len(args):
            value = args[i + 1]
            del args[i : i + 2]
            return value
        if arg.startswith(f"{flag}="):
            del args[i]
            return arg.removeprefix(f"{flag}=")
    return None
