"""Sensors of one world, traced for one model: motions of subtrees, touch, and contact forces of geoms.

Touch and contact forces are those of the last substep, as acceleration sensors are in MuJoCo.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.kinds import SHAPES, SPHERE
from torchrl_loco.sim.compiled.ir.symbols import Block, Scalar, array, cross, name, total
from torchrl_loco.sim.compiled.physics.dynamics import Dynamics, Poses, constant_matrix

SUBTREE_VELOCITY, ANGULAR_MOMENTUM, TOUCH, VELOCIMETER, GYRO, ACCELEROMETER, FORCE, TORQUE = (
    int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}"))
    for kind in ("SUBTREELINVEL", "SUBTREEANGMOM", "TOUCH", "VELOCIMETER", "GYRO", "ACCELEROMETER", "FORCE", "TORQUE")
)
AT_SITES = VELOCIMETER, GYRO, ACCELEROMETER, FORCE, TORQUE  # sensors at sites that lanes alone have


def subtree(m: mujoco.MjModel, root: int) -> list[int]:
    """Returns a body and all bodies below it."""
    below = [root]
    for body in range(root + 1, m.nbody):
        if m.body_parentid[body] in below:
            below.append(body)
    return below


def subtree_velocity(m: mujoco.MjModel, tree: Dynamics, root: int) -> list[Scalar]:
    """Returns the velocity of the center of mass of a body and all bodies below it (m/s)."""
    momentum = total((tree.inertia[body] @ tree.cvel[body])[3:] for body in subtree(m, root) if body)
    return list(momentum / m.body_subtreemass[root])


def angular_momentum(m: mujoco.MjModel, tree: Dynamics, root: int) -> list[Scalar]:
    """Returns the angular momentum of a moving body and all bodies below it, about their center of mass (kg m^2/s)."""
    bodies = subtree(m, root)
    momentum = total(tree.inertia[body] @ tree.cvel[body] for body in bodies)  # about the center of the whole tree
    if m.body_rootid[root] == root:
        return list(momentum[:3])
    center = total(tree.inertia[body].first for body in bodies) / m.body_subtreemass[root]
    return list(momentum[:3] - cross(center, momentum[3:]))


class TouchSensors:
    """Touch sensors: each adds up the normal forces of the contacts of its body that its site feels.

    A contact is felt if the ray from its point, along the normal and away from the body, meets the site; from a point
    within the site every ray does.

    C++ variables: ``contact_zones``, the sensors that feel contact ``k``, one bit each, and ``touch``, the sums (N).
    """

    def __init__(self, m: mujoco.MjModel, poses: Poses) -> None:
        self.m, self.poses = m, poses
        found = [i for i in range(m.nsensor) if m.sensor_type[i] == TOUCH]
        self.sites = [int(m.sensor_objid[i]) for i in found]
        self.addresses = [int(m.sensor_adr[i]) for i in found]

    def __len__(self) -> int:
        return len(self.sites)

    def of_body(self, body: int) -> int:
        """Returns the sensors of a body, as bits."""
        return sum(1 << s for s, site in enumerate(self.sites) if self.m.site_bodyid[site] == body)

    def mark(self, block: Block, sensor: int, point: np.ndarray, ray: np.ndarray) -> None:
        """Notes whether a sensor feels contact ``k``, at a point (m) along a ray from its body, in world axes."""
        m, site = self.m, self.sites[sensor]
        body = m.site_bodyid[site]
        axes = self.poses.xmat[body] @ constant_matrix(m.site_quat[site])
        center = self.poses.xpos[body] + self.poses.xmat[body] @ array(m.site_pos[site])
        size = m.site_size[site, [0, 0, 0]] if m.site_type[site] == SPHERE else m.site_size[site]
        start, along = axes.T @ (point - center), axes.T @ ray
        vectors = ", ".join(f"Vec{{{', '.join([block.value(x) for x in v])}}}" for v in (size, start, along))
        block(f"if (Interval::meets({SHAPES.index(m.site_type[site])}, {vectors})) contact_zones[k] |= {1 << sensor};")

    def add(self, block: Block, first: str, count: str, force: Scalar) -> None:
        """Adds the normal ``force`` of each contact ``k`` from ``first`` to ``count``, after the solver."""
        with block.scope(f"for (int k = {first}; k < {count}; ++k)") as contact:
            contact("if (!contact_zones[k]) continue;")
            contact(f"const float force_normal = {contact.value(force)};")
            for s in range(len(self)):
                contact(f"if (contact_zones[k] & {1 << s}) touch[{s}] += force_normal;")


class ContactForces:
    """Net forces of the contacts on some geoms, and whether they have any contact.

    C++ variables: ``contact_corner``, the place of the geoms of contact ``k`` in ``pairs``; behind its end for what is
    no contact. The results are added up where they are read from, in ``row`` of ``contact_force`` and ``in_contact``.
    """

    def __init__(self, geoms: Sequence[int], pairs: Sequence[tuple[int, int]]) -> None:
        self.count = len(geoms)
        index = {geom: i for i, geom in enumerate(geoms)}
        self._places = [[*(index.get(pair[i], -1) for pair in pairs), -1] for i in range(2)]

    def clear(self, block: Block) -> None:
        """Sets all to no contact, in ``row``."""
        with block.scope(f"for (int i = 0; i < {self.count}; ++i)") as each:
            each(f"wp::index(contact_force_out, world, {self.count} * row + i) = wp::vec3(0.0f, 0.0f, 0.0f);")
            each(f"wp::index(in_contact_out, world, {self.count} * row + i) = false;")
        for title, places in zip(("first", "second"), self._places, strict=True):
            block(f"static const int force_{title}[{len(places)}] = {{{', '.join(map(str, places))}}};")

    def add(self, block: Block, bounds: tuple[str, str], force: np.ndarray) -> None:
        """Adds the ``force`` ``(3,)`` on its second geom of each contact ``k`` within bounds, after :meth:`clear`."""
        with block.scope(f"for (int k = {bounds[0]}; k < {bounds[1]}; ++k)") as contact:
            contact("const int first = force_first[contact_corner[k]], second = force_second[contact_corner[k]];")
            contact("if (first < 0 && second < 0) continue;")
            parts = ", ".join(contact.value(component) for component in force)
            contact(f"const wp::vec3 push({parts});")
            for geom, sign in (("second", "+"), ("first", "-")):
                with contact.scope(f"if ({geom} >= 0)") as asked:
                    asked(f"wp::index(contact_force_out, world, {self.count} * row + {geom}) {sign}= push;")
                    asked(f"wp::index(in_contact_out, world, {self.count} * row + {geom}) = true;")


def read(m: mujoco.MjModel, tree: Dynamics, touch: TouchSensors) -> list[Scalar | None]:
    """Returns the row of ``sensordata``; ``None`` where no sensor of this module writes."""
    row: list[Scalar | None] = [None] * m.nsensordata
    of_subtrees = {SUBTREE_VELOCITY: subtree_velocity, ANGULAR_MOMENTUM: angular_momentum}
    for kind, body, first in zip(m.sensor_type, m.sensor_objid, m.sensor_adr, strict=True):
        if kind in of_subtrees:
            row[first : first + 3] = of_subtrees[kind](m, tree, int(body))
    for s, address in enumerate(touch.addresses):
        row[address] = name(f"touch[{s}]")
    return row
