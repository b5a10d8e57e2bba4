"""Height fields and many boxes of the world against C MuJoCo: contacts, steps, and what a world takes of memory."""

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each
from lane_contacts import find_contacts

from torchrl_loco import LocoEnv, SimConfig, Vary
from torchrl_loco.sim import Simulation
from torchrl_loco.sim.compiled.collision.pairs import MOST_LISTED
from torchrl_loco.sim.compiled.schedules.lanes import Description
from torchrl_loco.sim.compiled.support import unsupported
from torchrl_loco.sim.corners import corners_of, stand_on_corners
from torchrl_loco.sim.warp_init import init_warp

BODY = '<body pos="0 0 {z}"><freejoint/><geom {geom}/></body>'
ROUND = ('type="sphere" size=".06"', 'type="capsule" size=".03 .1"', 'type="capsule" size=".05 .05" margin=".02"')
OPTION = '<option timestep="0.002" iterations="100" ls_iterations="50" tolerance="1e-10"/>'


def field_spec(geoms, assets, ground=""):
    """Bodies over a field that is flat, which do not touch each other."""
    world = '<default><geom contype="2" conaffinity="1"/></default>'
    bodies = "".join(
        BODY.format(z=5 + 3 * i, geom=f'{geom} contype="1" conaffinity="2"') for i, geom in enumerate(geoms)
    )
    ground += '<geom type="hfield" hfield="c"/>'
    xml = f"<mujoco>{world}{OPTION}<asset>{assets}</asset><worldbody>{ground}{bodies}</worldbody></mujoco>"
    return mujoco.MjSpec.from_string(xml)


def falling(geoms, ground, assets=""):
    bodies = "".join(BODY.format(z=5 + 3 * i, geom=geom) for i, geom in enumerate(geoms))
    xml = f"<mujoco>{OPTION}<asset>{assets}</asset><worldbody>{ground}{bodies}</worldbody></mujoco>"
    return mujoco.MjModel.from_xml_string(xml)


def fields(rng, geoms=ROUND, assets=""):
    """Two fields of unlike cells, one of them tilted; parts of both are deep, steep and level."""
    assets += '<hfield name="a" nrow="12" ncol="9" size=".6 .7 .2 .1"/>'
    assets += '<hfield name="b" nrow="5" ncol="8" size=".5 .4 .1 .05"/>'
    ground = '<geom type="hfield" hfield="a" pos="-.5 0 .05"/>'
    ground += '<geom type="hfield" hfield="b" pos=".6 .1 0" euler="4 -7 30" friction=".5" condim="1"/>'
    m = falling(geoms, ground, assets)
    heights = rng.uniform(0.0, 1.0, (12, 9))
    heights[:4] = 0.3
    heights[6:9, 2:5] = (0.0, 0.5, 1.0)
    m.hfield_data[:108] = heights.ravel()
    m.hfield_data[108:] = rng.uniform(0.0, 1.0, 40)
    return m


def boxes(rng, count, geoms, has_floor=True):
    """A floor of flush boxes, if asked for, and others about and in it, turned any way."""
    flush = [
        f'<geom type="box" size=".2 .2 .1" pos="{0.4 * x - 0.8} {0.4 * y - 0.6} {-0.1 + 0.05 * (x + y)}"/>'
        for x in range(5)
        for y in range(4)
        if has_floor
    ]
    turned = [
        f'<geom type="box" size="{size}" pos="{place}" euler="{angles}" friction="{0.5 + 0.5 * (i % 2)}"/>'
        for i in range(count)
        for size, place, angles in [
            (
                " ".join(f"{x:.3f}" for x in rng.uniform(0.02, 0.15, 3)),
                " ".join(f"{x:.3f}" for x in rng.uniform((-1, -0.8, 0), (1, 0.8, 0.3))),
                " ".join(f"{x:.1f}" for x in rng.uniform(-90, 90, 3)),
            )
        ]
    ]
    return falling(geoms, "".join([*flush, *turned]))


