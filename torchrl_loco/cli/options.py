"""How values are parsed, and how the settings of a training run become options."""

import argparse
import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro

from torchrl_loco import tasks
from torchrl_loco.checks import check_choice, several
from torchrl_loco.cli.errors import user_errors
from torchrl_loco.registry import list_envs, resolve, summary, task_name
from torchrl_loco.training.config import CONFIGS, Sim, TrainingConfig, preset, tuning_note

VALUES = tyro.constructors.ConstructorRegistry()  # how values are parsed, where the parser's own rules are inconvenient


@VALUES.primitive_rule
def _integers_and_optionals(info: tyro.constructors.PrimitiveTypeInfo) -> Any:
    """Parses integers as people write them, and optional values, pairs of numbers too, without the word None."""
    kinds = get_args(info.type) if info.type_origin in (Union, UnionType) else (info.type,)
    named = [kind for kind in kinds if kind is not NoneType]
    if named != [int] and (len(named) != 1 or len(kinds) == 1):
        return None
    is_pair = get_origin(named[0]) is tuple
    kind: Any = get_args(named[0])[0] if is_pair else named[0]
    parse: Any = {int: _integer, bool: lambda word: {"true": True, "false": False}[word.lower()]}.get(kind, kind)
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=2 if is_pair else 1,
        metavar="{True,False}" if kind is bool else " ".join([kind.__name__.upper()] * (2 if is_pair else 1)),
        instance_from_str=lambda words: tuple(map(parse, words)) if is_pair else parse(words[0]),
        is_instance=lambda value: isinstance(value, (tuple, NoneType) if is_pair else tuple(kinds)),
        str_from_instance=lambda value: [str(each) for each in (value if isinstance(value, tuple) else [value])],
        choices=("True", "False") if kind is bool else None,
    )


def _integer(word: str) -> int:
    with contextlib.suppress(ValueError):
        return int(word)
    with contextlib.suppress(ValueError):
        if (value := float(word)).is_integer():
            return int(value)
    raise ValueError(f"{word!r} is not an integer: write it as 100000, 100_000 or 1e5")


def summaries() -> dict[str, str]:
    """Returns what each environment asks for, by id."""
    found = {}
    for name in list_envs():
        try:
            found[name] = summary(name)
        except ImportError as error:
            found[name] = f"NOT USABLE: {error}"
    return found


def task_options(args: list[str]) -> Any:
    """Returns the type of a task's settings; removes from ``args`` the options that choose the preset."""
    about = summaries()
    usage = "%(prog)s TASK [--device DEVICE] [--algorithm ALGORITHM] [--SETTING VALUE ...]; all settings: --help"
    preset_options = argparse.ArgumentParser("torchrl-loco train", usage, add_help=False, allow_abbrev=False)
    for flag in ("--device", "--algorithm"):
        preset_options.add_argument(flag)
    preset_options.add_argument("--from_pixels", "--from-pixels", action="store_true")
    chosen, args[:] = preset_options.parse_known_args(args)
    if len(args) > 1 and not args[1].startswith("-"):
        pixels: dict[str, Any] = {"from_pixels": True} if chosen.from_pixels else {}
        with user_errors():
            task = task_name(args[1], by_user=True)
            config = _options(preset(task, chosen.device, chosen.algorithm, **pixels))
            _check_names(args[2:], config)
            note = tuning_note(config)
            words = about[task] if task in list_envs() else (resolve(task).__doc__ or "").strip().partition("\n")[0]
        label = args[1] = config.label  # the parser's names have neither slash nor colon
        about[label] = f"{words} {note}\n\n--algorithm, {' or '.join(CONFIGS)} (here {config.algorithm}), and --device"
        about[label] += " choose the\nsettings and their defaults."
        configs = {label: config}
    elif len(args) > 1 and args[1] not in ("-h", "--help"):
        with user_errors():
            raise ValueError(f"name the task before its settings: torchrl-loco train TASK {args[1]} ...")
    else:  # the list of tasks need not wait for the imports of presets
        configs = {task: TrainingConfig(task) for task in about}
    return tyro.extras.subcommand_type_from_defaults(configs, about, prefix_names=False)


T = TypeVar("T")
Flat = Annotated[T, tyro.conf.arg(name="")]  # options of a dataclass, whose names stand alone

