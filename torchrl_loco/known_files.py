"""Files that the user has run here, told apart from those that only another file names.

Policies, run folders and NaN dumps hold the name of their task, which may be a file, and may come from a stranger. What
they name is run only where the user has named it too, once on this machine. That is remembered outside of all of them,
as ssh remembers hosts: in ``$XDG_STATE_HOME/torchrl_loco/known_files``, or below ``~/.local/state``, a line for each
version of a file that has run, with its SHA-256 and its path, as ``sha256sum`` writes it. To forget a file, delete its
lines.
"""

import ast
import functools
import hashlib
import os
import warnings
from importlib import machinery
from pathlib import Path

KEPT = "source"
"""Folder in a run folder that holds a copy of the task's file, and of what lies beside it and belongs to it."""

DIGITS = 64  # of a SHA-256, before two spaces and the path

_added: set[str] = set()  # lines of this process: they count where they cannot be written, too


class UnnamedFileError(ImportError):
    """A file names Python that the user has not named: it was not run."""


def store() -> Path:
    """Returns the file that remembers.

    Raises:
        RuntimeError: there is no home directory.
    """
    named = Path(os.environ.get("XDG_STATE_HOME", ""))
    folder = named if named.is_absolute() else Path.home() / ".local/state"
    return folder / "torchrl_loco" / "known_files"


def remember(path: Path) -> None:
    """Remembers a file, by its path without links, that runs by the user's word, and the modules beside it."""
    files = [file for file in with_imports(path) if "\n" not in str(file)] if path.is_file() else []
    new = sorted({f"{_sha256(file)}  {file}" for file in files} - _lines())
    if not new:
        return
    _added.update(new)
    try:
        to = store()
        to.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open(to, "ab", buffering=0, opener=lambda name, flags: os.open(name, flags, 0o600)) as file:
            file.write(b"".join(os.fsencode(f"{line}\n") for line in new))  # at once: others append too
    except (OSError, RuntimeError) as error:
        warnings.warn(f"other processes will not know that {path} is yours: {error}", stacklevel=2)


def is_known(path: Path) -> bool:
    """Returns whether a file, by its absolute path without links, may run where only another file names it.

    It may in the place where the user has run it, also after an edit. A copy in a run folder may if every file there
    that Python could run is one that the user has run, byte for byte.
    """
    lines = _lines()
    if not is_kept(path):
        return str(path) in {line[DIGITS + 2 :] for line in lines}
    hashes, ends = {line[:DIGITS] for line in lines}, tuple(machinery.all_suffixes())
    runs = [file for file in path.parent.rglob("*") if file.is_symlink() or file.name.endswith(ends)]
    return all(file.is_file() and not file.is_symlink() and _sha256(file) in hashes for file in runs)


def is_kept(path: Path) -> bool:
    """Returns whether a file is the copy of a task's file in a run folder."""
    return path.parent.name == KEPT and (path.parents[1] / "config.json").is_file()


def place_of(task: str, folder: Path) -> str:
    """Returns where the class of a task is that a file in a folder names: in the copy there if its own file is gone."""
    source, _, name = str(task).rpartition(":")
    copy = Path(folder).resolve() / KEPT / Path(source).name
    moved = source.endswith(".py") and not Path(source).is_file() and copy.is_file() and is_kept(copy)
    return f"{copy}:{name}" if moved else task


def with_imports(path: Path) -> list[Path]:
    """Returns a file and the modules beside it that it imports, or that these import; packages are left out."""
    found, left = dict[Path, None](), [path]
    while left:
        file = left.pop()
        if file in found:
            continue
        found[file] = None
        beside = {path.with_name(f"{name}.py") for name in _imported(file.read_bytes())}
        left += sorted(each for each in beside if each.is_file())
    return list(found)


@functools.lru_cache(maxsize=256)  # a start asks twice, a notebook at each run
def _imported(source: bytes) -> frozenset[str]:
    """Returns the top-level modules that a file imports by their names; none if it is not Python."""
    try:
        nodes = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):  # its import fails too
        return frozenset()
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level]
    return frozenset(name.partition(".")[0] for name in names)


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _lines() -> set[str]:
    """Returns all lines; what a crash has cut is none."""
    try:
        written = os.fsdecode(store().read_bytes()).split("\n")[:-1]
    except (OSError, RuntimeError):
        written = []
    return {*written, *_added}
