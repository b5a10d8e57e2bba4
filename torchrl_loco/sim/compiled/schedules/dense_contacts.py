"""Contacts whose Jacobians are stored, and limits of ball joints, traced for one model."""

from collections.abc import Callable
from typing import Any

import numpy as np

from torchrl_loco.sim.compiled.collision.pairs import Pair, contact_weight, half_length, least_regularisation
from torchrl_loco.sim.compiled.collision.planes import geom_pose
from torchrl_loco.sim.compiled.ir.symbols import (
    Block,
    Scalar,
    cell,
    cross,
    dot,
    literal,
    name,
    scalar,
    select,
    total,
    vec,
)
from torchrl_loco.sim.compiled.physics.constraints import Softness, Table, Variables, limited
from torchrl_loco.sim.compiled.physics.dynamics import BALL, Dynamics
from torchrl_loco.sim.compiled.physics.links import moved_by
from torchrl_loco.sim.compiled.physics.pyramid import FRICTIONLESS, FULL
from torchrl_loco.sim.compiled.physics.sensors import TouchSensors
from torchrl_loco.sim.compiled.schedules.ground_contacts import GroundContacts

MAX_DENSE = 12
"""Places for contacts between moving bodies. What finds none is dropped and counted."""

CONTACT = """
const Vec from = first_segment.at(nearest.first[i]), gap = second_segment.at(nearest.second[i]) - from;
float length;
const Vec n = Frame::normal(gap, first_segment.along, second_segment.along, length);
const float distance = length - (p_radius + q_radius), position = distance - margin;
if (!(position < 0.0f)) continue;
if (contacts >= MAX_CONTACTS) { flag(NO_PLACE); continue; }
const Vec tangent = Frame::tangent(n), other_tangent = n.cross(tangent), at = from + n * (p_radius + 0.5f * distance);
const int k = contacts++;
"""


