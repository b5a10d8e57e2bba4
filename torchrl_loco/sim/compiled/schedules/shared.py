"""The C++ that both schedules share: ``arithmetic.h``, ``laws.h``, ``newton.h`` and ``line_search.h``."""

import pathlib
from collections.abc import Sequence
from typing import NamedTuple

import mujoco

from torchrl_loco.sim.compiled.ir.tables import Tables
from torchrl_loco.sim.compiled.physics.constraints import MIN_TOLERANCE, near
from torchrl_loco.sim.overflow import Overflow

FOLDER = pathlib.Path(__file__).parents[1]
FLAGS = (
    f"enum {{ NO_PLACE = {Overflow.NARROWPHASE:d}, LIMIT_REACHED = {Overflow.ITERATIONS:d}, "
    f"UNSOLVED = {Overflow.UNSOLVED:d} }};\n"
)
"""Bits of overflow."""
LAWS = "".join((FOLDER / "physics" / f"{name}.h").read_text() + "\n" for name in ("arithmetic", "laws")) + FLAGS
"""Declarations, for the head of a function."""
LINE_SEARCH, NEWTON = ((FOLDER / "schedules" / f"{name}.h").read_text() for name in ("line_search", "newton"))
"""Bodies of functions."""


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


def add_options(tables: Tables, m: mujoco.MjModel, **flags: int) -> None:
    """Adds to struct ``Model`` what Newton's method and its line search go by: options of a model, and more flags.

    These are ``DELICATE`` (whether single precision may not be enough: :func:`.delicate.is_delicate`), ``BY_SLOPES``
    (whether searches leave out costs) and ``IMPLICIT_DAMPING`` (whether the method ends with what that adds).
    """
    tables.size(ITERATIONS=m.opt.iterations, LS_ITERATIONS=m.opt.ls_iterations, **flags)
    scale, tolerance = 1 / (m.stat.meaninertia * m.nv), max(m.opt.tolerance, MIN_TOLERANCE)  # relative to the inertia
    tables.constant(scale=scale, tolerance=tolerance, ls_tolerance=tolerance * m.opt.ls_tolerance, ls_near=near(m))
