"""What lanes have to know about a model: its links, pairs, limits, and how much of a world fits a multiprocessor."""

import copy
import dataclasses
import itertools
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.ground import Ground
from torchrl_loco.sim.compiled.collision.kinds import BOX, FUNCTIONS, GROUND_FUNCTIONS, MESH, ON_PLANES, PLANE, SOLID
from torchrl_loco.sim.compiled.collision.meshes import Mesh
from torchrl_loco.sim.compiled.collision.pairs import Pair, half_length, is_elliptic, kind, looked_up, pairs, stand_ins
from torchrl_loco.sim.compiled.ir import symbols
from torchrl_loco.sim.compiled.ir.parameters import nominal, present
from torchrl_loco.sim.compiled.physics import sensors
from torchrl_loco.sim.compiled.physics.actuators import Actuator, acting
from torchrl_loco.sim.compiled.physics.constraints import DryFriction, Softness, both_sides, limited
from torchrl_loco.sim.compiled.physics.dynamics import BALL, HINGE, SLIDE
from torchrl_loco.sim.compiled.physics.equalities import CONNECT, JOINT, TENDON, WELD, Equality, Weld, active
from torchrl_loco.sim.compiled.physics.lengths import OF_TENDON
from torchrl_loco.sim.compiled.physics.links import Mass, matrix, moved_by, moving_bodies, places
from torchrl_loco.sim.compiled.schedules.lanes.layout import Layout, Limbs
from torchrl_loco.sim.models import NEVER, home_pose

MOST_VERTICES = 4000  # vertices of all meshes that touch something: tables count their corners with 16 bits
LANES = 32  # threads of a GPU that step a world
BLOCK_BYTES = 48 * 1024  # static shared memory that a block of a GPU may have
WARP_BYTES = 4 * LANES
"""What Warp takes of it for the threads of a world, 4 bytes each, whether a kernel has tiles or not."""
WORLD_BYTES = (
    11136,
    BLOCK_BYTES // 4 - WARP_BYTES,
    18720,
    22592,
    BLOCK_BYTES // 2 - WARP_BYTES,
    BLOCK_BYTES - WARP_BYTES,
)
"""Shared memory that a world may fill: the first that leaves room for enough contacts. So 20 and 16 worlds in blocks of
4, 12, 10 and 8 in blocks of 2, and 4 fit a multiprocessor of an H100 or H200."""
MULTIPROCESSOR_BYTES, SYSTEM_BYTES = 228 * 1024, 1024
"""Shared memory of a multiprocessor of an H100 or H200, and what the system takes of it for each block."""
SCHEDULERS, REGISTERS = 4, 16 * 1024
"""Of a multiprocessor, and the registers of each, which it deals out to whole warps."""
LEAST_REGISTERS = 128
"""Of a thread, where moving geoms may touch each other: with fewer a step keeps numbers in memory, and 20 worlds of a
multiprocessor are slower than 16 without that."""
MOST_WORLDS = 4  # worlds of a block, at most
ENOUGH_FRICTIONAL, MOST_FRICTIONAL, MOST_FRICTIONLESS = 10, 28, 16
"""Places for contacts with friction, which a world should have and may have, and for those without.

A body that touches the floor in more places when it stands should have, and has, those.
"""
NEAR_GROUND = 64  # prisms of height fields, or boxes of the ground, that are listed and then looked at together
MOST_PRISMS, MOST_BOXES, MOST_ON_BOXES = 2**16 - 1, 2**24 - 1, 2**8
"""Prisms of a field near a geom, boxes of the ground, and geoms that may touch these: entries of lists hold no more."""
STANDING, FAR = 0.025, 1e3
"""Height over its lowest point of what a body stands on or may at once, and a height that no pose exceeds (m)."""


def is_implicitfast(m: mujoco.MjModel) -> bool:
    """Returns whether velocities advance by (M - h D) a' = M a, D the derivatives of the joints' forces by them.

    With ``euler`` D is that of the dampers alone, or zero.
    """
    return m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


