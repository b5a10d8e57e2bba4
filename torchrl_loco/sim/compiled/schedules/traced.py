"""The schedule of one thread a world: a control step of one model, traced to straight-line C++."""

from collections.abc import Iterable, Sequence

import mujoco

from torchrl_loco.sim.compiled.collision.pairs import pairs
from torchrl_loco.sim.compiled.ir.parameters import VariedModel, number, positive
from torchrl_loco.sim.compiled.ir.symbols import Block, Scalar, cells, literal, names, scalar, zeros
from torchrl_loco.sim.compiled.ir.tables import Tables
from torchrl_loco.sim.compiled.physics import sensors
from torchrl_loco.sim.compiled.physics.dynamics import BALL, FREE, ArticulatedFactor, Dynamics
from torchrl_loco.sim.compiled.physics.sensors import TOUCH, TouchSensors
from torchrl_loco.sim.compiled.schedules import shared
from torchrl_loco.sim.compiled.schedules.solver import NewtonSolver

INPUTS = {
    "qpos": ("nq", "qpos_out"),
    "qvel": ("nv", "qvel_out"),
    "qacc": ("nv", "qacc_warmstart_out"),
    "ctrl": ("nu", "ctrl_in"),
}
"""What a world reads, how many numbers of it, and from which array of all worlds."""

MOST_SHARED = 24 * 1024
"""Bytes of shared memory of a warp up to which it holds links on a GPU: stores to local memory go on to the second
cache, and links are what most of them were for."""


def source(m: mujoco.MjModel, substeps: int, asked: shared.Asked) -> str:
    """Returns the C++ of a control step of one world, by the arguments of :func:`.step.source`."""
    world = Block()
    world("if (!live) return;")
    if isinstance(m, VariedModel):
        world("// Numbers of the model.")
        for column in range(m.varied.count):
            world(f"const float {number(column).args[0]} = wp::index(numbers_out, world, {column});")
    for title, (size, argument) in INPUTS.items():
        count = getattr(m, size)
        world(f"float {title}[{max(count, 1)}];")
        world(f"for (int i = 0; i < {count}; ++i) {title}[i] = wp::index({argument}, world, i);")
    world("int overflow = 0;")
    world("const auto flag = [&](int bits) { overflow |= bits; };")
    if substeps or TOUCH in m.sensor_type or asked.contact_geoms:
        if not substeps:
            world("// Touch is a force: a step that is not taken finds it, without actuation.")
        step, solver = _substep(m, substeps, asked.contact_geoms, asked.contact_rows)
        options = Tables()
        flags = {"DELICATE": solver.delicate, "BY_SLOPES": solver.by_slopes, "IMPLICIT_DAMPING": False}
        shared.add_options(options, m, **flags)
        world(options.text())
        for title, count in solver.arrays.items():
            if count and title != "qacc":
                world(f"float {title}[{count}];")
        for title, (count, fields) in solver.structs.items():
            if count:
                world(f"struct alignas(16) {title.title()} {{ {'; '.join(fields)}; }};")
        if solver.places:
            world(f"Contact contact[{solver.places}];")
        if solver.ground.count:
            _declare_links(world, len(solver.ground.bodies), sum(solver.ground.link.values()))
        if solver.places:
            for title in ("contact_corner", *(["contact_zones"] if solver.touch else [])):
                world(f"int {title}[{solver.places}];")
        world("#pragma unroll 1")
        world(f"for (int step = 0; step < {max(substeps, 1)}; ++step) {{")
        world.lines += [f"  {line}" for line in "\n".join(step.lines).splitlines()]
        world("}")
    if substeps:
        for title, (size, argument) in INPUTS.items():
            if title != "ctrl":
                row = f"wp::index({argument}, world, i)"
                world(f"for (int i = 0; i < {getattr(m, size)}; ++i) {row} = {title}[i];")
        world(f"time_out.data[world] += {literal(substeps * m.opt.timestep)};")
        world("overflow_out.data[world] |= overflow;")
    _outputs(world, m, asked)
    return shared.LAWS + world.text() + "\n"


