"""Files as an archive in parts, each small enough to be handed on."""

import io
import tarfile
from collections.abc import Mapping
from pathlib import Path

from torchrl_loco.storage import replace_file

PART = 15 * 2**20
"""Most bytes of a part."""
PARTS = 4
"""Parts beyond which files that may be left out are left out."""


def pack(archive: Path, files: Mapping[str, bytes], optional: Mapping[str, bytes]) -> list[str]:
    """Writes files as a gzipped tar: to ``archive``, and what is beyond a part to ``archive.1``, ``archive.2``, ...

    ``cat archive*`` joins the parts. Nothing is written before all is packed, and each part is replaced as a whole.

    Args:
        archive: the first part.
        files: content of each file by name.
        optional: further files, of which those are left out that do not fit into all parts.

    Returns:
        Names of the files that were left out.
    """
    packed, left_out = io.BytesIO(), []
    with tarfile.open(fileobj=packed, mode="w:gz", compresslevel=1) as tar:
        for name, content in [*files.items(), *optional.items()]:
            if name in optional and packed.tell() + len(content) > PART * PARTS:
                left_out.append(name)
                continue
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            tar.addfile(entry, io.BytesIO(content))
    data = packed.getbuffer()
    parts = [data[start : start + PART] for start in range(0, len(data), PART)]
    names = [archive, *(Path(f"{archive}.{number}") for number in range(1, len(parts)))]
    archive.parent.mkdir(parents=True, exist_ok=True)
    for name, part in zip(names, parts, strict=True):
        replace_file(name, part)
    for stale in set(archive.parent.glob(f"{archive.name}.[0-9]*")) - set(names):
        stale.unlink()
    return left_out
