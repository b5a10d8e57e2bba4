"""A part of a step in plain torch as one kernel: a thread a world, whose numbers are scalars of straight-line C++.

The traced graph is interpreted once on symbols. A tensor of all worlds becomes a NumPy array of nodes, in which the
dimension of the worlds has size 1; views of tensors are views of such arrays, so that writing to one changes the other.
What a world does depends on no other world: on neither their number nor their numbers, bit for bit.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import warp as wp

from torchrl_loco.envs.fusion.nodes import CannotFuse as CannotFuse
from torchrl_loco.envs.fusion.program import LONG, Program
from torchrl_loco.envs.fusion.rules import RULES
from torchrl_loco.envs.fusion.trace import ReachedError as ReachedError
from torchrl_loco.envs.fusion.trace import trace as trace
from torchrl_loco.sim.world_func import BLOCK_DIM, fill


def fuse(
    traced: torch.fx.GraphModule,
    arrays: dict[str, torch.Tensor],
    num_envs: int,
    device: wp.Device,
    fixed: Sequence[torch.Tensor] = (),
) -> Callable[[], None]:
    """Returns a function that does what a traced one does to arrays, in one launch on Warp's current stream.

    Tensors that it uses are read from memory at each launch, so what is changed in place is seen. The tensors live as
    long as the returned function. Arrays are ``(num_envs, ...)`` in any order of memory; others are read only, and so
    is ``seed``. The tensors ``fixed``, which it uses too, never change: they alone can be indices.
    """
    given = arrays, num_envs, torch.device(wp.device_to_torch(device)), RULES, fixed
    constants = functools.partial(getattr, traced)
    with torch.no_grad():
        try:
            source = (program := Program(*given, LONG)).run(traced.graph, constants)
        except CannotFuse:  # a table may have as many rows as there are worlds
            if num_envs not in (len(table) for table in traced.buffers() if table.ndim):
                raise
            source = (program := Program(*given, math.inf)).run(traced.graph, constants)
    names = [f"p{index}" for index in source.used]
    Pointers: Any = wp.struct(type("Pointers", (), {"__annotations__": dict.fromkeys(names, wp.uint64)}))  # noqa: N806
    tensors = [program.tensors[index] for index in source.used]
    pointers = fill(Pointers, **{name: tensor.data_ptr() for name, tensor in zip(names, tensors, strict=True)})

    @wp.func_native(source.text)
    def run(world: int, args: Pointers): ...

    @wp.kernel(enable_backward=False, module="unique")
    def fused_hooks(args: Pointers):
        world = wp.tid()
        run(world, args)

    def launch(kept: Any = tensors) -> None:
        wp.launch(fused_hooks, num_envs, [pointers], device=device, block_dim=BLOCK_DIM)

    return launch
