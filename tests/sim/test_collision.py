"""Contacts that lanes find, in number, place and depth, against C MuJoCo in float64."""

import collections

import mujoco
import numpy as np
import torch
import warp as wp
from lane_contacts import find_contacts

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation
from torchrl_loco.sim.compiled import unsupported
from torchrl_loco.sim.compiled.collision import kinds
from torchrl_loco.sim.compiled.schedules.lanes import description
from torchrl_loco.sim.simulation import set_options

STATES = 400
CLOSE = 1e-6
"""Distance to the margin (m) within which rounding decides whether there is a contact."""
FLOORS = """
    <geom name="floor" type="plane" size="5 5 .1" margin=".01" gap=".005"/>
    <geom name="slope" type="plane" size="5 5 .1" pos=".1 0 0" euler="20 -30 40"/>
"""
BODY = """
    <body pos="0 0 1"><freejoint/>
      <geom name="{name}" {shape} contype="0" pos=".02 .01 -.03" euler="10 20 30"/></body>
"""
SOLIDS = {
    "box": ('type="box" size=".1 .07 .04"', 4),
    "cylinder": ('type="cylinder" size=".06 .09"', 4),
    "ellipsoid": ('type="ellipsoid" size=".1 .07 .04"', 1),
    "prism": ('type="mesh" mesh="prism"', 4),
    "bowl": ('type="mesh" mesh="bowl"', 4),
}
"""Shapes, and how many contacts with a plane they have at most."""
PRISM = " ".join(
    f"{size * np.cos(a):.4f} {0.8 * size * np.sin(a):.4f} {z}"
    for a in np.arange(0.1, 6.2, 0.8)
    for size, z in ((0.1, -0.03), (0.1, 0.04), (0.05, 0.0))
)
MESHES = f'''
<asset><mesh name="prism" vertex="{PRISM}"/><mesh name="bowl" builtin="hemisphere" params="3" scale=".1 .1 .1"/></asset>
'''
"""A prism over eight corners with as many points inside, and many small faces with one that is large."""


def model(*parts):
    return mujoco.MjModel.from_xml_string(f"<mujoco>{MESHES}<worldbody>{''.join(parts)}</worldbody></mujoco>")


def orientations(rng, count):
    """Returns quaternions, a third of them of whole quarter turns."""
    for _ in range(count):
        quaternion = rng.normal(size=4)
        if rng.random() < 1 / 3:
            mujoco.mju_euler2Quat(quaternion, rng.integers(0, 4, 3) * np.pi / 2, "xyz")
        yield quaternion / np.linalg.norm(quaternion)


def turned(m, geom, quaternion):
    """Returns the orientation of the body of a geom whose own is a quaternion."""
    back, result = np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(back, m.geom_quat[geom])
    mujoco.mju_mulQuat(result, quaternion, back)
    return result


def contacts_of_c(m, data):
    """Returns the contacts by their geoms, as :func:`find_contacts` has them, and the pairs that rounding decides."""
    found, unclear = collections.defaultdict(list), set()
    for contact in data.contact:
        depth = contact.dist - contact.includemargin
        if abs(depth) < CLOSE:
            unclear.add(tuple(contact.geom))
        if depth < 0:
            found[tuple(contact.geom)].append(np.concatenate([[depth], contact.pos, contact.frame[:3]]))
    return found, unclear


def assert_same(
    m, states, may_differ=lambda data, geoms: False, undecided=lambda data, geoms: False, atol=2e-6, place=5e-6
):
    """Every state has the contacts of C MuJoCo; returns how many pairs had how many."""
    assert unsupported(m) == []
    counts, data = collections.Counter(), mujoco.MjData(m)
    for qpos, ours in zip(states, find_contacts(m, states), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(m, data)
        expected, unclear = contacts_of_c(m, data)
        found = collections.defaultdict(list)
        for geoms, row in ours:
            found[geoms].append(row)
        for geoms in set(expected) | set(found):
            if geoms in unclear or undecided(data, geoms):
                continue
            a, b = np.array(expected[geoms]), np.array(found[geoms])
            assert len(a) == len(b), (geoms, qpos)
            counts[tuple(m.geom(g).name for g in geoms), len(a)] += 1
            np.testing.assert_allclose(np.sort(b[:, 0]), np.sort(a[:, 0]), rtol=0, atol=atol)
            if not may_differ(data, geoms):
                apart = np.abs(a[:, None] - b).max(axis=2)
                assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) < place, (geoms, qpos)
    return counts


