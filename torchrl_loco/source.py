"""What a user may edit of a task: which files it is in, and hashes that tell an edit."""

import hashlib
import inspect
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from torchrl_loco import known_files
from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.task import folder_of
from torchrl_loco.registry import resolve
from torchrl_loco.sim import models


def files_of(cls: Any, path: Path) -> list[Path]:
    """Returns the file of a task's class, the modules beside it that it imports, and the files of its model."""
    return [*known_files.with_imports(path), *models.files(cls.model, folder_of(cls))]


def source_of(task: str) -> str:
    """Returns a hash of what a user may edit of a task in files: those of its class and model."""
    return _digest(task).hexdigest()


def is_edited(info: Mapping[str, Any], task: str) -> bool:
    """Returns whether a task was edited since the training of a policy with this info, as far as that tells."""
    return "source_hash" in info and info["source_hash"] != source_of(task)


def _digest(task: str) -> Any:
    digest = hashlib.sha256()
    if ":" not in task:  # it is of a package
        return digest
    cls = resolve(task)
    try:
        file = inspect.getsourcefile(cls)
    except (TypeError, OSError):  # of a notebook
        file = None
    if file is not None and Path(file).is_file():
        for each in files_of(cls, Path(file)):
            digest.update(each.read_bytes())
    else:
        digest.update("\n".join(_written(cls)).encode())
    return digest


def content_of(task: str, env: LocoEnv) -> str:
    """Returns a hash of what a user may edit of a task: files of its class and model, and its tables, as of motions."""
    digest = _digest(task)
    if isinstance(getattr(type(env), "model", None), mujoco.MjSpec):  # made of files that nobody names
        model = np.empty(mujoco.mj_sizeModel(env.mj_model), dtype=np.uint8)
        mujoco.mj_saveModel(env.mj_model, None, model)
        digest.update(model.data)
    assert env.hooks is not None
    for table in env.hooks.catalog.constants.values():
        digest.update(table.cpu().numpy().tobytes())
    return digest.hexdigest()


def _written(cls: type) -> Iterator[str]:
    """Yields what a class and those above say that are in no file: names, numbers, texts and the code of functions."""
    for base in cls.__mro__:
        if base is LocoEnv:
            return
        for name, value in sorted(vars(base).items()):
            if isinstance(value, types.FunctionType):
                yield f"{name} {_steps(value.__code__)}"
            elif isinstance(value, bool | int | float | str | tuple | list | dict) and not name.startswith("__"):
                yield f"{name} {value!r}"


def _steps(code: types.CodeType) -> str:
    """Returns what a function does, wherever it is written."""
    sets = (sorted(each, key=repr) if isinstance(each, frozenset) else each for each in code.co_consts)  # in any order
    constants = [_steps(each) if isinstance(each, types.CodeType) else repr(each) for each in sets]
    return f"{code.co_code.hex()} {code.co_names} {constants}"
