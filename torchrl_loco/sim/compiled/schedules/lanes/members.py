"""Struct ``Model`` of what lanes run: sizes, constants and tables; and ``Varied``, for what worlds differ in."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.ground import BOX_NUMBERS
from torchrl_loco.sim.compiled.collision.kinds import MESH, POINT_BITS, SHAPES, SOLID
from torchrl_loco.sim.compiled.collision.pairs import Pair, contact_weight, half_length, impratio, least_regularisation
from torchrl_loco.sim.compiled.collision.planes import LEAST_ALIGNED
from torchrl_loco.sim.compiled.ir import symbols
from torchrl_loco.sim.compiled.ir.parameters import Number, VariedModel, nominal, positive, present, varies
from torchrl_loco.sim.compiled.ir.tables import Tables
from torchrl_loco.sim.compiled.physics.actuators import activation_flow
from torchrl_loco.sim.compiled.physics.delicate import LEAST_PIVOT, is_delicate
from torchrl_loco.sim.compiled.physics.dynamics import BALL, FREE, MINVAL, SLIDE
from torchrl_loco.sim.compiled.physics.lengths import OF_TENDON, Length
from torchrl_loco.sim.compiled.physics.links import matrix
from torchrl_loco.sim.compiled.physics.sensors import GYRO, TORQUE, subtree
from torchrl_loco.sim.compiled.schedules.lanes.description import LANES, Description, dofs_of, is_implicitfast
from torchrl_loco.sim.compiled.schedules.lanes.layout import pad
from torchrl_loco.sim.compiled.schedules.shared import Asked, add_options

TRANSLATION, ROTATION = 0, 1
"""Kinds of a degree of freedom in ``world.h``; SLIDE and HINGE are MuJoCo's numbers of the joints."""
UNLIMITED = 1e30
MOST_ROUNDS = 4  # pairs of geoms whose bounding spheres a lane compares side by side, at most


def members(d: Description, substeps: int, asked: Asked) -> Tables:
    """Returns structs ``Model`` and ``Varied``."""
    m, layout = d.m, d.layout
    tables = Tables(m.varied.count if isinstance(m, VariedModel) else 0)
    mask = "unsigned" if m.nv <= 32 else "unsigned long long"
    tables.lines.append(f"  typedef {mask} Dofs;  // a bit for each degree of freedom")
    tables.size(
        SUBSTEPS=substeps,
        WORLD_BYTES=layout.bytes,
        WORLDS_PER_BLOCK=d.worlds_per_block(),
        CONTROLS=m.nu,
        BODIES=m.nbody,
        SENSOR_VALUES=m.nsensordata,
        LIMIT_SIDES=d.limit_sides,
        VARIED=isinstance(m, VariedModel),
        ROWS=layout.rows,
        **{name.upper(): size for name, size in dataclasses.asdict(layout).items()},
    )
    add_options(tables, m, DELICATE=is_delicate(nominal(m)), BY_SLOPES=False)
    tables.constant(timestep=m.opt.timestep, least_aligned=LEAST_ALIGNED, least_pivot=LEAST_PIVOT)
    tables.structs("Vec", "gravity", [m.opt.gravity])
    _add_links(tables, d)
    _add_joints(tables, d)
    _add_limbs(tables, d)
    _add_forces(tables, d)
    _add_geoms(tables, d, mask)
    _add_limits(tables, d)
    _add_outputs(tables, d)
    tables.integers("root_body", d.roots)
    tables.size(HISTORY=asked.contact_rows, SUBTREE_COM=asked.with_subtree_com)
    _add_contact_geoms(tables, d, asked.contact_geoms)
    return tables


def _add_links(tables: Tables, d: Description) -> None:
    m, moving = d.m, d.moving
    parents = [d.places[m.body_parentid[b]] for b in moving]
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
    tables.floats("link_mass", [x.mass for x in d.masses])
    tables.structs("Vec", "link_center", [x.center for x in d.masses])
    tables.structs("Symmetric", "link_inertia", [x.moments[np.triu_indices(3)] for x in d.masses])
    tables.integers("tree", [d.roots.index(m.body_rootid[b]) for b in moving])
    tables.integers("first_joint", [*m.body_jntadr[moving], m.njnt])
    tables.integers("first_dof", [*m.body_dofadr[moving], m.nv])
    moments, totals = [], []
    for root in d.roots:
        bodies = [b for b in range(1, m.nbody) if m.body_rootid[b] == root]
        totals.append(m.body_mass[bodies].sum())
        fixed = [m.body_mass[b] * d.places[b].point(m.body_ipos[b]) for b in bodies if d.places[b].link < 0]
        moments.append(np.sum(fixed, axis=0) if fixed else np.zeros(3))
    tables.structs("Vec", "fixed_moment", moments)
    tables.floats("inverse_mass", [1 / total for total in totals])
    steps = [f"x[{p.link}] += x[{i}];" for i, p in reversed(list(enumerate(parents))) if p.link >= 0]
    tables.function("void", "add_children", steps, "float* x")