OtherTask = Annotated[
    str | None,
    tyro.conf.arg(
        name="task",
        metavar="TASK",
        help="the task, instead of what the run or the file says: an id, or FILE.py:CLASS, which is run.",
    ),
]
GPUS = Annotated[
    int | None,
    tyro.conf.arg(
        help="Train on so many GPUs of this machine, each with num_envs worlds; on a CPU, in so many processes."
    ),
]
SEEDS = Annotated[
    tuple[int, ...], tyro.conf.arg(help="Train these seeds one after the other, each in a run folder of its own.")
]


def _options(config: TrainingConfig) -> TrainingConfig:
    """Returns the settings as options: with their task fixed, as a preset belongs to one, several seeds and GPUs."""
    hidden = tyro.conf.Suppress, tyro.conf.Fixed
    kind = type(config)
    fields: list[Any] = [("task", Annotated[str, *hidden], config.task), ("seeds", SEEDS, ()), ("gpus", GPUS, None)]
    fields.append(("options", Annotated[dict[str, Any], *hidden], dataclasses.field(default_factory=dict)))
    own = _of_task(config.task)
    fields += [(name, _annotated(declared, words), value) for name, (declared, value, words) in own.items()]
    cls = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True)
    return cls(**{field.name: getattr(config, field.name) for field in dataclasses.fields(config)})


def _of_task(task: str) -> Mapping[str, tuple[Any, Any, str]]:
    """Returns the options of a task: what is declared, the value of its class, and words.

    It is imported only if it has any.
    """
    found = tasks.found().get(task)
    if found is not None and not found.has_options:
        return {}
    cls = resolve(task)
    from torchrl_loco.envs.task import options_of_class  # with torch, as the class is

    own = options_of_class(cls)
    return {name: (value, _of_kind(value, own.get(name, value)), words) for name, (value, words) in cls.options.items()}


def _of_kind(declared: Any, value: Any) -> Any:
    """Returns a value as one of the kind that is declared, and what is declared if it is none, such as an object."""
    is_tuple = isinstance(declared, tuple)
    kind: Any = type((*declared, "")[0] if is_tuple else declared)
    parts = several(value)
    taken = {float: (int, float), str: (str, Path)}.get(kind, kind)
    if not all(isinstance(part, taken) for part in parts) or not (is_tuple or len(parts) == 1):
        return declared
    return tuple(map(kind, parts)) if is_tuple else kind(parts[0])


def _annotated(value: Any, words: str) -> Any:
    """Returns the type of an option by the value that holds without it: of a tuple, that of its first, else words."""
    first: Any = type(value[0]) if isinstance(value, tuple) and value else str
    return Annotated[tuple[first, ...] if isinstance(value, tuple) else type(value), tyro.conf.arg(help=words)]


def _check_names(args: list[str], config: Any) -> None:
    """Checks that options are settings: the parser's own message does not say which there are."""
    settings_of = {algorithm: {field.name for field in dataclasses.fields(kind)} for algorithm, kind in CONFIGS.items()}
    mine = {field.name for field in dataclasses.fields(config)} - {"task", "options"} | set(_of_task(config.task))
    of_sim = [field.name for field in dataclasses.fields(Sim)]
    for arg in args:
        name = arg.partition("=")[0].removeprefix("--").replace("-", "_")
        if not arg.startswith("--") or name.removeprefix("no_") in mine or name in ("", "help"):
            continue
        if name.startswith("sim."):
            check_choice("field of --sim", name.removeprefix("sim."), of_sim)
            continue
        for algorithm, names in settings_of.items():
            if name in names - settings_of[config.algorithm]:
                raise ValueError(f"--{name} is a setting of --algorithm {algorithm}, and this is {config.algorithm}")
        if name in of_sim:
            raise ValueError(f"--{name} is a field of the simulation: write --sim.{name}")
        check_choice("setting", name, sorted(mine | {"device", "algorithm"}))


def settings(options: Any) -> tuple[TrainingConfig, tuple[int, ...], int | None]:
    """Returns the settings, the seeds and the number of GPUs of what :func:`_options` returned."""
    (kind,) = type(options).__bases__
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(kind)}
    asked = {name: (getattr(options, name), value) for name, (_, value, _) in _of_task(options.task).items()}
    if given := {name: value for name, (value, default) in asked.items() if value != default}:
        values["options"] = resolve(options.task).checked_options(given)
    return kind(**values), options.seeds, options.gpus
