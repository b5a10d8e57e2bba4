"""The compiled step on small random models against C MuJoCo in float64: one physics step along trajectories."""

import collections
import copy
import functools

import hypothesis
import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from contact_forces import net_forces
from for_each import for_each
from random_models import models, states
from variation import draw_rows, some_varied

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation
from torchrl_loco.sim.compiled import step, unsupported
from torchrl_loco.sim.overflow import Overflow

STATES = 16
FEW = 5
"""Most bodies of a model that is made here each time: the larger, the longer it compiles."""
NOISE = 3e-7
"""Relative noise in a state: about what rounding to float32 makes."""
EDGE = 1e-6
"""Distance (m) about where a contact begins, within which rounding decides whether there is one."""
ALONE = "implicitfast for a body that is alone in its tree"
KINDS = ("plane", "dense", "frictionless", "pyramid", "hinge limit", "slide limit", "ball limit", "dry friction")
"""Kinds of constraints that a state can have."""
KINDS_OF_LANES = (*KINDS, "cone", "turning")
"""The same with those that are not traced."""
FORMS = (31, 0)
"""Most degrees of freedom of bodies that are traced: all of the random models, or none, which are lanes then."""
"""Both forms of the compiled step: most degrees of freedom that are traced."""
ROLLING = """
<mujoco>
  <option timestep="0.004" cone="{cone}" impratio="10" iterations="100" ls_iterations="50"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" friction="0.6 0.01 0.002" condim="1"/>
    <body name="body0" pos="0 0 0.15">
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="ball"/>
      <geom size="0.08" pos="0.01 0 0.02" condim="6" friction="0.8 0.02 0.03"/><site name="zone0" size="0.1"/></body>
    <body name="body1" pos="0.05 0.02 0.3"><freejoint/>
      <geom size="0.07" pos="0 0 0.01" condim="4" friction="0.3 0.05 0.001"/>
      <body name="body2" pos="0.1 0 0"><joint name="hinge" axis="0 1 0.3" armature="0.01" damping="0.1" range="-40 40"/>
        <geom type="capsule" fromto="0 0 0 0.12 0 0" size="0.05" condim="3" friction="0.1" priority="1"/>
        <site name="zone2" type="capsule" fromto="0 0 0 0.2 0 0" size="0.08"/></body></body>
    <body name="body3" pos="-0.08 0 0.3"><joint type="slide" axis="0 0.3 1"/>
      <geom size="0.06" pos="0.01 0.02 0" condim="1"/></body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
  <sensor><subtreelinvel body="body0"/><subtreeangmom body="body2"/><touch site="zone0"/><touch site="zone2"/></sensor>
</mujoco>
"""
"""Bodies of every condim. None has its center of mass at its origin: MuJoCo keeps the mass of such a one."""
SETTINGS = {
    "deadline": None,
    "derandomize": True,
    "database": None,
    "phases": [hypothesis.Phase.generate],
    "suppress_health_check": list(hypothesis.HealthCheck),
}


@pytest.fixture(autouse=True)
def quiet_c_mujoco():
    mujoco.set_mju_user_warning(lambda message: None)  # else it writes a log into the working directory
    yield
    mujoco.set_mju_user_warning(None)


def compiled_step(model, state, varied=None, rows=None):
    """Returns the simulation of all states after one physics step, each with its row of numbers of the model."""
    option, count = model.opt, len(state[0])
    config = SimConfig(
        ctrl_dt=option.timestep,
        sim_dt=option.timestep,
        naconmax=1,
        njmax=1,
        iterations=option.iterations,
        ls_iterations=option.ls_iterations,
        euler_damping=not option.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP,
        integrator=mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower(),
        engine="compiled",
    )
    sim = Simulation(model, config, count, torch.device("cpu"), contact_geoms=range(model.ngeom), varied=varied)
    assert sim.cvel.shape == (count, model.nbody, 6)  # asking for it makes the step compute it
    assert sim.subtree_com.shape == (count, model.nbody, 3)
    if varied is not None:
        sim.numbers.copy_(torch.as_tensor(rows))
        sim.forward(wp.ones(count, dtype=bool, device="cpu"))
    for view, values in zip((sim.qpos, sim.qvel, sim.qacc_warmstart, sim.ctrl), state, strict=True):
        view.copy_(torch.as_tensor(values))
    sim.step()
    return sim


