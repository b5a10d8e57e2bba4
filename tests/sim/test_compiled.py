"""The engine ``compiled``: what it can do, when it is chosen, its physics on small scenes, and what has no place."""

import itertools

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from cases import CONFIGS, MODELS
from forms import in_both_forms
from mujoco_warp import OverflowType

import torchrl_loco
from torchrl_loco.config import SimConfig, sim_config
from torchrl_loco.registry import env_class
from torchrl_loco.sim import Simulation, models
from torchrl_loco.sim.compiled import step, unsupported
from torchrl_loco.sim.compiled.collision import pairs as collision
from torchrl_loco.sim.compiled.schedules import dense_contacts, lanes
from torchrl_loco.sim.compiled.schedules.lanes import description, layout
from torchrl_loco.sim.simulation import choose_engine
from torchrl_loco.sim.varied import Varied

BARE = '<body name="bare"/>'
BODY = (
    f'<body name="arm"><joint name="elbow" damping="1"/><geom name="hand" type="capsule" size="0.1 0.2"/>{BARE}</body>'
)
BALL = '<body name="ball" pos="1 0 1"><freejoint name="loose"/><geom name="marble" size="0.1"/></body>'
MOTOR = '<motor name="pull" joint="elbow"/>'
SENSOR = '<subtreelinvel name="speed" body="arm"/>'
HILLS = '<geom type="hfield" hfield="hills"/>'
CRATE = '<body pos="3 3 3"><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>'
TOUCH = "".join(f'<touch name="touch{i}" site="sole"/>' for i in range(36))
MODEL = f"""
<mujoco>
  <option/>
  <asset>
    <hfield name="hills" nrow="2" ncol="2" size="1 1 1 1"/>
    <mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
  </asset>
  <worldbody><geom type="plane" size="5 5 0.1"/><site name="sole"/>{BODY}{BALL}</worldbody>
  <actuator>{MOTOR}</actuator>
  <sensor>{SENSOR}</sensor>
</mujoco>
"""
ELBOW = '<joint joint="elbow" coef="1"/>'
MANY = "".join(f'<body pos="{i} 5 1"><freejoint/><geom size="0.1"/></body>' for i in range(10))
PAIR = '<contact><pair geom1="hand" geom2="marble" solreffriction="0.1 1"/></contact>'
OTHERS = [
    ("<option/>", '<option solver="CG"/>', "a solver other than Newton"),
    ("<option/>", '<option integrator="implicit"/>', "an integrator other than Euler and implicitfast"),
    ("<option/>", '<option integrator="implicitfast"/>', "'loose': implicitfast for a body that is alone in its tree"),
    ("<option/>", '<option noslip_iterations="2"/>', "noslip iterations"),
    ("<option/>", '<option viscosity="1"/>', "forces of a fluid"),
    ("<option/>", '<option density="1"/>', "forces of a fluid"),
    ("<option/>", '<option><flag gravity="disable"/></option>', "disabled gravity"),
    ("<option/>", '<option><flag warmstart="disable"/></option>', "disabled warmstart"),
    ('<geom type="plane" size="5 5 0.1"/>', f"{HILLS}{CRATE}", "contacts of hfield and box"),
    (SENSOR, f"{SENSOR}{TOUCH}", "'touch31', 'touch32', 'touch33' and 2 more: more than 31 sensors of touch"),
    ("<option/>", '<option><flag energy="enable"/></option>', "enabled energy"),
    ("</worldbody>", f'</worldbody><tendon><fixed springlength="1" stiffness="1">{ELBOW}</fixed></tendon>', "tendons"),
    ("</worldbody>", '<body mocap="true"/></worldbody>', "mocap bodies"),
    ("</worldbody>", f"{MANY}</worldbody>", "67 degrees of freedom, more than 64"),
    ('<body name="arm"', '<body name="arm" gravcomp="1"', "gravity compensation"),
    ('<freejoint name="loose"/>', '<joint name="loose" type="free" stiffness="1"/>', "'loose': stiffness of a free"),
    ('<freejoint name="loose"/>', '<joint name="loose" type="ball" stiffness="1"/>', "'loose': stiffness of a"),
    ('damping="1"', 'damping="1 2"', "dampers that are not linear"),
    ('damping="1"', 'stiffness="1 2"', "'elbow': springs that are not linear"),
    ('type="capsule" size="0.1 0.2"', 'type="mesh" mesh="wedge"', "contacts of sphere and mesh: "),
    ("<sensor>", f'<option cone="elliptic"/>{PAIR}<sensor>', "solreffriction of an explicit pair"),
    (MOTOR, MOTOR.replace("elbow", "loose"), "'pull': a transmission other than a hinge, slide or"),
    (MOTOR, '<general name="pull" joint="elbow" dyntype="muscle"/>', "'pull': activation other than a filter"),
    (MOTOR, '<general name="pull" joint="elbow" gaintype="affine" gainprm="1 1"/>', "'pull': a gain that is not fixed"),
    (MOTOR, MOTOR.replace("/>", ' damping="1"/>'), "'pull': delay, damping or armature"),
    (MOTOR, MOTOR.replace("/>", ' armature="1"/>'), "'pull': delay, damping or armature"),
    (MOTOR, MOTOR.replace("/>", ' delay="0.01" nsample="2"/>'), "'pull': delay, damping or armature"),
    (SENSOR, '<jointpos name="angle" joint="elbow"/>', "sensor 'angle'"),
    (SENSOR, SENSOR.replace("/>", ' cutoff="1"/>'), "sensor 'speed'"),
    (SENSOR, '<subtreeangmom name="spin" body="world"/>', "sensor 'spin'"),
    (SENSOR, SENSOR.replace("arm", "bare"), "sensor 'speed'"),
    ('<joint name="elbow"', '<joint name="elbow" type="ball"', "'pull': a transmission other than a hinge, slide or"),
]


