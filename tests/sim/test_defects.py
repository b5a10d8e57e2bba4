"""Wrong answers that were found in the compiled step, one by one, and what it refuses since."""

import functools
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import warp as wp
from evaluate import evaluate
from for_each import for_each
from forms import in_both_forms
from test_random_models import c_data, c_step, compiled_step
from variation import all_varied

from torchrl_loco.config import SimConfig
from torchrl_loco.sim.compiled import step, unsupported
from torchrl_loco.sim.compiled.collision import planes
from torchrl_loco.sim.compiled.engine import Chain, _kernel
from torchrl_loco.sim.compiled.ir.parameters import VariedModel
from torchrl_loco.sim.compiled.ir.symbols import array, names, scalar
from torchrl_loco.sim.compiled.physics.constraints import MANY_ITERATIONS, Softness
from torchrl_loco.sim.compiled.schedules import lanes
from torchrl_loco.sim.compiled.schedules.lanes import description
from torchrl_loco.sim.overflow import Overflow
from torchrl_loco.sim.simulation import choose_engine
from torchrl_loco.sim.varied import Varied

DATA = Path(__file__).parents[1] / "data"
LIMBS = """
<mujoco>
  <option timestep="0.004" iterations="100" ls_iterations="50"/>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="a" pos="0 0 .35"><freejoint/><geom name="ga" type="sphere" size=".1" density="500"/>
      <body name="b" pos=".15 0 0"><joint name="h1" axis="0 1 0" damping=".2" armature=".01"/>
        <geom name="gb" type="capsule" size=".04 .1" pos=".1 0 0" euler="0 1.2 0" density="500"/>
        <body name="c" pos=".25 0 0"><joint name="h2" axis="0 0.3 1" damping=".1" armature=".01"/>
          <geom name="gc" type="sphere" size=".06" pos=".08 0 0" density="700"/></body></body></body>
  </worldbody>
  <actuator>
    <motor name="m1" joint="h1" gear="2" ctrlrange="-1 1"/>
    <position name="m2" joint="h2" kp="3" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
"""A sphere with a limb of two hinges over a floor."""


KINKED = """
<mujoco>
  <option timestep="0.0005" iterations="1" ls_iterations="5" gravity="0 0 0"/>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .099"><joint name="s" type="slide" axis="0 0 1" range=".001 1" solreflimit=".0025 1" limited="true"/>
      <geom size=".1" mass="1" condim="1" solimp=".98 .98 .1"/></body>
  </worldbody>
  <actuator><motor joint="s"/></actuator>
</mujoco>
"""
"""A sphere that is pushed into the floor, and against a limit that begins to push back later."""


def chain(links, ratio, impedance):
    """Returns a sphere with a chain of capsules, of which the last is ``ratio`` times as dense, and constraints."""
    limb = ""
    for k in reversed(range(links)):
        axis, density = ("0 1 0", "0 0 1", "1 .3 0")[k % 3], 1e3 * ratio ** ((k + 1) / links)
        limb = f"""<body pos="{0.2 if k else 0.1} 0 0"><joint axis="{axis}" range="-86 86" limited="true"/>
          <geom type="capsule" fromto="0 0 0 .18 0 0" size=".03" density="{density}"/>{limb}</body>"""
    solimp = f"{impedance} {impedance} .001"
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option iterations="100"/><default>
      <geom solimp="{solimp}" solref=".004 1"/><joint solimplimit="{solimp}"/></default><worldbody>
      <geom type="plane" size="5 5 .1"/><body pos="0 0 .2"><freejoint/><geom size=".1"/>{limb}</body>
      </worldbody></mujoco>""")


def limbs(*replaced):
    """Returns the model with some of its text replaced."""
    xml = LIMBS
    for old, new in replaced:
        assert old in xml
        xml = xml.replace(old, new)
    return mujoco.MjModel.from_xml_string(xml)


