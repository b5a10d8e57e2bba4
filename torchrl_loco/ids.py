"""The ids of environments, ours and those that other distributions register. To know them imports no environment."""

import functools
import re
import warnings
from importlib import metadata

from torchrl_loco.config import suggestion

OURS = {
    "walker_stand": "Stand up and stay upright.",
    "walker_walk": "Walk at 1 m/s or faster.",
    "walker_run": "Run at 8 m/s or faster.",
    "humanoid_stand": "Stand still and upright.",
    "humanoid_walk": "Walk at 1 m/s or faster, in any direction.",
    "humanoid_run": "Run at 10 m/s or faster, in any direction.",
}
"""Our ids, and what each asks for."""

ALIASES = {f"mjx/{name}-v0": name for name in OURS}

GROUP = "torchrl_loco.envs"
"""Group of the entry points by which installed distributions add environments: ``id = "module:Class"``."""


@functools.cache
def plugins() -> dict[str, metadata.EntryPoint]:
    """Returns the entry points of :data:`GROUP` by id, none of them loaded. They are looked up once.

    Of an id that is taken already, by this package or by a distribution that was found before, a warning tells.
    """
    found: dict[str, metadata.EntryPoint] = {}
    for point in metadata.entry_points(group=GROUP):
        if point.name in OURS or point.name in ALIASES:
            taken = "torchrl_loco itself has it"
        elif point.name in found:
            taken = f"{origin(found[point.name])} has it"
        elif not re.fullmatch(r"[\w.-]+", point.name):
            taken = "an id is letters, digits, and _ . -, because runs are named after it"
        else:
            found[point.name] = point
            continue
        warnings.warn(f"environment {point.name!r} of {origin(point)} is refused: {taken}", stacklevel=3)
    return dict(sorted(found.items()))


def origin(point: metadata.EntryPoint) -> str:
    """Returns the distribution that an entry point is of, and what it names."""
    return f"{point.dist.name} {point.dist.version} ({point.value})" if point.dist else point.value


def list_envs() -> list[str]:
    """Returns the ids that :func:`torchrl_loco.make` takes: ours, then those of others.

    The aliases ``mjx/<id>-v0`` are not among them.
    """
    return [*OURS, *plugins()]


def canonical_id(id: str) -> str:
    """Returns the id that ``id``, or an alias, stands for.

    Raises:
        ValueError: there is no such id; the message names the nearest right one and all of them.
    """
    names = list_envs()
    name = ALIASES.get(id, id)
    if name not in names:
        hint = suggestion(str(id), [*names, *ALIASES])
        raise ValueError(f"unknown environment {id!r}{hint}: choose one of {', '.join(names)}")
    return name
