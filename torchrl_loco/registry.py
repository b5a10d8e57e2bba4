"""From the name of a task to its class, and ``make``. No environment is imported until it is asked for."""

import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import multiprocessing
import re
import shlex
import sys
import warnings
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import torchrl_loco
from torchrl_loco import known_files, tasks
from torchrl_loco.checks import check_choice, suggestion

if TYPE_CHECKING:
    from torchrl_loco.envs import LocoEnv

GROUP = "torchrl_loco.envs"
"""Group of the entry points by which installed distributions add environments: ``id = "module:Class"``."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """An environment that :func:`make` knows."""

    target: str  # where its class is, as "module:Class"
    summary: str = ""  # what the task asks for, in a sentence; empty for a plug-in: its class docstring is used
    distribution: str = ""  # name and version of the distribution that a plug-in comes from; empty for the others
    cls: "type[LocoEnv] | None" = None  # if it was registered at run time


OURS = {id: Entry(f"{task.module}:{task.name}", task.summary) for id, task in tasks.found().items()}
"""The environments of this package by id."""

ALIASES = {f"mjx/{id}-v0": id for id in OURS}

ID = r"[\w.-]+"
MALFORMED = "an id consists of letters, digits and _ . -, because run folders are named after it"

_added: dict[str, Entry] = {}  # what was registered at run time, by id


@functools.cache
def installed() -> dict[str, Entry]:
    """Returns what every process finds by its id: our environments, then the plug-ins of installed distributions.

    They are looked up once. A plug-in whose id is taken or malformed is left out with a warning.
    """
    entries = dict(OURS)
    for point in sorted(metadata.entry_points(group=GROUP), key=lambda point: point.name):
        origin = f"{point.dist.name} {point.dist.version}" if point.dist else "an unknown distribution"
        taken = entries.get(ALIASES.get(point.name, point.name))
        if taken is not None:
            reason = f"{taken.distribution or 'torchrl_loco'} already has this id"
        elif not re.fullmatch(ID, point.name):
            reason = MALFORMED
        else:
            entries[point.name] = Entry(point.value, distribution=origin)
            continue
        warnings.warn(f"environment {point.name!r} of {origin} ({point.value}) is ignored: {reason}", stacklevel=3)
    return entries


def registered() -> dict[str, Entry]:
    """Returns all environments by id: :func:`installed`, then those that :func:`register` added."""
    return {**installed(), **_added}


def register(id: str, cls: "type[LocoEnv]") -> None:
    """Gives a class an id, for this process: :func:`torchrl_loco.make` and training then take it like any other.

    A class of the same module and name replaces the one that had the id, so a cell of a notebook can run again. Entry
    points give a class an id in every process; see docs/guides/your-own-task.md.

    Args:
        id: letters, digits and ``_ . -``.
        cls: a subclass of :class:`torchrl_loco.LocoEnv`.

    Raises:
        ValueError: the id is malformed, or another class has it.
        TypeError: ``cls`` is no subclass of LocoEnv, or an incomplete one.

    Example:
        >>> class WalkSlowly(torchrl_loco.WalkerWalk):
        ...     target_speed = 0.5
        >>> torchrl_loco.register("walker_walk_slowly", WalkSlowly)
        >>> torchrl_loco.make("walker_walk_slowly", num_envs=2, device="cpu").target_speed
        0.5
    """
    if not isinstance(id, str) or not re.fullmatch(ID, id):
        raise ValueError(f"{id!r} cannot be an id: {MALFORMED}")
    _check_environment(cls).check_class()
    entry = Entry(_target(cls), _first_line(cls), cls=cls)
    taken = registered().get(id)
    if taken is not None and taken.target != entry.target:
        raise ValueError(f"the id {id!r} is taken by {taken.target}: choose another than {', '.join(list_envs())}")
    if id not in installed():
        _added[id] = entry


def _target(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _first_line(cls: type) -> str:
    return (cls.__doc__ or "").strip().partition("\n")[0]


def _check_environment(cls: Any) -> "type[LocoEnv]":
    if not (isinstance(cls, type) and issubclass(cls, torchrl_loco.LocoEnv)):
        raise TypeError(
            f"{cls!r} is no subclass of torchrl_loco.LocoEnv, as torchrl_loco.WalkerWalk is: pass the class"
        )
    return cls


def list_envs() -> list[str]:
    """Returns the ids that :func:`torchrl_loco.make` takes: ours, those of plug-ins, those registered; no aliases."""
    return list(registered())


def canonical_id(id: str) -> str:
    """Returns the id that ``id``, or an alias, stands for."""
    return check_choice("environment", ALIASES.get(id, id) if isinstance(id, str) else id, list_envs(), also=ALIASES)


def env_class(id: str) -> "type[LocoEnv]":
    """Returns the class of ``id`` or an alias."""
    name = canonical_id(id)
    entry = registered()[name]
    if entry.cls is not None:
        return entry.cls
    module, _, attribute = entry.target.partition(":")
    if not entry.distribution:
        return getattr(importlib.import_module(module), attribute)

    origin = f"environment {name!r} of {entry.distribution} ({entry.target})"
    try:
        cls: Any = functools.reduce(getattr, attribute.split("."), importlib.import_module(module))
    except Exception as error:  # a plug-in's module may raise anything
        raise ImportError(f"{origin} cannot be loaded: {type(error).__name__}: {error}") from error
    try:
        _check_environment(cls).check_class()
    except (TypeError, ValueError) as error:
        raise ImportError(f"{origin}: {error}") from error
    return cls


def label(task: str) -> str:
    """Returns the name of a task for people and file systems: its id, or the name of its class."""
    return re.sub(r"[^\w.-]+", "-", task.rpartition(":")[2])


def summary(id: str) -> str:
    """Returns what a task asks for, in a sentence; errors are those of :func:`env_class`."""
    id = canonical_id(id)
    return registered()[id].summary or _first_line(env_class(id))


def resolve(task: "str | type[LocoEnv]", by_user: bool = False) -> "type[LocoEnv]":
    """Returns the class of a task. Every name of a task becomes a class here.

    Args:
        task: an id or alias; a class; a class in a file, as ``"path/to/file.py:Class"``; or a class in a module that
            Python finds, as ``"module:Class"``. A file is run once. Modules beside it can be imported by it.
        by_user: whether the user has named it, so that its file or module may run, and is known from then on. What
            only a file names is run if it is known: see :mod:`torchrl_loco.known_files`.

    Raises:
        ValueError: there is no such id or class; the message names those that there are.
        TypeError: it is a class of something else.
        FileNotFoundError: there is no such file.
        UnnamedFileError: the user has not named it; the message says how to.
        ImportError: the file or the module raises an error.
    """
    if not isinstance(task, str):
        return _check_environment(task)
    if is_place(task):
        return _class_at(task, by_user)
    try:
        return env_class(task)
    except ValueError as error:
        raise ValueError(f"{error}, or name a class of your own as path/to/file.py:Class") from None


def task_name(task: "str | type[LocoEnv]", by_user: bool = False) -> str:
    """Returns the name by which :func:`resolve` finds a task, in another process too.

    It is the id, where every process knows it; else ``"/absolute/path/file.py:Class"`` if the class is in a script, in
    a file that was named by its path, or in one beside them; else ``"module:Class"``. A class of a notebook or
    of a function is found in this process only; ``~2`` follows its name where another class has it. A file is run again
    where it is looked up: what a script does beside defining classes belongs under ``if __name__ == "__main__"``.

    Arguments and errors are those of :func:`resolve`.
    """
    if isinstance(task, str) and not is_place(task) and ALIASES.get(task, task) in installed():
        return canonical_id(task)
    cls = resolve(task, by_user)
    for id, entry in installed().items():
        module, _, attribute = entry.target.partition(":")
        if _attribute(sys.modules.get(module), attribute) is cls:
            return id
    file = _file(sys.modules.get(cls.__module__))
    by_path = file is not None and (cls.__module__ in (*MAIN, _name_of(file)) or _only_here(cls.__module__, file))
    name = f"{file}:{cls.__qualname__}" if by_path else _target(cls)
    # Another class may have its name: one of a loop, or one that was defined in its place since.
    present, plain, count = _attribute(sys.modules.get(cls.__module__), cls.__qualname__), name, 1
    if present is not cls:  # else it has taken the place of the other
        while (name == plain and present is not None) or _named.get(name, cls) is not cls:
            count += 1
            name = f"{plain}~{count}"
    _named[name] = cls
    return name


MAIN = ("__main__", "__mp_main__")
"""Names of the script that this process, or the one that spawned it, was started with."""

_named: dict[str, "type[LocoEnv]"] = {}
"""Classes by the names that :func:`task_name` has given them: those of functions are found in no other way."""


_folders: set[Path] = set()
"""Folders of files that were named by their path: modules beside them are found in this process only."""


def is_place(task: str) -> bool:
    """Returns whether a task is named by where its class is."""
    return ":" in task or task.endswith(".py")


def _class_at(place: str, by_user: bool) -> "type[LocoEnv]":
    """Returns the class at ``"path/to/file.py:Class"`` or ``"module:Class"``."""
    source, _, name = place.rpartition(":") if ":" in place else (place, "", "")
    try:
        module = _loaded(source) or _run(source, name, by_user)
        if by_user and (file := _file(module)) is not None and module.__name__.partition(".")[0] != "torchrl_loco":
            known_files.remember(file)
        if (cls := _attribute(module, name)) is None:
            raise ValueError(_no_class(module, source, name))
    except (ValueError, OSError, ImportError):
        if place in _named:
            return _named[place]
        raise
    try:
        return _check_environment(cls)
    except TypeError as error:
        raise TypeError(f"{place}: {error}") from None


def _no_class(module: ModuleType, source: str, name: str) -> str:
    """Returns what is wrong with the name of a class that a module does not have."""
    if source in MAIN or "<locals>" in name:
        return f"{source}:{name} is of another process, of a notebook or a function: move the class into a file"
    package = module.__name__.partition(".")[0]
    classes = {each: cls for each in dir(module) if isinstance(cls := getattr(module, each, None), type)}
    tasks_of = {each: cls for each, cls in classes.items() if issubclass(cls, torchrl_loco.LocoEnv)}
    names = [each for each, cls in tasks_of.items() if cls.__module__.partition(".")[0] == package]
    what = f"{source} has no class {name!r}{suggestion(name, names)}" if name else f"{source!r} names no class"
    choice = f"choose one of {', '.join(names)}" if names else "it defines no subclass of torchrl_loco.LocoEnv"
    return f"{what}: {choice}"


def _loaded(source: str) -> ModuleType | None:
    """Returns a file or a module that this process has run already, as a script or under its own name too."""
    if not source.endswith(".py"):
        return sys.modules.get(source)
    path = Path(source).expanduser().resolve()
    modules = (sys.modules.get(name) for name in (*MAIN, path.stem, _name_of(path)))
    return next((module for module in modules if _file(module) == path), None)


def _run(source: str, name: str, by_user: bool) -> ModuleType:
    """Returns a file or a module, which is run, if the user has named it, now or before."""
    path = Path(source).expanduser().resolve() if source.endswith(".py") else None
    if path is not None and not path.is_file():
        way = "" if by_user else ": where its class is now is told by --task FILE.py:CLASS"
        raise FileNotFoundError(f"there is no file {path}{way}")
    if not by_user:
        file = path or _file_of(source)
        if file is None or not known_files.is_known(file):
            place = f"{path or source}:{name}"
            raise known_files.UnnamedFileError(
                f"{file or source} was not run: only a file names it, and you have not run it here. If you trust what "
                f"is in it, name it yourself, once: add --task {shlex.quote(place)} to the command, or call "
                f"torchrl_loco.registry.resolve({place!r}, by_user=True)"
            )
    if path is not None:
        return _module_of_file(path)
    try:
        return importlib.import_module(source)
    except Exception as error:  # a module may raise anything
        hint = "; a class in a file is named as path/to/file.py:Class" if isinstance(error, ModuleNotFoundError) else ""
        raise ImportError(f"the module {source!r} cannot be loaded: {type(error).__name__}: {error}{hint}") from error


def _file_of(module: str) -> Path | None:
    """Returns the file of a module. Neither it nor a package around it is imported, as ``importlib.util`` would."""
    places, origin = None, None
    for i in range(module.count(".") + 1):
        name = ".".join(module.split(".")[: i + 1])
        specs = (finder.find_spec(name, places) for finder in sys.meta_path)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None or (i > 0 and places is None):
            return None
        places, origin = spec.submodule_search_locations, spec.origin if spec.has_location else None
    return Path(origin).resolve() if origin else None


def _module_of_file(path: Path) -> ModuleType:
    """Returns a file as a module, which is run."""
    name = _name_of(path)
    if known_files.is_kept(path):
        sys.dont_write_bytecode = True  # only sources are compared with those that are known
    folder = str(path.parent)
    if folder not in sys.path:
        sys.path.append(folder)
        _folders.add(path.parent)
    # Modules beside it are its own, whatever is called so in the working directory, or was loaded beside another file.
    beside = {file.stem: file for file in known_files.with_imports(path) if file != path}
    others = {name: module for name in beside if (module := sys.modules.get(name)) and _file(module) != beside[name]}
    for each in others:
        del sys.modules[each]
    sys.path.insert(0, folder)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    _reading.append(path)
    try:
        spec.loader.exec_module(module)
    except _ReadEnough:
        pass
    except (Exception, SystemExit) as error:  # a file may raise anything
        del sys.modules[name]
        raise ImportError(f"{path} cannot be loaded: {type(error).__name__}: {error}") from error
    finally:
        _reading.remove(path)
        sys.path.remove(folder)
        sys.modules.update(others)
    return module


class _ReadEnough(BaseException):
    """A script was read up to where it trains."""


_reading: list[Path] = []  # files that run now because a class in them was named


def check_is_run() -> None:
    """Ends the reading of a script that trains outside of ``if __name__ == "__main__"``: it does not train twice."""
    if _reading:  # for a class, which is found if it is defined above
        raise _ReadEnough
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise RuntimeError(
            "a process that this script has started reads the script, and would train again: put what it does, beside "
            'defining classes, under if __name__ == "__main__":'
        )


def _name_of(path: Path) -> str:
    """Returns the name under which a file is a module here."""
    return re.sub(r"\W", "_", path.stem) + "_" + hashlib.sha256(str(path).encode()).hexdigest()[:8]


def _file(module: ModuleType | None) -> Path | None:
    file = getattr(module, "__file__", None)
    return Path(file).resolve() if file else None


def _only_here(module: str, file: Path) -> bool:
    """Returns whether other processes may not find a module by its name, as it is beside a script or a named file."""
    scripts = (path.parent for name in MAIN if (path := _file(sys.modules.get(name))))
    return module == file.stem and file.parent in {Path.cwd(), *scripts, *_folders}


def _attribute(thing: Any, name: str) -> Any:
    """Returns an attribute, which may be that of a class in it, or ``None``."""
    return functools.reduce(lambda owner, part: getattr(owner, part, None), name.split("."), thing)


TAKEN_BY_TORCHRL = {
    "auto_reset": "step_and_maybe_reset, rollout and collectors reset by themselves",
    "policy": "pass it to rollout or to a collector",
}
"""Arguments that TorchRL takes out of those of every environment before it is made, and what to do instead."""


def make(task: "str | type[LocoEnv]", *args: Any, **kwargs: Any) -> "LocoEnv":
    """Makes an environment.

    Args:
        task: one of :func:`torchrl_loco.list_envs`, or its alias ``mjx/<id>-v0``; or a class, or where one is, as
            ``"path/to/file.py:Class"``: that file is run. For a name that you read from a file, pass the class that
            ``registry.resolve`` returns.
        args: positional arguments of :class:`torchrl_loco.LocoEnv`: ``num_envs``, ``device``, ``seed``, ``protocol``.
        kwargs: keyword arguments of :class:`torchrl_loco.LocoEnv`, fields of :class:`torchrl_loco.SimConfig` among
            them, such as ``episode_length=500``.

    Returns:
        The environment, ready for ``reset()``; its batch size is ``(num_envs,)``, or ``()`` for ``num_envs=None``.

    Raises:
        ValueError: an argument is out of range or unknown; the message names the valid choices.
        TypeError: an argument has the wrong type.
        ImportError: the plug-in or the file that the environment comes from is broken.
        FileNotFoundError: there is no such file.
        MemoryError: the device has no room for so many worlds.

    Example:
        >>> env = torchrl_loco.make("walker_walk", num_envs=16, device="cpu", seed=0)
        >>> env.rollout(100)["next", "reward"].shape
        torch.Size([16, 100, 1])
    """
    for name, instead in TAKEN_BY_TORCHRL.items():
        if kwargs.get(name):
            raise ValueError(f"{name} is no argument: {instead}")
    env = resolve(task, by_user=True)(*args, **kwargs)
    if env.engine == "compiled" and (ignored := [name for name in ("njmax", "naconmax") if name in kwargs]):
        why = "the compiled step has no such limits, engine='mujoco_warp' has"
        warnings.warn(f"{' and '.join(ignored)} have no effect: {why}", stacklevel=2)
    return env
