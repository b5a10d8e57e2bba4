"""One world stepped by a group of lanes: the text of a compiled control step for bodies of more than a few joints.

:func:`source` puts a model's sizes, constants and tables in front of the algorithm in ``lanes.h``, as functions of a
struct ``Model``: a parameter that is the same everywhere is a constant there, any other a table. Those that differ from
world to world are functions of struct ``Varied``, which read the row of the world: its numbers, and what follows from
them, which is computed when the state is evaluated without stepping, or where a lane needs it.
"""

import copy
import dataclasses
import itertools
import math
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.sim.compiled import collision, shared, spatial, symbols
from torchrl_loco.sim.compiled.actuators import Actuator, acting
from torchrl_loco.sim.compiled.collision import (
    BOX,
    CAPSULE,
    CYLINDER,
    MESH,
    PLANE,
    SHAPES,
    SOLID,
    Mesh,
    Pair,
    contact_weight,
    is_elliptic,
    least_regularisation,
    pairs,
)
from torchrl_loco.sim.compiled.constraints import Softness, both_sides, near, tolerance
from torchrl_loco.sim.compiled.delicate import LEAST_PIVOT, is_delicate
from torchrl_loco.sim.compiled.dynamics import BALL, FREE, HINGE, MINVAL, SLIDE
from torchrl_loco.sim.compiled.links import Mass, matrix, moving_bodies, places
from torchrl_loco.sim.compiled.parameters import Number, VariedModel, nominal, present, varies
from torchrl_loco.sim.compiled.sensors import ANGULAR_MOMENTUM, SUBTREE_VELOCITY, TOUCH, subtree
from torchrl_loco.sim.compiled.tables import Tables
from torchrl_loco.sim.models import NEVER, home_pose

TEMPLATE = pathlib.Path(__file__).with_name("lanes.h")
LINE_SEARCH = shared.line_search("Model::scale()", "Model::ls_tolerance()", "Model::ls_near()", "Model::LS_ITERATIONS")
NEWTON = shared.newton(
    "Model::scale()",
    "Model::tolerance()",
    "Model::ITERATIONS",
    "Model::IMPLICIT_DAMPING",
    guesses="guesses",
    delicate="Model::DELICATE",
)
TRANSLATION, ROTATION = 0, 1
"""Kinds of a degree of freedom in ``lanes.h``; SLIDE and HINGE are MuJoCo's numbers of the joints."""
UNLIMITED = 1e30
MOST_VERTICES = 4000
"""Vertices of all meshes that touch something: tables count their corners with 16 bits."""
LANES = 32
"""Threads of a GPU that step a world."""
BLOCK_BYTES = 48 * 1024
"""Static shared memory that a block of a GPU may have."""
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
MOST_WORLDS = 4
"""Worlds of a block, at most."""
LOCKSTEP = True
"""Whether the worlds of a block begin each substep, and each iteration of its solver, together, so that they share what
they fetch of the text."""
MOST_TRUNK, MOST_LIMB = 8, 8
"""Degrees of freedom of the trunk, and of a limb, of a body whose limbs are eliminated side by side.

With 9 of the trunk (G1, the humanoid), a longer text costs more than the shorter elimination saves (measured).
"""
ENOUGH_FRICTIONAL, MOST_FRICTIONAL, MOST_FRICTIONLESS = 10, 28, 16
"""Places for contacts with friction, which a world should have and may have, and for those without.

A body that touches the floor in more places when it stands should have, and has, those.
"""
MOST_ROUNDS = 4
"""Pairs of geoms whose bounding spheres a lane compares side by side, at most."""
STANDING, FAR = 0.025, 1e3
"""Height over its lowest point of what a body stands on or may at once, and a height that no pose exceeds (m)."""


@dataclasses.dataclass
class Layout:
    """Sizes of the state of a world, as ``struct World`` has them; each is a constant of ``struct Model``, too.

    Attributes:
        limb_numbers: what the elimination by limbs holds for all lanes.
        directions: in which a contact with friction acts, each with a row of the Jacobian: the normal, two tangents,
            and turning about these three as far as any contact resists it.
        contact_rows: constraint rows of such a contact.
    """

    positions: int
    dofs: int
    links: int
    geoms: int
    trees: int
    limits: int
    friction_losses: int
    touch: int
    candidates: int
    directions: int
    contact_rows: int
    frictional: int
    frictionless: int
    jacobian_rows: int
    limb_numbers: int

    @property
    def stride(self) -> int:
        """Length of a row of a matrix."""
        return pad(self.dofs, 4)

    @property
    def rows(self) -> int:
        """Constraint rows: several for a contact with friction, one for anything else."""
        left = self.jacobian_rows - self.directions * self.frictional
        contacts = self.contact_rows * self.frictional + min(self.frictionless, left)
        return pad(contacts + self.limits + self.friction_losses, 4) or 4

    @property
    def bytes(self) -> int:
        """Size of ``struct World``."""
        contacts = self.frictional + self.frictionless
        vectors = pad(self.positions, 4) + 4 * self.stride + self.dofs * self.stride
        vectors += max(8 * self.dofs, self.stride + 2 * self.rows)
        before = 32 * contacts + 12 * (self.frictional + 1)
        quads = self.stride // 4
        solving = 4 * max(16 * (quads | 1) + 8 + 12 * quads, self.limb_numbers, self.rows)
        kinematics = 32 * self.dofs + 112 * self.links + 32 * (self.geoms + 1) + 2 * self.candidates
        total = 4 * vectors + pad(max(before, solving, 32 * self.links), 16)
        total = pad(total + 4 * self.jacobian_rows, 16)
        total += pad(max(kinematics, 4 * self.jacobian_rows * self.stride), 16)
        total += 12 * self.trees + self.limits + 1
        return pad(pad(total, 4) + 4 * (contacts if self.touch else 1), 16)


