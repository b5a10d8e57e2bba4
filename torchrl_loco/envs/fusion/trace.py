"""A function of arrays as a graph of the operators of torch that it calls; those without a rule are decomposed.

``make_fx`` gives the same graph, but takes five times as long: it notes what only torch's compilers read.
"""

import contextlib
import operator
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch._decomp import decomposition_table
from torch.fx._lazy_graph_module import _make_graph_module, _use_lazy_graph_module
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchrl_loco.envs.fusion.rules import RULES

aten = torch.ops.aten
COPIES = (aten._to_copy.default, aten.lift_fresh_copy.default)


def _searchsorted(row: torch.Tensor, x: Any, *, out_int32: bool = False, right: bool = False, side: Any = None) -> Any:
    """Returns what searchsorted does in one row, by the decomposition of bucketize: torch has none of its own."""
    return decomposition_table[aten.bucketize.Tensor](x, row, out_int32=out_int32, right=right or side == "right")


def _cross(one: torch.Tensor, other: torch.Tensor, *, dim: int = -1) -> torch.Tensor:
    """Returns the cross product: torch's own decomposition imports sympy, which takes a second."""
    if one.ndim != other.ndim or {one.shape[dim], other.shape[dim]} != {3}:
        raise ValueError  # then torch's own operator is called, whose error says why
    one, other = torch.broadcast_tensors(one, other)
    return one.roll(-1, dim) * other.roll(1, dim) - one.roll(1, dim) * other.roll(-1, dim)


DECOMPOSED: dict[Any, Callable[..., Any]] = {
    **decomposition_table,
    aten.searchsorted.Tensor: _searchsorted,
    aten.linalg_cross.default: _cross,
}
"""Operators of which torch's compilers know what they consist of."""


def _decomposed(func: Any) -> Callable[..., Any] | None:
    """Returns what does by other operators what one without a rule does, if torch has that for its compilers."""
    name, kept = func._schema.name.removeprefix("aten::"), {torch.Tag.nondeterministic_seeded, torch.Tag.inplace_view}
    in_place = name.endswith("_") and not name.startswith("_")
    if name in RULES or (in_place and name[:-1] in RULES) or not kept.isdisjoint(func.tags):
        return None
    if func._can_decompose():
        return func.decompose
    if not in_place:
        return DECOMPOSED.get(func)
    functional: Any = getattr(getattr(aten, name[:-1], None), func._overloadname, None)
    new = DECOMPOSED.get(functional)
    return new and (lambda target, *args, **kwargs: target.copy_(new(target, *args, **kwargs)))


class ReachedError(BaseException):
    """The operator at which to stop is reached. It is no ``Exception``: those of decompositions are suppressed."""


class NumberTakenError(RuntimeError):
    """What a hook does depends on a number that it reads out of a tensor."""