def thrown(m, rng, count):
    """States of free bodies over the ground, and in it."""
    qpos = np.tile(m.qpos0, (count, 1)).reshape(count, -1, 7)
    qpos[..., :3] = rng.uniform((-1.2, -0.8, -0.05), (1.2, 0.8, 0.35), (*qpos.shape[:2], 3))
    turn = rng.normal(size=(*qpos.shape[:2], 4))
    qpos[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    return qpos.reshape(count, -1).astype(np.float32).astype(float)


def c_contacts(m, qpos):
    data = mujoco.MjData(m)
    data.qpos[:] = qpos
    mujoco.mj_forward(m, data)
    world = m.body_weldid[m.geom_bodyid] == 0
    return [
        (max(c.geom, key=lambda g: not world[g]), [c.dist - c.includemargin, *c.pos, *c.frame[:3]])
        for c in data.contact
        if world[c.geom].any() and not c.exclude
    ]


def compared(m, states, most):
    """Returns errors of distance, point and normal of contacts with the ground where there are at most so many."""
    world, errors, count = m.body_weldid[m.geom_bodyid] == 0, [], 0
    for qpos, found in zip(states, find_contacts(m, states), strict=True):
        theirs = c_contacts(m, qpos)
        if len(theirs) > most:
            continue
        ours = [(max(geoms, key=lambda g: not world[g]), row) for geoms, row in found if world[list(geoms)].any()]
        count += 1
        for geom, row in theirs:
            if abs(row[0]) < 1e-6:  # rounding decides
                continue
            near = [
                (np.abs(np.array(other)[[0, 4, 5, 6]] - np.array(row)[[0, 4, 5, 6]]).max(), other)
                for g, other in ours
                if g == geom
            ]
            assert near, (qpos, row)
            _, best = min(near, key=lambda pair: pair[0])
            errors.append([abs(best[0] - row[0]), np.abs(best[1:4] - row[1:4]).max(), np.abs(best[4:] - row[4:]).max()])
        assert len(ours) <= len(theirs) + sum(abs(row[0]) < 1e-6 for _, row in theirs) + 1
    return np.array(errors), count


@pytest.fixture(autouse=True)
def warp():
    init_warp()


def test_spheres_and_capsules_touch_fields_as_in_c_mujoco():
    """A contact for each prism that is near: over it, beside it, in it and below; at the rim and on the base."""
    rng = np.random.default_rng(0)
    m = fields(rng)
    assert unsupported(m) == []
    errors, count = compared(m, thrown(m, rng, 400), Description(m).layout.frictional)
    assert count > 300
    assert len(errors) > 1500
    np.testing.assert_array_less(np.quantile(errors, 0.99, axis=0), (2e-6, 5e-4, 1e-4))
    assert np.quantile(errors[:, 2], 0.998) < 1e-2  # directions out that are as short


@for_each("turn", ["0 90 0", "180 0 0", "0 60 20"])
def test_a_field_may_lie_on_its_side(turn):
    """Its base is then beside or above what is its surface."""
    rng = np.random.default_rng(3)
    assets = '<hfield name="a" nrow="12" ncol="9" size=".6 .7 .2 1"/>'
    m = falling(ROUND, f'<geom type="hfield" hfield="a" euler="{turn}"/>', assets)
    m.hfield_data[:] = rng.uniform(0.0, 1.0, 108)
    errors, count = compared(m, thrown(m, rng, 150), Description(m).layout.frictional)
    assert count > 100
    assert len(errors) > 200
    np.testing.assert_array_less(np.quantile(errors, 0.98, axis=0), (2e-6, 5e-3, 1e-2))


@for_each(
    ("geom", "has_floor"),
    [
        ('type="sphere" size=".06"', True),
        ('type="capsule" size=".03 .1"', True),
        ('type="box" size=".1 .06 .04"', True),
        ('type="capsule" size=".03 .5"', False),  # over cells without boxes, too
    ],
)
def test_shapes_touch_many_boxes_as_in_c_mujoco(geom, has_floor):
    rng = np.random.default_rng(1)
    m = boxes(rng, 40, [geom, geom], has_floor)
    assert unsupported(m) == []
    errors, count = compared(m, thrown(m, rng, 250), 14)
    assert count > 100
    assert len(errors) > 200
    np.testing.assert_array_less(np.quantile(errors, 0.97, axis=0), (5e-6, 1e-2, 1e-3))


def test_steps_on_the_ground_are_those_of_c_mujoco(device):
    """Bodies that lie on a field and on boxes, with friction and without."""
    rng = np.random.default_rng(2)
    for m in (fields(rng), boxes(rng, 20, ROUND)):
        data, states = mujoco.MjData(m), []
        for qpos in thrown(m, rng, 24):
            mujoco.mj_resetData(m, data)
            data.qpos[:] = qpos
            data.qpos[2::7] = np.abs(data.qpos[2::7]) + 0.3
            mujoco.mj_step(m, data, 150)
            if np.isfinite(data.qvel).all() and 0 < data.ncon < 12:
                states.append((data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()))
        config = SimConfig.of(m, ctrl_dt=0.002, engine="compiled")
        sim = Simulation(m, config, len(states), torch.device(device))
        for name, values in zip(("qpos", "qvel", "qacc_warmstart"), zip(*states, strict=True), strict=True):
            getattr(sim, name).copy_(torch.tensor(np.array(values)))
        sim.step()
        expected = []
        for qpos, qvel, warmstart in states:
            mujoco.mj_resetData(m, data)
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, qvel, warmstart
            mujoco.mj_step(m, data)
            expected.append(data.qvel.copy())
        errors = np.abs(sim.qvel.cpu().numpy() - np.array(expected)).max(axis=1)
        assert len(states) > 12
        assert np.median(errors) < 2e-4
        assert np.quantile(errors, 0.8) < 5e-3


def test_contacts_that_mujoco_warp_leaves_out_are_said(caplog):
    m = fields(np.random.default_rng(2))
    warp, own = (Simulation(m, SimConfig.of(m, engine=e), 1, torch.device("cpu")) for e in ("mujoco_warp", "compiled"))
    assert [record.name for record in caplog.records if "at most 4 contacts" in record.message] == ["torchrl_loco"]
    assert "engine='mujoco'" in own.engine.remedy("contacts", 30)
    assert "naconmax" in warp.engine.remedy("contacts", 30)


def test_a_world_does_not_grow_with_the_ground():
    rng = np.random.default_rng(3)
    few, many = (Description(boxes(rng, count, ROUND)) for count in (10, 1000))
    assert few.layout == many.layout
    assert len(few.pairs) == len(many.pairs)
    assert len(Description(boxes(rng, -20 + MOST_LISTED, ROUND)).ground.fields) == 0


SOLIDS = (
    'type="box" size=".1 .06 .04"',
    'type="cylinder" size=".06 .1"',
    'type="ellipsoid" size=".1 .06 .04"',
    'type="mesh" mesh="wedge"',
)
WEDGE = '<mesh name="wedge" vertex="0 0 0 .2 0 0 0 .2 0 .2 .2 0 .1 0 .15 .1 .2 .15"/>'


def test_solids_touch_fields_by_spheres_in_their_corners():
    """The spheres lie in them, weigh nothing, and touch fields alone; all else touches as before."""
    rng = np.random.default_rng(4)
    exact = fields(rng, SOLIDS, WEDGE)
    (said,) = unsupported(exact)
    assert "hfield and box" in said
    assert "solids_on_terrain='spheres'" in said
    spec = field_spec(
        SOLIDS,
        WEDGE + '<hfield name="c" nrow="2" ncol="2" size="1 1 1 1"/>',
        '<geom type="plane" size="9 9 1" pos="0 0 -1"/>',
    )
    before = spec.compile()
    assert len(stand_on_corners(spec)) == len(SOLIDS)
    m = spec.compile()
    assert unsupported(m) == []
    assert sorted(map(len, corners_of(m).values())) == [6, 6, 8, 8]  # also of solids without names
    np.testing.assert_allclose(m.body_inertia, before.body_inertia)
    np.testing.assert_allclose(m.body_mass, before.body_mass)
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    spheres = np.flatnonzero(m.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)
    assert 8 * 2 + 6 + 6 <= len(spheres) <= 8 * 3 + 6
    for g in spheres:
        solid = m.body_geomadr[m.geom_bodyid[g]]
        line = np.empty(6)
        depth = mujoco.mj_geomDistance(m, data, solid, g, 1.0, line)
        assert depth < -1.2 * m.geom_size[g, 0]  # its center lies within
    touched = set()
    for qpos in thrown(m, rng, 200):
        data.qpos[:] = qpos
        data.qpos[2::7] -= rng.uniform(0.0, 1.0)
        mujoco.mj_forward(m, data)
        touched |= {tuple(sorted(m.geom_type[list(c.geom)].tolist())) for c in data.contact}
    kinds = mujoco.mjtGeom
    field, plane, sphere, box = (int(getattr(kinds, f"mjGEOM_{k}")) for k in ("HFIELD", "PLANE", "SPHERE", "BOX"))
    assert {pair for pair in touched if field in pair} == {(field, sphere)}
    assert (plane, box) in touched
    assert (plane, sphere) not in touched


def test_an_environment_says_that_its_solids_stand_on_spheres():
    """All engines step the model that has them."""

    class Thrown(LocoEnv):
        model = field_spec(SOLIDS[:1], '<hfield name="c" nrow="2" ncol="2" size="3 3 1 1"/>')
        config = SimConfig(ctrl_dt=0.02, sim_dt=0.002, episode_length=50, solids_on_terrain="spheres")

        def reward(self, s):
            return s.qpos[:, 2]

        def observation(self, s):
            return s.qpos

        def begin(self, s):
            low = torch.tensor([0.0, 0.0, 0.12, 1.0, 0.0, 0.0, 0.0])
            return {"qpos": low + s.uniform(-0.02, 0.02, 7)}

    found = {}
    for engine in ("compiled", "mujoco"):
        env = Thrown(4, "cpu", seed=0, engine=engine)
        assert "solids_on_terrain='spheres'" in repr(env)
        assert env.mj_model.ngeom == 2 + 8
        found[engine] = env.rollout(20)["next", "observation"]
    assert (found["mujoco"][:, -1, 2] - 0.04).abs().max() < 2e-3
    torch.testing.assert_close(found["compiled"], found["mujoco"], atol=1e-4, rtol=0)


def box_on_ground(how="spheres", randomize=(), pair=""):
    """A box of 16 kg that lies on a field, and begins to slide at 1 m/s."""

    class Slides(LocoEnv):
        model = f"""<mujoco><asset><hfield name="c" nrow="2" ncol="2" size="3 3 1 1"/></asset><worldbody>
          <geom name="ground" type="hfield" hfield="c"/>
          <body pos="0 0 .1"><freejoint/><geom name="box" type="box" size=".2 .1 .1"/></body>
        </worldbody><contact>{pair}</contact></mujoco>"""
        config = SimConfig(ctrl_dt=0.02, sim_dt=0.002, solids_on_terrain=how, engine="mujoco")

        def reward(self, s):
            return s.qpos[:, 0]

        def observation(self, s):
            forces = s.contact_force("box"), s.contact_force(["box", "ground"])[:, 1]
            return torch.cat([*forces, s.in_contact("box").float().unsqueeze(-1)], -1)

        def begin(self, s):
            return {"qpos": s.home, "qvel": torch.nn.functional.pad(torch.ones_like(s.qpos[:, :1]), (0, 5))}

    Slides.randomize = list(randomize)
    return Slides(1, "cpu", seed=0)


def test_a_solid_has_the_contacts_of_its_spheres_and_they_its_friction():
    weight = 9.81 * 16.0
    smooth = [Vary("geom_friction", 0.05, 0.05 + 1e-6, of=name, how="set") for name in ("box", "ground")]
    slid = {}
    for how in ("exact", "spheres"):
        for randomize in ((), smooth):
            rollout = box_on_ground(how, randomize).rollout(80)
            slid[how, bool(randomize)] = float(rollout["next", "reward"][0, -1])
            if how == "spheres" and not randomize:
                forces = rollout["next", "observation"][0, -1]
                torch.testing.assert_close(forces[[2, 5, 6]], torch.tensor([weight, -weight, 1.0]), rtol=1e-3, atol=0)
    for varied in (False, True):
        assert slid["spheres", varied] == pytest.approx(slid["exact", varied], rel=0.05)
    assert slid["spheres", True] > 8 * slid["spheres", False]
    with pytest.raises(ValueError, match="the pair of ground and box would touch beside the spheres"):
        box_on_ground(pair='<pair geom1="ground" geom2="box"/>')


def test_ground_that_pairs_alone_let_touch():
    geoms = '<geom contype="0" conaffinity="0" type="hfield" hfield="c" name="f"/>'
    ball = '<body pos="0 0 .3"><freejoint/><geom contype="0" conaffinity="0" size=".1" name="b"/></body>'
    pair = '<contact><pair geom1="f" geom2="b"/></contact>'

    class Falls(LocoEnv):
        model = f"""<mujoco>{OPTION}<asset><hfield name="c" nrow="2" ncol="2" size="3 3 1 1"/></asset>
          <worldbody>{geoms}{ball}</worldbody>{pair}</mujoco>"""
        config = SimConfig(ctrl_dt=0.02, sim_dt=0.002, episode_length=50)

        def reward(self, s):
            return s.terrain_height(s.qpos[:, :2])

        def observation(self, s):
            return s.qpos

        def begin(self, s):
            return {"qpos": s.home}

    for engine in ("compiled", "mujoco"):
        rollout = Falls(1, "cpu", seed=0, engine=engine).rollout(40)["next"]
        assert rollout["observation"][0, -1, 2] == pytest.approx(0.1, abs=2e-3)
        assert (rollout["reward"] == 0.0).all()