@functools.lru_cache(maxsize=3)
def scratch(model):
    """Returns data for what is read at once: to make it takes longer than a step."""
    return mujoco.MjData(model)


@functools.lru_cache(maxsize=1)
def at_the_edges(model):
    """Returns two models like it: contacts of one begin a little earlier, those of the other a little later."""
    models = [copy.copy(model), copy.copy(model)]
    for other, margin in zip(models, (EDGE, -EDGE), strict=True):
        other.geom_margin += margin / 2  # those of two geoms add up
        other.pair_margin += margin
    return models


def c_data(model, qpos, qvel, warmstart, ctrl, data=None):
    data = mujoco.MjData(model) if data is None else data
    mujoco.mj_resetData(model, data)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = qpos, qvel, warmstart, ctrl
    return data


def c_steps(model, *state):
    """Returns the velocity that C MuJoCo reaches, and the acceleration that its solver found."""
    data = c_data(model, *state, scratch(model))
    mujoco.mj_step(model, data)
    return data.qvel.copy(), data.qacc.copy()


def c_step(model, *state):
    return c_steps(model, *state)[0]


def neighbours(model, state, rng):
    """Returns what C MuJoCo reaches from states that differ by noise as small as rounding."""
    qpos, qvel, *rest = state
    for _ in range(4):
        near = qpos.astype(np.float64)
        mujoco.mj_integratePos(model, near, rng.normal(size=model.nv) * NOISE, 1.0)
        yield c_steps(model, near, qvel * (1 + rng.normal(size=model.nv) * NOISE), *rest)


def jacobian(model, data):
    """Returns the Jacobian of the constraints, ``(nefc, nv)``; MuJoCo keeps room for contacts that make no rows."""
    return data.efc_J[: data.nefc * model.nv].reshape(-1, model.nv)


def cost(model, data, qacc):
    """Returns what the solver minimises at an acceleration, in float64."""
    mass, rows = np.zeros((model.nv, model.nv)), np.zeros(1)
    mujoco.mj_fullM(model, data, mass)
    mujoco.mj_constraintUpdate(model, data, jacobian(model, data) @ qacc - data.efc_aref, rows, 0)
    apart = qacc - data.qacc_smooth
    return 0.5 * apart @ mass @ apart + rows[0]


def held(model, data):
    """Returns which actuators' forces are at a limit, of their own or of their joint."""
    own, joint = model.actuator_forcerange, model.actuator_trnid[:, 0]
    force, sums, limits = data.actuator_force, data.qfrc_actuator[model.jnt_dofadr[joint]], model.jnt_actfrcrange[joint]
    at_own = (model.actuator_forcelimited == 1) & ((force <= own[:, 0]) | (force >= own[:, 1]))
    return at_own | ((model.jnt_actfrclimited[joint] == 1) & ((sums <= limits[:, 0]) | (sums >= limits[:, 1])))


def constraints(model, data):
    """Returns the kinds of constraints of a state, from :data:`KINDS`."""
    kinds, row_types, ids = set(), data.efc_type, data.efc_id
    for geoms in data.contact.geom[data.contact.efc_address >= 0]:
        kinds.add("plane" if mujoco.mjtGeom.mjGEOM_PLANE in model.geom_type[geoms] else "dense")
    kinds |= {"turning"} if (data.contact.dim[data.contact.efc_address >= 0] > 3).any() else set()
    names = {"mjCNSTR_CONTACT_FRICTIONLESS": "frictionless", "mjCNSTR_CONTACT_PYRAMIDAL": "pyramid"}
    names |= {"mjCNSTR_CONTACT_ELLIPTIC": "cone", "mjCNSTR_FRICTION_DOF": "dry friction"}
    kinds |= {kind for name, kind in names.items() if (row_types == getattr(mujoco.mjtConstraint, name)).any()}
    for joint in ids[row_types == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT]:
        kinds.add(mujoco.mjtJoint(model.jnt_type[joint]).name.removeprefix("mjJNT_").lower() + " limit")
    return kinds