def config(engine="compiled", ctrl_dt=0.02, sim_dt=0.002, **overrides):
    settings = {"naconmax": 64, "njmax": 64, "iterations": 50, "ls_iterations": 20, "euler_damping": True}
    return SimConfig(ctrl_dt=ctrl_dt, sim_dt=sim_dt, engine=engine, **{**settings, **overrides})


# Which models, and which engine.


def test_what_a_model_must_not_need_is_named():
    for old, new, named in OTHERS:
        assert MODEL.count(old) == 1
        found = unsupported(mujoco.MjModel.from_xml_string(MODEL.replace(old, new)))
        assert len(found) == 1, (named, found)
        assert named in found[0]


def test_what_c_mujoco_searches_for_depends_on_how():
    for shape, reasons in (("capsule", 0), ("ellipsoid", 1)):
        m = mujoco.MjModel.from_xml_string(
            MODEL.replace('type="capsule" size="0.1 0.2"', f'type="{shape}" size=".1 .2 .3"')
        )
        m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
        assert ["nativeccd" in reason for reason in unsupported(m)] == [True] * reasons


def test_of_many_elements_the_first_are_named():
    m = models.load(MODELS["quadruped"])
    m.actuator_actearly[:], m.sensor_cutoff[:] = 1, 1.0
    actuators, sensors = unsupported(m)
    assert actuators.startswith("actuator 'yaw_front_left', 'lift_front_left', 'extend_front_left' and 9 more: ")
    assert sensors.startswith("sensor 'imu_accel', 'imu_gyro', 'velocimeter' and 8 more: ")


def test_a_model_needs_a_joint():
    assert unsupported(mujoco.MjModel.from_xml_string("<mujoco/>")) == ["a model without joints"]


def test_what_changes_nothing_is_supported():
    for old, new in [
        ("", ""),
        ("<option/>", '<option><flag eulerdamp="disable" filterparent="disable"/></option>'),
        ("<option/>", '<option cone="elliptic"/>'),
        ('size="0.1 0.2"', 'size="0.1 0.2" condim="6"'),
        ('<geom name="marble"', '<geom name="marble" condim="4"'),
        ('type="capsule" size="0.1 0.2"', 'type="box" size="0.1 0.1 0.1" contype="0" conaffinity="0"'),
        ('damping="1"', 'actuatorfrcrange="-1 1"'),
        ("<sensor>", f"{PAIR}<sensor>"),
    ]:
        assert unsupported(mujoco.MjModel.from_xml_string(MODEL.replace(old, new))) == []
    for path in MODELS.values():
        assert unsupported(models.load(path)) == []


