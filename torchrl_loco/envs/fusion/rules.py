"""What each operator of torch does to the numbers of a world: rules as data, an operator a line of :data:`RULES`."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from torchrl_loco.envs.fusion.nodes import ADD, LEAST, MOST, MUL, NEG, SHL, SUB, TYPES, WHERE, CannotFuse
from torchrl_loco.envs.fusion.program import FILLERS, LONG, Program, Value, _shifted, offsets_of, shape_of

aten = torch.ops.aten

DIV, AND, OR, EQUAL = "{0} / {1}", "{0} & {1}", "{0} | {1}", "{0} == {1}"
BEATS = {"max": "{0} > {1} || ({0} != {0} && {1} == {1})", "min": "{0} < {1} || ({0} != {0} && {1} == {1})"}
REMAINDER = "{0} != 0 && ({0} < 0) != ({1} < 0) ? {0} + {1} : {0}"

LOG1P = (  # Warp's compiler for the CPU has neither this nor the next
    "1.0f + {0} == 1.0f ? {0} : 1.0f + {0} == {0} ? logf({0}) : logf(1.0f + {0}) * ({0} / ((1.0f + {0}) - 1.0f))"
)
EXPM1 = "fabsf({0}) > 0.5f ? expf({0}) - 1.0f : expf({0}) == 1.0f ? {0} : (expf({0}) - 1.0f) * ({0} / logf(expf({0})))"
FUNCTIONS = "exp exp2 log log2 log10 sqrt sin cos tan asin acos atan sinh cosh tanh erf"
POINTWISE: dict[str, str | tuple[str, str]] = {
    **{name: f"{name}f({{0}})" for name in FUNCTIONS.split()},
    **{name: (f"{name}f({{0}})", "{0}") for name in ("floor", "ceil", "trunc")},
    **{"atan2": "atan2f({0}, {1})", "log1p": LOG1P, "expm1": EXPM1},
    **{"rsqrt": "1.0f / sqrtf({0})", "reciprocal": "1.0f / {0}"},
    **{"sigmoid": "1.0f / (1.0f + expf(-{0}))", "relu": "{0} < 0 ? 0 : {0}", "neg": NEG, "mul": MUL},
    **{"abs": ("fabsf({0})", "{0} < 0 ? -{0} : {0}"), "square": "{0} * {0}"},
    **{"copysign": "wp::copysign({0}, {1})", "fmax": "{0} >= {1} || {1} != {1} ? {0} : {1}"},
    **{"fmin": "{0} <= {1} || {1} != {1} ? {0} : {1}"},
    **{"sign": "{0} > 0 ? 1 : {0} < 0 ? -1 : 0", "minimum": LEAST, "maximum": MOST},
    **{"clamp_min": MOST, "clamp_max": LEAST, "fmod": ("fmodf({0}, {1})", "{1} == 0 ? 0 : {0} % {1}")},
    **{"bitwise_and": AND, "bitwise_or": OR, "bitwise_xor": "{0} ^ {1}", "bitwise_not": "~{0}"},
    **{"bitwise_left_shift": SHL, "__and__": AND, "__or__": OR, "__xor__": "{0} ^ {1}", "__lshift__": SHL},
}
"""Operators whose operands are of the type of the result: C++ for floats, and for integers if that differs."""

TESTS = {
    **{"lt": "{0} < {1}", "le": "{0} <= {1}", "gt": "{0} > {1}", "ge": "{0} >= {1}", "eq": EQUAL, "ne": "{0} != {1}"},
    **{"logical_and": "{0} && {1}", "logical_or": "{0} || {1}", "logical_xor": "!{0} != !{1}", "logical_not": "!{0}"},
    **{"isnan": "{0} != {0}", "isfinite": "{0} - {0} == 0", "isinf": "{0} == {0} && {0} - {0} != 0"},
    **{"signbit": "wp::copysign(1.0f, 1.0f * {0}) < 0"},
}
"""Operators that are bool, on operands of a common type."""

VIEWS = ("expand", "permute", "unsqueeze", "squeeze", "slice", "select", "split_with_sizes", "diagonal", "unfold")
"""Operators that look at a tensor in another way."""
FAR = 2**32  # how many numbers, for torch, a world begins behind the one before: more than any tensor has of one

FOLDS = {"sum": ADD, "prod": MUL, "amax": MOST, "amin": LEAST, "all": AND, "any": OR}  # reductions, from left to right


# Rules: an operator's result, of the program and the operator's arguments.


def _pointwise(text: str | tuple[str, str], p: Program, *args: Any) -> Value:
    dtype = p._meta.dtype
    text = text if isinstance(text, str) else text[dtype != torch.float32]
    return p.apply("!{0}" if dtype == torch.bool and text == "~{0}" else text, dtype, *args)


def _common(*operands: Any) -> torch.dtype:
    like = [torch.empty([1] * x.array.ndim, dtype=x.dtype) if isinstance(x, Value) else x for x in operands]
    return torch.result_type(*like) if len(like) == 2 else like[0].dtype


def _test(text: str, p: Program, *args: Any) -> Value:
    return p.apply(text, torch.bool, *args, of=_common(*args))


def _add(text: str, p: Program, a: Any, b: Any, alpha: Any = 1) -> Value:
    dtype = p._meta.dtype
    return p.apply(text, dtype, a, b if alpha == 1 else p.apply(MUL, dtype, b, alpha))


def _right_shift(p: Program, a: Any, b: Any) -> Value:
    most = torch.iinfo(p._meta.dtype).bits - 1
    by = "{1}" if isinstance(b, int) and 0 <= b <= most else f"({{1}} < 0 || {{1}} > {most} ? {most} : {{1}})"
    return p.apply(f"{{0}} >> {by}", p._meta.dtype, a, b)  # beyond the width C++ says nothing


def _remainder(p: Program, a: Any, b: Any) -> Value:
    return p.apply(REMAINDER, p._meta.dtype, _pointwise(POINTWISE["fmod"], p, a, b), b)


def _div(p: Program, a: Any, b: Any, rounding_mode: str | None = None) -> Value:
    dtype = p._meta.dtype
    if rounding_mode is None:
        return p.apply(DIV, dtype, a, b)
    if dtype != torch.float32:
        below = "" if rounding_mode == "trunc" else " - ({0} % {1} != 0 && ({0} < 0) != ({1} < 0))"
        return p.apply(f"{{1}} == 0 ? 0 : {{0}} / {{1}}{below}", dtype, a, b)
    if rounding_mode == "trunc":
        return p.apply("truncf({0} / {1})", dtype, a, b)
    rest = _pointwise(POINTWISE["fmod"], p, a, b)  # with the sign of a: torch goes down by one where it is not b's
    below = "(({0} - {2}) / {1} - ({2} != 0 && ({1} < 0) != ({2} < 0) ? 1.0f : 0.0f))"
    return p.apply(f"{{1}} == 0 ? {{0}} / {{1}} : rintf({below})", dtype, a, b, rest)


def _pow(p: Program, base: Any, exponent: Any) -> Value:
    dtype = p._meta.dtype
    if isinstance(exponent, int | float) and float(exponent).is_integer() and 0 < abs(exponent) <= 16:
        powers, count = [p.cast(base, dtype)], int(abs(exponent))
        while 2 ** len(powers) <= count:
            powers.append(p.apply(MUL, dtype, powers[-1], powers[-1]))
        product = functools.reduce(
            lambda a, b: p.apply(MUL, dtype, a, b), [power for i, power in enumerate(powers) if count >> i & 1]
        )
        return product if exponent > 0 else p.apply("1.0f / {0}", dtype, product)
    if dtype != torch.float32:
        raise CannotFuse("{op} takes integers to a power")
    if isinstance(exponent, float) and abs(exponent) == 0.5:  # powf has other zeros and infinities
        return p.apply("sqrtf({0})" if exponent > 0 else "1.0f / sqrtf({0})", dtype, base)
    return p.apply("powf({0}, {1})", dtype, base, exponent)


def _round(p: Program, x: Value, decimals: int = 0) -> Value:
    if decimals:
        raise CannotFuse("{op} rounds to decimals")
    return p.apply("rintf({0})", p._meta.dtype, x) if x.dtype == torch.float32 else x


def _clamp(p: Program, x: Value, min: Any = None, max: Any = None) -> Value:
    x = x if min is None else p.apply(MOST, p._meta.dtype, x, min)
    return x if max is None else p.apply(LEAST, p._meta.dtype, x, max)


def _hypot(p: Program, a: Any, b: Any) -> Value:
    kind = p._meta.dtype
    a, b = (p.apply("fabsf({0})", kind, x) for x in (a, b))
    far, near = p.apply(MOST, kind, a, b), p.apply(LEAST, kind, a, b)
    ratio = p.apply(DIV, kind, near, far)
    return p.apply("{0} == 0 || {0} - {0} != 0 ? {0} : {0} * sqrtf(1.0f + {1} * {1})", kind, far, ratio)


def _filler(number: Any, p: Program, *args: Any, **kwargs: Any) -> Value:
    """Returns a new tensor: one with a row for each world is one of worlds."""
    like, dtype, shape = args[0] if args else None, p._meta.dtype, list(p._meta.shape)
    number = (kwargs.get("fill_value", args[-1]) if args else kwargs["fill_value"]) if number is None else number
    if dtype not in TYPES or not isinstance(number, bool | int | float):
        raise CannotFuse(f"{{op}} makes a tensor of {dtype}")
    same = isinstance(like, Value) and list(like.array.shape) == [
        size // p._n if dim == like.world else size for dim, size in enumerate(shape)
    ]
    world = like.world if same and isinstance(like, Value) else 0 if shape and shape[0] == p._n else None
    if world is not None:
        shape[world] //= p._n
    return Value(np.full(shape, p.constant(number, dtype), dtype=object), dtype, world)


def _filled(p: Program, x: Value, new: Any, *args: Any) -> Value:
    (x, value), world = p.aligned(x, p.cast(new, x.dtype))
    return value.with_array(np.broadcast_to(value.array, x.array.shape).copy(), world)


def _copy(p: Program, x: Any, *args: Any, **kwargs: Any) -> Value:
    x = p.cast(x, p._meta.dtype)
    return x.with_array(x.array.copy(order="K"), x.world)


def _view(p: Program, x: Any, *args: Any, **kwargs: Any) -> Value:
    shape = list(p._meta.shape)
    world = x.world
    if world is not None:
        before = math.prod(x.array.shape[:world])
        fits = [i for i, size in enumerate(shape) if math.prod(shape[:i]) == before and size % p._n == 0]
        if not fits:
            raise CannotFuse(f"{{op}} makes shape {tuple(shape)}, which mixes worlds")
        world = fits[0]
        shape[world] //= p._n
    array = x.array.reshape(shape)
    if not np.shares_memory(array, x.array):
        array.flags.writeable = False  # torch's is a view
    return x.with_array(array, world)


def _seen(op: Any, p: Program, x: Value, *args: Any, **kwargs: Any) -> Any:
    """Returns the view, or views, that an operator of torch makes of a value: strides tell what has gone where."""
    array, step = x.array, x.array.itemsize
    shape, steps = list(array.shape), [stride // step for stride in array.strides]
    if x.world is not None:
        shape[x.world], steps[x.world] = p._n * shape[x.world], FAR
    seen = op(torch.empty_strided(shape, steps, dtype=torch.bool, device="meta"), *args, **kwargs)
    return [_view_of(p, x, each) for each in seen] if isinstance(seen, tuple | list) else _view_of(p, x, seen)


def _view_of(p: Program, x: Value, seen: torch.Tensor) -> Value:
    shape, steps, size = list(seen.shape), list(seen.stride()), x.array.itemsize
    start = int(seen.storage_offset()) % FAR
    worlds = [d for d, step in enumerate(steps) if step == FAR]
    world = worlds[-1] if worlds and shape[worlds[-1]] == p._n * x.array.shape[x.world] else None
    if world is not None:
        shape[world], steps[world] = x.array.shape[x.world], x.array.strides[x.world] // size
    elif x.world is not None and x.varies:
        raise CannotFuse("{op} goes across worlds")
    elif shape and shape[0] == p._n and steps[0] == 0:  # what all worlds are given
        world, shape[0] = 0, 1
    every = np.lib.stride_tricks.as_strided(x.array, (start + 1,), (size,))[start:]
    strides = [size * (step % FAR) for step in steps]  # none from world to world where all have the same
    return x.with_array(np.lib.stride_tricks.as_strided(every, shape, strides), world)


_slice, _select, _unsqueeze = (functools.partial(_seen, op) for op in (aten.slice, aten.select, aten.unsqueeze))


def _flip(p: Program, x: Value, dims: Sequence[int]) -> Value:
    return x.with_array(np.array(np.flip(x.array, tuple(x.rowwise(dims))), dtype=object), x.world)


def _cat(p: Program, tensors: Sequence[Any], dim: int = 0) -> Any:
    parts = [x for x in map(p.value, tensors) if x.array.size or x.array.ndim != 1]
    values, world = p.aligned(*parts)
    whole = Value(values[0].array, p._meta.dtype, world)
    (dim,) = whole.rowwise([dim])
    return Value(np.concatenate([p.cast(x, whole.dtype).array for x in values], axis=dim), whole.dtype, world)


def _pad(p: Program, x: Value, pad: Sequence[int], value: Any = 0) -> Value:
    widths = [(0, 0)] * (x.array.ndim - len(pad) // 2) + [(pad[i], pad[i + 1]) for i in range(0, len(pad), 2)][::-1]
    x.rowwise(dim for dim, width in enumerate(widths) if width != (0, 0))
    if min(pad) < 0:
        raise CannotFuse("{op} cuts")
    fill_with: Any = p.constant(value, x.dtype)
    return x.with_array(np.pad(x.array, widths, constant_values=fill_with), x.world)


def _stack(p: Program, tensors: Sequence[Any], dim: int = 0) -> Any:
    values, world = p.aligned(*tensors)
    return _cat(p, [_unsqueeze(p, x.with_array(x.array, world), dim) for x in values], dim)


def _out_of_range(dtype: torch.dtype) -> Any:
    """Returns what an index beyond the end gives: what shows, of integers also where it is an index itself."""
    known = {torch.float32: math.nan, torch.bool: False}
    return known[dtype] if dtype in known else torch.iinfo(dtype).min


def _pick(p: Program, columns: Sequence[Any], index: Value) -> Value:
    """Returns of several values that of an index, which may be counted from the end."""
    if len(columns) > LONG:
        raise CannotFuse(f"{{op}} chooses among {len(columns)} numbers")
    index, found = p.cast(index, torch.int64), p.value(_out_of_range(p.value(columns[0]).dtype))
    for i, column in enumerate(columns):
        chosen = p.apply(f"{{0}} == {i} || {{0}} == {i - len(columns)}", torch.bool, index, of=torch.int64)
        found = p.where(chosen, column, found)
    return found


def _gather(p: Program, x: Any, dim: int, index: Any, sparse_grad: bool = False) -> Value:
    (x, index), world = p.aligned(x, index)
    (dim,) = Value(x.array, x.dtype, world).rowwise([dim])
    cut = tuple(slice(None) if d == dim else slice(size) for d, size in enumerate(index.array.shape))
    columns = [_slice(p, x.with_array(x.array[cut], world), dim, i, i + 1) for i in range(x.array.shape[dim])]
    return _pick(p, columns, index)


def _looked_up(p: Program, x: Any, indices: Sequence[Any]) -> Value:
    """Returns what each world looks up in a table: NaN (of integers the least) where an index is beyond its end."""
    dims = [dim for dim, index in enumerate(indices) if index is not None]
    shape = shape_of(x)
    values, world = p.aligned(*(p.cast(indices[dim], torch.int64) for dim in dims))
    table, first, steps, dtype = p.table(x)
    address, inside = p.value(0), p.value(True)
    for dim, index in zip(dims, values, strict=True):
        index = p.apply(f"{{0}} < 0 ? {{0}} + {shape[dim]} : {{0}}", torch.int64, index)
        inside = p.apply(f"{{0}} && {{1}} >= 0 && {{1}} < {shape[dim]}", torch.bool, inside, index, of=torch.int64)
        address = p.apply(ADD, torch.int64, address, p.apply(MUL, torch.int64, index, steps[dim]))
    rest = [dim for dim in range(len(shape)) if dim not in dims]
    offsets = offsets_of([shape[dim] for dim in rest], [steps[dim] for dim in rest])
    nothing = p.constant(_out_of_range(dtype), dtype)
    made = np.empty((*address.array.shape, *offsets.shape), dtype=object)
    for at in np.ndindex(*address.array.shape):
        for of in np.ndindex(*offsets.shape):
            text = f"{{0}} ? p{table}_0[{first + int(offsets[of])} + {{1}}] : {{2}}"
            made[(*at, *of)] = p.node(text, dtype, inside.array[at], address.array[at], nothing, place=(table, None, 0))
    start, count = dims[0] if dims == list(range(dims[0], dims[-1] + 1)) else 0, address.array.ndim
    return Value(np.moveaxis(made, range(count), range(start, start + count)), dtype, _shifted(world, start))


def _index(p: Program, x: Any, indices: Sequence[Any]) -> Value:
    some = [index for index in indices if index is not None]
    has_worlds = isinstance(x, Value) and x.world is not None
    if not has_worlds and all(not isinstance(index, Value) or index.dtype != torch.bool for index in some):
        if any(isinstance(index, Value) and any(node.number is None for node in index.array.flat) for index in some):
            return _looked_up(p, x, indices)
    x = p.value(x)
    if x.world == 0 and indices[0] is not None and len(some) == len(indices) == 2:  # x[arange(n), i]
        if np.array_equal(p.numbers(indices[0]), np.arange(p._n)):
            index = p.value(indices[1])
            if index.world == 0 and index.array.ndim == 1 and x.array.ndim > 1:
                index = index.with_array(index.array.reshape(-1, *[1] * (x.array.ndim - 2)), 0)
                return _pick(p, [_select(p, x, 1, i) for i in range(x.array.shape[1])], index)
    at: list[Any] = [slice(None) if index is None else p.numbers(index) for index in indices]
    x.rowwise(dim for dim, index in enumerate(indices) if index is not None)
    world = x.world
    if world is not None:  # goes where those of a mark go
        mark = np.repeat(np.zeros(x.array.shape, dtype=int), 2, axis=world)
        np.moveaxis(mark, world, 0)[len(mark) // 2 if world == 0 else mark.shape[world] // 2 :] = 1
        moved = mark[tuple(at)]
        world = next(d for d in range(moved.ndim) if np.diff(moved, axis=d).any())
    return x.with_array(x.array[tuple(at)], world)


def _index_put(p: Program, x: Any, indices: Sequence[Any], values: Any, accumulate: bool = False) -> Value:
    mask, new = indices[0], p.value(values)
    if (
        len(indices) != 1
        or accumulate
        or not isinstance(mask, Value)
        or mask.dtype != torch.bool
        or new.world is not None
    ):
        raise CannotFuse("{op} writes to other places than those of a mask of worlds")
    if new.array.ndim > x.array.ndim - mask.array.ndim:
        new = new.with_array(new.array[0] if new.array.shape[0] == 1 else np.empty((0, 0)), None)
    shape = mask.array.shape + (1,) * (x.array.ndim - mask.array.ndim)
    return p.where(mask.with_array(mask.array.reshape(shape), mask.world), new, x, x.dtype)


def _dims(x: Value, dim: Any) -> list[int]:
    dims = range(x.array.ndim) if dim is None or dim == [] else [dim] if isinstance(dim, int) else dim
    return sorted(x.rowwise(dims))


def _reduced(p: Program, x: Any, dim: Any, keepdim: bool, reduce: Callable[[Any], Any], dtype: torch.dtype) -> Value:
    """Returns what ``reduce`` makes of the sequence of the numbers along dimensions."""
    x = p.value(x)
    dims = _dims(x, dim)
    rows = np.moveaxis(x.array, dims, range(len(dims)))
    rest = rows.shape[len(dims) :]
    array = np.asarray(reduce(rows.reshape(-1, *rest)), dtype=object).reshape(rest)
    if keepdim:
        return Value(np.expand_dims(array, dims), dtype, x.world)
    return Value(array, dtype, _shifted(x.world, -sum(x.world is not None and d < x.world for d in dims)))


def _fold(text: str, p: Program, x: Any, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Value:
    kind = p._meta.dtype
    empty = {ADD: 0, MUL: 1, AND: True, OR: False}

    def reduce(rows: Any) -> Any:
        if not len(rows) and text in empty:
            return np.full(rows.shape[1:], p.constant(empty[text], kind), dtype=object)
        return functools.reduce(lambda a, b: p.each(text, kind, a, b), rows)

    return _reduced(p, p.cast(x, kind), dim, keepdim, reduce, kind)


def _mean(p: Program, x: Value, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Value:
    count = math.prod(x.array.shape[d] for d in _dims(x, dim))
    return p.apply(DIV, p._meta.dtype, _fold(ADD, p, x, dim, keepdim), count)


def _var(
    p: Program, x: Value, dim: Any = None, unbiased: bool = True, keepdim: bool = False, *, correction: Any = None
) -> Value:
    kind, dims = p._meta.dtype, _dims(x, dim)
    off = p.apply(SUB, kind, x, _mean(p, x, dims, keepdim=True))
    count = math.prod(x.array.shape[d] for d in dims) - (int(unbiased) if correction is None else correction)
    return p.apply(DIV, kind, _fold(ADD, p, p.apply("{0} * {0}", kind, off), dims, keepdim), max(count, 0))


def _best(p: Program, name: str, x: Value, dim: int, keepdim: bool) -> tuple[Value, Value]:
    """Returns the largest or smallest numbers along a dimension, and where each is first."""

    def reduce(rows: Any) -> tuple[Any, Any]:
        best, place = rows[0], np.full(np.shape(rows[0]), p.constant(0, torch.int64), dtype=object)
        for i, row in enumerate(rows[1:], 1):
            beats = p.each(BEATS[name], torch.bool, row, best)
            best = p.each(WHERE, x.dtype, beats, row, best)
            place = p.each(WHERE, torch.int64, beats, p.constant(i, torch.int64), place)
        return best, place

    values = _reduced(p, x, dim, keepdim, lambda rows: reduce(rows)[0], x.dtype)
    return values, _reduced(p, x, dim, keepdim, lambda rows: reduce(rows)[1], torch.int64)


def _extreme(name: str, p: Program, x: Value, dim: Any = None, keepdim: bool = False) -> Any:
    text = MOST if name == "max" else LEAST
    if isinstance(dim, Value | torch.Tensor):
        return p.apply(text, p._meta.dtype, x, dim)
    return _fold(text, p, x) if dim is None else _best(p, name, x, dim, keepdim)


def _place(name: str, p: Program, x: Value, dim: int | None = None, keepdim: bool = False) -> Value:
    if dim is None:
        raise CannotFuse("{op} goes across worlds")
    return _best(p, name, x, dim, keepdim)[1]


def _cumsum(p: Program, x: Value, dim: int, dtype: Any = None) -> Value:
    rows = p.cast(x, p._meta.dtype).array.copy()
    for d in x.rowwise([dim]):
        columns = np.moveaxis(rows, d, 0)
        for i in range(1, len(columns)):
            columns[i, ...] = p.each(ADD, p._meta.dtype, columns[i - 1], columns[i])  # else a number becomes an array
    return Value(rows, p._meta.dtype, x.world)


def _matmul(p: Program, a: Any, b: Any) -> Value:
    a, b = p.value(a), p.value(b)
    product = p.apply(MUL, p._meta.dtype, _unsqueeze(p, a, -1), _unsqueeze(p, b, -3))
    return _fold(ADD, p, product, -2)


RULES: dict[str, Callable[..., Any]] = {
    **{name: functools.partial(_pointwise, text) for name, text in POINTWISE.items()},
    **{name: functools.partial(_test, text) for name, text in TESTS.items()},
    **{name: functools.partial(_fold, text) for name, text in FOLDS.items()},
    **{name: functools.partial(_filler, None if name.startswith("full") else 0) for name in FILLERS},
    **{"add": functools.partial(_add, ADD), "sub": functools.partial(_add, SUB), "remainder": _remainder, "div": _div},
    **{"bitwise_right_shift": _right_shift, "__rshift__": _right_shift},
    **{"pow": _pow, "round": _round, "clamp": _clamp, "where": lambda p, *of: p.where(*of), "copy": _filled},
    **{"hypot": _hypot, "var": _var, "mean": _mean, "cumsum": _cumsum, "mm": _matmul, "bmm": _matmul},
    **{name: functools.partial(_extreme, name) for name in BEATS},
    **{f"arg{name}": functools.partial(_place, name) for name in BEATS},
    **dict.fromkeys(("_to_copy", "clone", "lift_fresh_copy", "copy_strided"), _copy),
    **{name: lambda p, x: x for name in ("alias", "detach", "detach_", "lift_fresh")},
    **dict.fromkeys(("view", "_unsafe_view"), _view),
    **{name: functools.partial(_seen, getattr(aten, name)) for name in VIEWS},
    **{"flip": _flip, "cat": _cat, "stack": _stack, "constant_pad_nd": _pad},
    **{"index": _index, "index_put": _index_put, "gather": _gather},
}
"""Operators by name, without overload; what is missing is decomposed as torch does it for its compilers."""
