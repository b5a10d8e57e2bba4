"""Functions of one world, which an engine runs before and after the physics: in the same kernel, if it can."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import warp as wp

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
    """
    if source is not None:
        fields |= {name: getattr(source, name) for name in struct.vars if name not in fields}
    missing, unknown = struct.vars.keys() - fields.keys(), fields.keys() - struct.vars.keys()
    if missing or unknown:
        wrong = [f"no {name}" for name in sorted(missing)] + [f"unknown {name}" for name in sorted(unknown)]
        raise TypeError(f"{struct.key} has the fields {', '.join(struct.vars)}; got {', '.join(wrong)}")
    instance = struct()
    for name, value in fields.items():
        setattr(instance, name, value)
    return instance


def chain(funcs: Sequence[WorldFunc]) -> WorldFunc:
    """Returns one that does what ``funcs`` do, in their order."""
    whole = NOTHING
    for one in funcs:
        whole = one if whole is NOTHING else _both(whole, one)
    return whole


def launch_each(funcs: Sequence[WorldFunc], mask: wp.array) -> None:
    """Launches each function as a kernel of its own; worlds that are not in ``mask`` ``(nworld,)`` do nothing."""
    for func, args in funcs:
        wp.launch(_kernel(func, args._cls), mask.size, [mask, args], device=mask.device, block_dim=BLOCK_DIM)


@wp.struct
class Nothing:
    """A struct needs a field."""

    unused: int


@wp.func
def do_nothing(world: int, args: Nothing):
    pass


NOTHING = WorldFunc(do_nothing, Nothing())


def _both(first: WorldFunc, second: WorldFunc) -> WorldFunc:
    func, struct = _both_funcs(first.func, first.args._cls, second.func, second.args._cls)
    return WorldFunc(func, fill(struct, first=first.args, second=second.args))


@functools.cache  # else the same functions would make a new kernel for each environment
def _both_funcs(first: wp.Function, First: Any, second: wp.Function, Second: Any) -> tuple[wp.Function, Any]:  # noqa: N803
    @wp.struct
    class Both:
        first: First
        second: Second

    @wp.func
    def both(world: int, args: Both):
        first(world, args.first)
        second(world, args.second)

    return both, Both


@functools.cache
def _kernel(func: wp.Function, Args: Any) -> wp.Kernel:  # noqa: N803
    @wp.kernel(enable_backward=False, module="unique")
    def each_world(mask_in: wp.array[bool], args: Args):
        world = wp.tid()
        if mask_in[world]:
            func(world, args)

    return each_world
