"""Functions of one world, which an engine runs before and after the physics: in the same kernel, if that is faster."""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from torchrl_loco.sim import mjw

BLOCK_DIM = 64
"""Threads of a block where a thread has a world: few, so that a thousand worlds keep all multiprocessors busy."""


class WorldFunc(NamedTuple):
    """What is done in each world.

    Attributes:
        func: a ``wp.func`` of the index of the world and of ``args``.
        args: an instance of the ``wp.struct`` that it takes.
    """

    func: wp.Function
    args: Any


def fill(struct: Any, source: Any = None, /, **fields: Any) -> Any:
    """Returns an instance of a ``wp.struct``.

    Args:
        struct: the struct.
        source: has the fields that are not given as attributes of the same names: ``world.sim.data``, for example.
        fields: the values of fields.

    Raises:
        TypeError: a field is missing, or there is no such field; the message names them.
        ValueError: arrays lie on several devices.
    """
    given = dict(fields)
    for name in struct.vars:
        if name not in given and source is not None:
            with contextlib.suppress(AttributeError):
                given[name] = getattr(source, name)
    missing, unknown = sorted(struct.vars.keys() - given.keys()), sorted(given.keys() - struct.vars.keys())
    if missing or unknown:
        others = {field.name for field in dataclasses.fields(mjw.Data)} if missing and source is not None else set()
        hints = {name: ', which engine="mujoco_warp" has' for name in missing if name in others}
        wrong = [f"{name} is missing{hints.get(name, '')}" for name in missing]
        wrong += [f"there is no {name}" for name in unknown]
        raise TypeError(f"{struct.key} has the fields {', '.join(struct.vars)}: {', '.join(wrong)}")
    devices = {name: str(value.device) for name, value in given.items() if isinstance(value, wp.array)}
    if len(set(devices.values())) > 1:
        raise ValueError(f"the arrays of {struct.key} must lie on one device, got {devices}")
    instance = struct()
    for name, value in given.items():
        setattr(instance, name, value)
    return instance


def fill_from_numbers(struct: Any, device: wp.Device, source: Any = None, /, **fields: Any) -> Any:
    """Returns what :func:`fill` does, where the numbers of an array are given instead of one on the device."""
    for name, field in struct.vars.items():
        values, kind = fields.get(name, getattr(source, name, None)), field.type
        if hasattr(kind, "ndim") and values is not None:
            values, like = np.asarray(values), {"dtype": kind.dtype, "device": device}
            fields[name] = wp.array(values, **like) if values.size else wp.empty((0,) * kind.ndim, **like)
    return fill(struct, source, **fields)


class Around(NamedTuple):
    """What each world does around the physics: of a control step, or of an update of poses and sensors."""

    before: Sequence[WorldFunc] = ()
    after: Sequence[WorldFunc] = ()


ALONE = Around()  # the physics and nothing else


class Chain:
    """Functions of a world as one, which calls them in their order.

    Attributes:
        func: the function that calls them.
        struct: the ``wp.struct`` that it takes.
    """

    def __init__(self, funcs: Sequence[WorldFunc]) -> None:
        self.func, self.struct = do_nothing, Nothing
        self._pairs = []
        for index, (func, args) in enumerate(funcs):
            if index == 0:
                self.func, self.struct = func, args._cls
            else:
                self.func, self.struct = _both(self.func, self.struct, func, args._cls)
                self._pairs.append(self.struct)

    def args(self, funcs: Sequence[WorldFunc]) -> Any:
        """Returns the arguments of such functions as one instance of :attr:`struct`."""
        if not funcs:
            return Nothing()
        whole = funcs[0].args
        for pair, (_, args) in zip(self._pairs, funcs[1:], strict=True):
            whole = fill(pair, first=whole, second=args)
        return whole


