"""What a task declares beside its hooks: entries of memory and of what worlds share, and tables of constants."""

from collections.abc import Callable, Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch

DTYPES = (torch.float32, torch.int32, torch.int64, torch.bool)
"""Types of entries and tables: those that kernels of hooks know."""
CHOICES = ", ".join(map(str, DTYPES))


class Entry(NamedTuple):
    """An entry of ``memory`` or ``shared``."""

    shape: tuple[int, ...]  # of a row of a world, or of what worlds share
    dtype: torch.dtype


def entries(cls: type, attribute: str, taken: Collection[str]) -> dict[str, Entry]:
    """Returns the entries of ``memory`` or ``shared`` that a class declares, by names that are not ``taken``."""
    declared: Any = getattr(cls, attribute)
    title = f"{cls.__name__}.{attribute}"
    if not isinstance(declared, Mapping):
        raise TypeError(f"{title} must be a dict of names and shapes, such as {{'command': 3}}")
    found = {}
    for name, value in declared.items():
        _check_name(title, name, taken)
        shape, dtype = value, torch.float32
        if attribute == "shared" and isinstance(value, torch.Tensor):
            shape, dtype = tuple(value.shape), value.dtype
        elif isinstance(value, torch.dtype):
            shape, dtype = (), value
        elif isinstance(value, tuple) and len(value) == 2 and isinstance(value[1], torch.dtype):
            shape, dtype = value
        if isinstance(value, torch.Tensor | np.ndarray) and not isinstance(shape, tuple):
            raise TypeError(f"{title}[{name!r}] must be a shape or a dtype, not an array: see constants")
        sizes = (shape,) if isinstance(shape, int) else shape
        if not isinstance(sizes, tuple | list) or not all(isinstance(n, int) for n in sizes):
            raise TypeError(
                f"{title}[{name!r}] must be a size or a tuple of sizes, a dtype, or both as (shape, dtype), "
                f"got {value!r}"
            )
        if any(n < 1 for n in sizes):
            raise ValueError(f"{title}[{name!r}] must have sizes of 1 or more, got {value!r}")
        if dtype not in DTYPES:
            raise ValueError(f"{title}[{name!r}] must be of {CHOICES}, got {dtype}")
        found[name] = Entry(tuple(sizes), dtype)
    return found


def constants(title: str, declared: Any, taken: Collection[str], device: torch.device) -> dict[str, torch.Tensor]:
    """Returns the tables of a task on its device, but for names that are taken: floats are float32, integers int64."""
    if not isinstance(declared, Mapping):
        raise TypeError(f"{title}.constants must be a dict of tables by name, got {declared!r}")
    found = {}
    for name, value in declared.items():
        _check_name(f"{title}.constants", name, taken)
        try:
            table = value.detach() if isinstance(value, torch.Tensor) else torch.as_tensor(np.array(value))
        except (TypeError, ValueError) as error:
            raise TypeError(f"{title}.constants[{name!r}] must be an array of numbers: {error}") from None
        if table.is_complex():
            raise TypeError(f"{title}.constants[{name!r}] must be of {CHOICES}, got {table.dtype}")
        if table.dtype not in DTYPES:
            table = table.to(torch.float32 if table.is_floating_point() else torch.int64)
        found[name] = table.to(device).contiguous().clone()
    return found


def _check_name(title: str, name: Any, taken: Collection[str]) -> None:
    if not isinstance(name, str) or not name.isidentifier() or name.startswith("_"):
        raise ValueError(f"{title}: {name!r} is no name of an attribute")
    if name in taken:
        raise ValueError(f"{title}: {name!r} is taken, since s.{name} is something else: rename it")


