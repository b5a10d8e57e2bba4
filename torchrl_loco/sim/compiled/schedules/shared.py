"""The C++ that both schedules share: ``arithmetic.h``, ``laws.h``, ``newton.h`` and ``line_search.h``."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

from torchrl_loco.sim.overflow import Overflow

FOLDER = pathlib.Path(__file__).parents[1]
FLAGS = (
    f"enum {{ NO_PLACE = {Overflow.NARROWPHASE:d}, LIMIT_REACHED = {Overflow.ITERATIONS:d}, "
    f"UNSOLVED = {Overflow.UNSOLVED:d} }};\n"
)
"""Bits of overflow."""
MUCH = 1.0
"""Mean square of the acceleration (rad^2/s^4, m^2/s^4) above which a solver that gains nothing has lost its world."""
LAWS = "".join((FOLDER / "physics" / f"{name}.h").read_text() + "\n" for name in ("arithmetic", "laws")) + FLAGS
"""Declarations, for the head of a function."""
_LINE_SEARCH, _NEWTON = ((FOLDER / "schedules" / f"{name}.h").read_text() for name in ("line_search", "newton"))


class Asked(NamedTuple):
    """What a control step writes beside the state.

    Attributes:
        with_cvel: whether the velocities of the bodies are written; lanes do wherever there is an array for it.
        with_subtree_com: whether the centers of mass of the trees are written.
        contact_geoms: geoms whose contact forces are written.
        contact_rows: how many rows of them: one for the last substep, or one for each.
    """

    with_cvel: bool = False
    with_subtree_com: bool = False
    contact_geoms: Sequence[int] = ()
    contact_rows: int = 1


NO_MORE = Asked()


def line_search(scale: str, tolerance: str, near: str, iterations: str, by_slopes: str = "false") -> str:
    """Returns the body of the function of the line search.

    Args:
        scale: C++ expression of one over the inertia of the model.
        tolerance: of the slope, relative to it.
        near: the share of its first slope at which it may end.
        iterations: how many steps are tried, or brackets of three where ``near`` is 0 or there are at most 3.
        by_slopes: whether costs are left out; three steps are tried then where a bracket would be.
    """
    values = {"LS_TOLERANCE": tolerance, "LS_NEAR": near, "LS_ITERATIONS": iterations, "BY_SLOPES": by_slopes}
    return _filled(_LINE_SEARCH, SCALE=scale, **values)


def newton(scale: str, tolerance: str, iterations: str, implicit_damping: str, guesses: str, delicate: str) -> str:
    """Returns the body of the function of Newton's method.

    Args:
        scale: C++ expression of one over the inertia of the model.
        tolerance: of improvement and gradient, relative to it.
        iterations: at most.
        implicit_damping: whether it ends with what implicit damping adds.
        guesses: whether it begins with a guess.
        delicate: whether single precision may not be enough (:func:`.delicate.is_delicate`).
    """
    values = {"SCALE": scale, "TOLERANCE": tolerance, "ITERATIONS": iterations, "MUCH": f"{MUCH}f"}
    return _filled(_NEWTON, **values, IMPLICIT_DAMPING=implicit_damping, GUESSES=guesses, DELICATE=delicate)


def _filled(text: str, **values: str) -> str:
    for word, value in values.items():
        text = text.replace(word, value)
    return text
