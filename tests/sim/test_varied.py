"""Numbers of the model that differ from world to world: each world against C MuJoCo with its own model."""

import functools

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from contact_forces import net_forces
from for_each import for_each
from random_models import states
from variation import all_varied, candidates, draw_rows

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation, compiled, mujoco_warp
from torchrl_loco.sim.compiled import step, unsupported
from torchrl_loco.sim.engine import Setup
from torchrl_loco.sim.varied import FIELDS, Varied, field

WORLDS, SUBSTEPS = 32, 3
XML = """
<mujoco>
  <option timestep="0.002" iterations="100" ls_iterations="50"/>
  <worldbody>
    <geom type="plane" size="5 5 0.1" friction="0.6"/>
    <body name="base" pos="0 0 0.1">
      <inertial pos="0.01 0.02 0" mass="0.3" diaginertia="0.01 0.01 0.01"/>
      <body name="trunk">
        <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>
        <inertial pos="0.02 0 0.01" quat="0.9 0.1 0.2 0.3" mass="3" diaginertia="0.03 0.02 0.04"/>
        <geom size="0.08" pos="0.1 0.05 0"/><geom size="0.08" pos="-0.1 -0.05 0" friction="0.9"/>
        <body name="leg" pos="0.2 0 0">
          <joint name="hip" axis="0 1 0.2" damping="1" armature="0.02" stiffness="4" range="-60 60"/>
          <geom size="0.05" pos="0.1 0.1 -0.05"/>
          <body name="shoe" pos="0.1 0 0.02" euler="20 30 0">
            <inertial pos="0.02 0.01 0" quat="0.8 0.3 -0.1 0.2" mass="0.5" diaginertia="0.002 0.001 0.0015"/>
            <geom size="0.06" pos="0 0.1 0"/>
          </body>
        </body>
        <body name="arm" pos="-0.2 0 0">
          <joint name="shoulder" axis="1 1 0" armature="0.01" frictionloss="0.3"/>
          <geom size="0.05" pos="-0.1 0 -0.05" friction="0.5" priority="1"/>
        </body>
      </body>
    </body>
    <body name="ball" pos="0.3 0.2 0.15"><freejoint/><geom size="0.08" pos="0.01 0.02 0"/></body>
  </worldbody>
  <actuator>
    <position joint="hip" kp="20" kv="1" gear="1.5" ctrlrange="-1 1" forcerange="-8 8"/>
    <motor joint="shoulder" gear="5" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <subtreelinvel body="base"/><subtreelinvel body="leg"/><subtreeangmom body="leg"/><subtreeangmom body="ball"/>
  </sensor>
</mujoco>
"""
PAIR = '<contact><pair geom1="floor" geom2="marble" friction="0.4 0.4 0.01 0.001 0.001"/></contact>'
MARBLE = f"""
<mujoco>
  <option timestep="0.002" iterations="100" ls_iterations="50"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body pos="0 0 0.099"><freejoint name="loose"/><geom name="marble" size="0.1" pos="0.01 0 0"/></body>
  </worldbody>
  {PAIR}
</mujoco>
"""
KINDS = {"traced": 31, "lanes": 0, "mujoco_warp": 31}
"""Ways of stepping, and the largest body that is traced."""


@pytest.fixture
def kinds(engine):
    return ["mujoco_warp"] if engine == "mujoco_warp" else ["traced", "lanes"]


def simulate(model, kind, count=WORLDS, varied=None, substeps=SUBSTEPS, device="cpu"):
    step.TRACED_DOFS = KINDS[kind]
    option = model.opt
    config = SimConfig(
        ctrl_dt=substeps * option.timestep,
        sim_dt=option.timestep,
        naconmax=12 * count,
        njmax=80,
        iterations=option.iterations,
        ls_iterations=option.ls_iterations,
        euler_damping=True,
        engine="mujoco_warp" if kind == "mujoco_warp" else "compiled",
    )
    geoms = range(model.ngeom)
    return Simulation(model, config, count, torch.device(device), contact_geoms=geoms, varied=varied)


def every(sim):
    return wp.ones(sim.num_envs, dtype=bool, device=sim.device)