class Table(torch.Tensor):
    """What all worlds share, as hooks see it: an index of each world that is out of range gives NaN, and is noted.

    So it is everywhere, while torch would raise an error on the CPU and break the device on CUDA. Of integers, which
    have no NaN, it gives the first, and the world ends as one that is not finite.

    Its parts, and what is computed from tables alone, such as ``s.table[:, 3]`` or ``s.weights.cumsum(0)``, are tables.
    """

    _plain: torch.Tensor
    _note: "Note"

    @classmethod
    def of(cls, plain: torch.Tensor, note: "Note") -> "Table":
        """Returns a tensor as a table."""
        table = plain.as_subclass(cls)
        table._plain, table._note = plain, note
        return table

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Returns what torch does, but of :func:`lookup` where worlds look something up."""
        leaves = [leaf for leaf in torch.utils._pytree.tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
        tables = [leaf for leaf in leaves if isinstance(leaf, Table)]
        of_table = bool(args) and isinstance(args[0], Table)
        args, kwargs = torch.utils._pytree.tree_map_only(Table, lambda table: table._plain, (args, kwargs or {}))
        first, alone = tables[0], len(tables) == len(leaves)
        if of_table and func is torch.Tensor.__getitem__:
            result = lookup(args[0], args[1], first._note)
        elif of_table and func in (torch.index_select, torch.Tensor.index_select):
            dim, index = args[1:] if args[2:] else (args[1] if args[1:] else kwargs["dim"], kwargs["index"])
            result = lookup(args[0], (*[slice(None)] * (dim % args[0].ndim), index), first._note)
        elif of_table and func in (torch.take, torch.Tensor.take) and not alone:
            result = lookup(args[0].reshape(-1), args[1], first._note)
        elif func is torch.nn.functional.embedding and args[1:] and not (of_table or alone):
            result = lookup(args[1], args[0], first._note)
        else:
            result = func(*args, **kwargs)
        if not alone:
            return result
        return torch.utils._pytree.tree_map_only(torch.Tensor, lambda each: Table.of(each, first._note), result)


Note = Callable[[torch.Tensor, bool], None]
"""Takes in which worlds, ``(num_envs,)`` or all ``(1,)``, an index was out of range, and whether it gave NaN."""


def lookup(table: torch.Tensor, index: Any, note: Note) -> torch.Tensor:
    """Returns ``table[index]``, in which indices may be of each world: the first dimension of those is the world.

    It is NaN (or of integers the first) where an index is out of range, of which ``note`` is told.

    Raises:
        IndexError: a mask is beside an index.
    """
    parts = list(index) if isinstance(index, tuple) else [index]
    if not any(map(_is_index, parts)):
        return table[index]
    parts = [torch.tensor(part, device=table.device) if isinstance(part, list) else part for part in parts]
    if any(isinstance(part, torch.Tensor) and part.dtype == torch.bool for part in parts):
        raise IndexError("beside an index of worlds, a table takes numbers and slices, no masks")
    consumed = sum(part is not None and part is not Ellipsis for part in parts)
    rest = [slice(None)] * (table.ndim - consumed)
    parts = [each for part in parts for each in (rest if part is Ellipsis else [part])]
    table = table[tuple(slice(None) if _is_index(part) else part for part in parts)]  # as torch does it: first the rest
    parts = [part for part in parts if not isinstance(part, int)]
    inside = torch.ones(1, dtype=torch.bool, device=table.device)

    def checked(dim: int) -> torch.Tensor:
        nonlocal inside
        at, size = parts[dim].reshape(parts[dim].shape or (1,)), table.shape[dim]
        fits = (at >= -size) & (at < size)
        inside = inside & fits
        return torch.where(fits, at, 0).long()

    dims = [dim for dim, part in enumerate(parts) if _is_index(part)]
    if dims[-1] - dims[0] >= len(dims) and any(parts[dim].ndim for dim in dims):
        # Where others lie between, torch goes by indices without dimensions first.
        for dim in [dim for dim in reversed(dims) if not parts[dim].ndim]:
            table = table.index_select(dim, checked(dim)).squeeze(dim)
            del parts[dim]
        dims = [dim for dim, part in enumerate(parts) if _is_index(part)]
    safe = list[Any]([slice(None)] * (dims[-1] + 1))
    for dim in dims:
        safe[dim] = checked(dim)
    found = table[tuple(safe)]
    start = dims[0] if dims == list(range(dims[0], dims[-1] + 1)) else 0
    has_nan = found.is_floating_point()
    if has_nan:
        shape = *[1] * start, *inside.shape, *[1] * (found.ndim - start - inside.ndim)
        found = torch.where(inside.reshape(shape), found, float("nan"))
    note(~(inside.flatten(1).all(-1) if inside.ndim > 1 else inside), has_nan)
    return found if any(parts[dim].ndim for dim in dims) else found.squeeze(start)


def _is_index(part: Any) -> bool:
    return isinstance(part, torch.Tensor) and part.dtype in (torch.int64, torch.int32, torch.int16, torch.int8)