def falling(model, count=12, seed=0):
    """Returns float32 states in which a model has been falling for a while: qpos, qvel, qacc_warmstart and ctrl."""
    rng, data, rows = np.random.default_rng(seed), mujoco.MjData(model), []
    for _ in range(count):
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, 0.3 * rng.normal(size=model.nv), 1.0)
        data.qvel[:] = rng.normal(size=model.nv)
        data.ctrl[:] = rng.uniform(-1, 1, model.nu)
        for _ in range(int(rng.integers(20, 120))):
            mujoco.mj_step(model, data)
        state = data.qpos, data.qvel, data.qacc_warmstart, data.ctrl
        rows.append([x.astype(np.float32) for x in state])
    return [np.array(column) for column in zip(*rows, strict=True)]


def errors(model, states):
    """Returns by how much the velocity of each state after a step differs from C MuJoCo's."""
    assert unsupported(model) == []
    reached = compiled_step(model, states).qvel.numpy()
    expected = [c_step(model, *state) for state in zip(*states, strict=True)]
    return np.abs(reached - np.array(expected)).max(axis=1)


# What fails is seen.


def unsolved(sim):
    """Returns which worlds are flagged."""
    return sim.overflow.numpy() & int(Overflow.UNSOLVED) != 0


@in_both_forms
def test_what_is_no_number_ends_in_the_state(form):
    """One of a world's own numbers, or a control; it does not become a limit, and no row of constraints hides it."""
    limited = 'range="-1 1" limited="true" frictionloss=".1" axis="0 0.3 1"'
    light = 'timestep="0.004" gravity="0 0 -.01"'  # so that it does not show that a contact is missing
    replaced = (('axis="0 0.3 1"', limited), ("<motor", '<motor forcerange="-1 1"'), ('timestep="0.004"', light))
    model = limbs(*replaced)
    fields = ("body_mass", "dof_armature", "dof_damping", "gravity", "geom_friction", "actuator_gear")
    varied = Varied(model, {**{name: [0] for name in fields}, "body_mass": [2], "dof_frictionloss": [7]})
    data, count = mujoco.MjData(model), varied.count + 2
    data.qpos[2] = 0.0995  # touches the floor
    state = [np.repeat(x[None], count, axis=0) for x in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)]
    rows = np.repeat(varied.nominal()[None], count, axis=0)
    np.fill_diagonal(rows, np.nan)
    state[3][-2, 0] = np.nan
    sim = compiled_step(model, state, varied, rows)
    finite = np.array([sim.qvel.isfinite().all(1).tolist(), sim.qacc_warmstart.isfinite().all(1).tolist()])
    assert finite[:, -1].all()
    assert not finite[:, :-1].any(), [*varied.columns, "ctrl"]
    assert unsolved(sim).tolist() == [True] * (count - 1) + [False]


@pytest.mark.slow
@in_both_forms
def test_a_step_is_right_or_flagged(form):
    """Of stiff chains with heavy ends single precision keeps too few digits; ordinary ones are never flagged."""
    for links, ratio, impedance in ((4, 100.0, 0.9999), (8, 10.0, 0.9999), (6, 0.1, 0.95)):
        model = chain(links, ratio, impedance)
        states = [x[:60] for x in slow_states(model)]
        sim = compiled_step(model, states)
        after = np.array([c_step(model, *state) for state in zip(*states, strict=True)])
        change = np.maximum(np.abs(after - states[1]).max(axis=1), 0.05)
        wrong = np.abs(sim.qvel.numpy() - after).max(axis=1) > 0.1 * change
        assert not (wrong & ~unsolved(sim)).any()
        assert unsolved(sim).any() == (impedance > 0.99)


