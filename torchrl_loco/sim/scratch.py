"""Scratch memory for recorded work on CUDA."""

from collections import defaultdict

import torch
import warp as wp


class ScratchPool:
    """A Warp allocator that gives freed blocks out again and none back, for launches that will be recorded.

    Without it the arrays that mujoco_warp allocates within a step become allocation nodes of the CUDA graph, which are
    not allowed inside a condition. Blocks are reused within one graph and between graphs, which is sound because they
    are replayed one after another.

    What mujoco_warp's deterministic kernels need, a recording holds on to; Warp asks for it on a stream that is not
    being recorded, and gets it from the allocator that was there before.

    Args:
        device: a CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        self._warp_device = device
        self._before = device.get_allocator()
        self._from_before: set[int] = set()
        self._device = wp.device_to_torch(device)
        self._blocks: list[torch.Tensor] = []
        self._free: dict[int, list[int]] = defaultdict(list)

    def allocate(self, size_in_bytes: int) -> int:
        """Returns the address of a block of that size."""
        device = self._warp_device
        if device.is_capturing and not device.stream.is_capturing:
            ptr = self._before.allocate(size_in_bytes)
            self._from_before.add(ptr)
            return ptr
        if not self._free[size_in_bytes]:
            block = torch.empty(size_in_bytes, dtype=torch.uint8, device=self._device)
            self._blocks.append(block)
            return block.data_ptr()
        return self._free[size_in_bytes].pop()

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Takes a block back, to be given out again."""
        if ptr in self._from_before:
            self._from_before.remove(ptr)
            self._before.deallocate(ptr, size_in_bytes)
            return
        self._free[size_in_bytes].append(ptr)
