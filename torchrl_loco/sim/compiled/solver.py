"""The Newton solver of one world: minimises the cost of constraints over accelerations, traced for one model.

    minimise  1/2 (a - a_smooth)' M (a - a_smooth) + the cost of the rows

Each iteration solves H s = -gradient with H = M + J' D J over the active rows, and searches along s for the minimum of
the cost, which is piecewise quadratic and convex there. Source: MuJoCo's documentation, chapter Computation ("Solver
algorithms", Newton). What rows cost, the line search and the stopping tests are in ``laws.h`` and ``line_search.h``.
"""

from collections.abc import Sequence

from torchrl_loco.sim.compiled import shared
from torchrl_loco.sim.compiled.collision import Pair
from torchrl_loco.sim.compiled.constraints import DryFriction, JointLimits, Variables, near, tolerance
from torchrl_loco.sim.compiled.dense_contacts import DenseContacts
from torchrl_loco.sim.compiled.dynamics import Dynamics
from torchrl_loco.sim.compiled.ground_contacts import GroundContacts
from torchrl_loco.sim.compiled.sensors import ContactForces, TouchSensors
from torchrl_loco.sim.compiled.symbols import Block, cell, cells, dot, literal, total

WHOLE = "whole[0] += OneSided::cost(x, D); OneSided::add(x, v, D, 1.0f, whole + 1);"
WHOLE_FRICTION = "whole[0] += DryFriction::cost(x, D, bound); DryFriction::add(x, v, D, bound, 1.0f, whole + 1);"
STEPS = "UNROLLED for (int s = 0; s < n; ++s) OneSided::add(x, v, D, alphas[s], sums + 3 * s);"
STEPS_FRICTION = "UNROLLED for (int s = 0; s < n; ++s) DryFriction::add(x, v, D, bound, alphas[s], sums + 3 * s);"
"""What the line search does with each row."""


