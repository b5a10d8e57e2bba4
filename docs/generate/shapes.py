"""Which shapes touch which in the compiled step, from its table of pairs."""

from generate.markdown import table
from torchrl_loco.sim.compiled.collision.kinds import FIELD, KINDS, Kind, title


def pairs() -> str:
    """Returns a row for each pair of shapes: its contacts, and the schedules that have it."""
    rows = [
        [title(first), title(second), points(first, kind), "both" if kind.traced else "lanes"]
        for (first, second), kind in KINDS.items()
    ]
    return table(["first", "second", "contacts at most", "schedule"], rows)


def points(first: int, kind: Kind) -> str:
    """Returns how many contacts two shapes can have."""
    return "one a prism" if first == FIELD else str(kind.points)