def _add_joints(tables: Tables, d: Description) -> None:
    m = d.m
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
    tables.integers("dof_link", [d.moving.index(b) for b in m.dof_bodyid])
    tables.structs("Vec", "dof_anchor", m.jnt_pos[of_dof] * (joint == BALL)[:, None])
    quaternions = [j for j in range(m.njnt) if m.jnt_type[j] in (FREE, BALL)]
    shift = [3 * (m.jnt_type[j] == FREE) for j in quaternions]
    tables.size(QUATERNIONS=len(quaternions))
    tables.integers("quaternion_qpos", [m.jnt_qposadr[j] + s for j, s in zip(quaternions, shift, strict=True)])
    tables.integers("quaternion_dof", [m.jnt_dofadr[j] + s for j, s in zip(quaternions, shift, strict=True)])


def _add_limbs(tables: Tables, d: Description) -> None:
    tables.integers("crosses", [d.limbs is not None and d.limbs.crosses(d.apart(pair)) for pair in d.pairs])
    if d.limbs is None:
        return
    limbs, trunk, rows = d.limbs.limbs, d.limbs.trunk, d.limbs.rows
    of = [i for i, limb in enumerate(limbs) for _ in limb]
    tables.size(TRUNK=len(trunk), LIMBS=len(limbs), LIMB=d.limbs.longest, LIMB_ROWS=len(of))
    tables.integers("limb_row_dof", rows)
    tables.integers("limb_row_end", [limbs[i].stop for i in of])
    tables.integers("limb_of_row", of)
    tables.integers("limb_length", list(map(len, limbs)))
    places = {dof: t for t, dof in enumerate(trunk)}
    tables.integers("trunk_place", [places.get(dof, -1) for dof in range(d.layout.stride)])
    gradient = [(i, len(trunk)) for i in range(len(trunk))]
    lower = [(i, j) for i in range(len(trunk)) for j in range(i + 1)]
    unused = [(0, 0)] * 3
    corner = [*gradient, *unused[: -len(trunk) % 4], *lower, *unused[: -len(lower) % 4]]
    tables.integers("corner_row", [i for i, _ in corner])
    tables.integers("corner_column", [j for _, j in corner])


def _add_forces(tables: Tables, d: Description) -> None:
    m = d.m
    stiffness, damping = m.jnt_stiffness[m.dof_jntid], m.dof_damping
    explicit = m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    implicit = present(damping) if is_implicitfast(m) else positive(damping) and not explicit
    tables.size(HAS_SPRINGS=present(stiffness), IMPLICIT_DAMPING=implicit or d.implicit_actuators)
    tables.floats("stiffness", stiffness)
    tables.floats("spring", m.qpos_spring)
    tables.floats("damping", damping)
    tables.floats("armature", m.dof_armature)
    moved = [d.moved[body] for body in m.dof_bodyid]
    entries = [64 * dof + j for dof in range(m.nv) for j in reversed(range(dof)) if moved[dof] >> j & 1]
    tables.size(MASS_ENTRIES=len(entries))
    tables.integers("mass_entry", entries, "unsigned")
    of = [Length.of_tendon if m.actuator_trntype[i] == OF_TENDON else Length.of_joint for i in d.acting]
    lengths = [length(nominal(m), int(m.actuator_trnid[i, 0])) for length, i in zip(of, d.acting, strict=True)]
    pulls = sorted((dof, i, share) for i, length in enumerate(lengths) for dof, share in length.shares)
    order = [i for _, i, _ in pulls]  # an actuator comes once for each degree of freedom that it pulls
    actuators = [d.actuators[i] for i in order]
    tables.integers("first_actuator", [sum(dof < k for dof, *_ in pulls) for k in range(m.nv + 1)])
    tables.integers("control", [d.acting[i] for i in order])
    shares = [share for i in order for share in lengths[i].shares]
    tables.size(TENDONS=d.pulls_tendons)
    tables.floats("own_pull", [share for *_, share in pulls])
    tables.integers("first_pull", np.cumsum([0, *(len(lengths[i].shares) for i in order)]))
    tables.integers("pull_dof", [dof for dof, _ in shares])
    tables.floats("pull", [share for _, share in shares])
    tables.floats("gear", [a.gear for a in actuators])
    tables.floats("gain", [a.gain for a in actuators])
    for k, name in enumerate(("bias", "bias_position", "bias_velocity")):
        tables.floats(name, d.bias[order, k])
    _add_ranges(tables, "control", [a.control_range for a in actuators])
    _add_ranges(tables, "force", [a.force_range for a in actuators])
    _add_activations(tables, d, order)
    tables.size(IMPLICIT_ACTUATORS=d.implicit_actuators, JOINT_FORCE_LIMITS=d.joint_force_limits)
    _add_ranges(tables, "joint_force", [m.jnt_actfrcrange[j] if m.jnt_actfrclimited[j] else None for j in m.dof_jntid])