def slow_states(model, count=60):
    """Returns states on trajectories of C MuJoCo, none of which is fast or deep in another."""
    rng, data, rows = np.random.default_rng(0), mujoco.MjData(model), []
    while len(rows) < count:
        mujoco.mj_resetData(model, data)
        mujoco.mj_integratePos(model, data.qpos, 0.3 * rng.normal(size=model.nv), 1.0)
        data.qvel[:] = rng.normal(size=model.nv)
        mujoco.mj_step(model, data, int(rng.integers(20, 300)))
        state = [x.astype(np.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)]
        if data.ncon and data.contact.dist.min() > -0.02 and abs(data.qvel).max() < 30:
            rows.append(state)
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.slow
@in_both_forms
def test_a_world_that_blows_up_does_not_stand_still(form):
    """Thrown at up to 300 or 3000 rad/s, as many worlds are lost as C MuJoCo warns of; none keeps its acceleration."""
    model, count, steps = chain(3, 1.0, 0.9), 24, 200
    start = mujoco.MjData(model).qpos
    for speed in (300.0, 3000.0):
        velocities = np.random.default_rng(0).uniform(-speed, speed, (count, model.nv))
        states = [np.tile(start, (count, 1)), velocities, np.zeros_like(velocities), np.zeros((count, 0))]
        sim = compiled_step(model, [x.astype(np.float32) for x in states])
        lost, stands = np.zeros(count, bool), np.zeros(count, bool)
        for _ in range(steps - 1):
            before = sim.qacc_warmstart.clone()
            sim.step()
            bad = [~(x.abs() < 1e10).all(dim=1) for x in (sim.qpos, sim.qvel, sim.qacc_warmstart)]
            lost |= (bad[0] | bad[1] | bad[2]).numpy()
            stands = (sim.qacc_warmstart == before).all(dim=1).numpy()
        warned = []
        for state in zip(*states, strict=True):
            data = c_data(model, *state)
            mujoco.mj_step(model, data, steps)
            warned.append(any(warning.number for warning in data.warning))
        assert not (stands & ~lost).any()
        assert (lost != warned).sum() <= 3


@in_both_forms
def test_limits_of_ball_joints_have_places_beside_any_number_of_contacts(form, monkeypatch):
    """Twelve bars lie on the floor with 24 ends, more than lanes have places for, and six ball joints are beyond."""
    limbs = ""
    for k in range(6):
        at = 0.12 * np.cos(np.pi * k / 3), 0.12 * np.sin(np.pi * k / 3)
        bars = "".join(
            f'<geom type="capsule" fromto="{x} -.02 {z} {x} .02 {z}" size=".03"/>'
            for x, z in ((0.05, 0.05), (0.15, 0.07))
        )
        limbs += f"""<body pos="{at[0]} {at[1]} 0" euler="0 0 {60 * k}"><joint type="ball" range="0 8" limited="true"
          armature=".01" damping=".1"/>{bars}</body>"""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep=".004" iterations="100" ls_iterations="50">
      <flag eulerdamp="disable"/></option><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .1"><freejoint/>
      <geom size=".04" pos="0 0 .1"/>{limbs}</body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    for k in range(6):  # the bars level: 11.3 degrees, 3.3 beyond the limits
        mujoco.mju_axisAngle2Quat(data.qpos[7 + 4 * k : 11 + 4 * k], np.array([0.0, 1.0, 0.0]), np.arctan(0.2))
    mujoco.mj_kinematics(model, data)
    capsules = model.geom_type == int(mujoco.mjtGeom.mjGEOM_CAPSULE)
    data.qpos[2] -= data.geom_xpos[capsules, 2].min() - 0.029  # 1 mm deep
    state = [x[None].astype(np.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)]
    mujoco.mj_step(model, data)
    assert (data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)).sum() == 6
    for standing, tolerance in ((description.STANDING, 1e-6), (0.0, 0.1)):  # with it, places for half of the contacts
        step.texts.clear()
        with monkeypatch.context() as patch:
            patch.setattr(description, "STANDING", standing)
            sim = compiled_step(model, state)
        dropped = bool(sim.overflow.item() & int(Overflow.NARROWPHASE))
        assert dropped == (form == "lanes" and not standing)
        np.testing.assert_allclose(sim.qvel.numpy()[0, 6:], data.qvel[6:], atol=tolerance)


# What is refused.


