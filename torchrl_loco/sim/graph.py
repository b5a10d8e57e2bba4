"""Work recorded once and replayed at every step: CUDA graphs on the GPU, Warp's recorder on the CPU."""

import contextlib
import os
import threading
from collections.abc import Callable

import torch
import warp as wp

from torchrl_loco.sim.scratch import ScratchPool

EXCLUSIVE = threading.RLock()
"""Held while Warp works in the calling thread: a recording takes in what other threads launch meanwhile, and on the CPU
two threads would share the scratch memory of tiles."""

# A child of a fork has only the thread that forked: it must not find the lock held by another.
os.register_at_fork(before=EXCLUSIVE.acquire, after_in_parent=EXCLUSIVE.release, after_in_child=EXCLUSIVE.release)


def current_stream(device: wp.Device) -> wp.Stream | None:
    """Returns torch's current stream of a CUDA device as a Warp stream, and ``None`` for the CPU."""
    if not device.is_cuda:
        return None
    return wp.stream_from_torch(torch.cuda.current_stream(wp.device_to_torch(device)))


class Graph:
    """The Warp launches that ``launch`` makes, recorded at construction and run by :meth:`replay`.

    Every array that the launches touch must live, at the same address, as long as the graph does. Scratch memory that
    is allocated while recording comes from ``scratch`` on CUDA and is kept by the recording itself on the CPU.

    Args:
        launch: makes the launches. It is called twice: once for real, which compiles the kernels and lets mujoco_warp
            make what it makes lazily, and once to record. It must not read the device.
        device: the Warp device.
        scratch: where scratch memory comes from; needed on CUDA.
    """

    def __init__(self, launch: Callable[[], None], device: wp.Device, scratch: ScratchPool | None = None) -> None:
        self._device = device
        self._scratch = scratch
        allocator = wp.ScopedAllocator(device, scratch) if device.is_cuda else contextlib.nullcontext()
        with wp.ScopedDevice(device), allocator:
            launch()
            with wp.ScopedCapture(device=device) as capture:
                launch()
        self._graph = capture.graph

    def replay(self) -> None:
        """Runs the recorded work on torch's current stream of the device, without waiting for it."""
        with contextlib.nullcontext() if self._device.is_cuda else EXCLUSIVE:
            wp.capture_launch(self._graph, stream=current_stream(self._device))
