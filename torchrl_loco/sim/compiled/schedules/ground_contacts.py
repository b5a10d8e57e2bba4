"""Contacts with planes of the world, traced for one model.

J acts on one body, so that ``J' D J`` is a stiffness of that body.
"""

import numpy as np

from torchrl_loco.sim.compiled.collision.pairs import Pair, contact_weight, least_regularisation
from torchrl_loco.sim.compiled.collision.planes import Corner, corners
from torchrl_loco.sim.compiled.ir.symbols import (
    Block,
    Scalar,
    cell,
    cross,
    dot,
    leaves,
    literal,
    names,
    scalar,
    total,
    zeros,
)
from torchrl_loco.sim.compiled.physics.constraints import Softness, Table, Variables
from torchrl_loco.sim.compiled.physics.dynamics import Dynamics
from torchrl_loco.sim.compiled.physics.pyramid import FLAT, FRICTIONLESS, FULL
from torchrl_loco.sim.compiled.physics.sensors import TouchSensors


class GroundContacts:
    """Contacts of spheres and capsules with planes of the world. All have a place.

    With ``with_frames`` their directions are stored where they differ, even if the solver does without.

    Attributes:
        directions: of contact ``k``: the normal, and the two tangents times friction, ``(3,)`` each.
        fields: what a contact stores besides its rows, in C++.
        link: what a body keeps for its contacts, its twist and what they add up: arrays of floats, how many each has.
    """

    def __init__(self, tree: Dynamics, found: list[Pair], touch: TouchSensors, *, with_frames: bool = False) -> None:
        m, self.tree, self.touch = tree.m, tree, touch
        self.corners = corners(tree, found)
        self.count = len(self.corners)
        self.bodies = sorted({corner.body for corner in self.corners})
        twists = tree.twists(names("search", m.nv))
        self.live = [i for i in range(6) if any(scalar(twists[b][i]).constant != 0 for b in self.bodies)]
        self._weights = [contact_weight(m, corner.pair) for corner in self.corners]
        self._weights_differ = len(set(map(scalar, self._weights))) > 1
        self._lever = self._varying("lever", [corner.point for corner in self.corners])
        normal = self._varying("normal", [corner.normal for corner in self.corners])
        tangent = self._varying("tangent", [corner.tangent for corner in self.corners])
        self.directions = [normal, tangent, cross(normal, tangent)]
        if all(corner.pair.condim == 1 for corner in self.corners):
            self.pyramid = FRICTIONLESS
        elif self._velocity()[2].constant == 0:
            self.pyramid = FLAT
        else:
            self.pyramid = FULL
        read = [*self._velocity(), *(np.concatenate(self.directions) if with_frames else ())]
        titles = [f"{title}{i}" for title in ("lever", "normal", "tangent") for i in range(3)]
        read_cells = {leaf.args[0] for leaf in leaves(map(scalar, read), "cell")}
        self._stored = [title for title in titles if f"contact[k].{title}" in read_cells]
        self.fields = ["int body", *(f"float {title}" for title in self._stored)] if self.corners else []
        n = len(self.live)
        self.link = {"twist": n, "gradient": n, "stiffness": n * (n + 1) // 2}

    def _varying(self, title: str, vectors: list[np.ndarray]) -> np.ndarray:
        """Returns a vector of contact ``k``: numbers of the model where all contacts agree, else what is stored."""

        def component(i: int) -> Scalar:
            values = {scalar(vector[i]) for vector in vectors}
            agree = len(values) == 1 and not leaves(values, "name", "cell")
            return values.pop() if agree else cell(f"contact[k].{title}{i}")

        return np.array([component(i) for i in range(3)], dtype=object)

    def _velocity(self) -> list[Scalar]:
        """Returns the velocity at contact ``k`` along the normal and the scaled tangents, for the twist of its body."""
        twist = zeros(6)
        for i, component in enumerate(self.live):
            twist[component] = cell(f"link[contact[k].body][place].twist[{i}]")
        linear = twist[3:] + cross(twist[:3], self._lever)
        return [dot(direction, linear) for direction in self.directions]

    def create(self, block: Block, variables: Variables) -> None:
        """Finds the contacts, and sets weights and residuals."""
        block("int ground = 0;")
        for i, corner in enumerate(self.corners):
            position = corner.distance - corner.pair.margin
            with block.scope(f"if ({block.value(position)} < 0.0f)") as touching:
                touching("const int k = ground++;")
                touching(f"contact_corner[k] = {i}; contact[k].body = {self.bodies.index(corner.body)};")
                touching.set("contact[k].x0", position)
                if self._weights_differ:
                    touching.set("contact[k].D", scalar(self._weights[i]))
                for title, vector in (("lever", corner.point), ("normal", corner.normal), ("tangent", corner.tangent)):
                    for component in range(3):
                        if f"{title}{component}" in self._stored:
                            touching.set(f"contact[k].{title}{component}", vector[component])
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
        weight = cell("contact[k].D") if self._weights_differ else scalar(self._weights[0])
        least = table.column("least", [least_regularisation(corner.pair) for corner in self.corners])
        share = table.column("share", [self.pyramid.share(corner.pair.condim) for corner in self.corners])
        for damping in sorted({float(np.float32(row.damping)) for row in rows}):
            with block.scope("if (ground > 0)") as some:
                self._store_twists(some, [a + damping * v for a, v in zip(qacc, qvel, strict=True)])
                with some.loop("k", "ground") as contact:
                    if scalar(softness.damping).constant is None:
                        contact(f"if ({contact.value(softness.damping)} != {literal(damping)}) continue;")
                    position = contact.keep(cell("contact[k].x0"))
                    inertia, residual = softness.row(weight, position, least)
                    contact.set("contact[k].D", inertia * share)
                    self._set(contact, "x", residual)

    def _feel(self, block: Block, corner: Corner) -> None:
        """Notes which touch sensors feel contact ``k``."""
        bodies = self.tree.m.geom_bodyid[list(corner.pair.geoms)]
        first, second = (self.touch.of_body(body) for body in bodies)
        if len(self.touch):
            block("contact_zones[k] = 0;")
        for s in range(len(self.touch)):
            if (first | second) >> s & 1:
                away = corner.normal if first >> s & 1 else -corner.normal
                self.touch.mark(block, s, corner.point + self.tree.com[corner.body], away)

    def _store_twists(self, block: Block, velocity: list[Scalar]) -> None:
        """Stores the twists of the bodies for velocities of the joints."""
        twists = self.tree.twists(velocity)
        for b, body in enumerate(self.bodies):
            for i, component in enumerate(self.live):
                block.set(f"link[{b}][place].twist[{i}]", twists[body][component])

    def _set(self, block: Block, field: str, residual: Scalar | float = 0.0) -> None:
        velocity = self._velocity()
        for d in self.pyramid.directions:
            block.set(f"contact[k].{field}{d}", velocity[d] if d else residual + velocity[d])

    def project(self, block: Block, search: list[Scalar], body: str) -> None:
        """Sets how the residuals change along the search direction, then runs ``body`` for each ``row``."""
        if self.count:
            with block.scope("if (ground > 0)") as some:
                self._store_twists(some, search)
                with some.loop("k", "ground") as contact:
                    self._set(contact, "v")
                    for line in self.pyramid.rows(body):
                        contact(line)

    def gather(self, block: Block) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Returns gradient ``(6,)`` and Hessian ``(6, 6)`` of the cost at each body: forces and stiffnesses."""
        m, live, pyramid = self.tree.m, self.live, self.pyramid
        forces, stiffness = [zeros(6) for _ in range(m.nbody)], [zeros(6, 6) for _ in range(m.nbody)]
        if not self.count:
            return forces, stiffness
        packed = [(i, j) for i in range(len(live)) for j in range(i + 1)]
        with block.scope(f"for (int b = 0; b < {len(self.bodies)}; ++b)") as each:
            for title in ("gradient", "stiffness"):
                each(f"for (float& x : link[b][place].{title}) x = 0.0f;")
        with block.loop("k", "ground") as contact:
            gradient, hessian = pyramid.response()
            wrenches = [
                np.concatenate([cross(self._lever, self.directions[d]), self.directions[d]]) for d in pyramid.directions
            ]
            force = total(gradient[d] * wrenches[d] for d in pyramid.directions)
            for i, component in enumerate(live):
                contact.set(f"link[contact[k].body][place].gradient[{i}]", force[component], "+=")
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
                contact.set(f"link[contact[k].body][place].stiffness[{at}]", entry, "+=")
        for b, body in enumerate(self.bodies):
            for i, component in enumerate(live):
                forces[body][component] = cell(f"link[{b}][place].gradient[{i}]")
            for at, (i, j) in enumerate(packed):
                entry = cell(f"link[{b}][place].stiffness[{at}]")
                stiffness[body][live[i], live[j]] = stiffness[body][live[j], live[i]] = entry
        return forces, stiffness
