"""A part of the control step that hooks make: as one kernel, by torch.compile, or as plain torch."""

import contextlib
import itertools
import logging
import traceback
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
import warp as wp

import torchrl_loco
from torchrl_loco.envs.fusion import CannotFuse, ReachedError, fuse, trace
from torchrl_loco.envs.precision import own_precision
from torchrl_loco.envs.view import Arrays
from torchrl_loco.garbage import no_collection
from torchrl_loco.sim import Simulation

COMPARED = 64  # worlds in which a trace or a kernel is compared with the hooks themselves
SPREADS = (0.02, 2.0)
"""How far the numbers of a comparison are from those of worlds at rest: hooks may refuse wild ones, as an index."""
TRACE = (
    "its trace gives another {} for other numbers: a hook takes numbers out of torch (numpy, tolist), or changes "
    "something of its own at each call, or draws by torch.rand instead of s.uniform and s.normal"
)
KERNEL = "its kernel gives another {} than the hooks, which is an error of this package: please report it"
COMPILED = "torch.compile gives another {} than the hooks"  # what is said where what stands for hooks differs from them


class Part:
    """A function of the arrays of all worlds, which it changes in place.

    :meth:`compile` runs it once on the present worlds to trace it. Whatever Python hooks use is evaluated then: what
    shall change later must be a tensor that is changed in place.

    The arrays stay at their addresses, and the tensors ``fixed`` as they are; ``title`` is for messages. Those that
    parts beside it have ``said`` are not repeated.
    """

    def __init__(
        self,
        work: Callable[[Arrays], None],
        arrays: dict[str, torch.Tensor],
        title: str,
        fixed: Sequence[torch.Tensor] = (),
        said: set[str] | None = None,
    ) -> None:
        self._fixed, self._said = fixed, set[str]() if said is None else said
        self._arrays, self._title = arrays, title
        self._work = self._in_own_precision(work)
        self._launch: Callable[[], None] | None = None
        self._traced: torch.fx.GraphModule | None = None  # until its kernel is compared
        self._run: Callable[[], None] = lambda: self._work(arrays)
        self.kind = "plain torch"  # how it runs, or "kernel" or "torch.compile"
        self.before: Callable[[], None] = lambda: None  # makes what it reads, such as scans of the ground

    def _in_own_precision(self, work: Callable[..., None]) -> Callable[..., None]:
        """Returns what does the same under the caller's autocast and default dtype."""
        device = next(iter(self._arrays.values())).device

        def run(*args: Any) -> None:
            with own_precision(device):
                work(*args)

        return run

    @torch.no_grad()
    def __call__(self) -> None:
        """Runs it, without waiting for the device."""
        self.before()
        self._run()

    def launch(self) -> None:
        """Launches its kernel, on Warp's current stream."""
        assert self._launch is not None
        self._launch()

    @torch.no_grad()
    def compile(self, num_envs: int, device: wp.Device) -> bool:
        """Returns whether a kernel is made of it, which :meth:`record` completes once it is compiled.

        Else torch.compile makes something on CUDA, or the log says why it stays as it is.
        """
        try:
            with no_collection():  # an environment that is dropped meanwhile computes, which would be traced too
                self._traced = trace(self._work, self._arrays, self._fixed)
        except Exception as error:  # whatever hooks and tracing raise
            self._stays_plain(error)
            return False
        try:
            with no_collection():
                self._launch = fuse(self._traced, self._arrays, num_envs, device, self._fixed)
        except Exception as error:  # CannotFuse, and what torch raises where it decomposes operators
            self._do_without_kernel(device, error)
        return self._launch is not None

    def _do_without_kernel(self, device: wp.Device, error: Exception) -> None:
        """Takes torch.compile on CUDA, unless hooks do something that no trace shows."""
        self._launch, traced, self._traced = None, self._traced, None
        assert traced is not None
        try:
            self._compare(lambda: traced(*self._arrays.values()), TRACE)
        except ValueError as other:
            self._stays_plain(other)
            return
        if device.is_cuda:
            self._compile_by_torch(traced)
        else:
            self._stays_plain(error)

    def _compare(self, run: Callable[[], None], what: str) -> None:
        """Compares what stands for the hooks with the hooks themselves, on numbers that it was not made with.

        ``what`` is said of it where it differs, with the name of the array.

        Raises:
            ValueError: they differ, or hooks take none of the numbers.
        """
        generator, compared = torch.Generator(self._arrays["qpos"].device).manual_seed(0), 0
        kept = {name: rows.clone() for name, rows in self._arrays.items()}
        refused: Exception | None = None
        try:
            for spread, flags in itertools.product(SPREADS, (False, True)):  # flags of worlds: masked, not finite
                for name, rows in self._arrays.items():
                    most = 2 if name.startswith(("memory.", "shared.")) else 10  # which may be an index
                    rows.copy_(changed(kept[name], generator, spread, flags, most))
                # Only now, since some arrays are views of others; two names of one memory stay that.
                copies: dict[Any, torch.Tensor] = {}
                ours = {
                    name: copies.setdefault((rows.data_ptr(), rows.shape, rows.stride()), rows.clone())
                    for name, rows in self._arrays.items()
                }
                try:
                    self._work(ours)
                except Exception as error:
                    refused = error
                    continue
                run()
                for name, rows in ours.items():
                    one, other = (torch.atleast_1d(values)[:COMPARED].double() for values in (rows, self._arrays[name]))
                    if not torch.allclose(one, other, rtol=1e-4, atol=1e-4, equal_nan=True):
                        raise ValueError(what.format(name))
                compared += 1
        finally:
            for name, rows in self._arrays.items():
                rows.copy_(kept[name])
        if not compared:
            raise ValueError(f"hooks refuse all other numbers, so nothing can be compared: {refused}") from refused

    @torch.no_grad()
    def record(self, sim: Simulation) -> None:
        """Compares its kernel with the hooks, and records its launch; if they differ, there is no kernel."""

        def run() -> None:  # on Warp's stream, the rest on torch's
            wp.synchronize_device(sim.device)
            self.launch()
            wp.synchronize_device(sim.device)

        try:
            self._compare(run, KERNEL)
        except ValueError as error:
            self._do_without_kernel(sim.device, error)
            return
        self._traced, self.kind = None, "kernel"
        self._run = sim.capture(self.launch)

    def _compile_by_torch(self, traced: torch.fx.GraphModule) -> None:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # those of torch's own code
                # Not the lazy module itself, whose Python torch.compile cannot call for.
                module = torch.fx.GraphModule(traced, traced.graph)
                compiled = torch.compile(module, fullgraph=True, dynamic=False)
                compiled(*self._arrays.values())
            self._compare(lambda: compiled(*self._arrays.values()), COMPILED)
        except Exception as error:  # whatever the compiler raises
            self._stays_plain(error)
        else:
            run = self._in_own_precision(compiled)
            self._run, self.kind = lambda: run(*self._arrays.values()), "torch.compile"

    def _stays_plain(self, error: Exception) -> None:
        message = " ".join(str(error).split("\n")[:3]).strip()
        operator = error.operator if isinstance(error, CannotFuse) else None
        line = self._line_of(operator) if operator else _line_of_user(error)
        verdict = f"{self._title}: not compiled, runs as plain torch: {message}{line}"
        if verdict not in self._said:
            self._said.add(verdict)
            logging.getLogger("torchrl_loco").warning(verdict)

    def _line_of(self, operator: str) -> str:
        """Returns where the task's own code calls an operator of the graph, by its node's name: traces again."""
        with contextlib.suppress(Exception):  # of a hook that does something else at each call
            try:
                trace(self._work, {name: rows.clone() for name, rows in self._arrays.items()}, self._fixed, operator)
            except ReachedError as reached:
                return _line_of_user(reached)
        return ""


def _line_of_user(error: BaseException) -> str:
    """Returns where in the task's own code an error comes from, if it does."""
    packages = tuple(path for module in (torch, torchrl_loco) for path in module.__path__)
    frames = [each for each in traceback.extract_tb(error.__traceback__) if not each.filename.startswith(packages)]
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""


def changed(rows: torch.Tensor, generator: torch.Generator, spread: float, flags: bool, most: int = 10) -> torch.Tensor:
    """Returns a copy of an array with other finite numbers of the same kind; booleans are all ``flags``.

    Integers grow by less than ``most``.
    """
    if rows.dtype == torch.bool:
        return torch.full_like(rows, flags)
    noise = torch.rand(rows.shape, generator=generator, device=rows.device)
    if not rows.is_floating_point():
        return rows + (most * noise).to(rows.dtype)
    return rows.nan_to_num(0.0, 0.0, 0.0) + spread * (2 * noise - 1)
