"""The Newton solver of one world: minimises the cost of constraints over accelerations, traced for one model.

    minimise  1/2 (a - a_smooth)' M (a - a_smooth) + the cost of the rows

Each iteration solves H s = -gradient with H = M + J' D J over the active rows, and searches along s for the minimum of
the cost, which is piecewise quadratic and convex there. While no row changes sides, H and the direction stay what they
are. Source: MuJoCo's documentation, chapter Computation ("Solver algorithms", Newton). Bracketing, tolerances and
stopping tests are those of mujoco_warp, so that both engines stop at the same iteration.
"""

from collections.abc import Callable, Sequence

from torchrl_loco.sim.compiled.collision import Pair
from torchrl_loco.sim.compiled.constraints import DryFriction, JointLimits, Variables, tolerance
from torchrl_loco.sim.compiled.dense_contacts import DenseContacts
from torchrl_loco.sim.compiled.dynamics import Dynamics
from torchrl_loco.sim.compiled.ground_contacts import GroundContacts
from torchrl_loco.sim.compiled.sensors import ContactForces, TouchSensors
from torchrl_loco.sim.compiled.symbols import Block, cell, cells, dot, literal, total

LINE_SEARCH = """
// Cost, slope and curvature along the search direction at a step, relative to the cost at zero.
struct Point { float step, cost, slope, curvature; };
const float slope_smooth = SLOPE_SMOOTH, curvature_smooth = CURVATURE_SMOOTH, length = SQRT(LENGTH2);
auto smooth = [&](float step) {
  const float cost = step * (slope_smooth + 0.5f * step * curvature_smooth);
  return Point{step, cost, slope_smooth + step * curvature_smooth, curvature_smooth};
};
// A row whose residual y is x + step * v costs D / 2 y^2 where that is negative. Its change of cost is no difference of
// costs where it stays negative: beside what a deep contact costs, a single number has no room for what is gained.
#define ROW const float slope = D * v, curvature = slope * v, half = 0.5f * D, at_zero = wp::min(x, 0.0f);
#define ADD_ROW(p) { \\
  const float y = wp::min(fmaf(p.step, v, x), 0.0f); \\
  const float moved = y < 0.0f && x < 0.0f ? p.step * v : y - at_zero; \\
  p.cost = fmaf(half * (y + at_zero), moved, p.cost); \\
  p.slope = fmaf(slope, y, p.slope); \\
  p.curvature += y < 0.0f ? curvature : 0.0f; }
// A row of dry friction: quadratic up to the largest force, linear beyond.
#define FRICTION_COST(y) (fabsf(y) < bound ? 0.5f * D * (y) * (y) : limit * (fabsf(y) - 0.5f * bound))
#define ADD_FRICTION(p) { \\
  const float y = fmaf(p.step, v, x); const bool inside = fabsf(y) < bound; \\
  p.cost += inside && fabsf(x) < bound ? 0.5f * D * (x + y) * (p.step * v) : FRICTION_COST(y) - FRICTION_COST(x); \\
  p.slope += v * (inside ? D * y : y < 0.0f ? -limit : limit); \\
  p.curvature += inside ? D * v * v : 0.0f; }

float constraint_cost = 0.0f, row_curvature = 0.0f;
Point zero{0.0f, 0.0f, slope_smooth, curvature_smooth};
EACH_ROW({
  if (x < 0.0f) { constraint_cost += 0.5f * D * x * x; zero.slope += D * v * x; row_curvature += D * v * v; }
})
zero.curvature += row_curvature;
EACH_FRICTION({ const float bound = DIV(limit, D); constraint_cost += FRICTION_COST(x); ADD_FRICTION(zero) })
const float slope_tolerance = wp::max(LS_TOLERANCE * DIV(length, SCALE), 1e-6f);
const float slope_scale = SQRT(2.0f * wp::max(constraint_cost, 0.0f) * wp::max(row_curvature, 0.0f));
const float rounding = 8.0f * 1.1920929e-07f * (slope_scale + fabsf(slope_smooth));
const float small_slope = wp::max(slope_tolerance, rounding);
alpha = 0.0f;
improvement = 0.0f;
if (!(fabsf(zero.slope) < rounding)) {
  Point first = smooth(zero.curvature == 0.0f ? 0.0f : -DIV(zero.slope, zero.curvature));
  EACH_ROW({ ROW ADD_ROW(first) })
  EACH_FRICTION({ const float bound = DIV(limit, D); ADD_FRICTION(first) })
  if (fabsf(first.slope) < small_slope && first.cost < 0.0f) {
    alpha = first.step;
    improvement = -first.cost;
  } else {
    Point low = first.slope < zero.slope ? first : zero, high = first.slope < zero.slope ? zero : first;
    #pragma unroll 1
    for (int search_step = 0; search_step < LS_ITERATIONS; ++search_step) {
      Point from_low = smooth(low.curvature == 0.0f ? low.step : low.step - DIV(low.slope, low.curvature));
      Point from_high = smooth(high.curvature == 0.0f ? high.step : high.step - DIV(high.slope, high.curvature));
      Point middle = smooth(0.5f * (low.step + high.step));
      EACH_ROW({ ROW ADD_ROW(from_low) ADD_ROW(from_high) ADD_ROW(middle) })
      EACH_FRICTION({
        const float bound = DIV(limit, D);
        ADD_FRICTION(from_low) ADD_FRICTION(from_high) ADD_FRICTION(middle)
      })
      float best = 0.0f;
      bool found = false;
      auto consider = [&](const Point& p) {
        const bool flat = fabsf(p.slope) < small_slope && p.cost < 0.0f;
        if (flat && p.cost < best) { best = p.cost; alpha = p.step; improvement = -p.cost; }
        found |= flat;
      };
      consider(from_low); consider(from_high); consider(middle);
      if (found) break;
      bool moved = false;
      auto closer = [](const Point& end, const Point& p) {
        return (end.slope < p.slope && p.slope < 0.0f) || (end.slope > p.slope && p.slope > 0.0f);
      };
      auto move = [&](Point& end, const Point& p, bool replace) { if (replace) { end = p; moved = true; } };
      move(low, from_low, closer(low, from_low));
      move(low, middle, closer(low, middle));
      move(low, from_high, closer(low, from_high));
      move(high, from_high, closer(high, from_high) || (high.slope < 0.0f && from_high.slope > 0.0f));
      move(high, middle, closer(high, middle));
      move(high, from_low, closer(high, from_low));
      if (low.cost < 0.0f || high.cost < 0.0f) {
        alpha = low.cost < high.cost ? low.step : high.step;
        improvement = -wp::min(low.cost, high.cost);
      }
      const bool low_done = low.cost < 0.0f && low.slope < 0.0f && low.slope > -slope_tolerance;
      const bool high_done = high.cost < 0.0f && high.slope > 0.0f && high.slope < slope_tolerance;
      if (!moved || low_done || high_done) break;
    }
  }
}
"""
"""Line search by bracketing: Newton steps from both ends, and bisection. It leaves ``alpha`` and ``improvement``."""


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
        block("float gradient2 = 0.0f, decrement = 0.0f, improvement = 0.0f, alpha = 0.0f;")
        block("bool converged = false, same = false;  // whether the last step left all rows on their sides")
        with block.loop("iteration", option.iterations) as iteration:
            self._direction(iteration)
            small = f"(improvement > 0.0f && improvement * {literal(scale)} < {literal(tolerance(m))})"
            slope = f"{literal(scale)} * SQRT(LEFT gradient2) < {literal(tolerance(m))}"
            flat = f"({slope} || LEFT 0.5f * {literal(scale)} * decrement < {literal(tolerance(m))})"
            iteration(f"if (iteration > 0 && ({small} || {flat.replace('LEFT ', '')})) {{ converged = true; break; }}")
            self._project(iteration)
            self._line_search(iteration, scale)
            iteration("if (alpha == 0.0f) { converged = true; break; }")
            self._advance(iteration)
            # What is left of a Newton step; of a second one on the same parabola, rounding.
            iteration("const float left = (1.0f - alpha) * (1.0f - alpha);")
            done = f"repeated || {small} || {flat.replace('LEFT', 'left *')}"
            iteration(f"if (same && ({done})) {{ converged = true; break; }}")
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
        text = LINE_SEARCH
        for word, value in {
            "SLOPE_SMOOTH": block.value(dot(search, residual)),
            "CURVATURE_SMOOTH": block.value(dot(search, cells("M_search", nv))),
            "LENGTH2": block.value(dot(search, search)),
            "LS_TOLERANCE": literal(tolerance(m) * option.ls_tolerance),
            "LS_ITERATIONS": str(option.ls_iterations),
            "SCALE": literal(scale),
        }.items():
            text = text.replace(word, value)
        block(_expand(_expand(text, "EACH_ROW", self._each_row), "EACH_FRICTION", self._each_friction))

    def _each_row(self, body: str) -> str:
        """Returns C++ that runs ``body`` for each row, with its x, v and D."""
        loops = [self.limits.loop(body)]
        if self.ground.count:
            loops.append(self.ground.pyramid.loop("0", "ground", body))
        if self.dense.count:
            loops.append(self.dense.pyramid.loop("ground", "contacts", body))
        return "\n".join(loops)

    def _each_friction(self, body: str) -> str:
        return f"{{ {self.friction.loop(body)} }}" if self.friction.count else ""

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


def _expand(text: str, word: str, loop: Callable[[str], str]) -> str:
    """Returns a text with each ``word({body})`` replaced by the loop around ``body``."""
    while (start := text.find(word + "(")) >= 0:
        depth, end = 0, start + len(word)
        while True:
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
            if depth == 0:
                break
        body = text[start + len(word) + 1 : end - 1].strip().removeprefix("{").removesuffix("}")
        text = text[:start] + loop(body) + text[end:]
    return text