def test_an_actuator_with_several_controls_is_named():
    """There are more controls than actuators."""
    pid = '<pid name="m1" joint="h1" kp="2" ki="1"/>'
    for actuator in (pid, '<pid name="m1" joint="h1" kp="2"/>', f'<motor joint="h2"/>{pid}'):
        model = limbs(('<motor name="m1" joint="h1" gear="2" ctrlrange="-1 1"/>', actuator))
        assert model.nu > model.nactuator
        assert "actuator 'm1': other than one control" in unsupported(model)
        assert choose_engine(model, SimConfig(ctrl_dt=0.004, sim_dt=0.004))[0] == "mujoco_warp"


def test_a_model_that_cannot_be_read_is_not_supported(monkeypatch):
    monkeypatch.setattr("torchrl_loco.sim.compiled.support.pairs", lambda m: [][0])
    assert unsupported(limbs()) == ["contacts of an unknown kind (IndexError: list index out of range)"]


# What a step does.


@in_both_forms
def test_actuators_of_a_disabled_group_do_not_act(form):
    group = ('<motor name="m1"', '<motor name="m1" group="1"')
    model = limbs(group, ('timestep="0.004"', 'timestep="0.004" actuatorgroupdisable="1"'))
    states = falling(model)
    assert np.median(errors(model, states)) < 1e-6
    acting = [c_step(limbs(group), *state) for state in zip(*states, strict=True)]
    assert np.abs(compiled_step(model, states).qvel.numpy() - np.array(acting)).max() > 0.1


@in_both_forms
def test_a_light_body_is_moved(form):
    """Its inertia is below what rounding leaves of one."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option gravity="0 0 0"/><worldbody><body name="a"><joint name="h" axis="0 1 0" springref="1" '
        'stiffness="1e-13"/><inertial pos="0 0 0" mass="1e-9" diaginertia="3e-15 3e-15 3e-15"/></body></worldbody>'
        '<actuator><motor joint="h" gear="1e-13"/></actuator></mujoco>'
    )
    states = [np.array([[0.3], [-0.2]]), np.array([[0.0], [0.5]]), np.zeros((2, 1)), np.array([[0.0], [2.0]])]
    states = [x.astype(np.float32) for x in states]
    expected = np.array([c_step(model, *state) for state in zip(*states, strict=True)])
    assert np.abs(expected).min() > 0.01
    np.testing.assert_allclose(compiled_step(model, states).qvel.numpy(), expected, rtol=1e-5)


def test_joints_that_do_the_same_are_traced(monkeypatch):
    """The mass matrix is singular, which is C MuJoCo's to warn of; constants of it are not divided by zero."""
    joints = '<joint axis="0 0 1"/><joint axis="0 0 1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="a">{joints}<geom type="sphere" size="0.1"/></body></worldbody></mujoco>'
    )
    for traced_dofs in (31, 0):  # traced, and by lanes
        monkeypatch.setattr(step, "TRACED_DOFS", traced_dofs)
        assert unsupported(model) == []
        assert step.source(model, 1)


@in_both_forms
def test_a_site_feels_its_contact_and_none_beside_it(form):
    """The ray of a contact along an axis of the site runs beside it, as long as it may be."""
    shapes = ("box", "cylinder", "capsule", "ellipsoid", "sphere")
    names = [f"{shape}{i}" for shape in shapes for i in range(2)]
    sites = [f'<site name="{name}" type="{name[:-1]}" size=".12 .12 .12" pos="{name[-1]} 0 0"/>' for name in names]
    touches = "".join(f'<touch site="{name}"/>' for name in names)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body name="a" pos="0 0 .0999"><joint type="slide" '
        f'axis="0 0 1"/><geom size=".1"/>{"".join(sites)}</body></worldbody><sensor><subtreelinvel body="a"/>{touches}'
        "</sensor></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert (data.sensordata[3::2] > 1.0).all()
    assert (data.sensordata[4::2] == 0.0).all()
    sim = compiled_step(model, [np.zeros((1, size), np.float32) for size in (1, 1, 1, 0)])
    np.testing.assert_allclose(sim.data.sensordata.numpy()[0, 3:], data.sensordata[3:], rtol=1e-3)


