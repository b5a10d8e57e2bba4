"""Which entries of memory tell how far a curriculum has come: what the next episode is made from."""

import contextlib
from collections.abc import Callable, Collection

import torch

from torchrl_loco.envs.view import Arrays


class Noting(dict[str, torch.Tensor]):
    """Arrays of all worlds, with the names of those that were read."""

    def __init__(self, arrays: Arrays) -> None:
        super().__init__(arrays)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> torch.Tensor:
        self.read.add(name)
        return super().__getitem__(name)


def carried(begin: Callable[[Arrays], Arrays], arrays: Arrays, memory: Collection[str]) -> tuple[str, ...]:
    """Returns the entries of memory from which ``begin`` makes entries of memory: a level, or the next level.

    One that begins from itself stands for whatever else its next value is made from, such as a distance so far.

    Args:
        begin: makes what an episode begins with, by name, of arrays of all worlds.
        arrays: those of worlds at rest; entries of memory are ``memory.<name>``.
        memory: its entries.
    """
    rows = begin(noting := Noting(arrays))
    kept = {name for name in memory if name in rows}
    read = [name for name in memory if f"memory.{name}" in noting.read]
    if not kept:
        return ()
    made = {name: _made_from(name, begin, arrays, rows, kept) for name in read}
    # What an entry makes of itself may not show where all others are zero.
    held = {key: arrays[key] for key in (f"memory.{name}" for name in read)}
    others = {key: _moved(values, by=3 if values.is_floating_point() else 1) for key, values in held.items()}
    with contextlib.suppress(Exception):  # begin refuses these numbers: nothing more can be told
        rows = begin({**arrays, **others})
        for name in read:
            if name in kept - made[name]:
                made[name] |= _made_from(name, begin, {**arrays, **others}, rows, kept)
    explained = set[str]().union(*(entries for name, entries in made.items() if name in entries))
    return tuple(name for name, entries in made.items() if name in entries or entries - explained)


def _made_from(name: str, begin: Callable[[Arrays], Arrays], arrays: Arrays, rows: Arrays, kept: set[str]) -> set[str]:
    """Returns which of the entries ``kept`` differ from ``rows`` where an entry of memory holds another number."""
    key = f"memory.{name}"
    # Of several numbers some may be clamped. A number may be an index, which on CUDA ends the process if it is beyond
    # its table, so integers that may be no more than that are changed by one.
    steps = (1, 3, 10, 100, -1) if name in kept or arrays[key].is_floating_point() else (1,)
    for step in steps:
        try:
            after = begin({**arrays, key: _moved(arrays[key], step)})
            pairs = {entry: (after[entry].nan_to_num(), rows[entry].nan_to_num()) for entry in kept}
        except Exception:  # it refuses that number, so it reads it
            return {name} & kept or kept
        if found := {entry for entry, pair in pairs.items() if not torch.equal(*pair)}:
            return found
    return set()


def _moved(held: torch.Tensor, by: int) -> torch.Tensor:
    """Returns other numbers than an entry of memory holds; of flags the others."""
    return ~held if held.dtype == torch.bool else held + by