def test_the_engine_is_chosen_by_what_the_model_needs(caplog):
    model = mujoco.MjModel.from_xml_string(MODEL)
    assert choose_engine(model, config("auto"))[0] == choose_engine(model, config("compiled"))[0] == "compiled"
    assert choose_engine(model, config("mujoco_warp")) == ("mujoco_warp", "as asked")
    model.opt.noslip_iterations = 2
    model.opt.viscosity = 1.0
    assert choose_engine(model, config("mujoco_warp")) == ("mujoco_warp", "as asked")
    assert not caplog.records
    needs = "does not have: noslip iterations; forces of a fluid"
    name, why = choose_engine(model, config("auto"))
    assert name == "mujoco_warp"
    assert needs in why
    assert "noslip iterations and 1 more" in caplog.text
    with pytest.raises(ValueError, match=rf"engine='compiled' {needs}.*'auto' or 'mujoco_warp'"):
        choose_engine(model, config("compiled"))


def test_an_environment_falls_back_and_says_why(tmp_path, caplog):
    class Capped(torchrl_loco.WalkerWalk):
        """A walker whose sensor is cut off."""

        model = tmp_path / "walker.xml"

    text = MODELS["walker"].read_text()
    Capped.model.write_text(text.replace("<subtreelinvel ", '<subtreelinvel cutoff="100" '))
    with pytest.raises(ValueError, match="sensor 'torso_velocity'"):
        Capped(2, "cpu", engine="compiled")
    env = Capped(2, "cpu")
    assert "stepping with MuJoCo-Warp" in caplog.text
    assert env.engine == "mujoco_warp"
    assert "mujoco_warp (engine 'compiled' does not have: sensor 'torso_velocity'" in repr(env)
    assert env.rollout(3).shape == (2, 3)


# Physics.


def scene(*elements, gravity="0 0 -9.81", actuator="", body="root", touch=None, momenta=()):
    sensors = f'<subtreelinvel body="{body}"/>' + (f'<touch site="{touch}"/>' if touch else "")
    sensors += "".join(f'<subtreeangmom body="{one}"/>' for one in momenta)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option gravity="{gravity}"/><worldbody>{"".join(elements)}</worldbody>'
        f"<actuator>{actuator}</actuator><sensor>{sensors}</sensor></mujoco>"
    )


def simulated(model, num_envs=1, **overrides):
    return Simulation(model, config(**overrides), num_envs, torch.device("cpu"))