def _declare_links(world: Block, count: int, numbers: int) -> None:
    """Declares ``link``, so many of so many numbers, and the ``place`` of this thread. On a GPU a block is a warp."""
    size = 16 * -(-numbers // 4)  # bytes of a link
    local = f"Link link[{count}][1]; const int place = 0;"
    if 32 * size * count <= MOST_SHARED:  # an odd multiple of 16 bytes mostly: accesses of 16 bytes meet in no bank
        world("#ifdef __CUDA_ARCH__")
        world(f"__shared__ Link link[{count}][32]; const int place = threadIdx.x % 32;")
        world(f"#else\n{local}\n#endif")
    else:
        world(local)


def _substep(
    m: mujoco.MjModel, substeps: int, contact_geoms: Sequence[int], contact_rows: int
) -> tuple[Block, NewtonSolver]:
    """Returns one of ``substeps`` physics steps, and its solver; with 0 it does not integrate."""
    block = Block()
    qpos, qvel = names("qpos", m.nq), names("qvel", m.nv)
    tree = Dynamics(m, qpos, qvel, names("ctrl", m.nu) if substeps else None)
    tree.keep(block)
    for i, force in enumerate(tree.force):
        block.set(f"force[{i}]", force)
    solver = NewtonSolver(tree, pairs(m), contact_geoms)
    solver.write(block, (qpos, qvel, cells("qacc", m.nv)))
    if contact_geoms:
        row = f"step - {substeps - contact_rows}"
        head = f"int row = {row}; row >= 0 && row <= {row}" if substeps else f"int row = 0; row < {contact_rows}"
        with block.scope(f"for ({head}; ++row)") as each:
            solver.read_contact_forces(each)
    if solver.touch:
        with block.scope(f"if (step == {max(substeps - 1, 0)})") as last:
            solver.read_touch(last)
    if substeps:
        _integrate(block, m, tree)
    return block, solver


def _integrate(block: Block, m: mujoco.MjModel, tree: Dynamics) -> None:
    """Advances velocities, then positions with the new velocities (semi-implicit Euler).

    With implicit damping the acceleration is that of (M + h B) a' = M a.
    """
    h, qacc = m.opt.timestep, cells("qacc", m.nv)
    implicit = not m.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    if implicit and positive(m.dof_damping):
        diagonal = [scalar(h * damping) for damping in m.dof_damping]
        factor = ArticulatedFactor(tree, [zeros(6, 6) for _ in range(m.nbody)], diagonal)
        qacc = [block.keep(a) for a in factor.solve(cells("M_qacc", m.nv))]
    for i in range(m.nv):
        block.set(f"qvel[{i}]", qacc[i] * h, "+=")
    qvel = cells("qvel", m.nv)
    for j in range(m.njnt):
        q, d, kind = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j]), m.jnt_type[j]
        if kind in (FREE, BALL):
            if kind == FREE:
                for i in range(3):
                    block.set(f"qpos[{q + i}]", h * qvel[d + i], "+=")
                q, d = q + 3, d + 3
            q_text, rate = (
                ", ".join(f"{title}[{at + i}]" for i in range(n)) for title, at, n in (("qpos", q, 4), ("qvel", d, 3))
            )
            with block.scope("") as turn:
                turn(f"const Quat next = Quat{{{q_text}}}.turned(Vec{{{rate}}}, {literal(h)});")
                for i, component in enumerate("wxyz"):
                    turn(f"qpos[{q + i}] = next.{component};")
        else:
            block.set(f"qpos[{q}]", h * qvel[d], "+=")


def _outputs(world: Block, m: mujoco.MjModel, asked: shared.Asked) -> None:
    """Appends what an observation reads: poses and velocities of the bodies, and sensors, of the present state.

    Constants are left out: they are in the arrays from the start.
    """
    tree = Dynamics(m, names("qpos", m.nq), names("qvel", m.nv), names("ctrl", m.nu))
    rows: dict[str, Sequence[Iterable[Scalar | None]]] = {
        "xpos": tree.poses.xpos,
        "xmat": [orientation.flat for orientation in tree.poses.xmat],
        "sensordata": [[x] for x in sensors.read(m, tree, TouchSensors(m, tree.poses))],
    }
    if asked.with_cvel:
        rows["cvel"] = tree.cvel
    if asked.with_subtree_com:
        rows["subtree_com"] = [tree.com[b] if b and m.body_rootid[b] == b else () for b in range(m.nbody)]
    for title, row in rows.items():
        for i, element in enumerate(row):
            for k, x in enumerate(element):
                if x is not None and scalar(x).constant is None:
                    world.set(f"((float*)&wp::index({title}_out, world, {i}))[{k}]", x)
