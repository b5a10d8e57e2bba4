"""One process at a time in a folder: a lock that names the process."""

import contextlib
import fcntl
import os
import socket
from pathlib import Path

_held: dict[Path, int] = {}
"""File descriptors of the locks of this process, by folder."""


def lock(folder: Path) -> None:
    """Takes the lock of a folder, if this process does not have it. The system frees it when the process ends.

    Raises:
        BlockingIOError: another process has it.
    """
    folder = folder.resolve()
    file = folder / "lock"
    while folder not in _held:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 1000).decode(errors="replace").strip() or "another process"
            os.close(descriptor)
            raise BlockingIOError(f"{owner} is training in {folder}: wait until it ends, or end it") from None
        except OSError:  # a file system without locks
            pass
        if not file.exists() or not os.path.samestat(os.fstat(descriptor), file.stat()):
            os.close(descriptor)  # of a process that has just removed it
            continue
        os.ftruncate(descriptor, 0)
        os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        _held[folder] = descriptor


def unlock(folder: Path) -> None:
    """Gives the lock of a folder back, if this process has it."""
    folder = folder.resolve()
    if (descriptor := _held.pop(folder, None)) is not None:
        with contextlib.suppress(FileNotFoundError):
            (folder / "lock").unlink()
        os.close(descriptor)