def in_c_mujoco(model, sim, world=0):
    """Returns the state of a world as data of C MuJoCo, with energies and momenta."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = sim.qpos[world].double(), sim.qvel[world].double()
    mujoco.mj_forward(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    return data


@in_both_forms
def test_the_touch_of_a_state_that_was_set_is_that_of_its_contacts(form):
    """Nothing was stepped yet, and the motor counts as switched off, as in dm_control after a reset."""
    site = '<site name="sole" size="0.2"/>'
    body = (
        f'<body name="root" pos="0 0 0.099"><joint name="up" type="slide" axis="0 0 1"/><geom size="0.1"/>{site}</body>'
    )
    model = scene('<geom type="plane" size="5 5 0.1"/>', body, actuator='<motor joint="up" gear="50"/>', touch="sole")
    sim = simulated(model, num_envs=2)
    sim.qpos[1] = 0.5
    sim.ctrl.fill_(1.0)
    sim.forward(wp.ones(2, dtype=bool, device="cpu"))
    expected = in_c_mujoco(model, sim).sensordata[3]
    assert expected > 1.0
    np.testing.assert_allclose(sim.data.sensordata.numpy()[:, 3], [expected, 0.0], rtol=1e-3)


def link(name, joint, inner="", pos="0 0 -0.4"):
    geom = '<geom type="capsule" fromto="0 0 0 0.05 0 -0.4" size="0.03" contype="0" conaffinity="0"/>'
    return f'<body name="{name}" pos="{pos}">{joint}{geom}{inner}</body>'


@in_both_forms
def test_a_swinging_chain_keeps_its_energy(form):
    """A hinge, a ball joint and a hinge, without friction, for two seconds."""
    hand = link("hand", '<joint axis="0 1 0"/>')
    model = scene(link("root", '<joint axis="1 0 0"/>', link("arm", '<joint type="ball"/>', hand), pos="0 0 2"))
    sim = simulated(model, ctrl_dt=0.02, sim_dt=0.0001)
    sim.qpos[0] = torch.tensor([1.0, 0.9, 0.3, -0.3, 0.1, 0.5])
    sim.qpos[0, 1:5] /= sim.qpos[0, 1:5].norm()
    sim.qvel[0] = torch.tensor([0.3, 0.6, -0.3, 0.9, 0.6])
    total, potential = [], []
    for _ in range(100):
        data = in_c_mujoco(model, sim)
        total.append(data.energy.sum())
        potential.append(data.energy[0])
        sim.step()
    assert np.ptp(potential) > 2.0
    assert np.ptp(total) < 0.1  # as much as C MuJoCo's at this time step


@in_both_forms
def test_a_free_body_keeps_its_momentum(form):
    """A tree that drives itself by actuators and springs, far from everything."""
    hand = link("hand", '<joint name="wrist" axis="0 1 0" range="-20 20" limited="true"/>')
    leg = link("leg", '<joint name="hip" axis="1 0 0" stiffness="5" frictionloss="0.1"/>', pos="0.1 0 0")
    arm = link("arm", '<joint type="ball" damping="0.1"/>', hand)
    actuator, momenta = '<motor joint="wrist" gear="2"/>', ("root", "arm", "hand")
    model = scene(link("root", "<freejoint/>", arm + leg), gravity="0 0 0", actuator=actuator, momenta=momenta)
    sim = simulated(model, ctrl_dt=0.02, sim_dt=0.0001)
    sim.qvel[0] = torch.linspace(-2.0, 2.0, model.nv)
    sim.qpos[0] = torch.as_tensor(model.qpos0)
    start = in_c_mujoco(model, sim)
    for i in range(50):
        sim.ctrl.fill_(1.0 if i % 20 < 10 else -1.0)
        sim.step()
    end = in_c_mujoco(model, sim)
    assert np.abs(end.qvel - start.qvel).max() > 1.0
    np.testing.assert_allclose(end.subtree_linvel[1], start.subtree_linvel[1], atol=1e-3)
    np.testing.assert_allclose(end.subtree_angmom[1], start.subtree_angmom[1], atol=1e-3)
    expected = [end.subtree_linvel[1], *(end.subtree_angmom[model.body(name).id] for name in momenta)]
    np.testing.assert_allclose(sim.data.sensordata.numpy()[0].reshape(-1, 3), expected, atol=1e-5)


@in_both_forms
def test_constraints_are_no_stiffer_than_the_time_step_allows(form):
    """MuJoCo's flag refsafe: a time constant of less than two steps counts as two."""
    joint = '<joint type="slide" axis="0 0 1" range="-1 0.5" limited="true"/>'
    body = f'<body name="root" pos="0 0 0.099">{joint}<geom size="0.1"/></body>'
    model = scene(PLANE.format(euler="0 0 0"), body, f'<body pos="3 0 1">{joint}<geom size="0.1"/></body>')
    sim, data = simulated(model, sim_dt=0.02), mujoco.MjData(model)
    data.qpos[1], data.qvel[:] = 0.51, (-0.5, 0.5)  # one in contact, one beyond its limit
    sim.qpos[0], sim.qvel[0] = torch.as_tensor(data.qpos), torch.as_tensor(data.qvel)
    sim.step()
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(sim.qvel[0], data.qvel, rtol=1e-4)


def test_bodies_that_are_excluded_do_not_touch():
    bodies = "".join(f'<body name="{name}"><freejoint/><geom size="0.1"/></body>' for name in "abc")
    exclude = '<contact><exclude body1="c" body2="a"/></contact>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody>{exclude}</mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert {pair.geoms for pair in collision.pairs(model)} == {tuple(geoms) for geoms in data.contact.geom.tolist()}


def test_more_pairs_of_geoms_than_a_byte_counts(monkeypatch):
    """Of 4 rows of 8 balls the last two collide."""
    monkeypatch.setattr(step, "TRACED_DOFS", 31)
    balls = "".join(f'<geom size="0.04" pos="{0.1 * i} 0 0"/>' for i in range(8))
    rows = [
        f'<body name="{name}" pos="0 {2 * i} 2"><joint type="slide" axis="0 1 0"/>{balls}</body>'
        for i, name in enumerate(("root", "b", "c", "d"))
    ]
    model = scene(*rows, gravity="0 0 0")
    assert len(collision.pairs(model)) == 6 * 64
    sim = simulated(model, ctrl_dt=0.005, sim_dt=0.005)
    sim.qpos[0, 3] = -1.93
    data = mujoco.MjData(model)
    data.qpos[3] = -1.93
    model.opt.timestep = 0.005
    for _ in range(3):
        sim.step()
        mujoco.mj_step(model, data)
    assert data.qvel[3] > 0.05
    np.testing.assert_allclose(sim.qvel[0], data.qvel, atol=1e-4)