def step_from(sim, start, rows):
    """Takes a control step from a state, with these numbers."""
    if rows is not None:
        sim.numbers.copy_(torch.as_tensor(rows))
        sim.forward(every(sim))
    for view, values in zip((sim.qpos, sim.qvel, sim.qacc_warmstart, sim.ctrl), start, strict=True):
        view.copy_(torch.as_tensor(values))
    sim.step()


def data_of(model, *state):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = state
    return data


def stepped(model, *state):
    """Returns what a state becomes in C MuJoCo."""
    data = data_of(model, *state)
    for _ in range(SUBSTEPS):
        mujoco.mj_step(model, data)
    return data


def errors(sim, models, start):
    """Returns how far each world is from C MuJoCo: qpos, sensors of velocity, and contact forces, ``(worlds, 3)``."""
    found = []
    for world, (model, *state) in enumerate(zip(models, *start, strict=True)):
        data = stepped(model, *state)
        force = net_forces(model, data)[0] - sim.contact_force[world].cpu().numpy()
        now = data_of(model, *(x[world].cpu() for x in (sim.qpos, sim.qvel, sim.qacc_warmstart, sim.ctrl)))
        mujoco.mj_forward(model, now)
        speed = now.sensordata - sim.data.sensordata.numpy()[world]
        qpos = data.qpos - sim.qpos[world].cpu().numpy()
        found.append([np.abs(x).max(initial=0) for x in (qpos, speed, force)])
    return np.array(found)


def p95(found):
    return np.quantile(found, 0.95, axis=0)