def test_numbers_are_not_rounded_to_zero():
    assert scalar(1e-15).constant == 1e-15
    assert scalar(1 - 1e-15).constant == 1.0
    assert (scalar(0.3) - scalar(0.1) - scalar(0.2)).constant == 0.0
    assert [x.constant for x in array([1e-16, 3.0])] == [0.0, 3.0]
    assert [x.constant for x in array([1e-16, 3e-15])] == [1e-16, 3e-15]
    softness = Softness.make(limbs(), (0.02, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0))
    assert float(evaluate(softness.row(1e-30, scalar(-0.1))[0], {})) == pytest.approx(1e15)


@in_both_forms
def test_a_solref_that_mixes_its_formats_is_the_default(form):
    """Of contacts, limits and dry friction."""
    states = falling(limbs())
    states[0][:, 7] += 0.5
    for solref in (".05 -10", "-1000 1", "0 0"):
        joint = (
            f'<joint solreflimit="{solref}" solreffriction="{solref}" frictionloss=".1" range="-.2 .2" limited="true"/>'
        )
        model = limbs(("<worldbody>", f'<default><geom solref="{solref}"/>{joint}</default><worldbody>'))
        assert errors(model, states).max() < 1e-3, solref


@in_both_forms
def test_a_joint_may_be_near_both_its_limits(form):
    """Each is a row of its own where the margin exceeds half the range. Other joints have one, whichever is nearer."""
    near = '<joint name="h1" range="-.05 .05" limited="true" margin=".1"'
    far = '<joint name="h2" range="-.2 .3" limited="true" margin=".1"'
    model = limbs(('<joint name="h1"', near), ('<joint name="h2"', far))
    states = falling(model, count=30)
    kinds = []
    for state in zip(*states, strict=True):
        data = c_data(model, *state)
        mujoco.mj_forward(model, data)
        kinds.append(data.efc_id[data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT].tolist())
    assert [1, 1] in kinds
    assert [1, 1, 2] in kinds
    assert errors(model, states).max() < 1e-3


TILTED = """
<mujoco>
  <option timestep="0.002" iterations="100" ls_iterations="50"/>
  <worldbody>{pairs}</worldbody>
</mujoco>
"""
PAIR = """
<geom name="plane{bit}" type="plane" size="5 5 .1" euler="{plane}" contype="{bit}" conaffinity="0"/>
<body pos="0 0 .3"><freejoint/>
  <geom name="capsule{bit}" type="capsule" size=".05 .2" euler="{capsule}" contype="0" conaffinity="{bit}"/></body>
"""
"""A plane and a capsule that touch nothing else; in the first cases it is within 30 degrees of the plane's normal."""
CASES = [
    ("25 0 0", "35 5 0"),
    ("50 0 0", "45 5 0"),
    ("-40 20 0", "-30 20 0"),
    ("90 0 0", "80 10 0"),
    ("0 0 0", "20 15 0"),
    ("0 0 0", "2 -1 0"),
    ("0 0 0", "60 5 0"),
    ("0 70 0", "0 10 20"),
]


def leaning(cases, count=8):
    """Returns the model, and states in which an end of each capsule slides, pressed in by 1 mm."""
    pairs = "".join(PAIR.format(bit=2**i, plane=plane, capsule=capsule) for i, (plane, capsule) in enumerate(cases))
    model, rng, rows = mujoco.MjModel.from_xml_string(TILTED.format(pairs=pairs)), np.random.default_rng(0), []
    for _ in range(count):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        for i in range(len(cases)):
            plane, capsule = model.geom(f"plane{2**i}").id, model.geom(f"capsule{2**i}").id
            normal, axis = (data.geom_xmat[geom].reshape(3, 3)[:, 2] for geom in (plane, capsule))
            lowest = min((data.geom_xpos[capsule] + end * axis) @ normal for end in (-0.2, 0.2)) - 0.05
            data.qpos[7 * i : 7 * i + 3] -= normal * (lowest + 0.001)
        data.qvel[:] = 0.5 * rng.normal(size=model.nv)
        rows.append([x.astype(np.float32) for x in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)])
    return model, [np.array(column) for column in zip(*rows, strict=True)]