@in_both_forms
def test_contacts_whose_damping_differs_by_rounding_are_all_damped_once(form):
    """0.95 mixed with 0.95 is not always 0.95."""
    surface = 'solref="-800 -30" solimp="0.95 0.95 0.01 0.5 2.5"'
    mixes = (0.3, 0.7, 1.0, 1.3, 2.0, 2.7)
    joint = '<joint type="slide" axis="0 0 1"/>'
    balls = [
        f'<body name="{i or "root"}" pos="{i} 0 0.09">{joint}<geom size="0.1" solmix="{mix}" {surface}/></body>'
        for i, mix in enumerate(mixes)
    ]
    model = scene(f'<geom type="plane" size="9 9 1" {surface}/>', *balls)
    assert len({pair.solimp[1] for pair in collision.pairs(model) if 0 in pair.geoms}) > 1
    data = mujoco.MjData(model)
    data.qvel[:] = -1.0
    sim = simulated(model, sim_dt=0.02)
    sim.qvel.fill_(-1.0)
    sim.step()
    mujoco.mj_step(model, data)
    np.testing.assert_allclose(sim.qvel[0], data.qvel, rtol=1e-5)


SPHERE = '<body name="root" pos="{pos}"><freejoint/><geom size="0.1" condim="{condim}"/></body>'
PLANE = '<geom type="plane" size="5 5 0.1" euler="{euler}"/>'
CORNER = [PLANE.format(euler=f"0 {angle} 0") for angle in (40, -40)]


def settled(model, seconds=2.0):
    """Returns the state after some time, and the positions a moment before."""
    sim = simulated(model)
    sim.qpos[0] = torch.as_tensor(model.qpos0)
    for _ in range(round(seconds / 0.02)):
        before = sim.qpos[0].clone()
        sim.step()
    return sim.qpos[0], sim.qvel[0], before


@in_both_forms
def test_a_ball_comes_to_rest_on_the_floor(form):
    for condim in (1, 3):
        qpos, qvel, before = settled(scene(PLANE.format(euler="0 0 0"), SPHERE.format(pos="0 0 0.11", condim=condim)))
        assert 0.099 < qpos[2] < 0.1
        assert qvel.abs().max() < 1e-4
        torch.testing.assert_close(qpos, before, rtol=0, atol=1e-6)


@in_both_forms
def test_a_ball_comes_to_rest_in_a_corner(form):
    """Of two planes, at the place that is symmetric."""
    qpos, qvel, _ = settled(scene(*CORNER, SPHERE.format(pos="0.02 0 0.2", condim=3)), seconds=4.0)
    height = 0.1 / np.cos(np.deg2rad(40))
    assert qpos[:2].abs().max() < 1e-3
    assert height - 2e-3 < qpos[2] < height
    assert qvel.abs().max() < 1e-2


@in_both_forms
def test_a_tolerance_below_single_precision_counts_as_the_least(form):
    """Otherwise the solver would iterate over rounding. MuJoCo-Warp has the same bound, 1e-6."""
    ends = []
    for tolerance in (1e-6, 1e-12):
        model = scene(*CORNER, SPHERE.format(pos="0.02 0 0.2", condim=3))
        model.opt.tolerance = tolerance
        ends.append(settled(model, seconds=0.4)[:2])
    assert torch.equal(torch.cat(ends[0]), torch.cat(ends[1]))


@in_both_forms
def test_moving_bodies_touch_within_their_margin(form):
    ball = '<body name="{}" pos="0 0 {}"><joint type="slide" axis="0 0 1"/><geom size="0.1" margin="0.05"/></body>'
    model = scene(ball.format("root", 0), ball.format("upper", 0.23), gravity="0 0 0")
    sim = simulated(model)
    sim.qvel.copy_(torch.tensor([[1.0, -1.0]]))
    data = in_c_mujoco(model, sim)
    assert data.ncon == 1
    mujoco.mj_step(model, data, sim.config.substeps)
    sim.step()
    assert data.qvel[0] < 0.0 < data.qvel[1]  # they bounce off each other
    np.testing.assert_allclose(sim.qvel[0], data.qvel, atol=1e-3)