@dataclasses.dataclass(frozen=True)
class Limbs:
    """The degrees of freedom of a body whose limbs are eliminated side by side.

    Attributes:
        trunk: those with several ends of limbs below them.
        limbs: the others, those of each limb from the trunk to its end: they are neighbours.
    """

    trunk: list[int]
    limbs: list[range]

    @classmethod
    def of(cls, parents: Sequence[int]) -> "Limbs | None":
        """Returns them, or ``None`` where rows of the whole Hessian are as good, or all that fits.

        Args:
            parents: the parent of each degree of freedom, or -1.
        """
        ends = [0] * len(parents)
        for d in reversed(range(len(parents))):
            ends[d] = ends[d] or 1
            if parents[d] >= 0:
                ends[parents[d]] += ends[d]
        trunk = [d for d, count in enumerate(ends) if count > 1]
        limbs: list[range] = []
        for d in sorted(set(range(len(parents))) - set(trunk)):
            if limbs and parents[d] == limbs[-1][-1]:
                limbs[-1] = range(limbs[-1].start, d + 1)
            else:
                limbs.append(range(d, d + 1))
        found = cls(trunk, limbs)
        fits = 0 < len(trunk) <= MOST_TRUNK and found.longest <= MOST_LIMB and len(found.rows) - len(trunk) <= 32
        return found if len(limbs) > 1 and fits and min(limb.stop for limb in limbs) >= found.longest else None

    @property
    def longest(self) -> int:
        """Degrees of freedom of the longest limb."""
        return max(map(len, self.limbs))

    @property
    def rows(self) -> list[int]:
        """All degrees of freedom, those of limbs first."""
        return [*itertools.chain(*self.limbs), *self.trunk]

    @property
    def numbers(self) -> int:
        """Numbers that the lanes share: two pivots of each limb, and what they leave of the trunk."""
        trunk = len(self.trunk)
        corner = pad(pad(trunk, 4) + trunk * (trunk + 1) // 2, 4)
        return 2 * len(self.limbs) * pad(trunk + self.longest + 1, 4) + corner

    def crosses(self, dofs: int) -> bool:
        """Returns whether several limbs are among the bits of degrees of freedom."""
        return sum(any(dofs >> d & 1 for d in limb) for limb in self.limbs) > 1


def pad(x: int, unit: int) -> int:
    """Returns ``x`` rounded up to a multiple of a unit."""
    return -(-x // unit) * unit


def is_implicitfast(m: mujoco.MjModel) -> bool:
    """Returns whether velocities advance by (M - h D) a' = M a, D the derivatives of the joints' forces by them.

    With ``euler`` D is that of the dampers alone, or zero.
    """
    return m.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


class Description:
    """What ``lanes.h`` has to know about a model.

    Args:
        m: the model.
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
        self.ancestors = [sum(1 << int(j) for j in self._dofs_to_root(d)) for d in range(m.nv)]
        self.pairs = self._sorted_pairs(pairs(m))
        self.condims = {p.condim for p in self.pairs} - {1}
        self.elliptic = bool(self.condims) and is_elliptic(m)
        self.some_lack_edges = len(self.condims) > 1 and not self.elliptic
        self.geoms = sorted({g for p in self.pairs for g in p.geoms if m.geom_type[g] != PLANE})
        used = sorted({int(m.geom_dataid[g]) for g in self.geoms if m.geom_type[g] == MESH})
        self.meshes = {mesh: Mesh.of(m, mesh) for mesh in used}
        vertices = sum(len(mesh.vertices) for mesh in self.meshes.values())
        if vertices > MOST_VERTICES:
            raise ValueError(f"meshes with {vertices} vertices, more than {MOST_VERTICES}")
        limited = [j for j in range(m.njnt) if m.jnt_limited[j]]
        self.limited = [j for j in limited if m.jnt_type[j] in (SLIDE, HINGE)]
        self.limit_sides = 2 if any(both_sides(m, j) for j in self.limited) else 1
        self.limited_balls = [j for j in limited if m.jnt_type[j] == BALL]
        losses = m.dof_frictionloss
        self.losses = [d for d in range(m.nv) if varies(losses[d]) or losses[d] > 0]
        sensors = [(int(m.sensor_type[i]), int(m.sensor_objid[i]), int(m.sensor_adr[i])) for i in range(m.nsensor)]
        self.subtrees = [s for s in sensors if s[0] == SUBTREE_VELOCITY]
        self.momenta = [s for s in sensors if s[0] == ANGULAR_MOMENTUM]
        self.touch = [s for s in sensors if s[0] == TOUCH]
        self.acting = acting(m)
        self.actuators = [Actuator.of(m, a) for a in self.acting]
        self.bias = np.reshape([[0.0] * 3 if a.bias is None else a.bias for a in self.actuators], (-1, 3))
        self.implicit_actuators = is_implicitfast(m) and present(self.bias[:, 2])
        self.joint_force_limits = self.implicit_actuators or m.jnt_actfrclimited.any()
        self.limbs = Limbs.of(m.dof_parentid.tolist())
        self.layout = self._layout()

    def _dofs_to_root(self, dof: int) -> Iterator[int]:
        while dof >= 0:
            yield dof
            dof = self.m.dof_parentid[dof]

    def is_plane(self, pair: Pair) -> bool:
        """Returns whether the first geom of a pair is a plane."""
        return self.m.geom_type[pair.geoms[0]] == PLANE

    def is_solid(self, pair: Pair) -> bool:
        """Returns whether the second geom of a pair is neither a sphere nor a capsule."""
        return self.m.geom_type[pair.geoms[1]] in SOLID

    def _sorted_pairs(self, found: list[Pair]) -> list[Pair]:
        """Returns planes before others, in both parts those with friction first, and in all parts solids last."""
        return sorted(found, key=lambda p: (not self.is_plane(p), p.condim == 1, self.is_solid(p)))

    def points(self, pair: Pair) -> int:
        """Returns how many contacts a pair can have."""
        first, second = self.m.geom_type[list(pair.geoms)]
        if first == PLANE:
            return {CAPSULE: 2, BOX: 4, CYLINDER: 4, MESH: 4}.get(second, 1)
        return 2 if first == CAPSULE and second in (CAPSULE, BOX) else 1

    def _standing(self) -> tuple[int, int]:
        """Returns how many contacts with friction and without there are when the bodies stand in their home pose."""
        m = copy.copy(nominal(self.m))
        planes = m.geom_type == PLANE
        m.geom_margin[planes] = m.body_margin[m.geom_bodyid[planes]] = FAR
        of_planes = planes[m.pair_geom1] | planes[m.pair_geom2]
        m.pair_margin[of_planes & (m.pair_margin > NEVER)] = FAR
        data = mujoco.MjData(m)
        data.qpos[:] = home_pose(m)
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        mujoco.mj_collision(m, data)
        heights: dict[tuple[int, int], list[tuple[float, int]]] = {}  # by plane and tree
        for contact in data.contact:
            plane, geom = contact.geom
            if planes[plane] and not contact.exclude:
                root = m.body_rootid[m.geom_bodyid[geom]]
                heights.setdefault((plane, root), []).append((contact.dist, contact.dim))
        touching = [dim for found in heights.values() for height, dim in found if height < min(found)[0] + STANDING]
        return sum(dim > 1 for dim in touching), sum(dim == 1 for dim in touching)

    def _layout(self) -> Layout:
        """Returns the sizes, with as many places for contacts as there is room for.

        Raises:
            ValueError: a world does not fit the shared memory of a GPU.
        """
        m = self.m
        frictional = sum(self.points(p) for p in self.pairs if p.condim != 1)
        frictionless = sum(self.points(p) for p in self.pairs if p.condim == 1)
        standing, standing_frictionless = self._standing() if self.pairs else (0, 0)
        frictionless = min(frictionless, max(MOST_FRICTIONLESS, standing_frictionless)) + len(self.limited_balls)
        if not frictional and not frictionless:
            frictionless = 1  # C++ has no empty arrays
        directions = max(self.condims, default=3)
        empty = Layout(
            positions=m.nq,
            dofs=m.nv,
            links=len(self.moving),
            geoms=len(self.geoms),
            trees=len(self.roots),
            limits=self.limit_sides * len(self.limited),
            friction_losses=len(self.losses),
            touch=len(self.touch),
            candidates=max(1, sum(not self.is_plane(p) for p in self.pairs)),
            directions=directions,
            contact_rows=directions if self.elliptic else 2 * (directions - 1),
            frictional=0,
            frictionless=frictionless,
            jacobian_rows=0,
            limb_numbers=self.limbs.numbers if self.limbs else 0,
        )

        balls = len(self.limited_balls)  # their rows are there however many contacts there are

        def sized(places: int, more_rows: int = balls) -> Layout:
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
        more = max(r for r in range(balls, frictionless + 1) if sized(count, r).bytes <= budget)
        return sized(count, more)

    def tables(
        self,
        substeps: int,
        *,
        with_subtree_com: bool = False,
        contact_geoms: Sequence[int] = (),
        contact_rows: int = 1,
    ) -> Tables:
        """Returns structs ``Model`` and ``Varied``."""
        m, layout = self.m, self.layout
        tables = Tables(m.varied.count if isinstance(m, VariedModel) else 0)
        mask = "unsigned" if m.nv <= 32 else "unsigned long long"
        tables.lines.append(f"  typedef {mask} Dofs;  // a bit for each degree of freedom")
        tables.size(
            SUBSTEPS=substeps,
            ITERATIONS=m.opt.iterations,
            LS_ITERATIONS=m.opt.ls_iterations,
            WORLD_BYTES=layout.bytes,
            WORLDS_PER_BLOCK=self.worlds_per_block(),
            LOCKSTEP=LOCKSTEP,
            CONTROLS=m.nu,
            BODIES=m.nbody,
            SENSOR_VALUES=m.nsensordata,
            LIMIT_SIDES=self.limit_sides,
            VARIED=isinstance(m, VariedModel),
            DELICATE=is_delicate(nominal(m)),
            ROWS=layout.rows,
            **{name.upper(): size for name, size in dataclasses.asdict(layout).items()},
        )
        tables.constant(
            timestep=m.opt.timestep,
            scale=1 / (m.stat.meaninertia * m.nv),
            tolerance=tolerance(m),
            ls_tolerance=tolerance(m) * m.opt.ls_tolerance,
            ls_near=near(m),
            least_aligned=collision.LEAST_ALIGNED,
            least_pivot=LEAST_PIVOT,
        )
        tables.vector("gravity", m.opt.gravity)
        self._add_links(tables)
        self._add_joints(tables)
        self._add_limbs(tables)
        self._add_forces(tables)
        self._add_geoms(tables, mask)
        self._add_limits(tables)
        self._add_outputs(tables)
        if with_subtree_com:
            tables.integers("root_body", self.roots)
        tables.size(CONTACT_GEOMS=len(contact_geoms), HISTORY=contact_rows)
        if contact_geoms:
            self._add_contact_geoms(tables, contact_geoms)
        return tables

    def _add_links(self, tables: Tables) -> None:
        m, moving = self.m, self.moving
        parents = [self.places[m.body_parentid[b]] for b in moving]
        attached = list(zip(parents, moving, strict=True))
        tables.integers("parent", [p.link for p in parents])
        above = [p.link for p in parents]  # in each round, the ancestor at twice the distance of the round before
        rounds: list[int] = []
        while max(above) >= 0:
            rounds += above
            above = [above[i] if i >= 0 else -1 for i in above]
        tables.size(ROUNDS=len(rounds) // len(moving))
        tables.integers("above", rounds)
        tables.structs("Vec", "link_position", [p.point(m.body_pos[b]) for p, b in attached])
        turns = [p.turn(m.body_quat[b]) for p, b in attached]
        tables.structs("Quat", "link_orientation", turns)
        tables.size(JOINTS_TURNED=max(m.body_jntnum[moving]) > 1 or any(abs(turn[0]) < 1 for turn in turns))
        tables.floats("link_mass", [x.mass for x in self.masses])
        tables.structs("Vec", "link_center", [x.center for x in self.masses])
        tables.structs("Symmetric", "link_inertia", [x.moments[np.triu_indices(3)] for x in self.masses])
        tables.integers("tree", [self.roots.index(m.body_rootid[b]) for b in moving])
        tables.integers("first_joint", [*m.body_jntadr[moving], m.njnt])
        tables.integers("first_dof", [*m.body_dofadr[moving], m.nv])
        moments, totals = [], []
        for root in self.roots:
            bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == root]
            totals.append(m.body_mass[bodies].sum())
            fixed = [m.body_mass[b] * self.places[b].point(m.body_ipos[b]) for b in bodies if self.places[b].link < 0]
            moments.append(np.sum(fixed, axis=0) if fixed else np.zeros(3))
        tables.structs("Vec", "fixed_moment", moments)
        tables.floats("inverse_mass", [1 / total for total in totals])
        steps = [f"x[{p.link}] += x[{i}];" for i, p in reversed(list(enumerate(parents))) if p.link >= 0]
        tables.procedure("add_children", "float* x", steps)

    def _add_joints(self, tables: Tables) -> None:
        m = self.m
        kinds = set(m.jnt_type.tolist())
        tables.size(HAS_FREE=FREE in kinds, HAS_BALL=BALL in kinds, HAS_SLIDE=SLIDE in kinds)
        tables.integers("joint_kind", m.jnt_type)
        tables.integers("joint_qpos", m.jnt_qposadr)
        tables.integers("joint_dof", m.jnt_dofadr)
        tables.structs("Vec", "joint_axis", m.jnt_axis)
        tables.structs("Vec", "joint_position", m.jnt_pos)
        tables.size(JOINTS_ASIDE=m.jnt_pos.any())
        tables.floats("joint_qpos0", m.qpos0[m.jnt_qposadr])
        of_dof = m.dof_jntid
        component = np.arange(m.nv) - m.jnt_dofadr[of_dof]
        joint = m.jnt_type[of_dof]
        turning = (joint == BALL) | ((joint == FREE) & (component >= 3))
        kind = np.where(turning, ROTATION, np.where(joint == FREE, TRANSLATION, joint))
        address = m.jnt_qposadr[of_dof] + np.where(turning, np.where(joint == FREE, 3, 0), component)
        tables.integers("dof_kind", kind)
        tables.integers("dof_component", np.where(kind <= ROTATION, component % 3, 0))
        tables.integers("dof_qpos", address)
        tables.integers("dof_link", [self.moving.index(b) for b in m.dof_bodyid])
        tables.structs("Vec", "dof_anchor", m.jnt_pos[of_dof] * (joint == BALL)[:, None])
        quaternions = [j for j in range(m.njnt) if m.jnt_type[j] in (FREE, BALL)]
        shift = [3 * (m.jnt_type[j] == FREE) for j in quaternions]
        tables.size(QUATERNIONS=len(quaternions))
        tables.integers("quaternion_qpos", [m.jnt_qposadr[j] + s for j, s in zip(quaternions, shift, strict=True)])
        tables.integers("quaternion_dof", [m.jnt_dofadr[j] + s for j, s in zip(quaternions, shift, strict=True)])

    def _add_limbs(self, tables: Tables) -> None:
        if self.limbs is None:
            return
        limbs, trunk, rows = self.limbs.limbs, self.limbs.trunk, self.limbs.rows
        of = [i for i, limb in enumerate(limbs) for _ in limb]
        tables.size(TRUNK=len(trunk), LIMBS=len(limbs), LIMB=self.limbs.longest, LIMB_ROWS=len(of))
        tables.integers("limb_row_dof", rows)
        tables.integers("limb_row_end", [limbs[i].stop for i in of])
        tables.integers("limb_of_row", of)
        tables.integers("limb_length", list(map(len, limbs)))
        places = {d: t for t, d in enumerate(trunk)}
        tables.integers("trunk_place", [places.get(d, -1) for d in range(self.layout.stride)])
        gradient = [(i, len(trunk)) for i in range(len(trunk))]
        lower = [(i, j) for i in range(len(trunk)) for j in range(i + 1)]
        unused = [(0, 0)] * 3
        corner = [*gradient, *unused[: -len(trunk) % 4], *lower, *unused[: -len(lower) % 4]]
        tables.integers("corner_row", [i for i, _ in corner])
        tables.integers("corner_column", [j for _, j in corner])
        tables.integers("crosses", [self.limbs.crosses(self._apart(pair)) for pair in self.pairs])

    def _add_forces(self, tables: Tables) -> None:
        m = self.m
        stiffness, damping = m.jnt_stiffness[m.dof_jntid], m.dof_damping
        explicit = m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP) and not is_implicitfast(m)
        implicit = present(damping) and not explicit
        tables.size(HAS_SPRINGS=present(stiffness), IMPLICIT_DAMPING=implicit or self.implicit_actuators)
        tables.floats("stiffness", stiffness)
        tables.floats("spring", m.qpos_spring)
        tables.floats("damping", damping)
        tables.floats("armature", m.dof_armature)
        above = [list(self._dofs_to_root(parent)) for parent in m.dof_parentid]
        entries = [64 * d + j for d, ancestors in enumerate(above) for j in ancestors]
        tables.size(MASS_ENTRIES=len(entries))
        tables.integers("mass_entry", entries, "unsigned")
        dofs = m.jnt_dofadr[m.actuator_trnid[self.acting, 0]]
        order = np.argsort(dofs, kind="stable")
        actuators = [self.actuators[i] for i in order]
        tables.integers("first_actuator", [sum(dofs < k) for k in range(m.nv + 1)])
        tables.integers("control", [self.acting[i] for i in order])
        tables.floats("gear", [a.gear for a in actuators])
        tables.floats("gain", [a.gain for a in actuators])
        for k, name in enumerate(("bias", "bias_position", "bias_velocity")):
            tables.floats(name, self.bias[order, k])
        free = (-UNLIMITED, UNLIMITED)
        of_controls = [free if a.control_range is None else a.control_range for a in actuators]
        of_forces = [free if a.force_range is None else a.force_range for a in actuators]
        for k, name in enumerate(("low", "high")):
            tables.floats(f"control_{name}", [limits[k] for limits in of_controls])
            tables.floats(f"force_{name}", [limits[k] for limits in of_forces])
        tables.size(IMPLICIT_ACTUATORS=self.implicit_actuators, JOINT_FORCE_LIMITS=self.joint_force_limits)
        limited = m.jnt_actfrclimited.astype(bool)
        forces = np.where(limited[:, None], m.jnt_actfrcrange, [-UNLIMITED, UNLIMITED])[m.dof_jntid]
        for k, name in enumerate(("low", "high")):
            tables.floats(f"joint_force_{name}", forces[:, k])

    def actuator(self) -> Actuator:
        """Returns an actuator that reads the tables."""

        def read(*titles: str) -> list[symbols.Scalar]:
            return [symbols.name(f"Model::{title}(a)") for title in titles]

        gear, gain = read("gear", "gain")
        return Actuator(
            gear,
            gain,
            read("bias", "bias_position", "bias_velocity") if present(self.bias) else None,
            read("control_low", "control_high") if any(a.control_range is not None for a in self.actuators) else None,
            read("force_low", "force_high") if any(a.force_range is not None for a in self.actuators) else None,
        )

    def _geom(self, g: int) -> tuple[int, np.ndarray, np.ndarray]:
        """Returns the link of a geom, and its center and z axis in the frame of the link."""
        place = self.places[self.m.geom_bodyid[g]]
        return place.link, place.point(self.m.geom_pos[g]), matrix(place.turn(self.m.geom_quat[g]))[:, 2]

    def _half_length(self, g: int) -> float:
        return float(self.m.geom_size[g, 1]) if self.m.geom_type[g] == CAPSULE else 0.0

    def _radius(self, g: int) -> float:
        """Returns the radius of a sphere or capsule, and that of the bounding sphere of a solid."""
        return float(self.m.geom_rbound[g] if self.m.geom_type[g] in SOLID else self.m.geom_size[g, 0])

    def _add_geoms(self, tables: Tables, mask: str) -> None:
        m, found = self.m, self.pairs
        geoms = [self._geom(g) for g in self.geoms]
        half = [self._half_length(g) for g in self.geoms]
        tables.integers("geom_link", [link for link, _, _ in geoms])
        tables.structs("Vec", "geom_position", [center for _, center, _ in geoms])
        tables.structs("Vec", "geom_half_axis", [axis * h for (_, _, axis), h in zip(geoms, half, strict=True)])
        tables.floats("geom_radius", [self._radius(g) for g in self.geoms])
        planes = [p for p in found if self.is_plane(p)]
        others = found[len(planes) :]
        of_part = dict.fromkeys(itertools.product((True, False), repeat=3), 0)  # in the order of the pairs
        for pair in found:
            of_part[self.is_plane(pair), pair.condim != 1, not self.is_solid(pair)] += 1
        shapes = (("PLANE", "SOLID"), ("GEOM", "BOX"))
        names = [f"{x}{friction}_END" for part in shapes for friction in ("_FRICTIONAL", "") for x in part]
        tables.size(PAIRS=len(found), **dict(zip(names, itertools.accumulate(of_part.values()), strict=True)))
        if any(map(self.is_solid, found)):
            tables.integers("geom_shape", [SHAPES.index(m.geom_type[g]) for g in self.geoms])
            tables.structs("Vec", "geom_size", m.geom_size[self.geoms])
            turns = [self.places[m.geom_bodyid[g]].turn(m.geom_quat[g]) for g in self.geoms]
            tables.structs("Mat", "geom_orientation", [matrix(turn).ravel() for turn in turns])
            solid = np.isin(m.geom_type[self.geoms], SOLID)
            tables.size(SOLIDS_TURNED=any(abs(turn[0]) < 1 for turn in itertools.compress(turns, solid)))
        if self.meshes:
            self._add_meshes(tables)
        index = {g: i for i, g in enumerate(self.geoms)}
        tables.integers("first_geom", [index.get(p.geoms[0], 0) for p in found])
        tables.integers("second_geom", [index[p.geoms[1]] for p in found])
        tables.integers("first_dofs", [self._dofs_of_geom(p.geoms[0]) for p in found], mask)
        tables.integers("second_dofs", [self._dofs_of_geom(p.geoms[1]) for p in found], mask)
        apart = [self._apart(pair) for pair in found]
        of_balls = [-1] * len(self.limited_balls)  # all of them
        quads = [sum(1 << i for i in range(self.layout.stride // 4) if dofs >> 4 * i & 15) for dofs in apart + of_balls]
        tables.integers("quads", quads, "unsigned")
        frames = [self._geom(p.geoms[0]) for p in planes]
        tables.structs("Vec", "plane_normal", [normal for _, _, normal in frames])
        tables.floats("plane_offset", [normal @ center for _, center, normal in frames])
        half = [self._half_length(p.geoms[1]) for p in planes]
        tables.floats("inverse_half_length", [1 / h if h else 0.0 for h in half])
        reach = [sum(self._radius(g) + self._half_length(g) for g in p.geoms) + p.margin for p in others]
        self._add_near_pairs(tables, [(index[a], index[b]) for a, b in (p.geoms for p in others)], reach)
        self._add_friction(tables)
        # The limits of ball joints follow the pairs.
        balls = self.limited_balls
        tables.size(BALL_LIMITS=len(balls))
        tables.integers("ball_qpos", [m.jnt_qposadr[j] for j in balls])
        tables.integers("ball_dof", [m.jnt_dofadr[j] for j in balls])
        tables.floats("ball_range", [m.jnt_range[j].max() for j in balls])
        tables.floats("margin", [*(p.margin for p in found), *m.jnt_margin[balls]])
        soft = [*((p.solref, p.solimp) for p in found), *((m.jnt_solref[j], m.jnt_solimp[j]) for j in balls)]
        tables.structs("Softness", "contact_softness", [self._softness(*s) for s in soft])
        inertias = m.dof_invweight0[m.jnt_dofadr[balls]]
        plain = not self.elliptic and self.layout.directions == 3
        if plain and any(varies(pair.friction) for pair in found):
            tables.floats("pair_weight", [*(pair.weight for pair in found), *inertias])
            self._add_formulas(tables, found[0])
        else:
            weights = [contact_weight(m, pair) for pair in found]
            least = [MINVAL if self.elliptic else least_regularisation(pair) for pair in found]
            tables.floats("least_regularisation", [*least, *(MINVAL for _ in balls)])
            tables.floats("inverse_inertia", [*weights, *inertias])

    def _add_near_pairs(self, tables: Tables, of: list[tuple[int, int]], reach: list[float]) -> None:
        """Adds a number for each pair of moving geoms: the square of its reach, with the geoms in its lowest bits.

        The square is rounded up, as the exact tests follow. Pairs beside them, which are none, fill the last rounds.
        """
        bits, rounds = max(1, (len(self.geoms) - 1).bit_length()), -(-len(of) // LANES)
        together = -(-rounds // max(1, -(-rounds // MOST_ROUNDS)))
        tables.size(GEOM_BITS=bits, NEAR_ROUNDS=together)
        lowest = (1 << 2 * bits) - 1
        squared = [(int(np.float32(r * r).view(np.uint32)) + lowest) & ~lowest for r in reach]
        near = [r | a | b << bits for r, (a, b) in zip(squared, of, strict=True)]
        none = pad(len(near), max(1, together) * LANES) - len(near)
        tables.integers("near_pair", near + [0] * none, "unsigned")

    def _add_formulas(self, tables: Tables, pair: Pair) -> None:
        """Adds what follows from friction: the row of a world has less to read without it, as pairs are many."""
        friction, weight = symbols.name("mu"), symbols.name("weight")
        of_pair = "Model::BALL_LIMITS && i >= Model::PAIRS ? 0.0f : friction(i)"
        parts = {"mu": of_pair, "weight": "Model::pair_weight(i)"}
        pair = dataclasses.replace(pair, condim=3, friction=friction, weight=weight)
        for name, found, otherwise in (
            ("least_regularisation", least_regularisation(pair), MINVAL),
            ("inverse_inertia", contact_weight(self.m, pair), weight),
        ):
            tables.formula(name, symbols.select(friction, ">", 0, found, otherwise), **parts)

    def _add_friction(self, tables: Tables) -> None:
        """Adds the factors of the rows of the Jacobian off the normal, and what else the laws of friction read.

        The factors of a pyramid are the coefficients of friction. An elliptic cone becomes a round one of slope ``mu``,
        with the normal as it is, by factors that are the coefficients over ``mu``; the ratio of impedances makes it
        less steep than sliding friction.
        """
        found, ratio = self.pairs, math.sqrt(self.m.opt.impratio)
        tables.size(ELLIPTIC=self.elliptic)
        slopes: list[Number] = [1.0] * len(found)
        if self.elliptic:
            slopes = [p.friction / ratio if p.condim > 1 else 1.0 for p in found]
            tables.floats("mu", slopes)
        tables.floats("friction", [ratio if self.elliptic else p.friction for p in found])
        tables.floats("friction_ratio", [p.friction_ratio for p in found])
        if self.layout.directions > 3:
            tables.floats("torsional", [p.torsional / mu for p, mu in zip(found, slopes, strict=True)])
            tables.floats("rolling", [p.rolling / mu for p, mu in zip(found, slopes, strict=True)])
            tables.floats("rolling_ratio", [p.rolling_ratio for p in found])
        if self.some_lack_edges:
            tables.integers("edges", [2 * (p.condim - 1) for p in found])

    def _add_meshes(self, tables: Tables) -> None:
        of = [int(self.m.geom_dataid[g]) if self.m.geom_type[g] == MESH else -1 for g in self.geoms]
        used = list(self.meshes)
        meshes = list(self.meshes.values())
        sizes = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        corners = [
            (normal, [sizes[i] + vertex for vertex in others] + [-1] * (3 - len(others)))
            for i, mesh in enumerate(meshes)
            for of_vertex in mesh.corners
            for normal, others in of_vertex
        ]
        counts = [len(of_vertex) for mesh in meshes for of_vertex in mesh.corners]
        tables.integers("first_vertex", [sizes[used.index(mesh)] if mesh >= 0 else 0 for mesh in of])
        tables.integers("last_vertex", [sizes[used.index(mesh) + 1] if mesh >= 0 else 0 for mesh in of])
        tables.structs("Vec", "vertex", np.concatenate([mesh.vertices for mesh in meshes]))
        tables.integers("first_corner", np.cumsum([0, *counts]))
        tables.structs("Vec", "corner_normal", [normal for normal, _ in corners])
        tables.integers("corner_vertex", [vertex for _, others in corners for vertex in others])

    def _dofs_of_geom(self, g: int) -> int:
        """Returns a bit for each degree of freedom that moves a geom."""
        link = self.places[self.m.geom_bodyid[g]].link
        if link < 0:
            return 0
        body = self.moving[link]
        return self.ancestors[self.m.body_dofadr[body] + self.m.body_dofnum[body] - 1]

    def _apart(self, pair: Pair) -> int:
        """Returns a bit for each degree of freedom that moves one geom of a pair alone."""
        return self._dofs_of_geom(pair.geoms[0]) ^ self._dofs_of_geom(pair.geoms[1])

    def _softness(self, solref: Sequence[float], solimp: Sequence[float]) -> list[float]:
        """Returns the members of struct Softness."""
        return list(dataclasses.astuple(Softness.make(self.m, solref, solimp)))

    def _add_limits(self, tables: Tables) -> None:
        m = self.m
        joint = {int(m.jnt_dofadr[j]): j for j in self.limited}
        of = [joint.get(d) for d in range(m.nv)]
        tables.floats("limit_low", [-UNLIMITED if j is None else m.jnt_range[j, 0] for j in of])
        tables.floats("limit_high", [UNLIMITED if j is None else m.jnt_range[j, 1] for j in of])
        some = [self.limited[0] if j is None and self.limited else j for j in of]  # so that equal ones fold
        tables.floats("limit_margin", [0.0 if j is None else m.jnt_margin[j] for j in some])
        tables.floats("limit_inverse_inertia", m.dof_invweight0)
        soft = [self._softness(m.jnt_solref[j], m.jnt_solimp[j]) for j in some if j is not None]
        tables.structs("Softness", "limit_softness", soft)
        # Dry friction: a row at distance zero, so that its weight and damping are constant.
        friction = [self._softness(m.dof_solref[d], m.dof_solimp[d]) for d in self.losses]
        damping, impedance = [s[1] for s in friction], np.array([s[2] for s in friction])
        weight = 1 / np.maximum(MINVAL, m.dof_invweight0[self.losses] * (1 - impedance) / impedance)
        tables.integers("friction_row", [self.losses.index(d) if d in self.losses else -1 for d in range(m.nv)])
        tables.integers("friction_dof", self.losses)
        tables.floats("friction_damping", damping)
        tables.floats("friction_weight", weight)
        tables.floats("friction_bound", m.dof_frictionloss[self.losses] / weight)

    def _add_outputs(self, tables: Tables) -> None:
        m = self.m
        tables.integers("body_link", [p.link for p in self.places])
        tables.structs("Vec", "body_position", [p.position for p in self.places])
        tables.structs("Mat", "body_orientation", [matrix(p.quaternion).ravel() for p in self.places])
        parts = [
            [(i, x.center, x.mass / m.body_subtreemass[body]) for i, x in self._parts_below(body)]
            for _, body, _ in self.subtrees
        ]
        flat = [part for group in parts for part in group]
        tables.size(SUBTREES=len(self.subtrees))
        tables.integers("subtree_address", [address for _, _, address in self.subtrees])
        tables.integers("first_part", np.cumsum([0, *map(len, parts)]))
        tables.integers("part_link", [link for link, _, _ in flat])
        tables.structs("Vec", "part_center", [center for _, center, _ in flat])
        tables.floats("part_share", [share for _, _, share in flat])
        self._add_momenta(tables)
        self._add_touch(tables)

    def _parts_below(self, body: int) -> list[tuple[int, Mass]]:
        """Returns links of a subtree, and what of each belongs to it."""
        inside = set(subtree(self.m, body))
        by_link = [(i, [b for b in bodies if b in inside]) for i, bodies in enumerate(self.members)]
        return [(i, Mass.join(self.m, self.places, bodies)) for i, bodies in by_link if bodies]

    def _add_momenta(self, tables: Tables) -> None:
        parts = [self._parts_below(body) for _, body, _ in self.momenta]
        flat = [part for group in parts for part in group]
        tables.size(MOMENTA=len(self.momenta))
        tables.integers("momentum_address", [address for _, _, address in self.momenta])
        tables.floats("momentum_inverse_mass", [1 / self.m.body_subtreemass[body] for _, body, _ in self.momenta])
        tables.integers("first_momentum_part", np.cumsum([0, *map(len, parts)]))
        tables.integers("momentum_link", [link for link, _ in flat])
        tables.structs("Vec", "momentum_center", [x.center for _, x in flat])
        tables.structs("Symmetric", "momentum_inertia", [x.moments[np.triu_indices(3)] for _, x in flat])
        tables.floats("momentum_mass", [x.mass for _, x in flat])

    def _add_touch(self, tables: Tables) -> None:
        m, sites = self.m, [site for _, site, _ in self.touch]
        at = [(s, self.places[m.site_bodyid[s]]) for s in sites]
        sphere = int(mujoco.mjtGeom.mjGEOM_SPHERE)
        sizes = [m.site_size[s, [0, 0, 0]] if m.site_type[s] == sphere else m.site_size[s] for s in sites]
        tables.integers("touch_address", [address for _, _, address in self.touch])
        tables.integers("site_body", m.site_bodyid[sites])
        tables.integers("site_link", [p.link for _, p in at])
        tables.integers("site_shape", [SHAPES.index(m.site_type[s]) for s in sites])
        tables.structs("Vec", "site_size", sizes)
        tables.structs("Vec", "site_position", [p.point(m.site_pos[s]) for s, p in at])
        tables.structs("Mat", "site_orientation", [matrix(p.turn(m.site_quat[s])).ravel() for s, p in at])
        bodies = [m.geom_bodyid[list(p.geoms)] for p in self.pairs] if sites else []
        tables.integers("first_body", [first for first, _ in bodies])
        tables.integers("second_body", [second for _, second in bodies])

    def _add_contact_geoms(self, tables: Tables, geoms: Sequence[int]) -> None:
        index, balls = {geom: i for i, geom in enumerate(geoms)}, [-1] * len(self.limited_balls)
        for i, title in enumerate(("first", "second")):
            tables.integers(f"{title}_contact_geom", [*(index.get(p.geoms[i], -1) for p in self.pairs), *balls])

    def worlds_per_block(self) -> int:
        """Returns how many worlds share a block of threads: a power of two, as shared memory allows."""
        fit = max(1, BLOCK_BYTES // (self.layout.bytes + WARP_BYTES))
        return min(MOST_WORLDS, 1 << int(math.log2(fit)))

    def registers(self) -> int:
        """Returns how many registers of a thread leave a multiprocessor as many worlds as its shared memory does."""
        worlds = self.worlds_per_block()
        worlds *= MULTIPROCESSOR_BYTES // (worlds * (self.layout.bytes + WARP_BYTES) + SYSTEM_BYTES)
        return min(REGISTERS // (LANES * math.ceil(worlds / SCHEDULERS)) // 8 * 8, 255)

    def elimination(self) -> str:
        """Returns calls that eliminate all rows, in blocks of four: first those of which a lane has several."""
        last = self.layout.stride // 4 - 1
        edges = [last, *([LANES // 4] if last > LANES // 4 else []), -1]
        return "\n".join(f"    eliminate(h, {first}, {end});" for first, end in itertools.pairwise(edges))


def source(
    m: mujoco.MjModel,
    substeps: int,
    *,
    with_subtree_com: bool = False,
    contact_geoms: Sequence[int] = (),
    contact_rows: int = 1,
) -> str:
    """Returns the C++ of a control step of one world, the body of a function of its arrays.

    Args:
        m: the model, or a ``VariedModel``.
        substeps: physics steps; 0 evaluates the state without stepping.
        with_subtree_com: whether the centers of mass of the trees are written.
        contact_geoms: geoms whose contact forces are written.
        contact_rows: how many rows of them: one for the last substep, or one for each.
    """
    description = Description(m)
    contacts: dict[str, Any] = {"contact_geoms": contact_geoms, "contact_rows": contact_rows}
    tables = description.tables(substeps, with_subtree_com=with_subtree_com, **contacts)
    asked = {
        "SUBTREE_COM": with_subtree_com,
        "MOMENTA": len(description.momenta) > 0,
        "CONTACT_GEOMS": len(contact_geoms) > 0,
        "ELLIPTIC": description.elliptic,
        "TURNING": description.layout.directions > 3,
        "SOME_LACK_EDGES": description.some_lack_edges,
        "MESHES": bool(description.meshes),
        "SOLIDS": any(map(description.is_solid, description.pairs)),
        "LIMBS": description.limbs is not None,
        "BOXES": any(description.is_solid(p) and not description.is_plane(p) for p in description.pairs),
    }
    text = _parts(TEMPLATE.read_text(), asked).replace("//ACTUATOR", description.actuator().as_cpp())
    text = tables.use(text)
    text = text.replace("//SHARED", shared.LAWS).replace("//SOFTNESS", Softness.as_cpp())
    text = text.replace("//SPATIAL", spatial.as_cpp())
    text = text.replace("//LINE_SEARCH", LINE_SEARCH).replace("//NEWTON", NEWTON)
    text = text.replace("//MODEL", tables.text()).replace("//ELIMINATE", description.elimination())
    return text.replace("//VARYING", tables.varied_text()).replace("//DERIVE", "" if substeps else tables.row.derive())


def nominal_row(m: VariedModel) -> np.ndarray:
    """Returns what the lanes read of the model itself: its numbers, then what follows from them."""
    return Description(m).tables(0).row.nominal(m.varied)


def _parts(text: str, asked: dict[str, bool]) -> str:
    """Returns a text without the parts that are not asked for.

    A part stands between the lines ``//IF NAME`` and ``//END``; what follows a line ``//ELSE`` in it is for the
    opposite. Parts may stand in parts.
    """
    lines: list[str] = []
    keep: list[bool] = []
    for line in text.splitlines(keepends=True):
        match line.split():
            case ["//IF", name]:
                keep.append(asked[name])
            case ["//ELSE"]:
                keep[-1] = not keep[-1]
            case ["//END"]:
                keep.pop()
            case _ if all(keep):
                lines.append(line)
    return "".join(lines)
