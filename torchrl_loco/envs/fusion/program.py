"""A traced graph as straight-line C++ of one world: numbers as nodes, tensors as arrays of them."""

import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchrl_loco.envs.fusion.nodes import MOST_NUMBERS, OF_INTEGERS, TYPES, WHERE, WRAPPING, CannotFuse, Node
from torchrl_loco.envs.fusion.source import Source
from torchrl_loco.sim.compiled.ir.symbols import literal

LONG = 64
"""Rows of a user's tensor that are taken for those of the worlds, if there are as many worlds; fewer may be chance."""

GLOBAL = ("seed", "shared.")  # how the names of arrays begin that are the same in all worlds
INFINITE = "(1e30f * 1e30f)"
FILLERS = ("empty", "empty_like", "empty_strided", "full", "full_like")
"""Operators that make tensors, which may have a row for each world."""


@dataclass
class Value:
    """A tensor of nodes."""

    array: Any  # of the tensor's shape, but that the dimension of the worlds counts what each of them has there
    dtype: torch.dtype
    world: int | None  # dimension of the worlds, if there is one

    def rowwise(self, dims: Iterable[int]) -> list[int]:
        """Returns dimensions as numbers from 0, none of which may be that of the worlds."""
        ndim = self.array.ndim
        found = [dim % ndim for dim in dims] if ndim else []  # a number has none, though torch lets one name 0
        if self.world in found:
            raise CannotFuse("{op} goes across worlds")
        return found

    @property
    def varies(self) -> bool:
        """Whether a number may differ from world to world."""
        return any(node.varies for node in self.array.flat)

    def with_array(self, array: np.ndarray, world: int | None) -> "Value":
        """Returns a value of the same type."""
        return Value(array, self.dtype, world)


def _shifted(world: int | None, by: int) -> int | None:
    return None if world is None else world + by


@dataclass
class Huge:
    """A tensor without worlds that is too long to be written number by number."""

    tensor: torch.Tensor


def shape_of(x: Value | Huge | torch.Tensor) -> tuple[int, ...]:
    """Returns the shape of an operand: of a value, that of its nodes."""
    return tuple((x.array if isinstance(x, Value) else x.tensor if isinstance(x, Huge) else x).shape)


def offsets_of(shape: Sequence[int], steps: Sequence[int]) -> np.ndarray:
    """Returns how many elements behind the first each element of a tensor is in memory."""
    return np.tensordot(np.array(steps, dtype=int), np.indices(shape), 1)