class Description:
    """What lanes have to know about a model.

    Attributes:
        pairs: of geoms that may touch, in the order in which lanes look at them: planes first, in both parts those with
            friction, and in all parts by their function.
        moved: for each body, a bit for each degree of freedom that moves it.
    """

    def __init__(self, m: mujoco.MjModel) -> None:
        self.m = m
        self.places = places(m)
        self.moving = moving_bodies(m)
        if not self.moving or m.nv > 64:
            raise ValueError(f"{m.nv} degrees of freedom, more than 64")
        self.roots = sorted({int(m.body_rootid[b]) for b in self.moving})
        self.members = [[b for b in range(1, m.nbody) if self.places[b].link == i] for i in range(len(self.moving))]
        self.masses = [Mass.join(m, self.places, bodies) for bodies in self.members]
        self.moved = moved_by(m)
        self.ground = Ground.of(m)
        self.pairs = self._sorted_pairs(pairs(m))
        used_functions = {kind(m, p).function for p in self.pairs}
        self.functions = [f for f in FUNCTIONS if f in used_functions]
        self.condims = {p.condim for p in self.pairs} - {1}
        self.elliptic = bool(self.condims) and is_elliptic(m)
        on_ground = looked_up(m) | (m.geom_type == PLANE)
        self.geoms = sorted({g for p in self.pairs for g in p.geoms if not on_ground[g]})
        self.has_solids = any(m.geom_type[g] in SOLID for g in self.geoms)
        used = sorted({int(m.geom_dataid[g]) for g in self.geoms if m.geom_type[g] == MESH})
        self.meshes = {mesh: Mesh.of(m, mesh) for mesh in used}
        self._check_lists()
        vertices = sum(len(mesh.vertices) for mesh in self.meshes.values())
        if vertices > MOST_VERTICES:
            raise ValueError(f"meshes with {vertices} vertices, more than {MOST_VERTICES}")
        self.limited = limited(m, SLIDE, HINGE)
        self.limit_sides = 2 if any(both_sides(m, j) for j in self.limited) else 1
        self.limited_balls = limited(m, BALL)
        self.friction = DryFriction(m)
        found = [(int(m.sensor_type[i]), int(m.sensor_objid[i]), int(m.sensor_adr[i])) for i in range(m.nsensor)]
        self.subtrees = [s for s in found if s[0] == sensors.SUBTREE_VELOCITY]
        self.momenta = [s for s in found if s[0] == sensors.ANGULAR_MOMENTUM]
        self.touch = [s for s in found if s[0] == sensors.TOUCH]
        self.motions = [s for s in found if s[0] in (sensors.VELOCIMETER, sensors.GYRO)]
        self.accelerometers = [s for s in found if s[0] == sensors.ACCELEROMETER]
        self.wrenches = [s for s in found if s[0] in (sensors.FORCE, sensors.TORQUE)]
        self.acting = acting(m)
        self.actuators = [Actuator.of(m, a) for a in self.acting]
        self.bias = np.reshape([[0.0] * 3 if a.bias is None else a.bias for a in self.actuators], (-1, 3))
        self.implicit_actuators = is_implicitfast(m) and present(self.bias[:, 2])
        self.joint_force_limits = self.implicit_actuators or m.jnt_actfrclimited.any()
        self.pulls_tendons = bool((m.actuator_trntype[self.acting] == OF_TENDON).any())
        # Without those of what cannot move, which C MuJoCo leaves out too.
        equalities = [Equality.of(nominal(m), i) for i in active(m, (JOINT, TENDON))]
        self.equalities = [equality for equality in equalities if dofs_of(equality)]
        welds = [Weld.of(nominal(m), i) for i in active(m, (CONNECT, WELD))]
        self.welds = [weld for weld in welds if self.dofs_of_weld(weld)]
        self.limbs = Limbs.of(m.dof_parentid.tolist())
        coupled = [*map(dofs_of, self.equalities), *map(self.dofs_of_weld, self.welds)]
        if self.limbs and any(map(self.limbs.crosses, coupled)):
            self.limbs = None
        self.layout = self._layout()

    def is_ground(self, pair: Pair) -> bool:
        """Returns whether a geom of a pair is a plane of the world, or looked up."""
        return kind(self.m, pair).function in GROUND_FUNCTIONS

    def _sorted_pairs(self, found: list[Pair]) -> list[Pair]:
        order, of_ground = FUNCTIONS.index, stand_ins(self.m)

        def key(pair: Pair) -> tuple[bool, bool, int, int]:
            on = next((g for g in pair.geoms if g in of_ground), -1)
            return not self.is_ground(pair), pair.condim == 1, order(kind(self.m, pair).function), on

        return sorted(found, key=key)

    def pairs_on(self, geom: int, function: str) -> list[int]:
        """Returns the first pair of a geom of the ground and the one after the last, without friction and with it."""
        found = []
        for friction in (False, True):
            own = [
                i
                for i, p in enumerate(self.pairs)
                if geom in p.geoms and (p.condim != 1) == friction and kind(self.m, p).function == function
            ]
            found += [own[0], own[-1] + 1] if own else [0, 0]
        return found

    @property
    def lasting(self) -> int:
        """Rows among those of contacts without friction that are there however many contacts there are."""
        return len(self.limited_balls) + len(self.equalities) + sum(weld.rows for weld in self.welds)

    def _check_lists(self) -> None:
        """Checks that what is near a geom can be listed: numbers of 32 bits hold a pair and a prism, or a box."""
        moving = [g for g in self.geoms if self.m.body_weldid[self.m.geom_bodyid[g]]]
        most = max((2 * (self.radius(g) + half_length(self.m, g)) for g in moving), default=0.0)
        for field in self.ground.fields:
            prisms = 2 * (most / field.cell[0] + 2) * (most / field.cell[1] + 2)
            if prisms > MOST_PRISMS:
                raise ValueError(f"a height field with cells of {min(field.cell):.2g} m under a geom of {most:.2g} m")
        boxes = self.ground.boxes
        if boxes is not None and (len(boxes.numbers) > MOST_BOXES or len(self.geoms) > MOST_ON_BOXES):
            raise ValueError(f"{len(boxes.numbers)} boxes of the world, more than {MOST_BOXES}, or too many that move")

    def collide(self) -> str:
        """Returns the calls that find the contacts, those with friction if there is ``friction``, or those without."""
        calls, kinds = [], [(kind(self.m, pair).function, pair.condim != 1) for pair in self.pairs]
        for function in self.functions:
            spans = []
            for friction in (True, False):
                found = [i for i, key in enumerate(kinds) if key == (function, friction)]
                spans.append((found[0], found[-1] + 1) if found else (0, 0))
            begin, end = (f"friction ? {x} : {y}" for x, y in zip(*spans, strict=True))
            if function in ON_PLANES:
                calls.append(f"ROLLED_FOR(int i = {begin}, end = {end}; i < end; i += LANES)")
                calls.append(f"  collide_{function}(own_pair(i, end), friction);")
            elif function in GROUND_FUNCTIONS:
                calls.append(f"collide_{function}(friction);")
            else:
                calls.append(f"if (const int end = {end}) ROLLED_FOR(; at < count && w.candidates[at] < end;)")
                calls.append(f"  collide_{function}(own_pair(at, count, end), friction);")
        return "\n".join(calls)

    def _standing(self) -> tuple[int, int]:
        """Returns how many contacts with friction and without there are when the bodies stand in their home pose."""
        m = copy.copy(nominal(self.m))
        if of_ground := np.flatnonzero(looked_up(m)).tolist():  # a plane in place of all of it
            m.geom_contype[of_ground[1:]] = m.geom_conaffinity[of_ground[1:]] = 0
            m.geom_type[of_ground[0]], m.geom_quat[of_ground[0]], m.geom_rbound[of_ground[0]] = PLANE, (1, 0, 0, 0), 0.0
            m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
        planes = m.geom_type == PLANE
        floors = planes | ((m.geom_type == BOX) & (m.body_weldid[m.geom_bodyid] == 0))  # boxes only where they are near
        m.geom_margin[floors] = np.maximum(m.geom_margin[floors], STANDING)
        np.maximum.at(m.body_margin, m.geom_bodyid[floors], STANDING)
        m.geom_margin[planes] = m.body_margin[m.geom_bodyid[planes]] = FAR
        of_planes = planes[m.pair_geom1] | planes[m.pair_geom2]
        m.pair_margin[of_planes & (m.pair_margin > NEVER)] = FAR
        data = mujoco.MjData(m)
        data.qpos[:] = home_pose(m)
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        mujoco.mj_collision(m, data)
        heights: dict[tuple[int, int], list[tuple[float, int]]] = {}  # by plane or box, and tree
        for contact in data.contact:
            floor, geom = sorted(contact.geom, key=lambda g: not floors[g])
            if floors[floor] and not contact.exclude:
                root = m.body_rootid[m.geom_bodyid[geom]]
                heights.setdefault((floor, root), []).append((contact.dist, contact.dim))
        touching = [
            dim
            for (floor, _), found in heights.items()
            for height, dim in found
            if height < STANDING + (min(found)[0] if planes[floor] else 0.0)
        ]
        return sum(dim > 1 for dim in touching), sum(dim == 1 for dim in touching)

    def _layout(self) -> Layout:
        """Returns the sizes, with as many places for contacts as there is room for."""
        m = self.m
        frictional = sum(kind(m, p).points for p in self.pairs if p.condim != 1)
        frictionless = sum(kind(m, p).points for p in self.pairs if p.condim == 1)
        standing, standing_frictionless = self._standing() if self.pairs else (0, 0)
        frictionless = min(frictionless, max(MOST_FRICTIONLESS, standing_frictionless)) + self.lasting
        if not frictional and not frictionless:
            frictionless = 1  # C++ has no empty arrays
        directions = max(self.condims, default=3)
        empty = Layout(
            positions=m.nq,
            activations=m.na,
            weld_rows=sum(weld.rows for weld in self.welds),
            dofs=m.nv,
            links=len(self.moving),
            geoms=len(self.geoms),
            trees=len(self.roots),
            limits=self.limit_sides * len(self.limited),
            friction_losses=self.friction.count,
            touch=len(self.touch),
            candidates=max(1, sum(not self.is_ground(p) for p in self.pairs)),
            near_ground=NEAR_GROUND if self.ground.tops else 0,
            near_pairs=max(1, sum(map(self.is_ground, self.pairs))) if self.ground.tops else 0,
            directions=directions,
            contact_rows=directions if self.elliptic else 2 * (directions - 1),
            frictional=0,
            frictionless=frictionless,
            jacobian_rows=0,
            limb_numbers=self.limbs.numbers if self.limbs else 0,
        )

        lasting = self.lasting

        def sized(places: int, more_rows: int = lasting) -> Layout:
            rows = max(directions * places + more_rows, frictionless, 1)
            return dataclasses.replace(empty, frictional=places, jacobian_rows=rows)

        least, wanted = (min(frictional, n) for n in (ENOUGH_FRICTIONAL, max(ENOUGH_FRICTIONAL, standing)))
        enough = max((n for n in range(least, wanted + 1) if sized(n).bytes <= WORLD_BYTES[-1]), default=least)
        most = min(frictional, max(MOST_FRICTIONAL, enough))
        budget = next((b for b in WORLD_BYTES if sized(enough).bytes <= b), None)
        if budget is None:
            raise ValueError(
                f"a body so large: a world needs {sized(enough).bytes} bytes of shared memory, of {WORLD_BYTES[-1]}"
            )
        count = max(n for n in range(enough, most + 1) if sized(n).bytes <= budget)
        more = max(r for r in range(lasting, frictionless + 1) if sized(count, r).bytes <= budget)
        return sized(count, more)

    def geom_frame(self, g: int) -> tuple[int, np.ndarray, np.ndarray]:
        """Returns the link of a geom, and its center and z axis in the frame of the link."""
        place = self.places[self.m.geom_bodyid[g]]
        return place.link, place.point(self.m.geom_pos[g]), matrix(place.turn(self.m.geom_quat[g]))[:, 2]

    def radius(self, g: int) -> float:
        """Returns the radius of a sphere or capsule, and that of the bounding sphere of a solid."""
        return float(self.m.geom_rbound[g] if self.m.geom_type[g] in SOLID else self.m.geom_size[g, 0])

    def dofs_of_weld(self, weld: Weld) -> int:
        """Returns a bit for each degree of freedom that moves one of its bodies."""
        return self.moved[weld.bodies[0]] | self.moved[weld.bodies[1]]

    def apart(self, pair: Pair) -> int:
        """Returns a bit for each degree of freedom that moves one geom of a pair alone."""
        first, second = self.m.geom_bodyid[list(pair.geoms)]
        return self.moved[first] ^ self.moved[second]

    def softness(self, solref: Sequence[float], solimp: Sequence[float]) -> list[float]:
        """Returns the members of struct Softness."""
        return list(vars(Softness.make(self.m, solref, solimp)).values())

    def parts_below(self, body: int) -> list[tuple[int, Mass]]:
        """Returns links of a subtree, and what of each belongs to it."""
        inside = set(sensors.subtree(self.m, body))
        by_link = [(i, [b for b in bodies if b in inside]) for i, bodies in enumerate(self.members)]
        return [(i, Mass.join(self.m, self.places, bodies)) for i, bodies in by_link if bodies]

    def actuator(self) -> Actuator:
        """Returns an actuator that reads the tables."""

        def read(*titles: str) -> list[symbols.Scalar]:
            return [symbols.name(f"Model::{title}(a)") for title in titles]

        gear, gain = read("gear", "gain")
        return Actuator(
            gear,
            gain,
            read("bias", "bias_position", "bias_velocity") if present(self.bias) else None,
            read("control_low", "control_high")
            if not self.layout.activations and any(a.control_range is not None for a in self.actuators)
            else None,
            read("force_low", "force_high") if any(a.force_range is not None for a in self.actuators) else None,
        )

    def worlds_per_block(self) -> int:
        """Returns how many worlds share a block of threads: a power of two, as shared memory allows."""
        fit = max(1, BLOCK_BYTES // (self.layout.bytes + WARP_BYTES))
        return min(MOST_WORLDS, 1 << int(math.log2(fit)))

    def registers(self) -> int:
        """Returns how many registers of a thread leave a multiprocessor as many worlds as its shared memory does.

        But at least as many as a step needs.
        """
        worlds = self.worlds_per_block()
        worlds *= MULTIPROCESSOR_BYTES // (worlds * (self.layout.bytes + WARP_BYTES) + SYSTEM_BYTES)
        least = 0 if all(map(self.is_ground, self.pairs)) else LEAST_REGISTERS
        return min(max(REGISTERS // (LANES * math.ceil(worlds / SCHEDULERS)) // 8 * 8, least), 255)

    def elimination(self) -> str:
        """Returns calls that eliminate all rows, in blocks of four: first those of which a lane has several."""
        last = self.layout.stride // 4 - 1
        edges = [last, *([LANES // 4] if last > LANES // 4 else []), -1]
        return "\n".join(f"    eliminate(h, {first}, {end});" for first, end in itertools.pairwise(edges))


def dofs_of(equality: Equality) -> int:
    """Returns a bit for each degree of freedom of an equality."""
    return sum(1 << dof for dof in {dof for dof, share in equality.shares if share})