@in_both_forms
def test_friction_holds_a_stack(form, monkeypatch):
    """A capsule on one across it, which lies on two that are fixed, under gravity that leans by 0.2.

    Both forms of the step, where they hold it as they are compiled for users.
    """
    for friction, stays in ((0.6, True), (0.05, False)):
        monkeypatch.setattr(wp.config, "optimization_level", None if stays else 0)
        geom = f'<geom type="capsule" size="0.05 0.3" friction="{friction}" '
        slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))  # none rolls
        rails = [f'{geom} pos="0 {y} 0" euler="0 90 0"/>' for y in (-0.15, 0.15)]
        lower = f'<body name="root" pos="0 0 0.1">{slides}{geom} euler="90 0 0"/></body>'
        upper = f'<body pos="0 0 0.2">{slides}{geom} euler="0 90 0"/></body>'
        qpos, qvel, _ = settled(scene(*rails, lower, upper, gravity="1.5 1.2 -9.6"), seconds=0.4)
        assert (qpos.abs().max() < 0.02) == stays
        assert (qvel.abs().max() < 0.2) == stays


# What has no place.


SLIDE = '<joint type="slide" axis="1 0 0"/><geom size="0.1"/>'
ROW = "".join(f'<body name="{i or "root"}" pos="0 0 {0.19 * i}">{SLIDE}</body>' for i in range(6))
"""Spheres in a column, each of which touches the next."""


def column(places, monkeypatch, qpos, qvel):
    """Returns the simulation after a control step, with so many places for contacts between moving bodies."""
    step.texts.clear()
    with monkeypatch.context() as patched:
        patched.setattr(dense_contacts, "MAX_DENSE", places)
        patched.setattr(description, "ENOUGH_FRICTIONAL", places)
        patched.setattr(description, "MOST_FRICTIONAL", places)
        sim = simulated(scene(ROW, gravity="0 0 0"), len(qpos))
        sim.qpos.copy_(qpos)
        sim.qvel.copy_(qvel)
        sim.step()
    return sim


@in_both_forms
def test_contacts_without_a_place_are_marked_in_their_world(form, monkeypatch):
    """The others are stepped as if there were places enough."""
    generator = torch.Generator().manual_seed(0)
    qpos, qvel = 0.02 * torch.randn(5, 6, generator=generator), torch.randn(5, 6, generator=generator)
    qpos[1:4] += torch.arange(6) % 2  # only neighbours touch: here none does
    qpos[2, 1] = qpos[2, 0]  # here one, or two
    few, enough = (column(places, monkeypatch, qpos, qvel) for places in (3, 12))
    dropped = OverflowType.NARROWPHASE
    assert [bool(bits & dropped) for bits in few.overflow.tolist()] == [True, False, False, False, True]
    assert not any(bits & dropped for bits in enough.overflow.tolist())
    assert torch.equal(few.qvel[1:4], enough.qvel[1:4])
    assert few.qpos.isfinite().all()
    assert (few.qvel[0] != enough.qvel[0]).any()


@in_both_forms
def test_a_bad_world_harms_no_other(form, monkeypatch):
    generator = torch.Generator().manual_seed(0)
    qpos, qvel = 0.02 * torch.randn(5, 6, generator=generator), torch.randn(5, 6, generator=generator)
    expected = column(12, monkeypatch, qpos, qvel)
    for bad in (torch.nan, torch.inf, 1e30, -1e12):
        qpos[1, 3] = qvel[3, 0] = bad
        found = column(12, monkeypatch, qpos, qvel)
        for name in ("qpos", "qvel", "qacc_warmstart", "xpos", "xmat", "overflow"):
            assert torch.equal(getattr(found, name)[::2], getattr(expected, name)[::2]), (name, bad)