def assert_poses_belong_to_the_state(model, sim, world):
    """Poses, velocities and the sensor are those of C MuJoCo at the state that was reached."""
    data = c_data(model, *(view[world].double() for view in (sim.qpos, sim.qvel, sim.qacc_warmstart, sim.ctrl)))
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    far, fast = 2e-6 * (1 + np.abs(data.xpos).max()), 1e-5 * (1 + np.abs(data.cvel).max())
    np.testing.assert_allclose(sim.xpos[world], data.xpos, rtol=0, atol=far)
    turned = 4e-6 + 1e-6 * np.abs(data.qpos).max()  # an angle of many turns has fewer digits
    np.testing.assert_allclose(sim.xmat[world].reshape(-1, 9), data.xmat, rtol=0, atol=turned)
    np.testing.assert_allclose(sim.data.cvel.numpy()[world], data.cvel, rtol=0, atol=fast)
    roots = sorted(set(model.body_rootid) - {0})
    np.testing.assert_allclose(sim.subtree_com[world, roots], data.subtree_com[roots], rtol=0, atol=far)
    velocity = data.subtree_linvel[model.body("body0").id]
    sensed, (_, below, *_) = sim.data.sensordata.numpy()[world], model.sensor_objid
    np.testing.assert_allclose(sensed[:3], velocity, rtol=0, atol=fast)
    momentum, mass = data.subtree_angmom[below], model.body_subtreemass[below]
    np.testing.assert_allclose(sensed[3:6], momentum, rtol=0, atol=fast * max(mass, 1.0))


def forces_in_c(model, state, qacc):
    """Returns forces of C MuJoCo at an acceleration, and what rounding of its residuals makes of them.

    Touch sensors first, then contact forces and normal forces of the geoms, ``(ngeom, 3)`` and ``(ngeom,)``.
    """
    data = c_data(model, *state, scratch(model))
    mujoco.mj_forward(model, data)
    data.qacc[:] = qacc
    slopes = jacobian(model, data)
    mujoco.mj_constraintUpdate(model, data, slopes @ data.qacc - data.efc_aref, None, 0)
    mujoco.mj_sensorAcc(model, data)
    terms = np.abs(slopes) @ np.abs(data.qacc) + np.abs(data.efc_aref)
    net, normal, _ = net_forces(model, data)
    return [data.sensordata[6:].copy(), net, normal], 1e-5 * (data.efc_D * terms).max(initial=0)


def as_rounded(model, state, sim, world):
    """Returns the model, or where rounding decides what touches, the one like it that has the contact forces found.

    A contact pushes from where it begins, with hundreds of newtons if the geoms are quick: none is as right as one.
    """
    models, qacc = [model, *at_the_edges(model)], sim.qacc_warmstart[world].double().numpy()
    data = [c_data(each, *state, scratch(each)) for each in models]
    for each, of_it in zip(models, data, strict=True):
        mujoco.mj_fwdPosition(each, of_it)
    if len({of_it.nefc for of_it in data}) == 1:
        return model
    pushed = sim.contact_force[world].numpy()
    return min(models, key=lambda each: np.abs(forces_in_c(each, state, qacc)[0][1] - pushed).max())


