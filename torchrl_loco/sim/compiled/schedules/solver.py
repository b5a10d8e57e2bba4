"""The Newton solver of one world, traced for one model.

The method is in ``newton.h`` and ``line_search.h``, and what rows cost in ``laws.h``; here is what they work on.
"""

from collections.abc import Sequence

import numpy as np

from torchrl_loco.sim.compiled.collision.pairs import Pair
from torchrl_loco.sim.compiled.ir.parameters import nominal
from torchrl_loco.sim.compiled.ir.symbols import Block, Scalar, cell, cells, dot, name, total
from torchrl_loco.sim.compiled.physics.constraints import DryFriction, JointLimits, Variables, near
from torchrl_loco.sim.compiled.physics.delicate import LEAST_PIVOT, is_delicate
from torchrl_loco.sim.compiled.physics.dynamics import ArticulatedFactor, Dynamics
from torchrl_loco.sim.compiled.physics.sensors import ContactForces, TouchSensors
from torchrl_loco.sim.compiled.schedules import shared
from torchrl_loco.sim.compiled.schedules.dense_contacts import DenseContacts
from torchrl_loco.sim.compiled.schedules.ground_contacts import GroundContacts

WHOLE = "whole[0] += row.cost(); row.add(1.0f, whole + 1);"
STEPS = "UNROLLED_FOR(int s = 0; s < n; ++s) row.add(alphas[s], sums + 3 * s);"
"""What the line search does with each row."""
WHOLE_BY_SLOPES = "whole[0] += row.cost(); row.bend(1.0f, whole + 2);"
STEPS_BY_SLOPES = "UNROLLED_FOR(int s = 0; s < n; ++s) row.bend(alphas[s], sums + 3 * s + 1);"  # the same without costs


