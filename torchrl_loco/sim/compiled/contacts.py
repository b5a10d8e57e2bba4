"""Contact rows of one substep, traced for one model.

A contact has up to three directions, a normal and two tangents scaled by friction, whose combinations are the edges of
a pyramid (:class:`Pyramid`); each edge is a row.

=======================  ==================================================================================
:class:`GroundContacts`  J acts on one body, so that ``J' D J`` is a stiffness of that body
:class:`DenseContacts`   J is stored: contacts between moving bodies, and limits of ball joints
=======================  ==================================================================================
"""

import dataclasses
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision import CAPSULE, Corner, Pair, corners, frame, geom_pose
from torchrl_loco.sim.compiled.constraints import Softness, Table, Variables
from torchrl_loco.sim.compiled.dynamics import BALL, Dynamics
from torchrl_loco.sim.compiled.sensors import TouchSensors
from torchrl_loco.sim.compiled.symbols import (
    Block,
    Scalar,
    cell,
    cross,
    dot,
    literal,
    name,
    names,
    scalar,
    select,
    total,
    zeros,
)

MAX_DENSE = 12
"""Places for contacts between moving bodies. What finds none is dropped and counted."""


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

    def residual(self, edge: tuple[int, int, int], x: Sequence[Scalar]) -> Scalar:
        """Returns the residual of an edge from those of the directions."""
        sign, direction, _ = edge
        return x[0] + sign * x[direction] if direction else x[0]

    def response(self, weight: Scalar, x: Sequence[Scalar]) -> tuple[list[Scalar], dict[tuple[int, int], Scalar]]:
        """Returns gradient and Hessian of the cost with respect to the directions.

        Args:
            weight: of an edge.
            x: residuals of the directions.
        """
        gradient = [scalar(0) for _ in self.directions]
        hessian = {(0, 0): scalar(0)}
        for sign, direction, count in self.edges:
            residual = self.residual((sign, direction, count), x)
            active = select(residual, "<", 0, count * weight, 0)
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
        gradient, _ = self.response(cell("contact_D[k]"), [cell(f"contact_x{d}[k]") for d in self.directions])
        return -gradient[0]

    def loop(self, first: str, count: str, body: str) -> str:
        """Returns a C++ loop over the edges of contacts, with x, v and D."""
        lines = [f"#pragma unroll 1\nfor (int k = {first}; k < {count}; ++k) {{"]
        for sign, direction, copies in self.edges:
            x, v = (
                f"contact_{field}0[k]"
                + (f" {'+' if sign > 0 else '-'} contact_{field}{direction}[k]" if direction else "")
                for field in "xv"
            )
            weight = f"{literal(copies)} * contact_D[k]" if copies > 1 else "contact_D[k]"
            lines.append(f"  {{ const float x = {x}, v = {v}, D = {weight}; {body} }}")
        return "\n".join([*lines, "}"])

    def advance(self, first: str, count: str) -> str:
        """Returns C++ that moves the residuals along the search direction, and notes whether an edge changed sides."""
        edges = self.loop(first, count, "changed |= (x + alpha * v < 0.0f) != (x < 0.0f);").removesuffix("}")
        moves = " ".join(f"contact_x{d}[k] += alpha * contact_v{d}[k];" for d in self.directions)
        return f"{edges}  {moves}\n}}"


FRICTIONLESS = Pyramid(((0, 0, 1),))
FLAT = Pyramid(((1, 1, 1), (-1, 1, 1), (0, 0, 2)))
"""Nothing moves along the second tangent: its two edges are the normal, twice."""
FULL = Pyramid(((1, 1, 1), (-1, 1, 1), (1, 2, 1), (-1, 2, 1)))


def contact_weight(m: mujoco.MjModel, pair: Pair) -> float:
    """Returns the approximate inverse inertia along a row of a contact."""
    if pair.condim == 1:
        return pair.weight
    return pair.weight * (1 + pair.friction**2) * 2 * pair.friction**2 / m.opt.impratio