def test_tangents_are_normal_to_a_tilted_plane():
    """Of a capsule along the normal, which gives no direction."""
    for normal in ((0.0, 0.0, 1.0), (0.0, -0.4, 0.9), (0.6, 0.7, -0.2), (0.0, 1.0, 0.0)):
        normal = np.array(normal) / np.linalg.norm(normal)
        axis = normal + 1e-8 * np.array([1.0, -2.0, 3.0])
        tangent = evaluate(
            planes.frame(array(normal), np.array(names("axis", 3), dtype=object)),
            {f"axis[{i}]": axis[i] for i in range(3)},
        )
        assert normal @ tangent == pytest.approx(0, abs=1e-12)
        assert np.linalg.norm(tangent) == pytest.approx(1)


# What fits the shared memory of a GPU.

SIZES = range(17, 65)


def bristly(dofs, condim=3, touch=0, cone="pyramidal"):
    """Returns a sphere with limbs of up to three hinges, that touch each other and the floor."""
    limbs, left = [], dofs - 6
    while left > 0:
        angle, limb = 0.3 * len(limbs), ""
        for joint in reversed(range(min(3, left))):
            place = "0.12 0 0" if joint else f"{0.14 * np.cos(angle):.4f} {0.14 * np.sin(angle):.4f} 0"
            limb = (
                f'<body pos="{place}"><joint axis="0 {joint % 2} {1 - joint % 2}" range="-1 1" limited="true"/>'
                f'<geom type="capsule" size=".03" fromto="0 0 0 .1 0 0" condim="{condim}"/>{limb}</body>'
            )
        limbs.append(limb)
        left -= 3
    sensors = '<touch site="s"/>' * touch
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><option cone="{cone}"/><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .5"><freejoint/>'
        f'<geom size=".12" condim="{condim}"/><site name="s"/>'
        f"{''.join(limbs)}</body></worldbody><sensor>{sensors}</sensor></mujoco>"
    )


KINDS = [{}, {"condim": 1}, {"touch": 1, "condim": 6}, {"condim": 4, "cone": "elliptic"}]


@functools.cache
def bristles():
    """Returns a model of every number of degrees of freedom, of one kind after another."""
    return [bristly(dofs, **KINDS[dofs % len(KINDS)]) for dofs in SIZES]


@pytest.mark.slow
def test_worlds_and_what_warp_adds_fit_a_block():
    """Warp takes 4 bytes for each thread."""
    for model in bristles():
        description = lanes.Description(model)
        worlds = description.worlds_per_block()
        assert worlds * (description.layout.bytes + 4 * 32) <= 48 * 1024, model.nv


def wide(model):
    """Returns the C++ in which the state of a world is declared, and its size checked."""
    text = lanes.source(model, 1)
    head, check = text.split("// ---- Friction")[0], 'static_assert(sizeof(World) == Model::WORLD_BYTES, "size");'
    macros = ("INLINE", "ROLLED_FOR", "UNROLLED_FOR", "OWN_DOFS", "SHARED_LOOP")
    return "\n".join(["{", head, check, "}", *(f"#undef {macro}" for macro in macros), ""])


@pytest.mark.slow
def test_the_size_of_a_world_is_what_its_layout_says(monkeypatch):
    """Of every third number of degrees of freedom; what a model of lanes compiles to checks it too."""
    monkeypatch.setattr(step, "TRACED_DOFS", 0)

    @wp.func_native("\n".join(map(wide, [*bristles()[::3], limbs()])))
    def declare(x: int): ...

    @wp.kernel(module="unique", enable_backward=False)
    def sizes():
        declare(wp.tid())

    wp.launch(sizes, dim=1, device="cpu")
    assert "static_assert(sizeof(World)" in lanes.source(bristles()[0], 1)


