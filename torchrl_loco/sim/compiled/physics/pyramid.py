"""The rows of a contact, as edges of a friction pyramid.

A contact has up to three directions, a normal and two tangents scaled by friction, whose combinations are the edges of
a pyramid; each edge is a row.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from torchrl_loco.sim.compiled.ir.symbols import Scalar, call, cell, literal, scalar, total


@dataclasses.dataclass(frozen=True)
class Pyramid:
    """The edges of a contact's friction pyramid, and with them its rows.

    A contact without friction among others with friction is a pyramid whose tangents are zero: its four edges are
    alike, and each gets a quarter of the weight.

    Attributes:
        edges: sign, direction and count of each kind of edge: normal + sign * tangent. Direction 0 is the normal alone.
    """

    edges: tuple[tuple[int, int, int], ...]

    @property
    def directions(self) -> range:
        """The normal and the tangents that are needed."""
        return range(1 + max(direction for _, direction, _ in self.edges))

    def share(self, condim: int) -> float:
        """Returns how much of the weight of a contact an edge gets."""
        return 1.0 if condim > 1 else 1.0 / sum(count for *_, count in self.edges)

    def response(self) -> tuple[list[Scalar], dict[tuple[int, int], Scalar]]:
        """Returns gradient and Hessian of the cost of contact ``k`` with respect to the directions."""
        weight, x = cell("contact[k].D"), [cell(f"contact[k].x{d}") for d in self.directions]
        gradient = [scalar(0) for _ in self.directions]
        hessian = {(0, 0): scalar(0)}
        for sign, direction, count in self.edges:
            residual = x[0] + sign * x[direction] if direction else x[0]
            active = call("OneSided::curvature", residual, count * weight)
            force = active * residual
            gradient[0] = gradient[0] + force
            hessian[0, 0] = hessian[0, 0] + active
            if direction:
                gradient[direction] = gradient[direction] + sign * force
                hessian[0, direction] = hessian.get((0, direction), scalar(0)) + sign * active
                hessian[direction, direction] = hessian.get((direction, direction), scalar(0)) + active
        return gradient, hessian

    def normal_force(self) -> Scalar:
        """Returns the normal force of contact ``k`` (N)."""
        return -self.response()[0][0]

    def force(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        """Returns the force of contact ``k`` on its second geom (N), from normal and tangents times friction."""
        return -total(g * axis for g, axis in zip(self.response()[0], axes, strict=False))

    def rows(self, body: str) -> list[str]:
        """Returns C++ statements that run ``body`` for each edge of contact ``k``, ``row``."""
        lines = []
        for sign, direction, copies in self.edges:
            x, v = (
                f"contact[k].{field}0"
                + (f" {'+' if sign > 0 else '-'} contact[k].{field}{direction}" if direction else "")
                for field in "xv"
            )
            weight = f"{literal(copies)} * contact[k].D" if copies > 1 else "contact[k].D"
            lines.append(f"{{ const ConstraintRow row = {{{x}, {v}, {weight}, 0.0f, false}}; {body} }}")
        return lines

    def loop(self, first: str, count: str, body: str) -> str:
        """Returns a C++ loop over the edges of contacts, each a ``row``."""
        lines = "".join(f"  {line}\n" for line in self.rows(body))
        return f"#pragma unroll 1\nfor (int k = {first}; k < {count}; ++k) {{\n{lines}}}"

    def advance(self, first: str, count: str, before: str) -> str:
        """Returns C++ that moves the residuals along the direction, and notes if an edge changed sides."""
        edges = self.loop(first, count, f"{before}changed |= row.crosses(row.after(alpha));").removesuffix("}")
        moves = " ".join(f"contact[k].x{d} += alpha * contact[k].v{d};" for d in self.directions)
        return f"{edges}  {moves}\n}}"


FRICTIONLESS = Pyramid(((0, 0, 1),))
FLAT = Pyramid(((1, 1, 1), (-1, 1, 1), (0, 0, 2)))
"""Nothing moves along the second tangent: its two edges are the normal, twice."""
FULL = Pyramid(((1, 1, 1), (-1, 1, 1), (1, 2, 1), (-1, 2, 1)))