def _add_ranges(tables: Tables, name: str, ranges: Sequence[Any]) -> None:
    """Adds the ends of ranges; ``None`` has no limits."""
    for k, (end, free) in enumerate((("low", -UNLIMITED), ("high", UNLIMITED))):
        tables.floats(f"{name}_{end}", [free if limits is None else limits[k] for limits in ranges])


def _add_activations(tables: Tables, d: Description, order: list[int]) -> None:
    m = d.m
    tables.integers("activation", [m.actuator_actadr[d.acting[i]] for i in order])
    found = sorted((m.actuator_actadr[i], i) for i in d.acting if m.actuator_actadr[i] >= 0)
    tables.integers("activated", [order.index(d.acting.index(i)) for _, i in found])
    flows = [activation_flow(m, i) for _, i in found]
    tables.floats("inflow", [flow for flow, _ in flows])
    tables.floats("outflow", [flow for _, flow in flows])
    _add_ranges(tables, "act", [m.actuator_actrange[i] if m.actuator_actlimited[i] else None for _, i in found])


def _add_equalities(tables: Tables, d: Description) -> None:
    found = d.equalities
    first = len(d.pairs) + len(d.limited_balls) + len(found)
    tables.size(EQUALITIES=len(found), FIRST_WELD=first, TWO_SIDED=len(found) + d.layout.weld_rows)
    tables.integers("first_share", np.cumsum([0, *(len(e.shares) for e in found)]))
    shares = [share for e in found for share in e.shares]
    tables.integers("share_dof", [dof for dof, _ in shares])
    tables.floats("share", [share for _, share in shares])
    tables.integers("of_second", [k >= len(e.first.shares) for e in found for k in range(len(e.shares))])
    tables.floats("equality_reference", [e.first.at_home for e in found])
    tables.floats("other_reference", [e.second.at_home if e.second else 0.0 for e in found])
    tables.floats("polynomial", [x for e in found for x in e.polynomial])


def _add_welds(tables: Tables, d: Description, mask: str) -> None:
    welds = d.welds
    tables.integers("weld_of_row", [i for i, weld in enumerate(welds) for _ in range(weld.rows)])
    tables.integers("weld_axis", [k for weld in welds for k in range(weld.rows)])
    tables.integers("weld_rows", [weld.rows for weld in welds])
    tables.floats("weld_scale", [weld.scale for weld in welds])
    for end, title in enumerate(("first", "second")):
        at = [(weld, d.places[weld.bodies[end]]) for weld in welds]
        unturned = np.array([1.0, 0.0, 0.0, 0.0])
        turns = [place.turn(unturned if weld.turns is None else weld.turns[end]) for weld, place in at]
        tables.integers(f"weld_{title}_link", [place.link for _, place in at])
        tables.structs("Vec", f"weld_{title}_point", [place.point(weld.points[end]) for weld, place in at])
        tables.structs("Mat", f"weld_{title}_turn", [matrix(turn) for turn in turns])
        tables.integers(f"weld_{title}_dofs", [d.moved[weld.bodies[end]] for weld in welds], mask)