def is_upright(data, geoms):
    """Whether a cylinder or mesh is aligned with a plane: rounding chooses the lowest of its points in C MuJoCo."""
    plane, solid = (data.geom_xmat[g].reshape(3, 3) for g in geoms)
    edged = kinds.CYLINDER, kinds.MESH
    return data.model.geom_type[geoms[1]] in edged and np.abs(plane[:, 2] @ solid).max() > 1 - 1e-9


def test_solids_touch_planes(monkeypatch):
    for name in ("ENOUGH_FRICTIONAL", "MOST_FRICTIONAL"):
        monkeypatch.setattr(description, name, 64)  # so that all have a place
    m = model(FLOORS, *(BODY.format(name=name, shape=shape) for name, (shape, _) in SOLIDS.items()))
    rng, states = np.random.default_rng(0), np.zeros((STATES, m.nq))
    for body in range(len(SOLIDS)):
        states[:, 7 * body : 7 * body + 3] = rng.uniform((-0.3, -0.3, 0.0), (0.3, 0.3, 0.2), (STATES, 3))
        states[:, 7 * body + 3 : 7 * body + 7] = [turned(m, 2 + body, q) for q in orientations(rng, STATES)]
    counts = assert_same(m, states.astype(np.float32), is_upright)
    for floor in ("floor", "slope"):
        for name, (_, most) in SOLIDS.items():
            assert all(counts[(floor, name), number] > 1 for number in range(1, most + 1)), counts


def is_on_the_surface(data, geoms):
    """Whether a center of a sphere, or of an end of a capsule, is near the surface: rounding turns the normal."""
    radius = data.model.geom_size[geoms[0], 0]
    return any(abs(c.dist + radius) < 0.1 * radius for c in data.contact if tuple(c.geom) == geoms)