class GroundContacts:
    """Contacts of spheres and capsules with planes of the world. All have a place.

    Args:
        tree: the dynamics.
        found: pairs of geoms that may touch.
        touch: the sensors that may feel them.
    """

    def __init__(self, tree: Dynamics, found: list[Pair], touch: TouchSensors) -> None:
        m, self.tree, self.touch = tree.m, tree, touch
        self.corners = corners(m, found)
        self.count = len(self.corners)
        self.bodies = sorted({self.body(corner) for corner in self.corners})
        twists = tree.twists(names("search", m.nv))
        self.live = [i for i in range(6) if any(scalar(twists[b][i]).constant != 0 for b in self.bodies)]
        self._frames = [self._frame(corner) for corner in self.corners]
        self._lever = self._varying("lever", [self._point(corner) for corner in self.corners])
        self._directions = [
            self._varying(title, [frames[i] for frames in self._frames])
            for i, title in enumerate(("normal", "tangent"))
        ]
        normal, tangent = self._directions
        self._directions.append(cross(normal, tangent))
        if all(corner.pair.condim == 1 for corner in self.corners):
            self.pyramid = FRICTIONLESS
        elif self._velocity(self._stored_twist())[2].constant == 0:
            self.pyramid = FLAT
        else:
            self.pyramid = FULL
        packed = len(self.live) * (len(self.live) + 1) // 2
        self.arrays = {
            "body_twist": len(self.bodies) * len(self.live),
            "body_gradient": len(self.bodies) * len(self.live),
            "body_stiffness": len(self.bodies) * packed,
            **{f"contact_{title}{i}": self.count for title in ("lever", "normal", "tangent") for i in range(3)},
        }

    def body(self, corner: Corner) -> int:
        """Returns the body of a corner."""
        return int(self.tree.m.geom_bodyid[corner.pair.geoms[1]])

    def _plane(self, corner: Corner) -> tuple[np.ndarray, np.ndarray]:
        """Returns a point and the normal of the plane of a corner, ``(3,)`` each."""
        m, plane = self.tree.m, corner.pair.geoms[0]
        position, axis = geom_pose(m, self.tree.poses, plane)
        return position, axis

    def _end(self, corner: Corner) -> np.ndarray:
        """Returns the center of the sphere at a corner, ``(3,)`` (m)."""
        m, geom = self.tree.m, corner.pair.geoms[1]
        center, axis = geom_pose(m, self.tree.poses, geom)
        return center + axis * (corner.end * m.geom_size[geom, 1]) if corner.end else center

    def _distance(self, corner: Corner) -> Scalar:
        position, normal = self._plane(corner)
        return dot(normal, self._end(corner) - position) - self.tree.m.geom_size[corner.pair.geoms[1], 0]

    def _point(self, corner: Corner) -> np.ndarray:
        """Returns the contact point from the center of mass of the body's tree, ``(3,)`` (m)."""
        depth = self.tree.m.geom_size[corner.pair.geoms[1], 0] + 0.5 * self._distance(corner)
        return self._end(corner) - self.tree.com[self.body(corner)] - self._plane(corner)[1] * depth

    def _frame(self, corner: Corner) -> tuple[np.ndarray, np.ndarray]:
        """Returns the normal, and the first tangent times the friction coefficient, ``(3,)`` each."""
        pair = corner.pair
        normal = self._plane(corner)[1]
        axis = geom_pose(self.tree.m, self.tree.poses, pair.geoms[1])[1] if corner.end else None
        return normal, frame(normal, axis) * pair.friction

    def _varying(self, title: str, vectors: list[np.ndarray]) -> np.ndarray:
        """Returns a vector of contact ``k``: constants where all contacts agree, else what is stored."""

        def component(i: int) -> Scalar:
            values = {scalar(vector[i]) for vector in vectors}
            agreed = values.pop() if len(values) == 1 else None
            return agreed if agreed is not None and agreed.constant is not None else cell(f"contact_{title}{i}[k]")

        return np.array([component(i) for i in range(3)], dtype=object)

    def _stored_twist(self) -> np.ndarray:
        """Returns the twist of the body of contact ``k``, ``(6,)``."""
        twist = zeros(6)
        for i, component in enumerate(self.live):
            twist[component] = cell(f"body_twist[{len(self.live)} * contact_body[k] + {i}]")
        return twist

    def _velocity(self, twist: np.ndarray) -> list[Scalar]:
        """Returns the velocity at contact ``k`` along the normal and the scaled tangents."""
        linear = twist[3:] + cross(twist[:3], self._lever)
        return [dot(direction, linear) for direction in self._directions]

    def create(self, block: Block, variables: Variables) -> None:
        """Finds the contacts, and sets weights and residuals."""
        block("int ground = 0;")
        for i, (corner, (normal, tangent)) in enumerate(zip(self.corners, self._frames, strict=True)):
            position = self._distance(corner) - corner.pair.margin
            with block.scope(f"if ({block.value(position)} < 0.0f)") as touching:
                touching("const int k = ground++;")
                touching(f"contact_corner[k] = {i}; contact_body[k] = {self.bodies.index(self.body(corner))};")
                touching.set("contact_x0[k]", position)
                for title, vector in (("lever", self._point(corner)), ("normal", normal), ("tangent", tangent)):
                    for component in range(3):
                        touching.set(f"contact_{title}{component}[k]", vector[component])
                self._feel(touching, corner)
        if self.corners:
            self._create_rows(block, variables)

    def _create_rows(self, block: Block, variables: Variables) -> None:
        """Sets weights and residuals.

        It is a loop over the contacts: at the corners, the worlds of a warp would wait for each other's.
        """
        m, (_, qvel, qacc) = self.tree.m, variables
        table = Table(block, "corner", "contact_corner[k]")
        rows = [Softness.make(m, corner.pair.solref, corner.pair.solimp) for corner in self.corners]
        softness = Softness.from_table(table, rows)
        weight = table.column("weight", [contact_weight(m, corner.pair) for corner in self.corners])
        share = table.column("share", [self.pyramid.share(corner.pair.condim) for corner in self.corners])
        for damping in sorted({float(np.float32(row.damping)) for row in rows}):
            with block.scope("if (ground > 0)") as some:
                self._store_twists(some, [a + damping * v for a, v in zip(qacc, qvel, strict=True)])
                with some.loop("k", "ground") as contact:
                    if scalar(softness.damping).constant is None:
                        contact(f"if ({contact.value(softness.damping)} != {literal(damping)}) continue;")
                    position = contact.keep(cell("contact_x0[k]"))
                    inertia, residual = softness.row(weight, position)
                    contact.set("contact_D[k]", inertia * share)
                    self._set(contact, "x", residual)

    def _feel(self, block: Block, corner: Corner) -> None:
        """Notes which touch sensors feel contact ``k``."""
        bodies = self.tree.m.geom_bodyid[list(corner.pair.geoms)]
        first, second = (self.touch.of_body(body) for body in bodies)
        if len(self.touch):
            block("contact_zones[k] = 0;")
        for s in range(len(self.touch)):
            if (first | second) >> s & 1:
                point, normal = self._point(corner) + self.tree.com[bodies[1]], self._plane(corner)[1]
                self.touch.mark(block, s, point, normal if first >> s & 1 else -normal)

    def _store_twists(self, block: Block, velocity: list[Scalar]) -> None:
        """Stores the twists of the bodies for velocities of the joints."""
        twists = self.tree.twists(velocity)
        for b, body in enumerate(self.bodies):
            for i, component in enumerate(self.live):
                block.set(f"body_twist[{len(self.live) * b + i}]", twists[body][component])

    def _set(self, block: Block, field: str, residual: Scalar | float = 0.0) -> None:
        velocity = self._velocity(self._stored_twist())
        for d in self.pyramid.directions:
            block.set(f"contact_{field}{d}[k]", velocity[d] if d else residual + velocity[d])

    def project(self, block: Block, search: list[Scalar]) -> None:
        """Sets how the residuals change along the search direction."""
        if self.count:
            with block.scope("if (ground > 0)") as some:
                self._store_twists(some, search)
                with some.loop("k", "ground") as contact:
                    self._set(contact, "v")

    def gather(self, block: Block) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Adds up gradient and Hessian of the cost at each body.

        Returns:
            forces ``(6,)`` and stiffnesses ``(6, 6)``, one of each for every body of the model.
        """
        m, live, pyramid = self.tree.m, self.live, self.pyramid
        forces, stiffness = [zeros(6) for _ in range(m.nbody)], [zeros(6, 6) for _ in range(m.nbody)]
        if not self.count:
            return forces, stiffness
        packed = [(i, j) for i in range(len(live)) for j in range(i + 1)]
        for title in ("body_gradient", "body_stiffness"):
            block(f"for (int i = 0; i < {self.arrays[title]}; ++i) {title}[i] = 0.0f;")
        with block.loop("k", "ground") as contact:
            x = [cell(f"contact_x{d}[k]") for d in pyramid.directions]
            gradient, hessian = pyramid.response(cell("contact_D[k]"), x)
            wrenches = [
                np.concatenate([cross(self._lever, self._directions[d]), self._directions[d]])
                for d in pyramid.directions
            ]
            force = total(gradient[d] * wrenches[d] for d in pyramid.directions)
            for i, component in enumerate(live):
                contact.set(f"body_gradient[{len(live)} * contact_body[k] + {i}]", force[component], "+=")
            columns = [
                total(
                    hessian[min(d, e), max(d, e)] * wrenches[e]
                    for e in pyramid.directions
                    if (min(d, e), max(d, e)) in hessian
                )
                for d in pyramid.directions
            ]
            for at, (i, j) in enumerate(packed):
                entry = total(wrenches[d][live[i]] * columns[d][live[j]] for d in pyramid.directions)
                contact.set(f"body_stiffness[{len(packed)} * contact_body[k] + {at}]", entry, "+=")
        for b, body in enumerate(self.bodies):
            for i, component in enumerate(live):
                forces[body][component] = cell(f"body_gradient[{len(live) * b + i}]")
            for at, (i, j) in enumerate(packed):
                entry = cell(f"body_stiffness[{len(packed) * b + at}]")
                stiffness[body][live[i], live[j]] = stiffness[body][live[j], live[i]] = entry
        return forces, stiffness


SEGMENTS = """
// Closest points of the segments p0 + s (p1 - p0) and q0 + t (q1 - q0): one pair of weights (s, t), or two if the
// segments are parallel. (The end points of each overlap, and points instead of segments, are cases of their own.)
const wp::vec3 pd = p_half + p_half, qd = q_half + q_half, p0 = p - p_half, q0 = q - q_half, apart = p0 - q0;
const float pp = wp::dot(pd, pd), qq = wp::dot(qd, qd), pq = wp::dot(pd, qd);
const float pa = wp::dot(pd, apart), qa = wp::dot(qd, apart);
const wp::vec3 across = wp::cross(pd, qd);
const float sine2 = wp::dot(across, across);  // times pp * qq
float s[2] = {0.0f, 0.0f}, t[2] = {0.0f, 0.0f};
int points = 1;
if (pp <= 1e-15f || qq <= 1e-15f) {
  if (qq > 1e-15f) t[0] = CLAMP01(DIV(qa, qq));
  else if (pp > 1e-15f) s[0] = CLAMP01(DIV(-pa, pp));
} else {
  points = sine2 > 1e-8f * pp * qq ? 1 : 2;
  for (int i = 0; i < points; ++i) {
    float u = points == 2 ? (float)i : CLAMP01(DIV(wp::dot(across, wp::cross(qd, apart)), sine2));
    float w = DIV(pq * u + qa, qq);
    if (w < 0.0f) { w = 0.0f; u = CLAMP01(DIV(-pa, pp)); }
    else if (w > 1.0f) { w = 1.0f; u = CLAMP01(DIV(pq - pa, pp)); }
    s[i] = u; t[i] = w;
  }
}
"""

CONTACT_FRAME = """
const float distance = WP_LENGTH(gap) - (p_radius + q_radius), position = distance - margin;
if (!(position < 0.0f)) continue;
if (contacts >= MAX_CONTACTS) { overflow |= NO_PLACE; continue; }
const float length = WP_LENGTH(gap);
const wp::vec3 n = length > 0.0f ? gap * DIV(1.0f, length) : wp::vec3(1.0f, 0.0f, 0.0f);
const wp::vec3 side = fabsf(n[1]) < 0.5f ? wp::vec3(0.0f, 1.0f, 0.0f) : wp::vec3(0.0f, 0.0f, 1.0f);
const wp::vec3 level = side - n * wp::dot(n, side);
const wp::vec3 tangent = level * DIV(1.0f, WP_LENGTH(level)), other_tangent = wp::cross(n, tangent);
const wp::vec3 at = p0 + pd * s[i] + n * (p_radius + 0.5f * distance);
"""


class DenseContacts:
    """Contacts whose Jacobians are stored: between moving bodies, or with spheres and capsules of the world.

    A limit of a ball joint is one more, without friction. Pairs whose bounding spheres overlap are looked at one after
    the other.

    Args:
        tree: the dynamics.
        found: pairs of geoms that may touch.
        ground: the contacts that come before these.
        touch: the sensors that may feel them.
    """

    def __init__(self, tree: Dynamics, found: list[Pair], ground: GroundContacts, touch: TouchSensors) -> None:
        m, self.tree, self.ground, self.touch = tree.m, tree, ground, touch
        planes = {corner.pair for corner in ground.corners}
        self.pairs = [pair for pair in found if pair not in planes]
        self.balls = [j for j in range(m.njnt) if m.jnt_limited[j] and m.jnt_type[j] == BALL]
        self.geoms = sorted({geom for pair in self.pairs for geom in pair.geoms})
        self.count = min(2 * len(self.pairs), MAX_DENSE) + len(self.balls)
        self.pyramid = FULL if any(pair.condim > 1 for pair in self.pairs) else FRICTIONLESS
        self.modes = len(self.pyramid.directions) * self.count
        self.arrays = {
            **{f"dense_J{d}": self.count * m.nv for d in self.pyramid.directions},
            "geom_center": 3 * len(self.geoms),
            "geom_half": 3 * len(self.geoms),
            "mode_J": self.modes * m.nv,
            "mode_weight": self.modes,
            "mode_solution": self.modes * m.nv,
        }

    def create(self, block: Block, variables: Variables) -> None:
        """Finds the contacts, and sets Jacobians, weights and residuals."""
        block("int contacts = ground;")
        if self.pairs:
            self._find(block, variables)
        for joint in self.balls:
            self._limit_ball(block, joint, variables)

    def _find(self, block: Block, variables: Variables) -> None:
        m, tree, nv = self.tree.m, self.tree, self.tree.m.nv
        origin = tree.com[next(b for b in range(1, m.nbody) if m.body_weldid[b])]
        half = {g: float(m.geom_size[g, 1]) if m.geom_type[g] == CAPSULE else 0.0 for g in self.geoms}
        poses = {g: geom_pose(m, tree.poses, g) for g in self.geoms}
        for i, g in enumerate(self.geoms):
            center, axis = poses[g]
            for component in range(3):
                block.set(f"geom_center[{3 * i + component}]", center[component] - origin[component])
                block.set(f"geom_half[{3 * i + component}]", axis[component] * half[g])
        index = "char" if len(self.pairs) <= 256 else "short"
        block(f"int candidates = 0; unsigned {index} candidate[{len(self.pairs)}];")
        for i, pair in enumerate(self.pairs):
            a, b = pair.geoms
            offset = (poses[b][0] - origin) - (poses[a][0] - origin)
            reach = sum(m.geom_size[g, 0] + half[g] for g in (a, b)) + max(pair.margin, 0.0)
            block(f"if ({block.value(dot(offset, offset))} < {literal(reach**2)}) candidate[candidates++] = {i};")
        table = Table(block, "pair", "pair")
        geoms = [
            table.integers(title, [self.geoms.index(pair.geoms[i]) for pair in self.pairs])
            for i, title in enumerate(("first", "second"))
        ]
        masks = [
            table.integers(title, [self._moved_by(int(m.geom_bodyid[pair.geoms[i]])) for pair in self.pairs])
            for i, title in enumerate(("first_dofs", "second_dofs"))
        ]
        radii = [
            table.column(title, [float(m.geom_size[pair.geoms[i], 0]) for pair in self.pairs])
            for i, title in enumerate(("first_radius", "second_radius"))
        ]
        margin = table.column("margin", [pair.margin for pair in self.pairs])
        shares = [contact_weight(m, pair) for pair in self.pairs]
        weight = table.column("weight", shares)
        share = table.column("share", [self.pyramid.share(pair.condim) for pair in self.pairs])
        friction = table.column("friction", [pair.friction for pair in self.pairs])
        softness = Softness.from_table(table, [Softness.make(m, pair.solref, pair.solimp) for pair in self.pairs])
        touching = [
            table.integers(title, [self.touch.of_body(m.geom_bodyid[pair.geoms[i]]) for pair in self.pairs])
            for i, title in enumerate(("first_sensors", "second_sensors") if len(self.touch) else ())
        ]
        with block.loop("c", "candidates") as candidate:
            candidate(f"const int pair = candidate[c], first = {geoms[0]}, second = {geoms[1]};")
            candidate(f"const int first_dofs = {masks[0]}, second_dofs = {masks[1]};")
            candidate(f"const float p_radius = {candidate.value(radii[0])}, q_radius = {candidate.value(radii[1])};")
            candidate(f"const float margin = {candidate.value(margin)};")
            for variable, geom in (("p", "first"), ("q", "second")):
                for suffix, source in (("", "center"), ("_half", "half")):
                    parts = ", ".join(f"geom_{source}[3 * {geom} + {i}]" for i in range(3))
                    candidate(f"const wp::vec3 {variable}{suffix}({parts});")
            candidate(SEGMENTS)
            with candidate.loop("i", "points") as point:
                point("const wp::vec3 gap = q0 + qd * t[i] - p0 - pd * s[i];")
                point(CONTACT_FRAME.replace("MAX_CONTACTS", f"ground + {self.count - len(self.balls)}"))
                point("const int k = contacts++;")
                axes = [np.array(names(title, 3), dtype=object) for title in ("n", "tangent", "other_tangent")]
                axes = [axes[0], axes[1] * friction, axes[2] * friction]
                contact_point = np.array(names("at", 3), dtype=object)
                jacobians = [[scalar(0)] * nv for _ in self.pyramid.directions]
                for d in range(nv):
                    sign = name(f"(float)(((second_dofs >> {d}) & 1) - ((first_dofs >> {d}) & 1))")
                    lever = contact_point + origin - tree.com[m.dof_bodyid[d]]
                    for i in self.pyramid.directions:
                        moment = cross(lever, axes[i])
                        jacobians[i][d] = sign * dot(tree.cdof[d], np.concatenate([moment, axes[i]]))
                contact_weight_, residual = softness.row(weight, name("position"))
                self._store(point, jacobians, contact_weight_ * share, residual, softness.damping, variables)
                self._feel(point, touching, contact_point + origin)

    def _store(
        self,
        block: Block,
        jacobians: list[list[Scalar]],
        weight: Scalar,
        residual: Scalar,
        damping: float | Scalar,
        variables: Variables,
    ) -> None:
        """Stores contact ``k``."""
        nv, (_, qvel, qacc) = self.tree.m.nv, variables
        if len(self.touch):
            block("contact_zones[k] = 0;")
        block.set("contact_D[k]", weight)
        for i, jacobian in enumerate(jacobians):
            velocity = total(jacobian[d] * (qacc[d] + damping * qvel[d]) for d in range(nv))
            block.set(f"contact_x{i}[k]", (residual if i == 0 else 0) + velocity)
            for d in range(nv):
                block.set(f"dense_J{i}[(k - ground) * {nv} + {d}]", jacobian[d])

    def _feel(self, block: Block, sensors: list[str], at: np.ndarray) -> None:
        """Notes which touch sensors feel contact ``k``.

        Args:
            block: where the contact is made.
            sensors: C++ expressions of the sensors of either body.
            at: the contact in the world's frame (m), ``(3,)``.
        """
        for s in range(len(self.touch)):
            first, second = (f"{body} >> {s} & 1" for body in sensors)
            with block.scope(f"if (({first}) | ({second}))") as near:
                away = name(f"({first} ? 1.0f : -1.0f)")
                self.touch.mark(near, s, at, np.array(names("n", 3), dtype=object) * away)

    def _limit_ball(self, block: Block, joint: int, variables: Variables) -> None:
        """Adds the limit of a ball joint: one row against its rotation from the reference."""
        m, (qpos, *_) = self.tree.m, variables
        address, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
        softness = Softness.make(m, m.jnt_solref[joint], m.jnt_solimp[joint])
        with block.scope("") as scope:
            w, x, y, z = (scope.value(q) for q in qpos[address : address + 4])
            scope(f"const wp::vec3 imaginary({x}, {y}, {z});")
            scope(f"const float sine = WP_LENGTH(imaginary), half_angle = atan2f(sine, {w});")
            scope("const float turned = 2.0f * half_angle - (half_angle > 1.57079633f ? 6.28318531f : 0.0f);")
            scope(f"const float position = {literal(max(m.jnt_range[joint]) - m.jnt_margin[joint])} - fabsf(turned);")
            with scope.scope("if (position < 0.0f)") as violated:
                violated("const int k = contacts++;")
                violated("const wp::vec3 axis = imaginary * DIV(turned < 0.0f ? 1.0f : -1.0f, sine);")
                jacobians = [[scalar(0)] * m.nv for _ in self.pyramid.directions]
                for i in range(3):
                    jacobians[0][dof + i] = name(f"axis[{i}]")
                weight, residual = softness.row(m.dof_invweight0[dof], name("position"))
                share = self.pyramid.share(1)
                self._store(violated, jacobians, weight * share, residual, softness.damping, variables)

    def _moved_by(self, body: int) -> int:
        """Returns the degrees of freedom that move a body, as bits."""
        m, mask = self.tree.m, 0
        while body:
            mask |= sum(1 << d for d in self.tree.dofs(body))
            body = m.body_parentid[body]
        return mask

    def project(self, block: Block) -> None:
        """Sets how the residuals change along the search direction."""
        nv = self.tree.m.nv
        for d in self.pyramid.directions if self.count else ():
            with block.scope("for (int k = ground; k < contacts; ++k)") as contact:
                product = total(
                    cell(f"dense_J{d}[(k - ground) * {nv} + {i}]") * cell(f"search[{i}]") for i in range(nv)
                )
                contact.set(f"contact_v{d}[k]", product)

    def gather(self, block: Block) -> None:
        """Adds the forces to the gradient, and lists the Hessian as modes: weights and vectors of rank-one terms.

        The Hessian of a contact in its directions is factored (Cholesky without roots); weights of rounding are left
        out.
        """
        nv, directions = self.tree.m.nv, self.pyramid.directions
        block("int modes = 0;")
        with block.scope("for (int k = ground; k < contacts; ++k)") as contact:
            x = [cell(f"contact_x{d}[k]") for d in directions]
            gradient, hessian = self.pyramid.response(cell("contact_D[k]"), x)
            gradient = [contact.keep(entry) for entry in gradient]
            hessian = {key: contact.keep(entry) for key, entry in hessian.items()}
            jacobian = [[cell(f"dense_J{d}[(k - ground) * {nv} + {i}]") for i in range(nv)] for d in directions]
            contact(f"if (!({contact.value(hessian[0, 0])} > 0.0f)) continue;")
            for i in range(nv):
                contact.set(f"gradient[{i}]", total(gradient[d] * jacobian[d][i] for d in directions), "+=")
            if len(directions) == 1:
                self._add_mode(contact, hessian[0, 0], jacobian[0])
                return
            stiff = hessian[0, 0]
            lean = [contact.keep(hessian[0, d] / stiff) for d in (1, 2)]
            self._add_mode(
                contact,
                stiff,
                [jacobian[0][i] + lean[0] * jacobian[1][i] + lean[1] * jacobian[2][i] for i in range(nv)],
            )
            first = contact.keep(hessian[1, 1] - hessian[0, 1] * lean[0])
            mixed = contact.keep(scalar(0) - hessian[0, 1] * lean[1])
            with contact.scope(f"if ({contact.value(first)} > 1e-6f * {contact.value(stiff)})") as mode:
                slope = mode.keep(mixed / first)
                self._add_mode(mode, first, [jacobian[1][i] + slope * jacobian[2][i] for i in range(nv)])
            second = contact.keep(hessian[2, 2] - hessian[0, 2] * lean[1])
            shared = select(first, ">", 1e-6 * stiff, mixed * mixed / first, 0)
            last = contact.keep(second - shared)
            with contact.scope(f"if ({contact.value(last)} > 1e-6f * {contact.value(stiff)})") as mode:
                self._add_mode(mode, last, jacobian[2])

    def _add_mode(self, block: Block, weight: Scalar, vector: list[Scalar]) -> None:
        nv = self.tree.m.nv
        block.set("mode_weight[modes]", weight)
        for i in range(nv):
            block.set(f"mode_J[modes * {nv} + {i}]", vector[i])
        block("++modes;")

    def solve(self, block: Block, solve: Callable[[list[Scalar]], list[Scalar]]) -> None:
        """Sets ``solution`` to H^-1 gradient, adding the modes one after the other (Sherman and Morrison).

        Args:
            block: where it is computed.
            solve: returns (M + K)^-1 x, with the contacts of the ground in K.
        """
        nv = self.tree.m.nv
        with block.scope("for (int e = 0; e <= modes; ++e)") as mode:
            mode("const bool last = e == modes;")
            for i in range(nv):
                mode(f"const float right{i} = last ? gradient[{i}] : mode_J[e * {nv} + {i}];")
            for i, entry in enumerate(solve([name(f"right{i}") for i in range(nv)])):
                mode.set(f"solution[{i}]", entry)
            with mode.scope("for (int f = 0; f < e; ++f)") as earlier:
                product = total(cell(f"mode_J[f * {nv} + {i}]") * cell(f"solution[{i}]") for i in range(nv))
                share = earlier.keep(cell("mode_weight[f]") * product)
                for i in range(nv):
                    earlier.set(
                        f"solution[{i}]", cell(f"solution[{i}]") - share * cell(f"mode_solution[f * {nv} + {i}]")
                    )
            with mode.scope("if (!last)") as kept:
                product = total(cell(f"mode_J[e * {nv} + {i}]") * cell(f"solution[{i}]") for i in range(nv))
                weight = cell("mode_weight[e]")
                kept.set("mode_weight[e]", weight / (1 + weight * product))
                for i in range(nv):
                    kept.set(f"mode_solution[e * {nv} + {i}]", cell(f"solution[{i}]"))