class WorldKernels:
    """Functions of a world as kernels of their own, where the physics cannot call them or would wait for them.

    The kernel of each list of functions is made once.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[wp.Function, ...], tuple[Chain, wp.Kernel]] = {}

    def launch(self, funcs: Sequence[WorldFunc], mask: wp.array) -> None:
        """Launches functions as one kernel; worlds that are not in ``mask`` ``(nworld,)`` do nothing."""
        if not funcs:
            return
        key = tuple(func for func, _ in funcs)
        if key not in self._kept:
            chain = Chain(funcs)
            self._kept[key] = chain, _kernel(chain.func, chain.struct)
        chain, kernel = self._kept[key]
        wp.launch(kernel, mask.size, [mask, chain.args(funcs)], device=mask.device, block_dim=BLOCK_DIM)


@wp.func_native("""
int written = 0;
#ifdef __CUDA_ARCH__
const int PIECE = 8;  // numbers of a row that are written at once: 32 bytes, a sector of the memory
const unsigned ALL = 0xffffffffu;
const int lane = threadIdx.x % 32, place = lane % PIECE;
if (__activemask() == ALL) {
  float* const first = reinterpret_cast<float*>(__shfl_sync(ALL, reinterpret_cast<size_t>(out.data), 0));
  if (__all_sync(ALL, out.data == first + lane * row.shape[0] && out.strides[0] == sizeof(float))) {
    for (; written < row.shape[0]; written += PIECE) {
      float piece[PIECE];
      for (int i = 0; i < PIECE; ++i) piece[i] = written + i < row.shape[0] ? row.data[written + i] : 0.0f;
      for (int step = 1; step < PIECE; step *= 2) {  // transposes the pieces of each PIECE threads
        for (int i = 0; i < PIECE; ++i) {
          if (i & step) continue;
          const bool upper = place & step;
          const float other = __shfl_xor_sync(ALL, upper ? piece[i] : piece[i + step], step);
          (upper ? piece[i] : piece[i + step]) = other;
        }
      }
      for (int i = 0; i < PIECE; ++i) {
        if (written + place < row.shape[0]) first[(lane - place + i) * row.shape[0] + written + place] = piece[i];
      }
    }
    __syncwarp();  // each thread may read its own row now
  }
}
#endif
for (int i = written; i < row.shape[0]; ++i) wp::index(out, i) = row.data[i];
""")
def write_rows(row: wp.array[float], out: wp.array[float]):
    """Writes the row of a world.

    Threads of a warp write parts of each other's rows if these are contiguous, so that their accesses coalesce: one
    reaches four whole sectors of memory, instead of a number in each of 32.
    """


# The next two stay loops: a launch fetches each instruction anew, which takes longer than to execute it.


@wp.func_native("""
const int PIECE = 8, last = row.shape[0] - 1;  // several reads on their way at once: a write would wait for each
#pragma unroll 1
for (int first = 0; first <= last; first += PIECE) {
  float piece[PIECE];
  for (int i = 0; i < PIECE; ++i) piece[i] = wp::index(row, first + i < last ? first + i : last);
  for (int i = 0; i < PIECE; ++i) if (first + i <= last) wp::index(out, first + i) = piece[i];
}
""")
def copy_row(row: wp.array[float], out: wp.array[float]):
    """Copies a row."""


@wp.func_native("""
#pragma unroll 1
for (int i = 0; i < row.shape[0]; ++i) wp::index(row, i) = 0.0f;
""")
def zero_row(row: wp.array[float]):
    """Zeroes a row."""


@wp.struct
class Nothing:
    """A struct needs a field."""

    unused: int


@wp.func
def do_nothing(world: int, args: Nothing):
    pass


def _both(first: wp.Function, First: Any, second: wp.Function, Second: Any) -> tuple[wp.Function, Any]:  # noqa: N803
    @wp.struct
    class Both:
        first: First
        second: Second

    @wp.func
    def both(world: int, args: Both):
        first(world, args.first)
        second(world, args.second)

    return both, Both


def _kernel(func: wp.Function, Args: Any) -> wp.Kernel:  # noqa: N803
    # Made anew at each call: Warp compiles none that it has compiled before, and sees what the function calls.
    @wp.kernel(enable_backward=False, module="unique")
    def each_world(mask_in: wp.array[bool], args: Args):
        world = wp.tid()
        if mask_in[world]:
            func(world, args)

    return each_world
