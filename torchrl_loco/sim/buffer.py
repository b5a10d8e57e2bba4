"""Memory that Warp kernels and torch share."""

from collections.abc import Sequence
from typing import Any

import torch
import warp as wp


class Buffer:
    """An array of zeros on a device, as Warp and as torch see it. Its address never changes, so graphs can record it.

    Attributes:
        warp: what kernels read and write.
        torch: a view of the same memory. It always holds the current values: clone what you want to keep.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> None:
        self.warp: wp.array = wp.zeros(shape, dtype=dtype, device=device)
        self.torch: torch.Tensor = wp.to_torch(self.warp)

    @classmethod
    def around(cls, tensor: torch.Tensor) -> "Buffer":
        """Returns a buffer on the memory of a contiguous tensor."""
        buffer = object.__new__(cls)
        buffer.warp, buffer.torch = wp.from_torch(tensor), tensor
        return buffer


class PackedBuffers:
    """Arrays of so many float32 each, and as many flags, in one piece of memory, which can be copied at once.

    Attributes:
        memory: all of it, as bytes.
    """

    def __init__(self, floats: Sequence[int], flags: int, device: torch.device) -> None:
        self._floats, self._end, self._flags = list(floats), 4 * sum(floats), flags
        size = -(-(self._end + flags) // 4) * 4  # whole numbers, as torch.compile takes it for memory of floats
        self.memory = torch.zeros(size, dtype=torch.uint8, device=device)

    def parts(self, memory: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns the arrays, then the flags, in :attr:`memory` or in a copy of it; all of one dimension.

        To autograd each is a tensor of its own: a reward that is scaled in place leaves the observation as it was.
        """
        floats = memory[: self._end].view(torch.float32).split(self._floats)
        return *(part.data for part in floats), memory[self._end : self._end + self._flags].view(torch.bool).data
