"""A part of the control step that hooks make: as one kernel, by torch.compile, or as plain torch."""

import logging
import warnings
from collections.abc import Callable, Mapping

import torch
import warp as wp
from torch.fx.experimental.proxy_tensor import make_fx

from torchrl_loco.envs.fusion import CannotFuse, fuse
from torchrl_loco.sim import Recorded, Simulation

Arrays = Mapping[str, torch.Tensor]


class Part:
    """A function of the arrays of all worlds, which it changes in place.

    :meth:`compile` runs it once on the present worlds to trace it. Whatever Python hooks use is evaluated then: what
    shall change later must be a tensor that is changed in place.

    Args:
        work: the function.
        arrays: the arrays, by name, at addresses that stay.
        title: name of the task, for messages.

    Attributes:
        kind: how it runs, ``"kernel"``, ``"torch.compile"`` or ``"plain torch"``.
    """

    def __init__(self, work: Callable[[Arrays], None], arrays: dict[str, torch.Tensor], title: str) -> None:
        self._work, self._arrays, self._title = work, arrays, f"{title}.{work.__name__}"
        self._launch: Callable[[], None] | None = None
        self._run: Callable[[], None] = lambda: work(arrays)
        self.kind = "plain torch"

    @torch.no_grad()
    def __call__(self) -> None:
        """Runs it, without waiting for the device."""
        self._run()

    def launch(self) -> None:
        """Launches its kernel, on Warp's current stream."""
        assert self._launch is not None
        self._launch()

    @torch.no_grad()
    def compile(self, num_envs: int, device: wp.Device) -> bool:
        """Makes a kernel of it, or on CUDA what torch.compile makes; if it can be neither, logs why.

        Returns:
            Whether :meth:`record` is to follow, once kernels are compiled.
        """
        on = torch.device(wp.device_to_torch(device))
        try:
            traced = constants_on(on, make_fx(lambda arrays: self._work(arrays))(self._arrays))
        except Exception as error:  # whatever hooks and tracing raise
            self._stays_plain(error)
            return False
        try:
            self._launch, self.kind = fuse(traced, self._arrays, num_envs, device), "kernel"
        except CannotFuse as error:
            if device.is_cuda:
                self._compile_by_torch(traced)
            else:
                self._stays_plain(error)
        return self._launch is not None

    def record(self, sim: Simulation) -> None:
        """Records its launch."""
        self._run = Recorded(self.launch, sim.capture(self.launch), sim.device)

    def _compile_by_torch(self, traced: torch.fx.GraphModule) -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of torch's own code
                compiled = torch.compile(traced, fullgraph=True, dynamic=False)
                compiled(self._arrays)
        except Exception as error:  # whatever the compiler raises
            self._stays_plain(error)
        else:
            self._run, self.kind = lambda: compiled(self._arrays), "torch.compile"

    def _stays_plain(self, error: Exception) -> None:
        message = " ".join(str(error).split("\n")[:3]).strip()
        logging.getLogger("torchrl_loco").warning(
            "%s is not compiled and runs as plain torch: %s", self._title, message
        )


def constants_on(device: torch.device, traced: torch.fx.GraphModule) -> torch.fx.GraphModule:
    """Returns a trace in which tensors of other devices are copied to ``device`` once, and not at each step."""
    copies = (torch.ops.aten._to_copy.default, torch.ops.aten.lift_fresh_copy.default)
    for node in list(traced.graph.nodes):
        if node.target not in copies or node.args[0].op != "get_attr":
            continue
        constant = getattr(traced, node.args[0].target)
        if constant.device == device:
            continue
        name = f"{node.args[0].target}_{node.name}"
        traced.register_buffer(name, node.target(constant, *node.args[1:], **node.kwargs).to(device), persistent=False)
        with traced.graph.inserting_before(node):
            node.replace_all_uses_with(traced.graph.get_attr(name))
        traced.graph.erase_node(node)
    traced.recompile()
    return traced