class DenseContacts:
    """Contacts whose Jacobians are stored: between moving bodies, or with spheres and capsules of the world.

    A limit of a ball joint is one more, without friction. Pairs whose bounding spheres overlap are looked at one after
    the other. With ``with_frames`` directions and pairs are stored too, which the solver does without.

    Attributes:
        directions: of contact ``k``, if they are stored: the normal, and the two tangents times friction, ``(3,)``
            each.
    """

    def __init__(
        self,
        tree: Dynamics,
        found: list[Pair],
        ground: GroundContacts,
        touch: TouchSensors,
        *,
        with_frames: bool = False,
    ) -> None:
        m, self.tree, self.ground, self.touch, self._with_frames = tree.m, tree, ground, touch, with_frames
        planes = {corner.pair for corner in ground.corners}
        self.pairs = [pair for pair in found if pair not in planes]
        self.balls = limited(m, BALL)
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
        if with_frames:
            self.arrays.update({f"dense_{title}{i}": self.count for title in ("normal", "tangent") for i in range(3)})
        normal, tangent = (
            np.array([cell(f"dense_{title}{i}[k - ground]") for i in range(3)], dtype=object)
            for title in ("normal", "tangent")
        )
        self.directions = [normal, tangent, cross(normal, tangent)]

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
        half = {g: half_length(m, g) for g in self.geoms}
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

        def both(title: str, number: Callable[[int], Any], column: Callable[..., Any] = table.integers) -> list[Any]:
            """Returns columns of a number of the first geom of each pair, and of the second."""
            of = enumerate(("first", "second"))
            return [column(f"{which}{title}", [number(pair.geoms[i]) for pair in self.pairs]) for i, which in of]

        moved = moved_by(m)
        geoms = both("", self.geoms.index)
        masks = both("_dofs", lambda g: moved[m.geom_bodyid[g]])
        radii = both("_radius", lambda g: float(m.geom_size[g, 0]), table.column)
        margin = table.column("margin", [pair.margin for pair in self.pairs])
        shares = [contact_weight(m, pair) for pair in self.pairs]
        weight = table.column("weight", shares)
        least = table.column("least", [least_regularisation(pair) for pair in self.pairs])
        share = table.column("share", [self.pyramid.share(pair.condim) for pair in self.pairs])
        friction = table.column("friction", [pair.friction for pair in self.pairs])
        softness = Softness.from_table(table, [Softness.make(m, pair.solref, pair.solimp) for pair in self.pairs])
        touching = both("_sensors", lambda g: self.touch.of_body(m.geom_bodyid[g])) if len(self.touch) else []
        with block.loop("c", "candidates") as candidate:
            candidate(f"const int pair = candidate[c], first = {geoms[0]}, second = {geoms[1]};")
            candidate(f"const int first_dofs = {masks[0]}, second_dofs = {masks[1]};")
            candidate(f"const float p_radius = {candidate.value(radii[0])}, q_radius = {candidate.value(radii[1])};")
            candidate(f"const float margin = {candidate.value(margin)};")
            for variable, geom in (("p", "first"), ("q", "second")):
                for suffix, source in (("", "center"), ("_half", "half")):
                    parts = ", ".join(f"geom_{source}[3 * {geom} + {i}]" for i in range(3))
                    candidate(f"const Vec {variable}{suffix} = {{{parts}}};")
            candidate("const Segment first_segment = {p - p_half, p_half + p_half};")
            candidate("const Segment second_segment = {q - q_half, q_half + q_half};")
            candidate("const Nearest nearest = Nearest::of(first_segment, second_segment);")
            with candidate.loop("i", "nearest.points") as point:
                point(CONTACT.replace("MAX_CONTACTS", f"ground + {self.count - len(self.balls)}"))
                axes = [vec(title) for title in ("n", "tangent", "other_tangent")]
                axes = [axes[0], axes[1] * friction, axes[2] * friction]
                contact_point = vec("at")
                jacobians = [[scalar(0)] * nv for _ in self.pyramid.directions]
                for d in range(nv):
                    sign = name(f"(float)(((second_dofs >> {d}) & 1) - ((first_dofs >> {d}) & 1))")
                    lever = contact_point + origin - tree.com[m.dof_bodyid[d]]
                    for i in self.pyramid.directions:
                        moment = cross(lever, axes[i])
                        jacobians[i][d] = sign * dot(tree.cdof[d], np.concatenate([moment, axes[i]]))
                contact_weight_, residual = softness.row(weight, name("position"), least)
                self._store(point, jacobians, contact_weight_ * share, residual, softness.damping, variables)
                self._feel(point, touching, contact_point + origin)
                if self._with_frames:
                    point(f"contact_corner[k] = {len(self.ground.corners)} + pair;")
                    for title, axis in (("normal", axes[0]), ("tangent", axes[1])):
                        for i in range(3):
                            point.set(f"dense_{title}{i}[k - ground]", axis[i])

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
        block.set("contact[k].D", weight)
        for i, jacobian in enumerate(jacobians):
            velocity = total(jacobian[d] * (qacc[d] + damping * qvel[d]) for d in range(nv))
            block.set(f"contact[k].x{i}", (residual if i == 0 else 0) + velocity)
            for d in range(nv):
                block.set(f"dense_J{i}[(k - ground) * {nv} + {d}]", jacobian[d])

    def _feel(self, block: Block, sensors: list[str], at: np.ndarray) -> None:
        """Notes which touch sensors of either body feel contact ``k``."""
        for s in range(len(self.touch)):
            first, second = (f"{body} >> {s} & 1" for body in sensors)
            with block.scope(f"if (({first}) | ({second}))") as near:
                away = name(f"({first} ? 1.0f : -1.0f)")
                self.touch.mark(near, s, at, vec("n") * away)

    def _limit_ball(self, block: Block, joint: int, variables: Variables) -> None:
        """Adds the limit of a ball joint: one row against its rotation from the reference."""
        m, (qpos, *_) = self.tree.m, variables
        address, dof = int(m.jnt_qposadr[joint]), int(m.jnt_dofadr[joint])
        softness = Softness.make(m, m.jnt_solref[joint], m.jnt_solimp[joint])
        with block.scope("") as scope:
            w, x, y, z = (scope.value(q) for q in qpos[address : address + 4])
            scope(f"float angle; const Vec axis = Quat{{{w}, {x}, {y}, {z}}}.axis(angle);")
            scope(f"const float position = {literal(max(m.jnt_range[joint]) - m.jnt_margin[joint])} - angle;")
            with scope.scope("if (position < 0.0f)") as violated:
                violated("const int k = contacts++;")
                jacobians = [[scalar(0)] * m.nv for _ in self.pyramid.directions]
                for i, component in enumerate(vec("axis")):
                    jacobians[0][dof + i] = -component
                weight, residual = softness.row(m.dof_invweight0[dof], name("position"))
                share = self.pyramid.share(1)
                self._store(violated, jacobians, weight * share, residual, softness.damping, variables)
                if self._with_frames:
                    violated(f"contact_corner[k] = {len(self.ground.corners) + len(self.pairs)};  // no geoms")

    def project(self, block: Block) -> None:
        """Sets how the residuals change along the search direction."""
        nv = self.tree.m.nv
        for d in self.pyramid.directions if self.count else ():
            with block.scope("for (int k = ground; k < contacts; ++k)") as contact:
                product = total(
                    cell(f"dense_J{d}[(k - ground) * {nv} + {i}]") * cell(f"search[{i}]") for i in range(nv)
                )
                contact.set(f"contact[k].v{d}", product)

    def gather(self, block: Block) -> None:
        """Adds the forces to the gradient, and lists the Hessian as modes: weights and vectors of rank-one terms.

        The Hessian of a contact in its directions is factored (Cholesky without roots); weights of rounding are left
        out.
        """
        nv, directions = self.tree.m.nv, self.pyramid.directions
        block("int modes = 0;")
        with block.scope("for (int k = ground; k < contacts; ++k)") as contact:
            gradient, hessian = self.pyramid.response()
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
        """Sets ``solution`` to H^-1 gradient, adding modes one after the other (Sherman and Morrison) to ``solve``."""
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
