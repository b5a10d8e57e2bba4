"""Constraint rows of one substep, traced for one model: their softness, joint limits and dry friction.

A row has a residual ``x = J a - a_ref`` of the acceleration ``a`` and a weight ``D``. It costs ``D x^2 / 2`` where
``x < 0`` and nothing elsewhere; a row of dry friction costs that on both sides, and grows linearly beyond a force.
Along a search direction ``s`` the residual changes by ``v = J s``. Source: MuJoCo's documentation, chapter Computation
("Constraint model"), and chapter Modeling ("Solver parameters") for ``a_ref`` and ``D``.

Here J has a single number, plus or minus one; the rows of contacts are in ``ground_contacts`` and ``dense_contacts``.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.ir.parameters import Number, varies
from torchrl_loco.sim.compiled.ir.symbols import (
    Block,
    Scalar,
    absolute,
    call,
    cell,
    maximum,
    minimum,
    name,
    scalar,
    select,
)
from torchrl_loco.sim.compiled.physics.dynamics import HINGE, MINVAL, SLIDE

MINIMP, MAXIMP = 1e-4, 0.9999  # MuJoCo's mjMINIMP and mjMAXIMP

DEFAULT_SOLREF = 0.02, 1.0  # what MuJoCo takes in the place of a solref that mixes its two formats, with a warning

MIN_TOLERANCE = 1e-6
"""Tolerance below which a solver in single precision would only see rounding; mujoco_warp has the same bound."""

NEAR, MANY_ITERATIONS = 0.1, 10
"""Share of its first slope at which a line search may end, and iterations that nearly always converge: with fewer, what
is left depends on where the searches end, which is then where those of MuJoCo-Warp do."""

Variables = tuple[list[Scalar], list[Scalar], list[Scalar]]  # symbols of qpos, qvel and qacc


def near(m: mujoco.MjModel) -> float:
    """Returns the share of its first slope at which a line search may end, besides where the slope vanishes."""
    return NEAR if m.opt.iterations >= MANY_ITERATIONS else 0.0


@dataclasses.dataclass(frozen=True)
class Softness:
    """Stiffness, damping and impedance of a constraint, from its ``solref`` and ``solimp``.

    Numbers, or scalars that read tables. The impedance rises from ``dmin`` by ``rise`` within a width: as a power of
    the distance up to the midpoint, and mirrored beyond.

    Attributes:
        stiffness: restoring acceleration per distance (1/s^2).
        damping: restoring acceleration per velocity (1/s).
        dmin: impedance at distance zero.
        rise: how much larger it becomes.
        per_width: one over the width (1/m or 1/rad).
        midpoint: where the two powers meet, as a share of the width.
        power: the power.
        lower: factor of the power below the midpoint.
        upper: factor of the power above it.
    """

    stiffness: Any
    damping: Any
    dmin: Any
    rise: Any
    per_width: Any
    midpoint: Any
    power: Any
    lower: Any
    upper: Any

    @classmethod
    def make(cls, m: mujoco.MjModel, solref: Sequence[float], solimp: Sequence[float]) -> "Softness":
        """Returns the softness for the parameters of a model."""
        dmin, dmax, midpoint = (float(np.clip(solimp[i], MINIMP, MAXIMP)) for i in (0, 1, 3))
        if (solref[0] > 0) != (solref[1] > 0):  # neither of the two formats
            solref = DEFAULT_SOLREF
        safe = not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_REFSAFE)
        time = max(solref[0], 2 * m.opt.timestep) if safe else solref[0]
        if solref[0] <= 0:
            stiffness = -solref[0] / max(MINVAL, dmax**2)
        else:
            stiffness = 1 / max(MINVAL, (dmax * time * solref[1]) ** 2)
        damping = -solref[1] / max(MINVAL, dmax) if solref[1] <= 0 else 2 / max(MINVAL, dmax * time)
        width, power = float(solimp[2]), max(1.0, float(solimp[4]))
        if width <= MINVAL:
            dmin, dmax, width = (dmin + dmax) / 2, (dmin + dmax) / 2, 1.0
        lower, upper = midpoint ** (1 - power), (1 - midpoint) ** (1 - power)
        return cls(float(stiffness), float(damping), dmin, dmax - dmin, 1 / width, midpoint, power, lower, upper)

    @classmethod
    def from_table(cls, table: "Table", rows: "list[Softness]") -> "Softness":
        """Returns the softness of the row of a table that the C++ variable of ``table`` names."""
        fields = [field.name for field in dataclasses.fields(cls)]
        return cls(**{field: table.column(field, [getattr(row, field) for row in rows]) for field in fields})

    def impedance(self, position: Scalar) -> Scalar:
        """Returns the impedance at a distance."""
        if scalar(self.rise).constant == 0:
            return scalar(self.dmin)
        x = minimum(absolute(position) * self.per_width, 1)
        power = raised(select(x, "<=", self.midpoint, x, 1 - x), self.power)
        return self.dmin + select(x, "<=", self.midpoint, self.lower * power, 1 - self.upper * power) * self.rise

    def row(self, weight: float | Scalar, position: Scalar, least: float | Scalar = MINVAL) -> tuple[Scalar, Scalar]:
        """Returns D, at most one over ``least``, and the part of the residual that the position makes.

        The weight is the approximate inverse inertia along the row; a position (m or rad) that violates it is negative.
        """
        impedance = self.impedance(position)
        regularisation = maximum(scalar(weight) * (1 - impedance), least * impedance)  # times impedance
        return impedance / regularisation, self.stiffness * impedance * position

    @classmethod
    def as_cpp(cls) -> str:
        """Returns a C++ struct with these members, and :meth:`row` as a function."""
        fields = [field.name for field in dataclasses.fields(cls)]
        results = cls(*map(name, fields)).row(name("inverse_inertia"), name("position"), name("least"))
        block = Block()
        for target, result in zip(("weight", "residual"), results, strict=True):
            block.set(target, result)
        arguments = "float inverse_inertia, float position, float least, float& weight, float& residual"
        row = f"INLINE void row({arguments}) const {{\n{block.text()}\n}}"
        return f"struct Softness {{\nfloat {', '.join(fields)};\n{row}\n}};"


def raised(x: Scalar, power: float | Scalar) -> Scalar:
    """Returns ``x`` to a power."""
    constant = scalar(power).constant
    if constant is None or constant != int(constant) or constant > 8:
        return call("Math::raised", x, power)
    result = x
    for _ in range(int(constant) - 1):
        result = result * x
    return result


class Table:
    """Numbers that differ between the rows of a loop, of which C++ calls the present one ``index``; equal ones fold."""

    def __init__(self, block: Block, prefix: str, index: str) -> None:
        self.block, self.prefix, self.index = block, prefix, index

    def column(self, title: str, values: Sequence[Number]) -> Scalar:
        """Returns the number of the current row."""
        nodes = [scalar(x) for x in values]
        if len(set(nodes)) == 1:
            return nodes[0]
        listed = ", ".join([self.block.value(x) for x in nodes])
        kept = "const" if any(map(varies, nodes)) else "static const"
        self.block(f"{kept} float {self.prefix}_{title}[{len(values)}] = {{{listed}}};")
        return name(f"{self.prefix}_{title}[{self.index}]")

    def integers(self, title: str, values: Sequence[int]) -> str:
        """Returns the C++ expression of the integer of the current row."""
        listed = ", ".join(str(int(x)) for x in values)
        self.block(f"static const int {self.prefix}_{title}[{len(values)}] = {{{listed}}};")
        return f"{self.prefix}_{title}[{self.index}]"


def limited(m: mujoco.MjModel, *kinds: int) -> list[int]:
    """Returns the joints of some kinds that have limits."""
    return [j for j in range(m.njnt) if m.jnt_limited[j] and m.jnt_type[j] in kinds]


def both_sides(m: mujoco.MjModel, joint: int) -> bool:
    """Returns whether a joint can be within the margin of both its limits, each of which is a row then."""
    low, high = m.jnt_range[joint]
    return bool(2 * m.jnt_margin[joint] > high - low)


class JointLimits:
    """Limits of hinges and slides. Each has a place of its own, whose weight is zero while the joint is within them.

    Where a joint cannot be near both its limits, they share a place.
    """

    def __init__(self, m: mujoco.MjModel) -> None:
        self.m = m
        joints = limited(m, SLIDE, HINGE)
        self.rows = [(j, sign) for j in joints for sign in ((1, -1) if both_sides(m, j) else (None,))]
        self.count = len(self.rows)
        self.arrays = {f"limit_{field}": self.count for field in ("D", "x", "v", "sign")}

    def create(self, block: Block, variables: Variables) -> None:
        """Sets weights, signs and residuals."""
        m, (qpos, qvel, qacc) = self.m, variables
        for i, (j, side) in enumerate(self.rows):
            d, (low, high) = int(m.jnt_dofadr[j]), m.jnt_range[j]
            below, above = qpos[m.jnt_qposadr[j]] - low, high - qpos[m.jnt_qposadr[j]]
            if side is None:
                position, sign = minimum(below, above) - m.jnt_margin[j], select(below, "<", above, 1, -1)
            else:
                position, sign = (below if side > 0 else above) - m.jnt_margin[j], scalar(side)
            softness = Softness.make(m, m.jnt_solref[j], m.jnt_solimp[j])
            weight, residual = softness.row(m.dof_invweight0[d], position)
            block.set(f"limit_sign[{i}]", sign)
            block.set(f"limit_D[{i}]", select(position, "<", 0, weight, 0))
            block.set(f"limit_x[{i}]", residual + sign * (softness.damping * qvel[d] + qacc[d]))

    def project(self, block: Block, search: list[Scalar]) -> None:
        """Sets how the residuals change along the search direction."""
        for i, (j, _) in enumerate(self.rows):
            block.set(f"limit_v[{i}]", cell(f"limit_sign[{i}]") * search[self.m.jnt_dofadr[j]])

    def add_to(self, gradient: list[Scalar], diagonal: list[Scalar]) -> None:
        """Adds the rows to the gradient of the cost and to the diagonal of its Hessian."""
        for i, (j, _) in enumerate(self.rows):
            d, x, sign = self.m.jnt_dofadr[j], cell(f"limit_x[{i}]"), cell(f"limit_sign[{i}]")
            weight = call("OneSided::curvature", x, cell(f"limit_D[{i}]"))
            gradient[d] = gradient[d] + weight * sign * x
            diagonal[d] = diagonal[d] + weight

    def loop(self, body: str) -> str:
        """Returns a C++ loop over the rows, each a ``row``."""
        if not self.count:
            return ""
        row = "const ConstraintRow row = {limit_x[i], limit_v[i], limit_D[i], 0.0f, false};"
        return f"#pragma unroll\nfor (int i = 0; i < {self.count}; ++i) {{ {row} {body} }}"

    def advance(self, first: str) -> str:
        """Returns C++ that does ``first``, moves residuals along the direction, and notes if a row changed sides."""
        moves = "changed |= row.weight > 0.0f && row.crosses(next); limit_x[i] = next;"
        return self.loop(f"{first}const float next = row.after(alpha); {moves}")


class DryFriction:
    """Friction loss of degrees of freedom: a force of constant size against the motion.

    A row at distance zero, so that its weight and damping are constant.

    Attributes:
        dofs: the degrees of freedom.
        softness: of each row.
        weight: D of each.
        bound: size of the residual beyond which the force of each is constant.
    """

    def __init__(self, m: mujoco.MjModel) -> None:
        self.m = m
        losses = m.dof_frictionloss
        self.dofs = [d for d in range(m.nv) if varies(losses[d]) or losses[d] > 0]
        self.count = len(self.dofs)
        self.arrays = {f"friction_{field}": self.count for field in ("x", "v")}
        self.softness = [Softness.make(m, m.dof_solref[d], m.dof_solimp[d]) for d in self.dofs]
        weights = m.dof_invweight0[self.dofs]
        rows = zip(weights, self.softness, strict=True)
        self.weight = [1 / max(w * (1 - softness.dmin) / softness.dmin, MINVAL) for w, softness in rows]
        self.bound: list[Number] = [losses[d] / weight for d, weight in zip(self.dofs, self.weight, strict=True)]
        self._kept = "const" if any(map(varies, self.bound)) else "static const"

    def create(self, block: Block, variables: Variables) -> None:
        """Sets the residuals."""
        _, qvel, qacc = variables
        self.bound = [block.keep(bound) if varies(bound) else bound for bound in self.bound]
        for i, d in enumerate(self.dofs):
            block.set(f"friction_x[{i}]", qacc[d] + self.softness[i].damping * qvel[d])

    def project(self, block: Block, search: list[Scalar]) -> None:
        """Sets how the residuals change along the search direction."""
        for i, d in enumerate(self.dofs):
            block.set(f"friction_v[{i}]", search[d])

    def add_to(self, gradient: list[Scalar], diagonal: list[Scalar]) -> None:
        """Adds the rows to the gradient of the cost and to the diagonal of its Hessian."""
        for i, d in enumerate(self.dofs):
            row = cell(f"friction_x[{i}]"), self.weight[i], self.bound[i]
            gradient[d] = gradient[d] + call("DryFriction::gradient", *row)
            diagonal[d] = diagonal[d] + call("DryFriction::curvature", *row)

    def loop(self, body: str) -> str:
        """Returns a C++ loop over the rows, each a ``row``."""
        if not self.count:
            return ""
        listed = [", ".join(map(Block().value, values)) for values in (self.weight, self.bound)]  # constants, or names
        row = "const ConstraintRow row = {friction_x[i], friction_v[i], friction_D[i], friction_bound[i], true};"
        return (
            f"{{ {self._kept} float friction_D[] = {{{listed[0]}}}, friction_bound[] = {{{listed[1]}}};\n"
            f"#pragma unroll\nfor (int i = 0; i < {self.count}; ++i) {{ {row} {body} }} }}"
        )

    def advance(self, first: str) -> str:
        """Returns C++ that does ``first``, moves residuals along the direction, and notes if a row changed sides."""
        moves = "changed |= row.crosses(next); friction_x[i] = next;"
        return self.loop(f"{first}const float next = row.after(alpha); {moves}")