@pytest.mark.slow
@pytest.mark.skipif(90 not in wp.get_cuda_supported_archs(), reason="Warp was built without NVRTC")
@for_each(
    ("dofs", "kind", "varied", "asked", "arch"),
    [
        (64, {"touch": 1}, False, {"contact_geoms": (1, 2), "contact_rows": 2}, 90),
        (36, {"condim": 6, "cone": "elliptic"}, True, {}, 75),
    ],
)
def test_a_body_builds_for_a_gpu(dofs, kind, varied, asked, arch, tmp_path, monkeypatch):
    """NVRTC needs no GPU; ptxas counts the shared memory. Colab's are of architecture 75."""
    monkeypatch.setattr(step, "TRACED_DOFS", 0)
    model = bristly(dofs, **kind)
    assert unsupported(model) == []
    start, end = Chain(()), Chain(())
    text = step.source(VariedModel(model, all_varied(model)) if varied else model, 2, **asked)
    description = lanes.Description(model)
    kernel = _kernel(text, start, end, description.registers())
    kernel.module.options["optimization_level"] = 3  # as for users
    kernel.module.options["block_dim"] = 32 * description.worlds_per_block()
    (built,) = wp.compile_aot_module(
        kernel.module, arch=arch, module_dir=tmp_path / str(dofs), use_ptx=False, strip_hash=True
    )
    assert built.suffix == ".cubin"


ROUND_OVER_FIELD = """<mujoco>
  <asset><hfield name="h" nrow="3" ncol="3" size="2 2 1 1" elevation="0 1 0 1 0 1 0 1 0"/></asset>
  <worldbody>
    <geom type="hfield" hfield="h"/>
    <body pos="0 0 3">
      <freejoint/>
      <geom size="0.2"/>
      <body pos="0.5 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/></body>
    </body>
  </worldbody>
</mujoco>"""


@pytest.mark.slow
@pytest.mark.skipif(90 not in wp.get_cuda_supported_archs(), reason="Warp was built without NVRTC")
def test_lanes_keep_what_they_have_in_registers(tmp_path, monkeypatch):
    """What lies in memory takes longer, and if it is a pointer to shared memory, so does all that it points to."""
    monkeypatch.setattr(step, "TRACED_DOFS", 0)
    model = mujoco.MjModel.from_xml_string(ROUND_OVER_FIELD)
    kernel = _kernel(step.source(model, 2), Chain(()), Chain(()), lanes.Description(model).registers())
    kernel.module.options["optimization_level"] = 3
    (built,) = wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=True, strip_hash=True)
    spaces = set(re.findall(r"\b(?:ld|st)\.(?:v\d\.)?([a-z]+)", built.read_text()))
    assert spaces == {"shared", "global", "param"}, spaces


@in_both_forms
def test_a_slippery_floor_is_no_stiffer_than_single_precision(form):
    """Stiffness grows with the inverse square of friction."""
    for friction, most in ((0.01, 5e-3), (0.001, 2e-3)):
        model = limbs(("<worldbody>", f'<default><geom friction="{friction}"/></default><worldbody>'))
        found = errors(model, falling(model, count=60))
        assert found.max() < most
        assert np.quantile(found, 0.9) < 5e-4


@pytest.mark.slow
@in_both_forms
def test_the_limit_of_iterations_is_flagged_where_it_is_reached(form):
    """One iteration fewer than a world needs is flagged; as many are not, and give what more of them give."""
    model, reached, flags = limbs(), [], []
    states = falling(model, count=40)
    for iterations in (1, 3, MANY_ITERATIONS - 1):  # with more, searches end earlier
        model.opt.iterations = iterations
        sim = compiled_step(model, states)
        reached.append(sim.qacc_warmstart.numpy().copy())
        flags.append((sim.overflow.numpy() & int(Overflow.ITERATIONS)) != 0)
        assert not (sim.overflow.numpy() & ~int(Overflow.ITERATIONS)).any()
    assert 40 > flags[0].sum() > flags[1].sum() > 0
    assert not flags[-1].any()
    final = np.array([(rows == reached[-1]).all(axis=1) for rows in reached])
    np.testing.assert_array_equal(flags, ~final)


