"""A process that trains: signals to end it wait for an update, and it has its folder to itself."""

import contextlib
import fcntl
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # signals by which a process is asked to end
_held: dict[Path, int] = {}  # file descriptors of the locks of this process, by folder


def lock(folder: Path) -> bool:
    """Takes the lock of a folder, which the system frees when this process ends; returns False if it has it already."""
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


@contextlib.contextmanager
def interruptible(notice: str = "") -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether SIGINT, SIGTERM or SIGHUP, which a closed terminal sends, has arrived.

    The first signal does not stop the process; it prints ``notice`` on the standard error. The second one does, by a
    KeyboardInterrupt if it is SIGINT, also where a library turns that into an error of its own.

    Outside the main thread, and for signals that are ignored (as SIGINT is under ``nohup``), nothing is changed.

    Raises:
        KeyboardInterrupt: a second SIGINT.
    """
    pressed, again = threading.Event(), threading.Event()
    in_main = threading.current_thread() is threading.main_thread()
    handlers = {kind: signal.getsignal(kind) for kind in ENDS if in_main}
    handlers = {kind: handler for kind, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}

    def restore() -> None:
        for kind, handler in handlers.items():
            signal.signal(kind, handler)

    def press(*_: object) -> None:
        pressed.set()
        restore()
        if handlers.get(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, press_again)
        if notice:
            with contextlib.suppress(OSError):  # the terminal may be closed; print could be called while it is printing
                os.write(2, f"\n{notice}\n".encode())

    def press_again(*_: object) -> None:
        again.set()
        raise KeyboardInterrupt

    for kind in handlers:
        signal.signal(kind, press)
    try:
        yield pressed.is_set
    except Exception:
        if again.is_set():
            raise KeyboardInterrupt from None
        raise
    finally:
        restore()