class Tracer(TorchDispatchMode):
    """Notes each operator while it runs.

    A result bears its node as an attribute, which is dropped with it: all results together may not fit in memory.
    """

    def __init__(
        self, arrays: dict[str, torch.Tensor], fixed: Iterable[torch.Tensor] = (), stop: str | None = None
    ) -> None:
        super().__init__()
        self._stop = stop
        self.graph, self.constants = torch.fx.Graph(), torch.nn.Module()
        self._device = next(iter(arrays.values())).device
        self._fixed = {tensor.data_ptr() for tensor in fixed}
        self._known: set[torch.fx.Node] = set()  # whose numbers are the same in each run
        self._kept = list(arrays.values())  # arrays and constants: no other tensor gets their ids meanwhile
        self._nodes = {id(array): self.graph.placeholder(f"arg{i}") for i, array in enumerate(self._kept)}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Returns no: torch 2.13 would import its compiler, which takes a second, to keep it away from this method."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func is aten.lift_fresh.default:  # of torch.tensor(...): each run needs a copy
            func = aten.lift_fresh_copy.default
        if (decomposed := _decomposed(func)) is not None:
            with self, contextlib.suppress(Exception):  # what it refuses is noted as it is, or refused by torch
                return decomposed(*args, **kwargs)
        if torch.Tag.data_dependent_output in func.tags:
            self.check_known(args, "if, .item(), float()")
            return func(*args, **kwargs)
        if func in COPIES and args[0].device != self._device:
            source = self._noted(args[0])
            if source is None or source.op == "get_attr":  # a constant: copied to the device once, not in each run
                result = func(*args, **kwargs)
                self._note(result, self._constant(result.to(self._device)))
                return result
        node = self.graph.call_function(func, *torch.fx.node.map_aggregate((args, kwargs), self.argument))
        if node.name == self._stop:
            raise ReachedError
        operands = node.all_input_nodes
        if func is aten.lift_fresh_copy.default or (operands and self._known.issuperset(operands)):
            self._known.add(node)
        result = func(*args, **kwargs)
        if isinstance(result, tuple | list):
            for i, each in enumerate(result):
                self._note(each, self.graph.call_function(operator.getitem, (node, i)))
        else:
            self._note(result, node)
        return result

    def _noted(self, tensor: torch.Tensor) -> torch.fx.Node | None:
        node = getattr(tensor, "_node", None)
        return node if node is not None and node.graph is self.graph else self._nodes.get(id(tensor))

    def argument(self, arg: Any) -> Any:
        """Returns what stands for an argument of an operator in the graph, or for a result of it."""
        if not isinstance(arg, torch.Tensor):
            return arg
        if (node := self._noted(arg)) is not None:
            return node
        self._nodes[id(arg)] = self._constant(arg)
        return self._nodes[id(arg)]

    def _constant(self, tensor: torch.Tensor) -> torch.fx.Node:
        name = f"constant{len(self._kept)}"
        self.constants.register_buffer(name, tensor.detach(), persistent=False)
        self._kept.append(tensor)
        return self.graph.get_attr(name)

    def _note(self, result: Any, node: torch.fx.Node) -> None:
        if not isinstance(result, torch.Tensor):
            return
        node.meta["val"] = torch.empty(result.shape, dtype=result.dtype, device="meta")
        if self._noted(result) is None:  # else it was changed in place
            result._node = node  # type: ignore[attr-defined]

    def check_known(self, args: Any, by: str) -> None:
        """Raises ``NumberTakenError`` if a number of a tensor is read that may be another one in the next run."""
        for arg in args:
            if not isinstance(arg, torch.Tensor) or self._noted(arg) in self._known or arg.data_ptr() in self._fixed:
                continue
            raise NumberTakenError(f"a hook reads a number out of a tensor ({by})")


class NumbersTaken(TorchFunctionMode):
    """Notices what no operator does."""

    TAKE = torch.Tensor.numpy, torch.Tensor.tolist, torch.Tensor.__array__

    def __init__(self, tracer: Tracer) -> None:
        super().__init__()
        self._tracer = tracer

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in self.TAKE:
            self._tracer.check_known(args[:1], "numpy, tolist")
        elif func is torch.tensor and args and isinstance(args[0], list | tuple):
            self._tracer.check_known(tree_leaves(args[0]), "torch.tensor")
        return func(*args, **(kwargs or {}))


def trace(
    work: Callable[[dict[str, torch.Tensor]], Any],
    arrays: dict[str, torch.Tensor],
    fixed: Iterable[torch.Tensor] = (),
    stop: str | None = None,
) -> torch.fx.GraphModule:
    """Returns what a function, called once, does to arrays in place, and what it returns of them.

    It is a module that takes them one after another. What it does must not depend on a number of an array, or of a
    tensor that is not among ``fixed``. ``stop`` names the node of an operator at which to raise ``ReachedError``.
    """
    tracer = Tracer(arrays, fixed, stop)
    with NumbersTaken(tracer), tracer:
        results = work(arrays)
    tracer.graph.output(torch.fx.node.map_aggregate(results, tracer.argument))
    tracer.graph.eliminate_dead_code()
    with _use_lazy_graph_module(True):  # its Python is written when it is called, which it seldom is
        return _make_graph_module(tracer.constants, tracer.graph)