def test_spheres_and_capsules_touch_boxes():
    """A third of them are aligned without rounding: with it, rounding decides in C MuJoCo."""
    shapes = {"ball": ("sphere", ".05"), "short": ("capsule", ".03 .05"), "long": ("capsule", ".02 .3")}
    box = '<geom name="box" type="box" size=".1 .07 .04" margin=".01"/>'
    bodies = [
        f'<body pos="0 0 1"><freejoint/><geom name="{name}" type="{kind}" size="{size}" contype="0"/></body>'
        for name, (kind, size) in shapes.items()
    ]
    m, rng = model(box, *bodies), np.random.default_rng(0)
    states = np.zeros((3 * STATES, m.nq))
    for body in range(len(shapes)):
        states[:, 7 * body : 7 * body + 3] = rng.uniform((-0.2, -0.2, -0.15), (0.2, 0.2, 0.15), (len(states), 3))
        states[:, 7 * body + 3 : 7 * body + 7] = rng.normal(size=(len(states), 4))
        states[: len(states) // 3, 7 * body + 3 : 7 * body + 7] = [1, 0, 0, 0]
    counts = assert_same(m, states.astype(np.float32), is_on_the_surface)
    assert all(counts[pair] > 100 for pair in [(("ball", "box"), 1), (("short", "box"), 1), (("long", "box"), 1)]), (
        counts
    )
    assert all(counts[(name, "box"), 2] > 100 for name in ("short", "long")), counts


def is_inside(data, geoms):
    """Whether the axis of a sphere or capsule enters a solid: which way it leaves again, C MuJoCo searches."""
    radius = data.model.geom_size[geoms[0], 0]
    return any(c.dist < -0.98 * radius for c in data.contact if tuple(c.geom) == geoms)


def test_spheres_and_capsules_touch_ellipsoids_and_cylinders():
    """From all sides; half of the capsules lie nearly flat on a cap or beyond its rim, where there are two contacts.

    C MuJoCo searches for the normal there, which it finds to some 1e-3.
    """
    shapes = {"ball": ("sphere", ".05"), "short": ("capsule", ".03 .05"), "long": ("capsule", ".02 .3")}
    bodies = [
        f'<body pos="0 0 1"><freejoint/><geom name="{name}" type="{kind}" size="{size}" contype="0"/></body>'
        for name, (kind, size) in shapes.items()
    ]
    rng = np.random.default_rng(0)
    for solid, size in (("ellipsoid", ".1 .07 .04"), ("ellipsoid", ".12 .12 .006"), ("cylinder", ".06 .09")):
        m = model(f'<geom name="solid" type="{solid}" size="{size}" margin=".01"/>', *bodies)
        m.opt.ccd_tolerance, m.opt.ccd_iterations = 1e-9, 200
        states = np.zeros((3 * STATES, m.nq))
        for body in range(len(shapes)):
            states[:, 7 * body : 7 * body + 3] = rng.uniform((-0.2, -0.2, -0.15), (0.2, 0.2, 0.15), (len(states), 3))
            states[:, 7 * body + 3 : 7 * body + 7] = rng.normal(size=(len(states), 4))
        flat = rng.normal(size=(2 * STATES, 3)) * (1, 1, 0.06)
        x, y, z = (flat / np.linalg.norm(flat, axis=1, keepdims=True)).T
        for body, axes in ((1, slice(0, STATES)), (2, slice(STATES, None))):
            states[:STATES, 7 * body + 3 : 7 * body + 7] = np.stack([1 + z, -y, x, 0 * z], axis=1)[axes]
            states[:STATES, 7 * body + 2] = rng.choice([-1, 1], STATES) * (0.09 + rng.uniform(-0.03, 0.04, STATES))
        counts = assert_same(m, states.astype(np.float32), undecided=is_inside, atol=5e-5, place=1e-3)
        assert all(counts[(name, "solid"), 1] > 50 for name in shapes), counts
        assert (counts[("long", "solid"), 2] > 30) == (solid == "cylinder"), counts


def test_boxes_touch_boxes(monkeypatch):
    """Flat, on edges and at corners, deep and within the margin; a third of them without rounding."""
    for name in ("ENOUGH_FRICTIONAL", "MOST_FRICTIONAL"):
        monkeypatch.setattr(description, name, 40)
    fixed = '<geom name="step" type="box" size=".1 .07 .04" margin=".01" euler="0 0 30"/>'
    sizes = {"cube": ".08 .08 .05", "plank": ".2 .03 .01", "bar": ".02 .02 .15"}
    bodies = [
        f'<body><freejoint/><geom name="{name}" type="box" size="{size}" contype="0"/></body>'
        for name, size in sizes.items()
    ]
    m, rng = model(fixed, *bodies), np.random.default_rng(0)
    states = np.zeros((3 * STATES, m.nq))
    for body in range(len(sizes)):
        states[:, 7 * body : 7 * body + 3] = rng.uniform((-0.15, -0.15, -0.1), (0.15, 0.15, 0.1), (len(states), 3))
        states[:, 7 * body + 3 : 7 * body + 7] = rng.normal(size=(len(states), 4))
        quarters = rng.integers(0, 4, STATES) * np.pi / 4 + np.pi / 12  # from the turn of the step
        turns = np.where(rng.random(STATES) < 0.5, quarters, rng.uniform(0, np.pi, STATES))
        states[:STATES, 7 * body + 3 : 7 * body + 7] = [[np.cos(a), 0, 0, np.sin(a)] for a in turns]
    counts = assert_same(m, states.astype(np.float32))
    assert sum(counts.values()) > 1000
    assert {number for _, number in counts} >= set(range(1, 9)), counts


MASKED = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" contype="2" conaffinity="4"/>
    <geom name="step" type="box" size=".5 .5 .1" conaffinity="6"/>
    <body pos="0 0 .19"><freejoint/><geom name="a" size=".1"/></body>
    <body pos="0 0 .35"><freejoint/><geom name="b" size=".1"/></body>
    <body pos="1 0 .09"><freejoint/><geom name="c" size=".1" contype="4" conaffinity="0"/></body>
    <body pos="1 .1 .09"><freejoint/><geom name="d" size=".1" contype="0" conaffinity="2"/></body>
    <body pos="2 0 .09"><freejoint/><geom name="e" size=".1" contype="0" conaffinity="0"/></body>
    <body pos="2 .1 .09"><freejoint/><geom name="f" size=".1" contype="4" conaffinity="6"/></body>
    <body pos="2 .2 .09"><freejoint/><geom name="g" size=".1" contype="2" conaffinity="4"/></body>
  </worldbody>
  <contact><pair geom1="e" geom2="f"/><pair geom1="e" geom2="floor"/></contact>
</mujoco>
"""


def touching(m):
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    return {"".join(sorted(m.geom(g).name for g in c.geom)) for c in data.contact if not c.exclude}


def test_bodies_touch_the_ground_only():
    m = mujoco.MjModel.from_xml_string(MASKED)
    assert touching(m) == {"ab", "astep", "ef", "fg", "cfloor", "dfloor", "efloor", "ffloor"}
    settings = {"ctrl_dt": 0.002, "sim_dt": 0.002, "iterations": 50, "ls_iterations": 50, "euler_damping": True}
    config = SimConfig(**settings, naconmax=100, njmax=100, engine="compiled", contacts="ground")
    sim = Simulation(m, config, 1, torch.device("cpu"))
    sim.reset(wp.ones(1, dtype=bool, device="cpu"))
    assert touching(m) == {"astep", "cfloor", "dfloor", "efloor", "ffloor"}
    data = mujoco.MjData(m)
    mujoco.mj_step(m, data)
    sim.step()
    np.testing.assert_allclose(sim.qvel[0], data.qvel, rtol=0, atol=1e-4)
    set_options(m, config)
    assert len(touching(m)) == 5


def test_the_deepest_contacts_stay(monkeypatch):
    """With and without friction. Limits of ball joints, which are among the latter, stay whatever they are."""
    for name in ("ENOUGH_FRICTIONAL", "MOST_FRICTIONAL", "MOST_FRICTIONLESS"):
        monkeypatch.setattr(description, name, 3)
    balls = [
        f'<geom size=".05" pos="{0.1 * i} {0.1 * condim} {0.02 * i}" condim="{condim}" margin="{0.001 * i}"/>'
        for condim in (1, 3)
        for i in range(8)
    ]
    joint = '<joint type="ball" range="0 10" limited="true"/>'
    m = model(
        '<geom type="plane" size="5 5 .1" condim="1"/>',
        f'<body pos="0 0 .1"><freejoint/>{"".join(balls)}<body>{joint}<geom size=".01" pos="0 0 1"/></body></body>',
    )
    rng = np.random.default_rng(0)
    states = np.zeros((50, m.nq))
    states[:, 2] = rng.uniform(-0.3, 0.2, len(states))
    states[:, 3:7] = list(orientations(rng, len(states)))
    states[:, 7:] = [np.cos(0.2), np.sin(0.2), 0, 0]
    data, numbers = mujoco.MjData(m), collections.Counter()
    for qpos, ours in zip(states.astype(np.float32), find_contacts(m, states), strict=True):
        data.qpos[:] = qpos
        mujoco.mj_forward(m, data)
        for condim in (1, 3):
            depths = sorted(c.dist - c.includemargin for c in data.contact if c.dim == condim and not c.exclude)
            found = sorted(row[0] for geoms, row in ours if m.geom_condim[geoms[1]] == condim)
            np.testing.assert_allclose(found, depths[:3], rtol=0, atol=2e-6)
            numbers[len(depths) > 3] += 1
    assert numbers[True] > 30
    assert numbers[False] > 30


def test_there_are_places_for_what_a_body_stands_on():
    feet = "".join(f'<geom type="box" size=".1 .03 .02" pos="0 {0.1 * i} {0.001 * i}"/>' for i in range(7))
    m = model(FLOORS, f'<body pos="0 0 1"><freejoint/>{feet}<geom type="box" size=".1 .1 .1" pos="0 0 .2"/></body>')
    assert description.Description(m).layout.frictional >= 28


def test_there_are_places_for_what_a_body_stands_on_boxes():
    """Of nine feet on a box of the world; one that is out of reach asks for none."""
    feet = "".join(f'<geom type="box" size=".1 .03 .02" pos="0 {0.1 * i} 0"/>' for i in range(9))
    body = f'<body pos="0 0 .07"><freejoint/>{feet}</body>'
    near, far = (model(f'<geom type="box" size="5 5 .05" pos="0 0 {z}"/>', body) for z in (0, -3))
    data = mujoco.MjData(near)
    mujoco.mj_forward(near, data)
    assert description.Description(near).layout.frictional == data.ncon == 36
    assert description.Description(far).layout.frictional == description.MOST_FRICTIONAL
