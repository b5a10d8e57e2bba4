"""Ctrl-C and SIGTERM, which end a run after its update."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def interruptible(notice: str = "") -> Iterator[Callable[[], bool]]:
    """Yields a function that tells whether SIGINT or SIGTERM has arrived.

    The first signal does not stop the process; it prints ``notice`` on the standard error. The second one does, by a
    KeyboardInterrupt if it is SIGINT, also where a library turns that into an error of its own.

    Outside the main thread, and for signals that are ignored (as SIGINT is under ``nohup``), nothing is changed.

    Raises:
        KeyboardInterrupt: a second SIGINT.
    """
    pressed, again = threading.Event(), threading.Event()
    in_main = threading.current_thread() is threading.main_thread()
    handlers = {kind: signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM) if in_main}
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
            os.write(2, f"\n{notice}\n".encode())  # print could be called while it is printing

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
