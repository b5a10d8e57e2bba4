"""Opening and closing an environment, and the ends of a process."""

import atexit
import contextlib
import os
import warnings
import weakref
from typing import Any

import torch
from torchrl.envs import EnvBase

from torchrl_loco.envs.watcher import Watcher


class Closable(EnvBase):
    """Mixin: :meth:`close` lets go of all that ``_build`` makes, and a reset makes it again."""

    _watchers: list[Watcher]
    _views: dict[str, torch.Tensor]

    def _build(self) -> None:
        """Makes the worlds and whatever else takes memory, with ``_views["episode"]`` among it."""
        raise NotImplementedError

    def _open(self) -> None:
        """Makes an environment ready to be reset."""
        kept = set(self.__dict__)
        try:
            with torch.inference_mode(False):  # the buffers must stay writable wherever they are made
                self._build()
                if "_episodes" in kept:  # it was open before: its worlds go on drawing where they were
                    self._views["episode"].copy_(self._episodes)
        except BaseException:
            self._forget(set(self.__dict__) - kept)
            raise
        self._memory = set(self.__dict__) - kept
        self._pid = os.getpid()
        self.is_closed = False
        _OPEN.add(self)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Frees the memory of the worlds; a ``reset()`` opens the environment again, with its next episodes.

        TorchRL's collectors close their environment when they end. Counters begin anew. What else needs the worlds of a
        closed environment raises an error that says so.

        Args:
            raise_if_closed: TorchRL's; closing twice is no error here.
        """
        super().close()
        if "_views" not in self.__dict__:
            return
        self._episodes = self._views["episode"].cpu()
        with contextlib.ExitStack() as stack:  # whatever a watcher raises, the others act and the memory goes
            stack.callback(self._forget, self._memory)
            for watcher in self._watchers:
                stack.callback(watcher.check)

    def _forget(self, names: set[str]) -> None:
        for name in names:
            del self.__dict__[name]

    def _close_at_last(self) -> None:
        """Closes where nothing can be raised any more: it becomes a warning."""
        if "_views" in self.__dict__:
            with contextlib.suppress(Warning):  # which may be errors
                try:
                    self.close()
                except Exception as error:
                    warnings.warn(str(error), RuntimeWarning, stacklevel=2)

    def __del__(self) -> None:
        self._close_at_last()

    def __getattr__(self, name: str) -> Any:
        if name in self.__dict__.get("_memory", ()):
            raise RuntimeError(f"this {type(self).__name__} is closed: reset() opens it again")
        return super().__getattr__(name)

    def _refuse_after_fork(self) -> None:
        if self.device.type == "cuda" and os.getpid() != self._pid:
            raise RuntimeError("CUDA does not survive a fork: make the environment in the process that steps it")

    def __reduce__(self) -> Any:
        raise TypeError(
            "an environment cannot be copied or pickled: pass on what makes it, functools.partial(torchrl_loco.make, "
            "...), or what it holds, env.get_state()"
        )


_OPEN: weakref.WeakSet[Closable] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    """Closes what is open while that still can be done: later, the interpreter takes torch apart."""
    for env in list(_OPEN):
        if env._pid == os.getpid():  # a fork's copies are the parent's to close
            env._close_at_last()
