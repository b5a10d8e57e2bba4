"""What looks on while worlds step, without ever making the host wait for the device."""

from abc import ABC, abstractmethod

import torch

INTERVAL = 100
"""Control steps between two looks."""


class Watcher(ABC):
    """Notes on the device what happens in a step, reads a few numbers of it now and then, and acts on them.

    Args:
        count: how many numbers :meth:`look` returns.
        device: where they are.
    """

    def __init__(self, count: int, device: torch.device) -> None:
        self._device = device
        on_cuda = device.type == "cuda"
        self._seen = torch.zeros(count, dtype=torch.long, device="cpu", pin_memory=on_cuda)
        self._copied = torch.cuda.Event() if on_cuda else None
        self._steps, self._looking = 0, False

    def launch_before_step(self) -> None:  # noqa: B027
        """Launches what a recorded control step begins with."""

    @abstractmethod
    def launch_after_step(self) -> None:
        """Launches what a recorded control step ends with."""

    @abstractmethod
    def look(self) -> torch.Tensor:
        """Returns the numbers, shape ``(count,)`` and dtype int64, without waiting for the device."""

    @abstractmethod
    def act(self, numbers: list[int]) -> None:
        """Does what the numbers ask for."""

    def restart(self) -> None:
        """Forgets everything."""
        self._steps, self._looking = 0, False

    def after_step(self) -> None:
        """Looks every :data:`INTERVAL` steps, and acts on a look once it has arrived."""
        self._steps += 1
        if self._steps % INTERVAL == 0 and not self._looking:
            self._start_look()
        if self._looking and (self._copied is None or self._copied.query()):  # on the CPU it is here at once
            self._looking = False
            self.act(self._seen.tolist())

    def check(self) -> None:
        """Looks now, waits for the device, and acts."""
        self._start_look()
        if self._copied is not None:
            self._copied.synchronize()
        self._looking = False
        self.act(self._seen.tolist())

    def _start_look(self) -> None:
        self._seen.copy_(self.look(), non_blocking=True)
        if self._copied is not None:
            self._copied.record(torch.cuda.current_stream(self._device))
        self._looking = True
