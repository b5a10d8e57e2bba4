"""One process at a time in a folder: a lock that names the process."""

import contextlib
import fcntl
import os
import socket
from pathlib import Path

_held: dict[Path, int] = {}
"""File descriptors of the locks of this process, by folder."""


def lock(folder: Path) -> bool:
    """Takes the lock of a folder, if this process does not have it. The system frees it when the process ends.

    Returns:
        Whether this call has taken it.

    Raises:
        BlockingIOError: another process has it.
    """
    folder = folder.resolve()
    file = folder / "lock"
    if folder in _held:
        return False
    while folder not in _held:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _take(descriptor, folder)
            # Else it is that of a process that has just removed it.
            if file.exists() and os.path.samestat(os.fstat(descriptor), file.stat()):
                os.ftruncate(descriptor, 0)
                os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
                _held[folder] = descriptor
        finally:
            if folder not in _held:
                os.close(descriptor)
    return True


def _take(descriptor: int, folder: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = os.read(descriptor, 1000).decode(errors="replace").strip() or "another process"
        raise BlockingIOError(f"{owner} is training in {folder}: wait until it ends, or end it") from None
    except OSError:  # a file system without locks
        pass


def unlock(folder: Path) -> None:
    """Gives the lock of a folder back, if this process has it."""
    folder = folder.resolve()
    if (descriptor := _held.pop(folder, None)) is not None:
        with contextlib.suppress(FileNotFoundError):
            (folder / "lock").unlink()
        os.close(descriptor)
