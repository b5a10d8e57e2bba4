"""Tensors and settings in a file without code; files that are replaced whole, and that replace none."""

import contextlib
import hashlib
import itertools
import json
import os
import uuid
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize

VERSION = 1


def save(path: Path, kind: str, tensors: dict[str, torch.Tensor], settings: dict[str, Any]) -> None:
    """Writes tensors of any device, and settings for JSON, as a safetensors file of a kind such as "policy"."""
    metadata = {"format": _format(kind), **{name: json.dumps(value) for name, value in settings.items()}}
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    replace_file(Path(path), serialize(tensors, {**metadata, "sha256": _sha256(tensors, metadata)}))


def replace_file(path: Path, content: bytes | memoryview) -> None:
    """Writes a file as a whole, onto the disk: if that fails or is interrupted, the file stays as it was.

    Of several processes that write the same file, the last one wins.

    Raises:
        OSError: it cannot be written, for example because the disk is full.
    """
    part = path.with_name(f"{path.name}.{uuid.uuid4().hex}.part")
    try:
        with part.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # else a file system may rename before it writes
        part.replace(path)
        _keep_name(path)
    except OSError as error:
        kept = "; the previous file is kept" if path.exists() else ""
        raise OSError(error.errno or 0, f"{error.strerror or error}{kept}", str(path)) from error
    finally:
        with contextlib.suppress(OSError):  # after a rename there is none
            part.unlink()


def _keep_name(path: Path) -> None:
    """Writes the folder of a file onto the disk, where the file system can."""
    with contextlib.suppress(OSError):
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def load(path: Path, kind: str) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Returns the tensors, on the CPU, and the settings that :func:`save` wrote, read without executing code."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no {kind} at {path}")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if metadata.get("format") != _format(kind):
            raise ValueError(f"its format is {metadata.get('format')!r}, this release reads {_format(kind)!r}")
        kept = metadata.pop("sha256", None)  # early files have none
        if kept not in (None, _sha256(tensors, metadata)):
            raise ValueError("it is damaged, as its checksum says")
        return tensors, {name: json.loads(value) for name, value in metadata.items() if name != "format"}
    except (SafetensorError, ValueError, RuntimeError, OSError) as error:
        raise ValueError(f"{path} cannot be read as a {kind}: {error}") from error


def _sha256(tensors: dict[str, torch.Tensor], metadata: dict[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name in sorted(tensors):
        digest.update(tensors[name].reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _format(kind: str) -> str:
    return f"torchrl_loco {kind} {VERSION}"


def unused_path(path: Path) -> Path:
    """Returns ``path`` if it is free, else the first free of ``-2``, ``-3``, ... (before the suffix of a file)."""
    stem, suffix = (path.name, "") if path.is_dir() else (path.stem, path.suffix)
    numbered = (path.with_name(f"{stem}-{i}{suffix}") for i in itertools.count(2))
    return next(candidate for candidate in itertools.chain([path], numbered) if not candidate.exists())
