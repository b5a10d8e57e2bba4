"""Work recorded once and replayed at every step: CUDA graphs on the GPU, Warp's recorder on the CPU."""

import contextlib
import inspect
import os
import threading
import weakref
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import torch
import warp as wp

from torchrl_loco.garbage import no_collection

EXCLUSIVE = threading.RLock()
"""Held while Warp works in the calling thread: a recording includes what other threads launch meanwhile, and on the CPU
two threads would share the scratch memory of tiles."""

# A child of a fork has only the thread that forked: it must not find the lock held by another.
os.register_at_fork(before=EXCLUSIVE.acquire, after_in_parent=EXCLUSIVE.release, after_in_child=EXCLUSIVE.release)


def current_stream(device: wp.Device) -> wp.Stream | None:
    """Returns torch's current stream of a CUDA device as a Warp stream, and ``None`` for the CPU."""
    if not device.is_cuda:
        return None
    return wp.stream_from_torch(torch.cuda.current_stream(wp.device_to_torch(device)))


def torch_is_recording(device: wp.Device) -> bool:
    """Returns whether torch records a CUDA graph on its current stream.

    CUDA's default stream cannot be recorded, and asking about it while Warp records on another one is an error.
    """
    if not device.is_cuda:
        return False
    with torch.cuda.device(wp.device_to_torch(device)):
        return torch.cuda.current_stream() != torch.cuda.default_stream() and torch.cuda.is_current_stream_capturing()


@contextlib.contextmanager
def joined_to_torch(device: wp.Device) -> Iterator[None]:
    """Adds Warp's launches to the CUDA graph that torch records on its current stream."""
    stream = current_stream(device)
    with (
        wp.ScopedDevice(device),
        wp.ScopedStream(stream, sync_enter=False),
        wp.ScopedCapture(stream=stream, external=True),
    ):
        yield


class Graph:
    """Warp launches as a call: a recording of them is replayed, or they join the CUDA graph that torch records.

    Every array that the launches touch must live, at the same address, as long as this does. Scratch memory that is
    allocated while recording comes from ``scratch`` on CUDA and is kept by the recording itself on the CPU.

    Args:
        launch: makes the launches. It is called twice: once for real, which compiles the kernels and lets mujoco_warp
            allocate what it allocates lazily, and once to record. It must not read from the device. If it is a method,
            its object is not kept alive.
        device: the Warp device.
        scratch: where scratch memory comes from; needed on CUDA.
        anew: whether it is called at each replay instead: C MuJoCo's steps are none that Warp could record.
    """

    def __init__(
        self,
        launch: Callable[..., None],
        device: wp.Device,
        scratch: "ScratchPool | None" = None,
        *,
        anew: bool = False,
    ) -> None:
        self._launch = weakref.WeakMethod(launch) if inspect.ismethod(launch) else lambda: launch
        self._device, self._scratch, self._graph = device, scratch, None
        if anew:
            return
        allocator = wp.ScopedAllocator(device, scratch) if device.is_cuda else contextlib.nullcontext()
        with EXCLUSIVE, wp.ScopedDevice(device), allocator:
            launch()
            with no_collection(), wp.ScopedCapture(device=device) as capture:
                launch()
        self._graph = capture.graph

    def __call__(self, *args: Any) -> None:
        """Runs them on torch's current stream, without a wait; ``args`` are for where they join torch's recording."""
        if not torch_is_recording(self._device):
            self.replay()
            return
        with joined_to_torch(self._device):
            self._launch_now(*args)

    def replay(self) -> None:
        """Runs the recorded work on torch's current stream of the device, without waiting for it."""
        with contextlib.nullcontext() if self._device.is_cuda else EXCLUSIVE:
            if self._graph is not None:
                wp.capture_launch(self._graph, stream=current_stream(self._device))
                return
            with wp.ScopedDevice(self._device):
                self._launch_now()

    def _launch_now(self, *args: Any) -> None:
        launch = self._launch()
        assert launch is not None
        launch(*args)


class TorchGraph:
    """A function without arguments, recorded as a CUDA graph of torch after some warm-up calls.

    ``tensordict.nn.CudaGraphModule`` waits for the device at every call; this does not.

    Args:
        work: reads and writes tensors that keep their addresses. Warp's launches need :func:`joined_to_torch`, at the
            end of which the branches are joined that were recorded so far; but for those of a kernel that is loaded,
            which allocate nothing: the current stream is enough for them.
        device: a CUDA device.
        warmup: calls that run the work directly, before it is recorded.
    """

    def __init__(self, work: Callable[[], None], device: torch.device, warmup: int = 0) -> None:
        self._work, self._device, self._warmup = work, device, warmup
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> None:
        """Runs the work, on torch's current stream."""
        if self._warmup > 0:
            self._warmup -= 1
            side = torch.cuda.Stream(self._device)
            side.wait_stream(torch.cuda.current_stream(self._device))
            with torch.cuda.stream(side):
                self._work()
            torch.cuda.current_stream(self._device).wait_stream(side)
            return
        if self._graph is None:
            torch.cuda.synchronize(self._device)
            graph = torch.cuda.CUDAGraph()
            side = torch.cuda.Stream(self._device)  # else torch takes one of its current device
            recording = torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local")
            with EXCLUSIVE, no_collection(), torch.cuda.device(self._device):
                before = torch.cuda.current_stream()
                try:
                    with recording:
                        self._work()
                except BaseException:
                    # A recording that cannot end leaves its stream current, and torch's random numbers waiting for its
                    # end: let an empty one end.
                    torch.cuda.set_stream(before)
                    with torch.cuda.graph(torch.cuda.CUDAGraph(), stream=side):
                        torch.zeros(1, device=self._device)
                    # Warp keeps the error of a call that failed in it, which its next strided copy would raise.
                    with contextlib.suppress(RuntimeError):
                        wp.clone(wp.zeros((2, 2), dtype=float, device=wp.device_from_torch(self._device))[:, 0])
                    raise
            self._graph = graph
        self._graph.replay()

    def release(self) -> None:
        """Forgets the recording; the next call records anew."""
        if self._graph is not None:
            torch.cuda.synchronize(self._device)
            self._graph.reset()
            self._graph = None


class ScratchPool:
    """A Warp allocator for launches that will be recorded. It reuses freed blocks and never returns them to the device.

    Without it the arrays that mujoco_warp allocates within a step become allocation nodes of the CUDA graph, which are
    not allowed inside a condition. Blocks are reused within one graph and between graphs, which is sound because graphs
    are replayed one after another.

    The memory of mujoco_warp's deterministic kernels belongs to the recording. Warp requests it on a stream that is not
    being recorded; such requests go to the allocator that was active before.
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
