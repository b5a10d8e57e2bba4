"""Work recorded once and replayed at every step: CUDA graphs on the GPU, Warp's recorder on the CPU."""

from collections.abc import Callable

import torch
import warp as wp


class Graph:
    """The Warp launches that ``launch`` makes, recorded at construction and run by :meth:`replay`.

    Recording runs nothing on CUDA. Every array that the launches touch must live, at the same address, as long as the
    graph does; scratch memory that is allocated while recording is kept by the graph itself.

    Args:
        launch: makes the launches; called once to load the kernels and once to record. It must not read the device.
        device: the Warp device.
    """

    def __init__(self, launch: Callable[[], None], device: wp.Device) -> None:
        self._device = device
        with wp.ScopedDevice(device):
            # Recording loads kernels too, but lazily created buffers of mujoco_warp must exist before it.
            launch()
            with wp.ScopedCapture(device=device) as capture:
                launch()
        self._graph = capture.graph

    def replay(self) -> None:
        """Runs the recorded work on torch's current stream of the device, without waiting for it."""
        if self._device.is_cuda:
            wp.capture_launch(self._graph, stream=wp.stream_from_torch(torch.cuda.current_stream(self._torch_device)))
        else:
            wp.capture_launch(self._graph)

    @property
    def _torch_device(self) -> torch.device:
        return torch.device(wp.device_to_torch(self._device))