@functools.cache
def start_of(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    found = [rows[:WORLDS] for rows in states(model, np.random.default_rng(0), WORLDS + 20)]
    assert len(found[0]) == WORLDS
    return found


# Each world has its own model.


@for_each("kind", "kinds")
def test_each_world_steps_with_its_numbers(kind, device):
    """With all of them together, and with those of each field alone, which has an effect."""
    model, start, rng = mujoco.MjModel.from_xml_string(XML), start_of(XML), np.random.default_rng(1)
    varied = all_varied(model)
    plain = simulate(model, kind, device=device)
    step_from(plain, start, None)
    usual = p95(errors(plain, [model] * WORLDS, start))
    assert (usual < [1e-6, 1e-5, 0.05]).all()
    sim = simulate(model, kind, varied=varied, device=device)
    assert sim.varied is varied
    np.testing.assert_array_equal(sim.numbers.cpu(), np.repeat(varied.nominal()[None], WORLDS, 0).astype(np.float32))
    nominal = np.array([stepped(model, *state).qpos for state in zip(*start, strict=True)])
    fields = [name for name in FIELDS if candidates(model, name).size]
    assert len(fields) == len(FIELDS) - 1
    for names in (fields, *([name] for name in fields)):
        rows = draw_rows(varied, rng, WORLDS, names)
        step_from(sim, start, rows)
        found = errors(sim, [varied.edited(row) for row in rows], start)
        off = np.abs(nominal - sim.qpos.cpu().numpy()).max()
        assert (p95(found) < 3 * usual + [1e-7, 1e-6, 1e-3]).all(), (names, p95(found), usual)
        assert off > 30 * p95(found)[0], (names, off)
    step_from(sim, start, np.repeat(varied.nominal()[None], WORLDS, axis=0))
    np.testing.assert_allclose(sim.qpos.cpu(), plain.qpos.cpu(), rtol=0, atol=1e-6)


@for_each("kind", ["mujoco_warp", "lanes"])
def test_numbers_of_pairs_vary(kind):
    """Friction differs along the two tangents."""
    model, rng = mujoco.MjModel.from_xml_string(MARBLE), np.random.default_rng(0)
    varied = Varied(model, {"pair_friction": [0, 1]})
    assert unsupported(model, varied) == []
    rows = rng.uniform(0.05, 0.3, (WORLDS, 2)).astype(np.float32)
    start = [np.repeat(x[None], WORLDS, axis=0).astype(np.float32) for x in (model.qpos0, np.zeros(6), np.zeros(6))]
    start[1][:, :2] = 1.0
    start.append(np.zeros((WORLDS, 0), np.float32))
    sim = simulate(model, kind, varied=varied)
    step_from(sim, start, rows)
    found, off = (errors(sim, m, start) for m in ([varied.edited(row) for row in rows], [model] * WORLDS))
    assert p95(found)[0] < 1e-6 < 0.01 * off[:, 0].max()


@for_each("kind", ["traced", "lanes"])
def test_a_world_does_not_depend_on_the_others(kind, device):
    model, start = mujoco.MjModel.from_xml_string(XML), start_of(XML)
    varied = all_varied(model)
    rows = draw_rows(varied, np.random.default_rng(0), WORLDS)
    found = []
    for worlds in (np.arange(3), np.arange(WORLDS), np.arange(3000) % WORLDS):
        sim = simulate(model, kind, len(worlds), varied, device=device)
        step_from(sim, [x[worlds] for x in start], rows[worlds])
        found.append([torch.cat([sim.qpos, sim.qvel], dim=-1).cpu(), sim.contact_force.cpu()])
    for few, some, many in zip(*found, strict=True):
        assert torch.equal(few, some[:3])
        assert torch.equal(some, many[:WORLDS])
        assert torch.equal(some[:24], many[2976:])


@for_each("kind", ["mujoco_warp", "lanes"])
def test_a_mask_says_whose_numbers_count(kind):
    """And a world that is put at rest has its new numbers."""
    model, start, rng = mujoco.MjModel.from_xml_string(XML), start_of(XML), np.random.default_rng(0)
    varied = all_varied(model)
    old, new = draw_rows(varied, rng, WORLDS), draw_rows(varied, rng, WORLDS)
    sim = simulate(model, kind, varied=varied)
    step_from(sim, start, old)
    mask = np.arange(WORLDS) % 2 == 0
    sim.numbers[torch.as_tensor(mask)] = torch.as_tensor(new[mask])
    sim.reset(wp.array(mask, dtype=bool, device="cpu"))
    for view, values in zip((sim.qpos, sim.qvel, sim.qacc_warmstart, sim.ctrl), start, strict=True):
        view.copy_(torch.as_tensor(values))
    sim.step()
    models = [varied.edited(row) for row in np.where(mask[:, None], new, old)]
    assert p95(errors(sim, models, start))[0] < 1e-6


@for_each("kind", "kinds")
def test_mujoco_data_has_the_numbers_of_each_world(kind):
    model, start = mujoco.MjModel.from_xml_string(XML), start_of(XML)
    varied = all_varied(model)
    rows = draw_rows(varied, np.random.default_rng(0), WORLDS)
    sim = simulate(model, kind, varied=varied)
    step_from(sim, start, rows)
    data = sim.mujoco_data(contacts=True)
    frictions = {}
    for i in range(data.nacon.numpy()[0]):
        frictions.setdefault(data.contact.worldid.numpy()[i], []).append(data.contact.friction.numpy()[i, 0])
    for world, row in enumerate(rows):
        own = varied.edited(row)
        expected = data_of(own, *(x[world] for x in (sim.qpos, sim.qvel, sim.qacc_warmstart, sim.ctrl)))
        mujoco.mj_forward(own, expected)
        np.testing.assert_allclose(data.xipos.numpy()[world], expected.xipos, atol=1e-6)
        np.testing.assert_allclose(data.subtree_com.numpy()[world], expected.subtree_com, atol=1e-6)
        found = sorted(frictions.get(world, []))
        np.testing.assert_allclose(found, sorted(expected.contact.friction[:, 0]), rtol=1e-6)
    assert len(frictions) > WORLDS // 4


# The model in C MuJoCo.


def test_an_edited_model_is_one_that_was_compiled_so():
    model = mujoco.MjModel.from_xml_string(XML)
    varied = all_varied(model)
    names = [name for name in FIELDS if name != "body_inertia"]  # which the compiler of MuJoCo holds to be possible
    row = draw_rows(varied, np.random.default_rng(0), 1, names)[0].astype(float)
    edited, spec = varied.edited(row), mujoco.MjSpec.from_string(XML)
    for i, body in enumerate(spec.bodies):
        if i:
            body.explicitinertial = True
            body.mass, body.ipos = edited.body_mass[i], edited.body_ipos[i]
            body.inertia, body.iquat = edited.body_inertia[i], edited.body_iquat[i]
    compiled_so = spec.compile()
    for name in ("body_subtreemass", "bvh_aabb", "M_rownnz", "body_simple"):
        np.testing.assert_allclose(getattr(edited, name), getattr(compiled_so, name), atol=1e-9, err_msg=name)
    for x in (edited, compiled_so):  # what is left of them are the numbers that follow from mass
        for name in FIELDS:
            field(x, name)[...] = varied.full(name, row)
        x.body_invweight0[:], x.dof_invweight0[:] = model.body_invweight0, model.dof_invweight0
        x.stat.meaninertia, x.dof_M0[:] = model.stat.meaninertia, edited.dof_M0
    for state in zip(*start_of(XML), strict=True):
        a, b = data_of(edited, *state), data_of(compiled_so, *state)
        mujoco.mj_step(edited, a)
        mujoco.mj_step(compiled_so, b)
        np.testing.assert_allclose(a.qvel, b.qvel, atol=1e-9)


def test_a_body_whose_mass_matrix_is_diagonal_has_the_mass_of_its_world():
    text = "<mujoco><worldbody><body><freejoint/><geom type='box' size='.1 .2 .3'/></body></worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    varied = Varied(model, {"body_mass": [1], "body_inertia": [3, 4, 5], "dof_armature": [0]})
    edited = varied.edited([5.0, 0.1, 0.2, 0.15, 0.5])
    data, matrix = mujoco.MjData(edited), np.zeros((6, 6))
    mujoco.mj_forward(edited, data)
    mujoco.mj_fullM(edited, data, matrix)
    np.testing.assert_allclose(np.diag(matrix), [5.5, 5.0, 5.0, 0.1, 0.2, 0.15])


@for_each(
    ("places", "wrong"),
    [
        ({"geom_size": [0]}, "'geom_size' cannot vary: choose of geom_friction"),
        ({"body_mass": [7]}, "body_mass has 7 numbers, but the number 7"),
        ({"actuator_forcerange": [0, 2]}, "actuator 'free' cannot vary: no force range limits"),
        ({"body_ipos": [18]}, "body 'ball' cannot vary: MuJoCo takes the body's mass matrix for diagonal"),
    ],
)
def test_what_cannot_vary_is_refused(places, wrong):
    xml = XML.replace(' pos="0.01 0.02 0"/></body>\n  </world', "/></body>\n  </world")
    xml = xml.replace('<motor joint="shoulder"', '<motor name="free" joint="shoulder"')
    with pytest.raises(ValueError, match=wrong):
        Varied(mujoco.MjModel.from_xml_string(xml), places)


def test_what_only_mujoco_warp_varies_is_named():
    model = mujoco.MjModel.from_xml_string(MARBLE.replace(PAIR, ""))
    assert unsupported(model) == unsupported(model, Varied(model, {"gravity": [2]})) == []
    stiff = Varied(model, {"jnt_stiffness": [0]})
    assert unsupported(model, stiff) == ["joint 'loose': stiffness of a free or ball joint"]
    with pytest.raises(ValueError, match="'loose': stiffness of a free"):
        simulate(model, "traced", varied=stiff)


# What it takes.


@for_each("kind", ["lanes", "mujoco_warp"])
def test_memory_counts_the_numbers(kind):
    model, device = mujoco.MjModel.from_xml_string(XML), wp.get_device("cpu")
    varied = all_varied(model)
    config = simulate(model, kind, 1).config
    setup, plain = (Setup(model, config, 5, device, varied=v) for v in (varied, None))
    if kind == "mujoco_warp":
        engine = mujoco_warp.MujocoWarpEngine(setup)
        batched = {name for name in (*FIELDS, "body_subtreemass") if name != "pair_friction"}
        arrays = [engine.model.opt.gravity if name == "gravity" else getattr(engine.model, name) for name in batched]
        assert {array.shape[0] for array in arrays} == {5}
        taken = engine.numbers.capacity + sum(array.capacity for array in arrays)
        bytes_ = [mujoco_warp.data_bytes(s) for s in (setup, plain)]
    else:
        taken = compiled.CompiledEngine(setup)._rows.capacity
        bytes_ = [compiled.CompiledEngine.memory(s) for s in (setup, plain)]
    assert bytes_[0] - bytes_[1] == taken