class NewtonSolver:
    """Generates the solver for one model.

    C++ variables: ``qacc`` (result), ``force`` (smooth force), ``search`` (direction), and their products with M,
    ``M_qacc`` and ``M_search``.

    Attributes:
        contacts: those with the ground and the dense ones, as far as there are any, and C++ of the first and the end.
        arrays: C++ arrays of floats, and how many each has.
        structs: C++ arrays of structs, how many each has, and their fields. What a loop over contacts reads of one is a
            load or two.
    """

    def __init__(self, tree: Dynamics, found: list[Pair], contact_geoms: Sequence[int] = ()) -> None:
        self.tree = tree
        m = self.m = tree.m
        self.limits, self.friction = JointLimits(m), DryFriction(m)
        self.touch = TouchSensors(m, tree.poses)
        self.ground = GroundContacts(tree, found, self.touch, with_frames=bool(contact_geoms))
        self.dense = DenseContacts(tree, found, self.ground, self.touch, with_frames=bool(contact_geoms))
        self.arrays = dict.fromkeys(("qacc", "force", "search", "M_qacc", "M_search"), m.nv)
        for rows in (self.limits, self.friction, self.dense):
            self.arrays.update(rows.arrays)
        self.by_slopes = near(m) == 0
        self.delicate = is_delicate(nominal(m))
        self.places = self.ground.count + self.dense.count
        contacts = (self.ground, "0", "ground"), (self.dense, "ground", "contacts")
        self.contacts = [(rows, first, end) for rows, first, end in contacts if rows.count]
        directions = max(len(rows.pyramid.directions) for rows in (self.ground, self.dense))
        rows_of_contact = [f"{field}{d}" for field in "xv" for d in range(directions)]
        self.structs = {
            "contact": (self.places, [f"float {', '.join([*rows_of_contact, 'D'])}", *self.ground.fields]),
            "link": (len(self.ground.bodies), [f"float {title}[{size}]" for title, size in self.ground.link.items()]),
        }
        self.arrays["touch"] = len(self.touch)
        if self.dense.count:
            self.arrays.update({"gradient": m.nv, "solution": m.nv})
        if contact_geoms:
            corners = [corner.pair.geoms for corner in self.ground.corners]
            self.contact_forces = ContactForces(contact_geoms, corners + [pair.geoms for pair in self.dense.pairs])

    def write(self, block: Block, variables: Variables) -> None:
        """Appends constraints and solver to a block, in which ``force`` is set, and ``qacc`` holds the start."""
        m = self.m
        for rows in (self.limits, self.friction, self.ground, self.dense):
            rows.create(block, variables)
        for i, product in enumerate(self.tree.mass_times(cells("qacc", m.nv))):
            block.set(f"M_qacc[{i}]", product)
        with block.function(
            "set_direction", "bool, float regularisation, float& gradient_squared, float& decrement"
        ) as direction:
            self._set_direction(direction)
        block("float quadratic[3], whole[4];")
        with block.function("project") as projection:
            self._project(projection)
        with block.function("line_search", "const float decrement, const bool guessed") as search:
            self._line_search(search)
        with block.function("move", "Search& step") as step:
            self._move(step)
        block("const auto any_of_block = [](bool x) { return x; };")
        with block.function("lose", "") as loss:
            loss("qacc[0] = M_qacc[0] = Math::from_bits(NAN_BITS);")
        block("const bool guesses = false;")
        block(shared.NEWTON)

    def read_touch(self, block: Block) -> None:
        """Sets the touch sensors from the forces that were found."""
        block(f"for (int i = 0; i < {len(self.touch)}; ++i) touch[i] = 0.0f;")
        for rows, first, end in self.contacts:
            self.touch.add(block, first, end, rows.pyramid.normal_force())

    def read_contact_forces(self, block: Block) -> None:
        """Writes the forces of the contacts on the geoms that were asked for, into ``row``."""
        self.contact_forces.clear(block)
        for rows, first, end in self.contacts:
            self.contact_forces.add(block, (first, end), rows.pyramid.force(rows.directions))

    def _set_direction(self, block: Block) -> None:
        """Sets ``search`` to -H^-1 gradient, and ``gradient_squared`` and ``decrement``."""
        m, tree, nv = self.m, self.tree, self.m.nv
        forces, stiffness = self.ground.gather(block)
        for body in reversed(range(1, m.nbody)):
            forces[m.body_parentid[body]] = forces[m.body_parentid[body]] + forces[body]
        gradient = [
            cell(f"M_qacc[{i}]") - cell(f"force[{i}]") + dot(tree.cdof[i], forces[m.dof_bodyid[i]]) for i in range(nv)
        ]
        diagonal = [total([]) for _ in range(nv)]
        self.limits.add_to(gradient, diagonal)
        self.friction.add_to(gradient, diagonal)
        if self.delicate:
            diagonal = [x + name("regularisation") * float(m.dof_M0[i]) for i, x in enumerate(diagonal)]
        factor = ArticulatedFactor(tree, stiffness, diagonal)
        if self.delicate:
            self._look_at_pivots(block, factor, stiffness, diagonal)
        if self.dense.count:
            for i in range(nv):
                block.set(f"gradient[{i}]", gradient[i])
            self.dense.gather(block)
            factor.keep(block)
            self.dense.solve(block, factor.solve)
            gradient, solution = cells("gradient", nv), cells("solution", nv)
        else:
            gradient = [block.keep(entry) for entry in gradient]
            solution = factor.solve(gradient)
        block.set("gradient_squared", dot(gradient, gradient))
        block.set("decrement", dot(gradient, solution))
        for i, entry in enumerate([block.keep(entry) for entry in solution]):
            block.set(f"search[{i}]", -entry)

    def _look_at_pivots(
        self, block: Block, factor: ArticulatedFactor, stiffness: list[np.ndarray], diagonal: list[Scalar]
    ) -> None:
        """Flags a world of whose entry of the diagonal of H elimination leaves little but rounding."""
        tree = self.tree
        for whole, inverse in zip(tree.diagonal(stiffness, diagonal), factor.inverse, strict=True):
            kept = block.value(whole * inverse * LEAST_PIVOT)
            block(f"if (!(({block.value(inverse)} > 0.0f) & ({kept} < 1.0f))) flag(UNSOLVED);")

    def _project(self, block: Block) -> None:
        """Sets how residuals and M qacc change along the search direction, and what a line search asks of all rows."""
        search, whole = cells("search", self.m.nv), WHOLE_BY_SLOPES if self.by_slopes else WHOLE
        block("for (float& sum : whole) sum = 0.0f;")
        self.limits.project(block, search)
        self.friction.project(block, search)
        self.dense.project(block)
        block(self._each_row(whole, ground=False))
        self.ground.project(block, search, whole)
        for i, product in enumerate(self.tree.mass_times(search)):
            block.set(f"M_search[{i}]", product)

    def _line_search(self, block: Block) -> None:
        """Returns a step along the direction, and sets the quadratic form there."""
        nv = self.m.nv
        search = cells("search", nv)
        residual = [cell(f"M_qacc[{i}]") - cell(f"force[{i}]") for i in range(nv)]
        sums = (dot(search, residual), dot(search, cells("M_search", nv)), dot(search, search))
        for i, x in enumerate(sums):
            block.set(f"quadratic[{i}]", x)
        block("const auto add_rows = [&](const float* alphas, const int n, float* sums) {")
        block(self._each_row(STEPS_BY_SLOPES if self.by_slopes else STEPS))
        block("};")
        block(shared.LINE_SEARCH)

    def _each_row(self, body: str, *, ground: bool = True) -> str:
        """Returns C++ that runs ``body`` for each row, ``row``, with or without contacts with the ground."""
        contacts = [each for each in self.contacts if ground or each[0] is not self.ground]
        loops = [rows.pyramid.loop(first, end, body) for rows, first, end in contacts]
        return "\n".join([self.limits.loop(body), *loops, self.friction.loop(body)])

    def _move(self, block: Block) -> None:
        """Moves along the direction, and returns whether a row changed sides; says what is gained if no search has."""
        block("const float alpha = step.alpha;")
        gained = ""
        if self.by_slopes:
            block("float change = alpha * quadratic[0] + 0.5f * alpha * alpha * quadratic[1];")
            gained = "change += row.change(alpha); "
        for i in range(self.m.nv):
            block(f"qacc[{i}] += alpha * search[{i}]; M_qacc[{i}] += alpha * M_search[{i}];")
        block("bool changed = false;")
        block(self.limits.advance(gained))
        block(self.friction.advance(gained))
        for rows, first, end in self.contacts:
            block(rows.pyramid.advance(first, end, gained))
        if self.by_slopes:
            block("step.improvement = -change;")
        block("return changed;")