class NewtonSolver:
    """Generates the solver for one model.

    C++ variables: ``qacc`` (result), ``force`` (smooth force), ``search`` (direction), and their products with M,
    ``M_qacc`` and ``M_search``.

    Args:
        tree: the dynamics.
        found: pairs of geoms that may touch.
        contact_geoms: geoms whose contact forces are asked for.
    """

    def __init__(self, tree: Dynamics, found: list[Pair], contact_geoms: Sequence[int] = ()) -> None:
        self.tree = tree
        m = self.m = tree.m
        self.limits, self.friction = JointLimits(m), DryFriction(m)
        self.touch = TouchSensors(m, tree.poses)
        self.ground = GroundContacts(tree, found, self.touch)
        self.dense = DenseContacts(tree, found, self.ground, self.touch, with_frames=bool(contact_geoms))
        self.arrays = dict.fromkeys(("qacc", "force", "search", "M_qacc", "M_search"), m.nv)
        for rows in (self.limits, self.friction, self.ground, self.dense):
            self.arrays.update(rows.arrays)
        self.places = self.ground.count + self.dense.count
        directions = max(len(rows.pyramid.directions) for rows in (self.ground, self.dense))
        self.arrays["contact_D"] = self.places
        self.arrays.update({f"contact_{field}{d}": self.places for field in "xv" for d in range(directions)})
        self.arrays["touch"] = len(self.touch)
        if self.dense.count:
            self.arrays.update({"gradient": m.nv, "solution": m.nv})
        if contact_geoms:
            corners = [corner.pair.geoms for corner in self.ground.corners]
            self.contact_forces = ContactForces(contact_geoms, corners + [pair.geoms for pair in self.dense.pairs])

    def write(self, block: Block, variables: Variables) -> None:
        """Appends constraints and solver to a block, after which ``qacc`` is the acceleration.

        Args:
            block: the block, in which ``force`` is set and ``qacc`` holds the start.
            variables: symbols of qpos, qvel and qacc.
        """
        m, option = self.m, self.m.opt
        for rows in (self.limits, self.friction, self.ground, self.dense):
            rows.create(block, variables)
        for i, product in enumerate(self.tree.mass_times(cells("qacc", m.nv))):
            block.set(f"M_qacc[{i}]", product)
        scale = 1 / (m.stat.meaninertia * max(m.nv, 1))
        block("float gradient2 = 0.0f, decrement = 0.0f; Search taken = {0.0f, 0.0f};")
        block("bool converged = false, same = false;  // whether the last step left all rows on their sides")
        with block.loop("iteration", option.iterations) as iteration:
            self._direction(iteration)
            limits = f"{literal(scale)}, {literal(tolerance(m))}"
            small = f"Converged::small(taken, {limits})"
            begins = f"{small} || Converged::flat(gradient2, decrement, {limits})"
            iteration(f"if (iteration > 0 && ({begins})) {{ converged = true; break; }}")
            self._project(iteration)
            self._line_search(iteration, scale)
            iteration("const float alpha = taken.alpha;")
            iteration("if (alpha == 0.0f) { converged = true; break; }")
            self._advance(iteration)
            # What is left of a Newton step; of a second one on the same parabola, rounding.
            iteration("const float left = (1.0f - alpha) * (1.0f - alpha);")
            ends = f"repeated || {small} || Converged::flat(gradient2 * left, decrement * left, {limits})"
            iteration(f"if (same && ({ends})) {{ converged = true; break; }}")
        block(f"if (!converged && !{small}) overflow |= LIMIT_REACHED;")

    def read_touch(self, block: Block) -> None:
        """Sets the touch sensors from the forces that were found."""
        block(f"for (int i = 0; i < {len(self.touch)}; ++i) touch[i] = 0.0f;")
        if self.ground.count:
            self.touch.add(block, "0", "ground", self.ground.pyramid.normal_force())
        if self.dense.count:
            self.touch.add(block, "ground", "contacts", self.dense.pyramid.normal_force())

    def read_contact_forces(self, block: Block, row: str | None = None) -> None:
        """Writes the forces of the contacts on the geoms that were asked for, into a row if there are several."""
        self.contact_forces.clear(block, row)
        for rows, first, end in ((self.ground, "0", "ground"), (self.dense, "ground", "contacts")):
            if rows.count:
                self.contact_forces.add(block, (first, end), rows.pyramid.force(rows.directions), row)

    def _direction(self, block: Block) -> None:
        """Sets ``search`` to -H^-1 gradient, and the two measures of convergence."""
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
        factor = tree.factor(stiffness, diagonal)
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
        block.set("gradient2", dot(gradient, gradient))
        block.set("decrement", dot(gradient, solution))
        for i, entry in enumerate([block.keep(entry) for entry in solution]):
            block.set(f"search[{i}]", -entry)

    def _project(self, block: Block) -> None:
        """Sets how residuals and M qacc change along the search direction."""
        search = cells("search", self.m.nv)
        self.ground.project(block, search)
        self.limits.project(block, search)
        self.friction.project(block, search)
        self.dense.project(block)
        for i, product in enumerate(self.tree.mass_times(search)):
            block.set(f"M_search[{i}]", product)

    def _line_search(self, block: Block, scale: float) -> None:
        m, nv, option = self.m, self.m.nv, self.m.opt
        search = cells("search", nv)
        residual = [cell(f"M_qacc[{i}]") - cell(f"force[{i}]") for i in range(nv)]
        sums = (dot(search, residual), dot(search, cells("M_search", nv)), dot(search, search))
        block(f"const float quadratic[3] = {{{', '.join([block.value(x) for x in sums])}}};")
        block("float whole[4] = {0.0f, 0.0f, 0.0f, 0.0f};")
        block(self._each_row(WHOLE, WHOLE_FRICTION))
        block("const auto add_rows = [&](const float* alphas, const int n, float* sums) {")
        block(self._each_row(STEPS, STEPS_FRICTION))
        block("};")
        block("const auto line_search = [&]() {")
        tolerances = literal(scale), literal(tolerance(m) * option.ls_tolerance), literal(near(m))
        block(shared.line_search(*tolerances, str(option.ls_iterations)))
        block("};")
        block("taken = line_search();")

    def _each_row(self, body: str, of_friction: str) -> str:
        """Returns C++ that runs ``body`` for each row, with its x, v and D; of dry friction another, with its bound."""
        loops = [self.limits.loop(body)]
        if self.ground.count:
            loops.append(self.ground.pyramid.loop("0", "ground", body))
        if self.dense.count:
            loops.append(self.dense.pyramid.loop("ground", "contacts", body))
        if self.friction.count:
            loops.append(f"{{ {self.friction.loop(of_friction)} }}")
        return "\n".join(loops)

    def _advance(self, block: Block) -> None:
        """Moves along the direction, and notes whether a row changed sides."""
        for i in range(self.m.nv):
            block(f"qacc[{i}] += alpha * search[{i}]; M_qacc[{i}] += alpha * M_search[{i}];")
        block("bool changed = false;")
        block(self.limits.advance())
        block(self.friction.advance())
        if self.ground.count:
            block(self.ground.pyramid.advance("0", "ground"))
        if self.dense.count:
            block(self.dense.pyramid.advance("ground", "contacts"))
        block("const bool repeated = same;")
        block("same = !changed;")