class Program:
    """A traced graph as C++.

    It is called with ``arrays``, and reads and writes ``tensors``. A rule, by operator's name without overload, is a
    function of the program and the operator's arguments. Tensors that are ``fixed`` are constants, and can be indices
    and tables. From ``long`` rows on a user's tensor is taken for one of the worlds, if there are as many.
    """

    def __init__(
        self,
        arrays: dict[str, torch.Tensor],
        num_envs: int,
        device: torch.device,
        rules: dict[str, Callable[..., Any]],
        fixed: Iterable[torch.Tensor] = (),
        long: float = LONG,
    ) -> None:
        self._long = long
        self._fixed = {tensor.data_ptr() for tensor in fixed}
        self._copied: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}  # constants by the storage of their copies
        self._tables: dict[Any, int] = {}
        self._kept: list[torch.Tensor] = []  # no other constant gets its address meanwhile
        self._arrays, self._n, self._device, self._rules = arrays, num_envs, device, rules
        self.tensors: list[torch.Tensor] = []
        self._nodes: dict[Any, Node] = {}
        self._sources: dict[Any, tuple[int, Value, Any]] = {}
        self._meta: Any = None  # what torch says about the result of the present operator

    # Nodes and values.

    def node(self, text: str, dtype: torch.dtype, *args: Node, number: Any = None, place: Any = None) -> Node:
        """Returns a number, a new one if there is none like it."""
        if text == WHERE and args[1] is args[2]:
            return args[1]
        if text in OF_INTEGERS and dtype != torch.float32:
            text = OF_INTEGERS[text]
        if text in WRAPPING and dtype in (torch.int32, torch.int64):
            text = text.replace("{", f"(unsigned {TYPES[dtype]}){{")
        key = text, dtype, place, *map(id, args)
        if key not in self._nodes:
            if len(self._nodes) > 10 * MOST_NUMBERS:
                raise CannotFuse("it has too many numbers")
            self._nodes[key] = Node(text, dtype, args, number, place)
        return self._nodes[key]

    def constant(self, number: Any, dtype: torch.dtype) -> Node:
        """Returns a constant."""
        if dtype == torch.float32:
            with np.errstate(over="ignore"):
                number = float(np.float32(number))
            text = literal(number) if math.isfinite(number) else INFINITE if number > 0 else f"(-{INFINITE})"
            text = f"({INFINITE} - {INFINITE})" if number != number else f"({text})"
            return self.node(text, dtype, number=number)
        if dtype == torch.bool:
            return self.node(str(bool(number)).lower(), dtype, number=bool(number))
        text = f"(-{2**63 - 1}LL - 1)" if number == -(2**63) else f"({int(number)}LL)"
        return self.node(text, dtype, number=int(number))

    def each(self, text: str, dtype: torch.dtype, *arrays: Any) -> np.ndarray:
        """Returns the array of an operator's results, of arrays that broadcast."""
        made = np.frompyfunc(lambda *nodes: self.node(text, dtype, *nodes), len(arrays), 1)(*arrays)
        return np.asarray(made, dtype=object)

    def value(self, x: Any) -> Value:
        """Returns an operand as a value: a number or a constant tensor, or what already is one."""
        if isinstance(x, Value):
            return x
        if isinstance(x, bool | int | float):
            dtype = {bool: torch.bool, int: torch.int64, float: torch.float32}[type(x)]
            return Value(np.asarray(self.constant(x, dtype), dtype=object), dtype, None)
        if not isinstance(x, torch.Tensor) or x.dtype not in TYPES or x.numel() > MOST_NUMBERS:
            what = f"a large tensor of {x.dtype}" if isinstance(x, torch.Tensor) else repr(x)
            raise CannotFuse(f"{{op}} takes {what}")
        array: Any = np.empty(x.shape, dtype=object)
        numbers = x.flatten().tolist()
        keys = list(zip(numbers, np.signbit(numbers).tolist(), strict=True))  # 0.0 == -0.0
        made = {key: self.constant(key[0], x.dtype) for key in dict.fromkeys(keys)}  # tables repeat a few numbers
        array.flat = [made[key] for key in keys]
        return Value(array, x.dtype, None)

    def cast(self, x: Any, dtype: torch.dtype) -> Value:
        """Returns an operand as a value of a type."""
        x = self.value(x)

        def convert(node: Node) -> Node:
            if node.number is not None and math.isfinite(node.number):
                return self.constant(torch.tensor(node.number, dtype=node.dtype).to(dtype).item(), dtype)
            return self.node("{0} != 0" if dtype == torch.bool else f"({TYPES[dtype]}){{0}}", dtype, node)

        if x.dtype == dtype:
            return x
        if dtype not in TYPES:
            raise CannotFuse(f"{{op}} is of {dtype}")
        with np.errstate(invalid="ignore"):  # which NumPy would say of a constant that torch converts meanwhile
            return Value(np.asarray(np.frompyfunc(convert, 1, 1)(x.array), dtype=object), dtype, x.world)

    def source(self, tensor: torch.Tensor, world: int | None) -> Value:
        """Returns a tensor that is read from memory, and whose changes are written there."""
        key = tensor.data_ptr(), tuple(tensor.shape), tensor.stride(), tensor.dtype
        if key not in self._sources:
            if tensor.dtype not in TYPES or tensor.numel() > (MOST_NUMBERS * (1 if world is None else self._n)):
                raise CannotFuse(f"it reads a tensor of shape {tuple(tensor.shape)} and {tensor.dtype}")
            shape, index = list(tensor.shape), len(self.tensors)
            by_world = 0
            if world is not None:
                shape[world], by_world = 1, tensor.stride(world)
            offsets = offsets_of(shape, tensor.stride()).ravel().tolist()
            array: Any = np.empty(shape, dtype=object)
            array.flat = [self.read(index, offset, by_world, tensor.dtype) for offset in offsets]
            self.tensors.append(tensor)
            self._sources[key] = index, Value(array, tensor.dtype, world), array.copy()
        return self._sources[key][1]

    def read(self, index: int, offset: int, by_world: int, dtype: torch.dtype) -> Node:
        """Returns a number in memory."""
        return self.node(f"p{index}_{by_world}[{offset}]", dtype, place=(index, offset, by_world))

    def aligned(self, *operands: Any) -> tuple[list[Value], int | None]:
        """Returns operands with the same number of dimensions, and where the worlds are."""
        values = [self.value(x) for x in operands]
        ndim = max(x.array.ndim for x in values)
        places = [None if x.world is None else x.world + ndim - x.array.ndim for x in values]
        varying = {place for x, place in zip(values, places, strict=True) if place is not None and x.varies}
        if len(varying) > 1:
            raise CannotFuse("{op} mixes worlds")
        world = min(varying) if varying else min((place for place in places if place is not None), default=None)
        result = []
        for x, place in zip(values, places, strict=True):
            array = x.array
            if place is not None and place != world:  # the same in all worlds, so it can be read as any other tensor
                array = np.repeat(array, self._n, axis=x.world)
            array = array.reshape((1,) * (ndim - array.ndim) + array.shape)
            if world is not None and place != world and array.shape[world] > 1:
                array = self._by_world(array, world)
            result.append(x.with_array(array, world))
        return result, world

    def _by_world(self, array: np.ndarray, world: int) -> np.ndarray:
        """Returns what each world takes of a tensor that has a row for each."""
        rows = np.moveaxis(array, world, 0)
        made = np.empty(rows.shape[1:], dtype=object)
        for at in np.ndindex(*made.shape):
            column = [rows[(i, *at)] for i in range(len(rows))]
            if all(node is column[0] for node in column):
                made[at] = column[0]
                continue
            reads = [node.place for node in column]
            if len(rows) != self._n or None in reads or len({(place[0], place[2]) for place in reads}) > 1:
                raise CannotFuse(f"{{op}} takes a tensor of {len(rows)} rows for those of the worlds")
            steps = {b[1] - a[1] for a, b in itertools.pairwise(reads)}
            if len(steps) > 1 or reads[0][2]:
                raise CannotFuse("{op} takes a tensor whose rows are not those of the worlds")
            made[at] = self.read(reads[0][0], reads[0][1], steps.pop(), column[0].dtype)
        return np.expand_dims(made, world)

    def apply(self, text: str, dtype: torch.dtype, *operands: Any, of: Any = None) -> Value:
        """Returns an operator's result of type ``dtype`` on operands of type ``of``, or types, by default the same."""
        values, world = self.aligned(*operands)
        types = of if isinstance(of, tuple) else [of or dtype] * len(values)
        arrays = [self.cast(x, to).array for x, to in zip(values, types, strict=True)]
        return Value(self.each(text, dtype, *arrays), dtype, world)

    def where(self, mask: Any, a: Any, b: Any, dtype: torch.dtype | None = None) -> Value:
        """Returns ``a`` where ``mask`` is set, else ``b``."""
        dtype = dtype or self._meta.dtype
        return self.apply(WHERE, dtype, mask, a, b, of=(torch.bool, dtype, dtype))

    def numbers(self, x: Any) -> np.ndarray:
        """Returns constants as numbers: for indices."""
        if isinstance(x, torch.Tensor):
            return x.numpy()
        values = np.empty(x.array.shape, dtype=bool if x.dtype == torch.bool else int)
        for at in np.ndindex(*values.shape):
            if (number := x.array[at].number) is None:
                why = "depend on the state" if x.array[at].varies else "in a tensor that may change"
                raise CannotFuse(f"{{op}} has indices that {why}: index with numbers, by names, or with constants")
            values[at] = number
        return values

    def table(self, x: Any) -> tuple[int, int, list[int], torch.dtype]:
        """Returns where a tensor without worlds is in memory: its index, first element and steps, and its type."""
        if isinstance(x, torch.Tensor | Huge):
            tensor = x.tensor if isinstance(x, Huge) else x
            return self._index_of(tensor), 0, list(tensor.stride()), tensor.dtype
        first = x.array.flat[0].place if x.array.size else None
        places = [node.place for node in x.array.flat]
        if x.world is not None or first is None or any(p is None or p[0] != first[0] or p[2] for p in places):
            raise CannotFuse("{op} looks up what is computed")
        offsets = np.array([place[1] for place in places]).reshape(x.array.shape)
        steps = [
            int(np.take(offsets, 1, d).flat[0]) - first[1] if size > 1 else 0 for d, size in enumerate(offsets.shape)
        ]
        if not np.array_equal(offsets, first[1] + offsets_of(offsets.shape, steps)):
            raise CannotFuse("{op} looks up parts of several tables")
        return first[0], first[1], steps, x.dtype

    def _index_of(self, x: torch.Tensor) -> int:
        """Returns the index of a constant among the tensors: of what is on the device already, or of a copy there."""
        key = x.data_ptr(), tuple(x.shape), x.stride(), x.dtype
        if key not in self._tables:
            if x.dtype not in TYPES:
                raise CannotFuse(f"{{op}} looks up a table of {x.dtype}")
            copy, original = self._copied.get(x.untyped_storage().data_ptr(), (None, None))
            if copy is None or original is None or x.dtype != original.dtype:
                original = x.to(self._device)
            else:
                offset = original.storage_offset() + x.storage_offset() - copy.storage_offset()
                original = original.as_strided(x.shape, x.stride(), offset)
            self._tables[key] = len(self.tensors)
            self.tensors.append(original)
            self._kept.append(x)
        return self._tables[key]

    # The graph.

    def run(self, graph: torch.fx.Graph, constants: Callable[[str], torch.Tensor]) -> Source:
        """Returns the C++ of a graph."""
        inputs, found = iter(self._arrays.items()), dict[torch.fx.Node, Any]()
        for node in graph.nodes:
            if node.op == "placeholder":
                name, tensor = next(inputs)
                if not node.users:  # most arrays in most parts
                    continue
                by_world = tensor.ndim > 0 and tensor.shape[0] == self._n and not name.startswith(GLOBAL)
                huge = not by_world and tensor.numel() > MOST_NUMBERS  # can be looked up alone
                found[node] = Huge(tensor) if huge else self.source(tensor, 0 if by_world else None)
            elif node.op == "get_attr":
                found[node] = self._constant(node, constants(node.target))
            elif node.op == "call_function":
                try:
                    found[node] = self._call(node, found)
                except CannotFuse as error:
                    raise CannotFuse(str(error).replace("{op}", str(node.target)), node.name) from None
                except Exception as error:  # operands that its rule did not foresee
                    raise CannotFuse(f"the rule of {node.target} fails: {error}", node.name) from error
        stores: list[tuple[Node, Node]] = []  # what has changed, and how it is computed
        for _, value, before in self._sources.values():
            for old, new in zip(before.flat, value.array.flat, strict=True):
                if new is not old:
                    if value.world is None:
                        raise CannotFuse("a tensor that has no worlds is changed")
                    stores.append((old, new))
        return Source(stores, self.tensors)

    def _constant(self, node: torch.fx.Node, tensor: torch.Tensor) -> Any:
        # Of torch.tensor(...) in a hook, or a copy that was made when it was traced.
        fresh = all(user.target is torch.ops.aten.lift_fresh_copy.default for user in node.users)
        if fresh or tensor.device != self._device:
            return tensor.detach().cpu()
        if tensor.data_ptr() in self._fixed and tensor.numel():
            copy = tensor.detach().cpu()
            self._copied[copy.untyped_storage().data_ptr()] = copy, tensor.detach()
            return copy
        long = self._n >= self._long and tensor.ndim > 0 and tensor.shape[0] == self._n
        return self.source(tensor, 0 if long else None)

    def _call(self, node: torch.fx.Node, found: dict[torch.fx.Node, Any]) -> Any:
        target: Any = node.target
        given: Any = torch.fx.node.map_arg((node.args, node.kwargs), lambda arg: found[arg])
        args, kwargs = given
        if target is operator.getitem:
            return args[0][args[1]]
        name, self._meta = target._schema.name.split("::")[-1], node.meta.get("val")  # of one in place, it ends with _
        if torch.Tag.nondeterministic_seeded in target.tags:
            raise CannotFuse("{op} draws numbers that are no function of the world: use s.uniform or s.normal")
        leaves = torch.utils._pytree.tree_leaves((args, kwargs))
        if not any(isinstance(leaf, Value | Huge) for leaf in leaves) and name not in FILLERS:
            # torch computes constants
            kwargs = {**kwargs, "device": "cpu"} if "device" in kwargs else kwargs
            return target(*args, **kwargs)
        if name in self._rules:
            result = self._rules[name](self, *args, **kwargs)
        elif name.endswith("_") and name[:-1] in self._rules and torch.Tag.inplace_view not in target.tags:
            self._assign(args[0], self._rules[name[:-1]](self, *args, **kwargs))
            result = args[0]
        else:
            raise CannotFuse("{op} has no rule")
        if isinstance(result, Value) and isinstance(self._meta, torch.Tensor):
            shape = list(result.array.shape)
            if result.world is not None:
                shape[result.world] *= self._n
            if tuple(shape) != tuple(self._meta.shape) or result.dtype != self._meta.dtype:
                raise CannotFuse(f"{{op}} gives shape {tuple(self._meta.shape)} of {self._meta.dtype}")
        return result

    def _assign(self, target: Any, result: Value) -> None:
        if not isinstance(target, Value) or not target.array.flags.writeable:
            raise CannotFuse("{op} writes to a constant, or to a copy")
        if target.world is None and result.varies:
            raise CannotFuse("{op} writes what differs from world to world to a tensor that has no worlds")
        (_, source), world = self.aligned(target, self.cast(result, target.dtype))
        if world != target.world:
            raise CannotFuse("{op} mixes worlds")
        target.array[...] = source.array