@in_both_forms
def test_a_capsule_orients_the_frame_of_its_contact(form):
    """However steep it is, and however tilted the plane."""
    for cases in (CASES[:4], CASES[4:]):
        assert errors(*leaning(cases)).max() < 2e-5, cases


def test_links_that_cross_in_their_plane_are_pushed_out_of_it():
    """The gap of their axes is what rounding leaves; the normal is across both."""
    link = """<body pos="0 0 -.2"><joint axis="0 1 0" armature=".01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".2" condim="1"/>"""
    rng = np.random.default_rng(0)
    for links, bend in ((8, 2.0), (20, 1.5)):  # traced, and by lanes
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option gravity="0 0 0"/><worldbody>{link * links}{"</body>" * links}</worldbody></mujoco>'
        )
        states = [rng.uniform(-bend, bend, (64, links)), rng.normal(size=(64, links)), np.zeros((64, links))]
        found = errors(model, [x.astype(np.float32) for x in (*states, np.zeros((64, 0)))])
        assert found.max() < 1e-3


@in_both_forms
def test_a_small_gain_is_found_beside_a_large_cost(form):
    """Contacts 0.10 and 0.15 m deep cost 6e9 J, of which the last steps of the solver gain 8 to 70 J.

    In the other state a Newton step of single precision misses by 0.4 % and crosses no row: 28 of 2508 rad/s^2 are off.
    In the last, the first step ends just where a limit begins that is 1e9 times as heavy as what ends it before.
    """
    for name, allowed in (("stalled", 0.02), ("skewed", 1.0))[: 1 if form == "traced" else 2]:
        model = mujoco.MjModel.from_xml_path(str(DATA / f"{name}.xml"))
        with np.load(DATA / f"{name}_states.npz") as file:
            rows = np.array([file[name] for name in file.files], dtype=np.float32)
        states = np.split(rows, np.cumsum([model.nq, model.nv, model.nv]), axis=1)
        assert (errors(model, states) / model.opt.timestep).max() < allowed, name
    model, count = mujoco.MjModel.from_xml_string(KINKED), 64
    model.dof_invweight0[:] *= 1e-9
    speeds = np.linspace(0.9, 1.2, count)  # at which that limit pushes from 0.75 to 1 of the way on
    states = [np.full((count, 1), x, dtype=np.float32) for x in (0, 0, 0, -1000)]
    states[1][:, 0] = speeds
    assert (errors(model, states) / model.opt.timestep).max() < 1.0


@in_both_forms
def test_ends_of_ranges_may_be_infinite_and_numbers_odd_as_in_c_mujoco(form):
    """Damping that is negative everywhere is explicit; the ratio of impedances has a lower bound."""
    odd = LIMBS.replace(" iterations=", ' impratio="0" iterations=').replace(
        'damping=".2"', 'damping="-.3" range="-inf 1"'
    )
    odd = odd.replace('damping=".1"', 'damping="-.1" limited="true" range="-.2 inf"')
    odd = odd.replace('gear="2"', 'gear="2" forcerange="-inf 1e300"')
    m = mujoco.MjModel.from_xml_string(odd)
    rng, n = np.random.default_rng(0), 20
    states = [np.zeros((n, size), dtype=np.float32) for size in (m.nq, m.nv, m.nv, m.nu)]
    states[0][:] = m.qpos0
    states[0][:, 2] = rng.uniform(0.09, 0.2, n)  # some touch the floor
    states[0][:, 7:] = rng.uniform(-0.5, 1.2, (n, 2))
    states[1][:], states[3][:] = rng.normal(size=(n, m.nv)), rng.uniform(-1, 1, (n, m.nu))
    expected = np.array([c_step(m, *state) for state in zip(*states, strict=True)])
    np.testing.assert_allclose(compiled_step(m, states).qvel.numpy(), expected, rtol=1e-4, atol=1e-4)