def test_a_dropped_contact_is_reported_with_what_helps():
    env = torchrl_loco.make("walker_walk", 3, "cpu", seed=0)
    td = env.reset()
    env.sim.overflow[1] = int(OverflowType.NARROWPHASE)
    env.step(td.set("action", env.action_spec.zero()))
    assert env.health()["worlds", "contact_overflow"].tolist() == [0, 1, 0]
    with pytest.warns(torchrl_loco.PhysicsOverflowWarning, match="contacts were dropped in 1 .*engine='mujoco_warp'"):
        env.close()


def test_a_text_is_kept_for_a_model_with_the_same_numbers_alone():
    body = '<body><joint axis="0 1 0"/><geom size="0.1" pos="0 0 1"/></body>'
    model, same = (mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>") for _ in "ab")
    varied = step.VariedModel(model, Varied(model, {"body_mass": [1]}))
    other = step.VariedModel(model, Varied(model, {"dof_damping": [0]}))

    def texts():
        return [
            *(step.kept_source(m, 1) for m in (model, varied, other)),
            step.kept_source(model, 2),
            *(step.kept_source(model, 1, step.Asked(**{name: True})) for name in ("with_cvel", "with_subtree_com")),
            step.kept_source(model, 1, step.Asked(contact_geoms=(0,))),
        ]

    first = texts()
    assert len(set(first)) == len(first)
    assert all(one is other for one, other in zip(texts(), first, strict=True))
    assert step.kept_source(same, 1) is first[0] == step.source(model, 1)
    same.dof_damping[0] = 1e-3
    assert step.kept_source(same, 1) == step.source(same, 1) != first[0]


def test_settings_of_room_change_nothing():
    """``njmax`` and ``naconmax`` are for the other engine."""
    reached = []
    for overrides in ({}, {"njmax": 1, "naconmax": 1}):
        settings = sim_config(CONFIGS["walker"], "playground", 3, {"engine": "compiled", **overrides})
        sim = Simulation(models.load(MODELS["walker"]), settings, 3, torch.device("cpu"))
        sim.qpos[:, 0] = -0.5
        sim.step()
        reached.append(sim.qvel)
    assert torch.equal(*reached)
    assert (sim.overflow & int(OverflowType.NEFC | OverflowType.NARROWPHASE) == 0).all()


def test_contact_parameters_are_mixed_as_in_mujoco():
    firsts = ('solref="-800 -30"', 'solref="-800 -30" solmix="0"', 'solref="-800 -30" priority="1"')
    seconds = ('solmix="2"', 'solmix="0"', 'friction="0"', 'condim="1" friction="0.3"')
    for first, second in itertools.product(firsts, seconds):
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody><geom size='0.1' {first}/>"
            f"<body pos='0 0 0.15'><freejoint/><geom size='0.1' {second}/></body></worldbody></mujoco>"
        )
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        (pair,) = collision.pairs(model)
        assert (pair.condim, pair.solref) == (data.contact.dim[0], tuple(data.contact.solref[0])), (first, second)
        np.testing.assert_allclose(pair.solimp, data.contact.solimp[0], err_msg=f"{first} {second}")
        assert pair.condim == 1 or pair.friction == data.contact.friction[0, 0], (first, second)


def test_limbs_share_no_column_but_the_trunk_s():
    """So the mass matrix has no number where rows of the Hessian have no room."""
    for task, trunk, limbs in (("go1_velocity", 6, [3, 3, 3, 3]), ("h1_velocity", 7, [5, 5, 4, 4])):
        m = models.load(env_class(task).model)
        data = mujoco.MjData(m)
        mujoco.mj_forward(m, data)
        mass = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, data, mass)
        found = lanes.Description(m).limbs
        assert (len(found.trunk), list(map(len, found.limbs))) == (trunk, limbs)
        assert sorted(found.rows) == list(range(m.nv))
        for one, other in itertools.permutations(found.limbs, 2):
            assert not mass[np.ix_(one, other)].any()
            assert found.crosses(1 << one[0] | 1 << other[0])
            assert not found.crosses(1 << one[0] | 1 << one[-1] | 1 << found.trunk[0])
    assert layout.Limbs.of([-1, 0, 1, 2]) is None  # a chain
    trunk = list(range(-1, layout.MOST_TRUNK - 1))
    assert layout.Limbs.of([*trunk, trunk[-1] + 1, trunk[-1] + 1]) is not None
    assert layout.Limbs.of([*trunk, trunk[-1] + 1, trunk[-1] + 2, trunk[-1] + 2]) is None  # a longer trunk
