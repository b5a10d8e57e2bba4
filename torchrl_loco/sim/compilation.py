"""Compiles the kernels of a launch before it first runs: in parallel, and with a progress bar."""

import contextlib
import fcntl
import json
import os
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import warp as wp
from tqdm.auto import tqdm

SHOW_AFTER = 2.0  # seconds after which the progress bar appears; loading from the cache is faster

_COLLECTING = threading.Lock()


def compile_kernels(launches: Iterable[Callable[[], None]], device: wp.Device) -> None:
    """Compiles and loads the kernels that ``launches`` would launch, without launching any.

    Warp compiles a module when one of its kernels is first launched, one module after another. Once the modules are
    known they can be compiled on all cores, and the progress bar knows how many are left. A module that another process
    is compiling is waited for. Whatever else ``launches`` do takes effect.
    """
    with wp.ScopedDevice(device), _collecting() as variants:
        for launch in launches:
            launch()
    pool = ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="compile")
    with tqdm(total=len(variants), desc=f"compiling for {device}", unit="module", delay=SHOW_AFTER, leave=False) as bar:
        try:
            for loaded in as_completed([pool.submit(_load, *variant, device) for variant in variants]):
                loaded.result()
                bar.update()
        finally:
            pool.shutdown(cancel_futures=True)


def _load(module: wp.Module, block_dim: int, device: wp.Device) -> None:
    with one_process(module.name):
        try:
            module.load(device, block_dim)
        except Exception as error:
            if isinstance(error, json.JSONDecodeError) or "Failed to load" in str(error):  # no more than Warp tells
                where = f"Warp's kernel cache {wp.config.kernel_cache_dir} is damaged"
                raise OSError(f"{where}: delete that folder, its kernels are compiled anew ({error})") from error
            raise


@contextlib.contextmanager
def one_process(module: str) -> Iterator[None]:
    """Lets one process at a time compile a module, which the others then find in Warp's cache."""
    path = Path(wp.config.kernel_cache_dir, f"lock{zlib.crc32(module.encode()) % 256}")
    with path.open("a") as file:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)  # a process that was forked meanwhile has the file open, too


@contextlib.contextmanager
def _collecting() -> Iterator[dict[tuple[wp.Module, int], None]]:
    """Yields the modules and block sizes, in order, that this thread's launches need, without running them.

    A launch returns early if its module has no executable. Conditional bodies are visited once.
    """
    variants: dict[tuple[wp.Module, int], None] = {}
    thread = threading.get_ident()

    def load(module: wp.Module, device: Any, block_dim: Any = None, *args: Any, **kwargs: Any) -> None:
        variants[module, block_dim] = None

    def both(condition: wp.array, on_true: Any = None, on_false: Any = None, stream: Any = None, **kwargs: Any) -> None:
        for body in filter(callable, (on_true, on_false)):
            body(**kwargs)

    def once(condition: wp.array, while_body: Any, stream: Any = None, **kwargs: Any) -> None:
        both(condition, while_body, **kwargs)

    def block_size(kernel: wp.Kernel, device: Any = None) -> tuple[int, int]:
        variants[kernel.module, kernel.module.options["block_dim"]] = None
        return 1, 1

    def here(new: Callable[..., Any], original: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **kwargs: (new if threading.get_ident() == thread else original)(*args, **kwargs)

    replaced: list[tuple[Any, str, Callable[..., Any]]] = [(wp.Module, "load", load), (wp, "capture_if", both)]
    replaced += [(wp, "capture_while", once), (wp, "get_suggested_block_size", block_size)]
    with contextlib.ExitStack() as stack:
        stack.enter_context(_COLLECTING)  # one at a time: two would restore each other's functions
        for owner, name, new in replaced:
            original = getattr(owner, name)
            stack.callback(setattr, owner, name, original)
            setattr(owner, name, here(new, original))
        yield variants