def assert_forces_belong_to_the_acceleration(model, state, sim, world, rng):
    """Touch sensors and contact forces are those of C MuJoCo at the acceleration that was reached.

    Returns:
        how many touch sensors and how many geoms feel something.
    """
    qacc = sim.qacc_warmstart[world].double().numpy()
    (touch, net, normal), rounding = forces_in_c(model, state, qacc)
    changes, (qpos, *rest) = [np.zeros_like(touch), np.zeros_like(net)], state
    for _ in range(4):  # a contact that is almost none is as soft as rounding of its distance makes it
        near = qpos.astype(np.float64)
        mujoco.mj_integratePos(model, near, rng.normal(size=model.nv) * NOISE, 1.0)
        others = forces_in_c(model, (near, *rest), qacc)[0]
        changes = [np.maximum(c, np.abs(a - b)) for c, a, b in zip(changes, others, (touch, net), strict=False)]
    felt, pushed = sim.data.sensordata.numpy()[world, 6:], sim.contact_force[world].numpy()
    assert (np.abs(felt - touch) <= 0.01 * touch + rounding + 10 * changes[0]).all(), (felt, touch)
    allowed = 0.01 * normal[:, None] + 4 * rounding + 10 * changes[1]
    assert (np.abs(pushed - net) <= allowed).all(), (pushed, net)
    return int((felt > 1e-3).sum()), int((np.abs(pushed).max(axis=1) > 1e-3).sum())


def with_implicitfast(xml, rng):
    """Returns a model with implicitfast, actuators that damp, and joints that limit the sum of their forces."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for actuator in spec.actuators:
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[2] -= rng.uniform(0, 0.5)
        if rng.random() < 0.5:  # a second one on the joint
            spec.add_actuator(target=actuator.target, trntype=actuator.trntype, gainprm=actuator.gainprm)
    for joint in spec.joints:
        if joint.type in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE) and rng.random() < 0.5:
            joint.actfrclimited, joint.actfrcrange = mujoco.mjtLimited.mjLIMITED_TRUE, [-rng.uniform(0, 9), 5]
    model = spec.compile()
    if ALONE in str(unsupported(model)):
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    return model


def usable(xml):
    """Returns whether the compiled step steps a model, and MuJoCo weighs its contacts sensibly.

    It weighs those of a sphere that can only turn about its center by the inverse of nothing, 1e15.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    return not unsupported(model) and (model.body_invweight0[model.body_weldid > 0, 0] > 1e-6).all()


def compare(xml, count=STATES, *, vary=False, implicitfast=False):
    """Holds the model's states to C MuJoCo; returns how many there were, how many agreed closely, and their kinds.

    With ``vary`` each state has numbers of the model of its own.
    """
    model = with_implicitfast(xml, np.random.default_rng(0)) if implicitfast else mujoco.MjModel.from_xml_string(xml)
    rng, found = np.random.default_rng(0), collections.Counter()
    starts = states(model, rng, count)
    if not len(starts[0]):
        return found
    varied = some_varied(model, rng) if vary else None
    rows = draw_rows(varied, rng, len(starts[0])) if vary else [None] * len(starts[0])
    sim = compiled_step(model, starts, varied, rows)
    nominal = model
    for world, (row, *state) in enumerate(zip(rows, *starts, strict=True)):
        model = nominal if varied is None else varied.edited(row)
        if flags := int(sim.overflow[world]):
            found["unsolved" if flags == Overflow.UNSOLVED else "overflow"] += 1
            continue
        model = as_rounded(model, state, sim, world)
        data = c_data(model, *state)
        mujoco.mj_forward(model, data)
        found.update(["states", *constraints(model, data)])
        found["held"] += int(held(model, data).sum())
        expected, found_by_c = c_steps(model, *state)
        nearby = list(neighbours(model, state, rng))
        error, change = np.abs(sim.qvel[world].numpy() - expected).max(), np.abs(expected - state[1]).max()
        if error <= 1e-4 + 2e-5 * change + 10 * max(np.abs(qvel - expected).max() for qvel, _ in nearby):
            found["close"] += 1
        else:  # a direction without much cost: as near to the minimum as float32 can tell from where the solver starts
            tried = (state[2], found_by_c, sim.qacc_warmstart[world].double().numpy(), *(qacc for _, qacc in nearby))
            start, least, reached, *others = (cost(model, data, qacc) for qacc in tried)
            allowed = 2 * np.finfo(np.float32).eps * max(start, least) + 10 * (max(others) - least)
            assert reached - least < allowed, f"world {world}: qvel differs by {error} of {change}"
        qpos = state[0].astype(np.float64)
        mujoco.mj_integratePos(model, qpos, sim.qvel[world].double().numpy(), model.opt.timestep)
        np.testing.assert_allclose(sim.qpos[world], qpos, rtol=1e-6, atol=1e-6)
        assert_poses_belong_to_the_state(model, sim, world)
        touch, geoms = assert_forces_belong_to_the_acceleration(model, state, sim, world, rng)
        found.update({"touch": touch, "geoms": geoms})
        near = np.abs(data.contact.dist - data.contact.includemargin) < EDGE  # where rounding decides
        clear = np.setdiff1d(np.arange(model.ngeom), data.contact.geom[near])
        assert (sim.in_contact[world].numpy() == net_forces(model, data)[2])[clear].all()
    return found