def _add_geoms(tables: Tables, d: Description, mask: str) -> None:
    m, found, balls = d.m, d.pairs, d.limited_balls
    geoms = [d.geom_frame(g) for g in d.geoms]
    half = [half_length(m, g) for g in d.geoms]
    tables.integers("geom_link", [link for link, _, _ in geoms])
    tables.structs("Vec", "geom_position", [center for _, center, _ in geoms])
    tables.structs("Vec", "geom_half_axis", [axis * h for (_, _, axis), h in zip(geoms, half, strict=True)])
    tables.floats("geom_radius", [d.radius(g) for g in d.geoms])
    planes = [p for p in found if d.is_ground(p)]
    others = found[len(planes) :]
    tables.size(PAIRS=len(found), PLANE_PAIRS=len(planes), POINT_BITS=POINT_BITS)
    if d.has_solids or d.ground.boxes is not None:
        tables.integers("geom_shape", [SHAPES.index(m.geom_type[g]) for g in d.geoms])
        tables.structs("Vec", "geom_size", m.geom_size[d.geoms])
        turns = [d.places[m.geom_bodyid[g]].turn(m.geom_quat[g]) for g in d.geoms]
        tables.structs("Mat", "geom_orientation", [matrix(turn) for turn in turns])
        solid = np.isin(m.geom_type[d.geoms], SOLID)
        tables.size(SOLIDS_TURNED=any(abs(turn[0]) < 1 for turn in itertools.compress(turns, solid)))
    _add_meshes(tables, d)
    _add_ground(tables, d)
    index = {g: i for i, g in enumerate(d.geoms)}
    for i, title in enumerate(("first", "second")):
        tables.integers(f"{title}_geom", [index.get(p.geoms[i], 0) for p in found])
        tables.integers(f"{title}_dofs", [d.moved[m.geom_bodyid[p.geoms[i]]] for p in found], mask)
    lasting = [  # degrees of freedom, margin, softness and inverse inertia of each
        *((-1, m.jnt_margin[j], m.jnt_solref[j], m.jnt_solimp[j], m.dof_invweight0[m.jnt_dofadr[j]]) for j in balls),
        *((dofs_of(e), 0.0, e.solref, e.solimp, e.weight) for e in d.equalities),
        *((d.dofs_of_weld(x), 0.0, x.solref, x.solimp, x.weights[k // 3]) for x in d.welds for k in range(x.rows)),
    ]
    moved = [*map(d.apart, found), *(dofs for dofs, *_ in lasting)]
    quads = [sum(1 << i for i in range(d.layout.stride // 4) if dofs >> 4 * i & 15) for dofs in moved]
    tables.integers("quads", quads, "unsigned")
    frames = [d.geom_frame(p.geoms[0]) for p in planes]
    tables.structs("Vec", "plane_normal", [normal for _, _, normal in frames])
    tables.floats("plane_offset", [normal @ center for _, center, normal in frames])
    half = [half_length(m, p.geoms[1]) for p in planes]
    tables.floats("inverse_half_length", [1 / h if h else 0.0 for h in half])
    reach = [sum(d.radius(g) + half_length(m, g) for g in p.geoms) + p.margin for p in others]
    _add_near_pairs(tables, d, [(index[a], index[b]) for a, b in (p.geoms for p in others)], reach)
    _add_friction(tables, d)
    # The limits of ball joints follow the pairs, then the equalities, then the rows of welds and connections.
    _add_equalities(tables, d)
    _add_welds(tables, d, mask)
    tables.size(BALL_LIMITS=len(balls), LASTING=d.lasting)
    tables.integers("ball_qpos", [m.jnt_qposadr[j] for j in balls])
    tables.integers("ball_dof", [m.jnt_dofadr[j] for j in balls])
    tables.floats("ball_range", [m.jnt_range[j].max() for j in balls])
    tables.floats("margin", [*(p.margin for p in found), *(margin for _, margin, *_ in lasting)])
    soft = [*((p.solref, p.solimp) for p in found), *(softness for _, _, *softness, _ in lasting)]
    tables.structs("Softness", "contact_softness", [d.softness(*s) for s in soft])
    inertias = [inertia for *_, inertia in lasting]
    plain = not d.elliptic and d.layout.directions == 3
    if plain and any(varies(pair.friction) for pair in found):
        tables.floats("pair_weight", [*(pair.weight for pair in found), *inertias])
        _add_formulas(tables, d, found[0])
    else:
        weights = [contact_weight(m, pair) for pair in found]
        least = [MINVAL if d.elliptic else least_regularisation(pair) for pair in found]
        tables.floats("least_regularisation", [*least, *(MINVAL for _ in inertias)])
        tables.floats("inverse_inertia", [*weights, *inertias])


def _add_near_pairs(tables: Tables, d: Description, of: list[tuple[int, int]], reach: list[float]) -> None:
    """Adds a number for each pair of moving geoms: the square of its reach, with the geoms in its lowest bits.

    The square is rounded up, as the exact tests follow. Pairs beside them, which are none, fill the last rounds.
    """
    bits, rounds = max(1, (len(d.geoms) - 1).bit_length()), -(-len(of) // LANES)
    together = -(-rounds // max(1, -(-rounds // MOST_ROUNDS)))
    tables.size(GEOM_BITS=bits, NEAR_ROUNDS=together)
    lowest = (1 << 2 * bits) - 1
    squared = [(int(np.float32(r * r).view(np.uint32)) + lowest) & ~lowest for r in reach]
    near = [r | a | b << bits for r, (a, b) in zip(squared, of, strict=True)]
    none = pad(len(near), max(1, together) * LANES) - len(near)
    tables.integers("near_pair", near + [0] * none, "unsigned")


def _add_formulas(tables: Tables, d: Description, pair: Pair) -> None:
    """Adds what follows from friction: the row of a world has less to read without it, as pairs are many."""
    friction, weight = symbols.name("mu"), symbols.name("weight")
    of_pair = "Model::LASTING && i >= Model::PAIRS ? 0.0f : friction(i)"
    parts = {"mu": of_pair, "weight": "Model::pair_weight(i)"}
    pair = dataclasses.replace(pair, condim=3, friction=friction, weight=weight)
    for name, found, otherwise in (
        ("least_regularisation", least_regularisation(pair), MINVAL),
        ("inverse_inertia", contact_weight(d.m, pair), weight),
    ):
        tables.formula(name, symbols.select(friction, ">", 0, found, otherwise), **parts)


def _add_friction(tables: Tables, d: Description) -> None:
    """Adds the factors of the rows of the Jacobian off the normal, and what else the laws of friction read.

    The factors of a pyramid are the coefficients of friction. An elliptic cone becomes a round one of slope ``mu``,
    with the normal as it is, by factors that are the coefficients over ``mu``; the ratio of impedances makes it
    less steep than sliding friction.
    """
    found, ratio = d.pairs, math.sqrt(impratio(d.m))
    tables.size(ELLIPTIC=d.elliptic)
    slopes: list[Number] = [p.friction / ratio if d.elliptic and p.condim > 1 else 1.0 for p in found]
    tables.floats("mu", slopes)
    tables.floats("friction", [ratio if d.elliptic else p.friction for p in found])
    tables.floats("friction_ratio", [p.friction_ratio for p in found])
    tables.floats("torsional", [p.torsional / mu for p, mu in zip(found, slopes, strict=True)])
    tables.floats("rolling", [p.rolling / mu for p, mu in zip(found, slopes, strict=True)])
    tables.floats("rolling_ratio", [p.rolling_ratio for p in found])
    rows = d.layout.contact_rows  # a pyramid may have fewer edges; where none does, this folds
    tables.integers("edges", [rows if d.elliptic or p.condim == 1 else 2 * (p.condim - 1) for p in found])


def _add_meshes(tables: Tables, d: Description) -> None:
    of = [int(d.m.geom_dataid[g]) if d.m.geom_type[g] == MESH else -1 for g in d.geoms]
    used = list(d.meshes)
    meshes = list(d.meshes.values())
    sizes = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    corners = [
        (normal, [sizes[i] + vertex for vertex in others] + [-1] * (3 - len(others)))
        for i, mesh in enumerate(meshes)
        for of_vertex in mesh.corners
        for normal, others in of_vertex
    ]
    counts = [len(of_vertex) for mesh in meshes for of_vertex in mesh.corners]
    tables.size(MESHES=len(meshes))
    tables.integers("first_vertex", [sizes[used.index(mesh)] if mesh >= 0 else 0 for mesh in of])
    tables.integers("last_vertex", [sizes[used.index(mesh) + 1] if mesh >= 0 else 0 for mesh in of])
    tables.structs("Vec", "vertex", [vertex for mesh in meshes for vertex in mesh.vertices])
    tables.integers("first_corner", np.cumsum([0, *counts]))
    tables.structs("Vec", "corner_normal", [normal for normal, _ in corners])
    tables.integers("corner_vertex", [vertex for _, others in corners for vertex in others])


def _add_ground(tables: Tables, d: Description) -> None:
    fields, boxes, tops = d.ground.fields, d.ground.boxes, d.ground.tops
    if tops is None:
        return
    tables.size(FIELDS=len(fields))
    tables.structs("Vec", "field_corner", [field.corner for field in fields])
    tables.structs("Mat", "field_orientation", [field.orientation for field in fields])
    tables.floats("cell_width", [field.cell[0] for field in fields])
    tables.floats("cell_height", [field.cell[1] for field in fields])
    tables.floats("field_columns", [field.heights.shape[1] - 1 for field in fields])
    tables.floats("field_rows", [field.heights.shape[0] - 1 for field in fields])
    tables.floats("field_base", [field.base for field in fields])
    tables.floats("field_top", [field.heights.max() for field in fields])
    starts = np.cumsum([0, *(field.heights.size for field in fields)])[:-1]
    tables.integers("field_data", starts, "unsigned")
    tables.integers("field_pair", [i for field in fields for i in d.pairs_on(field.like, "round_on_field")])
    end = sum(field.heights.size for field in fields)
    if boxes is not None:
        grid, start, cells = boxes.grid, end, end + BOX_NUMBERS * len(boxes.numbers)
        named = cells + len(grid.first)
        end = named + len(grid.named)
        tables.size(BOXES=start, CELLS=cells, NAMED=named, BOX_KINDS=len(boxes.kinds))
        tables.size(BOX_NUMBERS=BOX_NUMBERS, GRID_COLUMNS=grid.shape[0], GRID_ROWS=grid.shape[1])
        tables.constant(grid_x=grid.corner[0], grid_y=grid.corner[1], grid_cell=grid.cell)
        functions = ("box_on_boxes", "round_on_boxes")
        pairs = [i for kind in boxes.kinds for function in functions for i in d.pairs_on(kind, function)]
        tables.integers("on_boxes_pair", pairs)
    tables.size(TOPS=end, TOPS_COLUMNS=tops.heights.shape[1], TOPS_ROWS=tops.heights.shape[0])
    margin = max((p.margin for p in d.pairs if d.is_ground(p)), default=0.0)
    tables.constant(ground_margin=margin, tops_x=tops.corner[0], tops_y=tops.corner[1], tops_cell=tops.cell)


def _add_limits(tables: Tables, d: Description) -> None:
    m = d.m
    joint = {int(m.jnt_dofadr[j]): j for j in d.limited}
    of = [joint.get(dof) for dof in range(m.nv)]
    _add_ranges(tables, "limit", [None if j is None else m.jnt_range[j] for j in of])
    some = [d.limited[0] if j is None and d.limited else j for j in of]  # so that equal ones fold
    tables.floats("limit_margin", [0.0 if j is None else m.jnt_margin[j] for j in some])
    tables.floats("limit_inverse_inertia", m.dof_invweight0)
    soft = [d.softness(m.jnt_solref[j], m.jnt_solimp[j]) for j in some if j is not None]
    tables.structs("Softness", "limit_softness", soft)
    dofs = d.friction.dofs
    tables.integers("friction_row", [dofs.index(dof) if dof in dofs else -1 for dof in range(m.nv)])
    tables.integers("friction_dof", dofs)
    tables.floats("friction_damping", [softness.damping for softness in d.friction.softness])
    tables.floats("friction_weight", d.friction.weight)
    tables.floats("friction_bound", d.friction.bound)


def _add_outputs(tables: Tables, d: Description) -> None:
    m = d.m
    tables.integers("body_link", [p.link for p in d.places])
    tables.structs("Vec", "body_position", [p.position for p in d.places])
    tables.structs("Mat", "body_orientation", [matrix(p.quaternion) for p in d.places])
    parts = [
        [(i, x.center, x.mass / m.body_subtreemass[body]) for i, x in d.parts_below(body)] for _, body, _ in d.subtrees
    ]
    flat = [part for group in parts for part in group]
    tables.size(SUBTREES=len(d.subtrees))
    tables.integers("subtree_address", [address for _, _, address in d.subtrees])
    tables.integers("first_part", np.cumsum([0, *map(len, parts)]))
    tables.integers("part_link", [link for link, _, _ in flat])
    tables.structs("Vec", "part_center", [center for _, center, _ in flat])
    tables.floats("part_share", [share for _, _, share in flat])
    _add_momenta(tables, d)
    _add_touch(tables, d)
    _add_site_sensors(tables, d)
    bodies = [m.geom_bodyid[list(p.geoms)] for p in d.pairs] if d.touch or d.wrenches else []
    tables.integers("first_body", [first for first, _ in bodies])
    tables.integers("second_body", [second for _, second in bodies])


def _add_site_sensors(tables: Tables, d: Description) -> None:
    m, sensors = d.m, [*d.motions, *d.accelerometers, *d.wrenches]
    tables.size(
        MOTION_SENSORS=len(d.motions),
        ACCELEROMETERS=len(d.accelerometers),
        WRENCHES=len(d.wrenches),
        FIRST_WRENCH=len(d.motions) + len(d.accelerometers),
        ACCELERATIONS=len(d.accelerometers) + len(d.wrenches),
    )
    tables.integers("frame_address", [address for *_, address in sensors])
    tables.integers("frame_turning", [kind in (GYRO, TORQUE) for kind, *_ in sensors])
    _add_frames(tables, d, "frame", [site for _, site, _ in sensors])
    roots = [int(m.site_bodyid[site]) for _, site, _ in d.wrenches]
    _add_parts(tables, d, "wrench", roots)
    inside = [set(subtree(m, body)) for body in roots]
    tables.integers("in_subtree", [body in bodies for bodies in inside for body in range(m.nbody)])


def _add_momenta(tables: Tables, d: Description) -> None:
    tables.size(MOMENTA=len(d.momenta))
    tables.integers("momentum_address", [address for _, _, address in d.momenta])
    tables.floats("momentum_inverse_mass", [1 / d.m.body_subtreemass[body] for _, body, _ in d.momenta])
    _add_parts(tables, d, "momentum", [body for _, body, _ in d.momenta])


def _add_parts(tables: Tables, d: Description, name: str, roots: list[int]) -> None:
    """Adds what of each link belongs to the subtrees of some bodies."""
    parts = [d.parts_below(body) for body in roots]
    flat = [part for group in parts for part in group]
    tables.integers(f"first_{name}_part", np.cumsum([0, *map(len, parts)]))
    tables.integers(f"{name}_link", [link for link, _ in flat])
    tables.structs("Vec", f"{name}_center", [x.center for _, x in flat])
    tables.structs("Symmetric", f"{name}_inertia", [x.moments[np.triu_indices(3)] for _, x in flat])
    tables.floats(f"{name}_mass", [x.mass for _, x in flat])


def _add_frames(tables: Tables, d: Description, name: str, sites: list[int]) -> None:
    """Adds where sites are in the frames of their links."""
    m, at = d.m, [(site, d.places[d.m.site_bodyid[site]]) for site in sites]
    tables.integers(f"{name}_link", [place.link for _, place in at])
    tables.structs("Vec", f"{name}_position", [place.point(m.site_pos[site]) for site, place in at])
    turns = [matrix(place.turn(m.site_quat[site])) for site, place in at]
    tables.structs("Mat", f"{name}_orientation", turns)


def _add_touch(tables: Tables, d: Description) -> None:
    m, sites = d.m, [site for _, site, _ in d.touch]
    sphere = int(mujoco.mjtGeom.mjGEOM_SPHERE)
    sizes = [m.site_size[s, [0, 0, 0]] if m.site_type[s] == sphere else m.site_size[s] for s in sites]
    tables.integers("touch_address", [address for _, _, address in d.touch])
    tables.integers("site_body", m.site_bodyid[sites])
    tables.integers("site_shape", [SHAPES.index(m.site_type[s]) for s in sites])
    tables.structs("Vec", "site_size", sizes)
    _add_frames(tables, d, "site", sites)


def _add_contact_geoms(tables: Tables, d: Description, geoms: Sequence[int]) -> None:
    index, none = {geom: i for i, geom in enumerate(geoms)}, [-1] * d.lasting
    tables.size(CONTACT_GEOMS=len(geoms), KEPT_CONTACTS=bool(geoms or d.wrenches))
    for i, title in enumerate(("first", "second")):
        tables.integers(f"{title}_contact_geom", [*(index.get(p.geoms[i], -1) for p in d.pairs), *none])