@for_each(("cone", "varied"), [("pyramidal", False), ("elliptic", True)])
def test_friction_that_is_not_traced(cone, varied):
    """A body that rolls, one that turns and one that slides, and touch each other: small enough to be traced."""
    xml = ROLLING.format(cone=cone)
    assert not step.is_traced(mujoco.MjModel.from_xml_string(xml))
    found = compare(xml, 24, vary=varied)
    assert found["close"] > 0.9 * found["states"] > 16
    assert min(found[kind] for kind in ("turning", "plane", "frictionless", "touch")) > 8
    assert found["dense"] > 2


@pytest.mark.parametrize("count", [pytest.param(3, marks=pytest.mark.slow), pytest.param(200, marks=pytest.mark.ci)])
@for_each("traced_dofs", FORMS)
def test_a_step_agrees_with_c_mujoco(traced_dofs, count, monkeypatch):
    """Both forms of the compiled step, which one takes small bodies and the other large ones, step any model."""
    monkeypatch.setattr(step, "TRACED_DOFS", traced_dofs)
    total = collections.Counter()

    @hypothesis.settings(max_examples=count, **SETTINGS)
    @hypothesis.given(models(8 if count == 200 else FEW, lanes=not traced_dofs))
    def check(xml):
        hypothesis.assume(usable(xml))
        total.update(compare(xml))

    check()
    print(dict(total))
    assert total["states"] > 4 * count
    assert total["close"] > 0.95 * total["states"]
    assert total["overflow"] < 0.01 * total["states"]
    assert total["unsolved"] < 0.02 * total["states"]  # of models for which single precision may not be enough
    if count == 200:
        assert min(total[kind] for kind in (KINDS if traced_dofs else KINDS_OF_LANES)) > 50, total


@pytest.mark.slow
@for_each("traced_dofs", FORMS)
def test_a_step_with_numbers_of_each_world_agrees_with_c_mujoco(traced_dofs, monkeypatch):
    monkeypatch.setattr(step, "TRACED_DOFS", traced_dofs)
    total, count = collections.Counter(), 2

    @hypothesis.settings(max_examples=count, **SETTINGS)
    @hypothesis.given(models(FEW, lanes=not traced_dofs))
    def check(xml):
        hypothesis.assume(usable(xml))
        total.update(compare(xml, vary=True))

    check()
    print(dict(total))
    assert total["states"] > 4 * count
    assert total["close"] > 0.95 * total["states"]
    assert total["overflow"] < 0.01 * total["states"]
    assert total["unsolved"] < 0.02 * total["states"]  # of models for which single precision may not be enough


@pytest.mark.slow
@for_each("vary", [False, True])
def test_a_step_by_implicitfast_agrees_with_c_mujoco(vary):
    total, count = collections.Counter(), 2

    @hypothesis.settings(max_examples=count, **SETTINGS)
    @hypothesis.given(models(lanes=True))
    def check(xml):
        hypothesis.assume(usable(xml))
        total.update(compare(xml, vary=vary, implicitfast=True))

    check()
    print(dict(total))
    assert total["states"] > 4 * count
    assert total["held"] > 2 * count
    assert total["close"] > 0.97 * total["states"]
