"""Simulation and Graph below any environment."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from cases import CONFIGS, MODELS
from for_each import for_each

from torchrl_loco.config import SimConfig, sim_config
from torchrl_loco.sim import Simulation, models

CPU = torch.device("cpu")
VIEWS = ("qpos", "qvel", "ctrl", "qacc_warmstart", "xpos", "xmat", "time", "overflow")


def simulation(body, device, num_envs=4, **overrides):
    config = sim_config(CONFIGS[body], "dm_control", num_envs, overrides)
    sim = Simulation(models.load(MODELS[body]), config, num_envs, torch.device(device))
    return sim, wp.ones(num_envs, dtype=bool, device=sim.device)


of_each_kind = for_each("body", "bodies")


@pytest.fixture
def bodies(engine):
    """Under the compiled engine, one that is traced and one by lanes."""
    return ["walker", "humanoid"] if engine == "compiled" else ["humanoid"]


@of_each_kind
def test_views_are_zero_copy_and_never_rebound(body, engine, device):
    sim, mask = simulation(body, device, engine=engine)
    pointers = {name: getattr(sim, name).data_ptr() for name in VIEWS}
    graph = sim.capture(lambda: (sim.reset(mask), sim.step()))
    for _ in range(3):
        graph.replay()
    for name in VIEWS:
        assert getattr(sim, name).data_ptr() == pointers[name] == getattr(sim.data, name).ptr, name
    sim.qpos.fill_(0.25)
    assert (sim.data.qpos.numpy() == 0.25).all()


@of_each_kind
def test_replay_equals_eager(body, engine):
    """The recorded step does bitwise what the launched one does, on the CPU."""
    traces = []
    for captured in (True, False):
        sim, mask = simulation(body, "cpu", engine=engine)
        step = sim.capture(sim.step).replay if captured else sim.step
        start = sim.capture(lambda s=sim, m=mask: s.reset(m)).replay
        start()
        generator, trace = torch.Generator().manual_seed(0), []
        for _ in range(10):
            sim.ctrl.uniform_(-1, 1, generator=generator)
            step()
            trace.append(torch.cat([sim.qpos, sim.qvel, sim.xpos.flatten(1)], dim=1))
        traces.append(torch.stack(trace))
    assert torch.equal(*traces)


@of_each_kind
def test_derived_quantities_belong_to_the_new_state(body, engine):
    """dm_control's order: after a step, xpos, xmat and sensors are those of the qpos and qvel at hand."""
    sim, mask = simulation(body, "cpu", engine=engine)
    sim.reset(mask)
    for _ in range(8):
        sim.ctrl.uniform_(-1, 1)
        sim.step()
    data = mujoco.MjData(sim.mj_model)
    for world in range(sim.num_envs):
        data.qpos[:], data.qvel[:] = sim.qpos[world], sim.qvel[world]
        mujoco.mj_forward(sim.mj_model, data)
        np.testing.assert_allclose(sim.xpos[world], data.xpos, atol=1e-5)
        np.testing.assert_allclose(sim.xmat[world].reshape(-1, 9), data.xmat, atol=1e-5)
        np.testing.assert_allclose(sim.data.sensordata.numpy()[world], data.sensordata, atol=1e-4)


@of_each_kind
def test_a_world_at_rest_has_no_velocities(body, engine):
    """They are zero after a reset, and the worlds beside keep what they have."""
    sim, mask = simulation(body, "cpu", engine=engine)
    d = sim.data
    arrays = [d.xpos, d.xmat, d.cvel, d.sensordata]
    if engine == "mujoco_warp":
        arrays += [d.geom_xpos, d.efc.J]
    generator = torch.Generator().manual_seed(0)
    sim.reset(mask)
    sim.ctrl.uniform_(-1, 1, generator=generator)
    sim.step()
    before = [wp.to_torch(x).clone() for x in arrays]
    wp.to_torch(mask)[1:] = False
    sim.reset(mask)
    sim.qpos[0, -5:].uniform_(-1, 1, generator=generator)
    sim.forward(mask)
    for array, old in zip(map(wp.to_torch, arrays), before, strict=True):
        assert old[0].any()
        assert old[1:].any()
        assert torch.equal(array[1:], old[1:])
    assert not d.cvel.numpy()[0].any()
    assert not d.sensordata.numpy()[0].any()


@of_each_kind
def test_mujoco_data_shows_the_present_state(body, engine):
    """Poses of geoms, and contacts where they are asked for, as C MuJoCo finds them; the state stays as it is."""
    sim, mask = simulation(body, "cpu", engine=engine)
    sim.reset(mask)
    height, start = (2, 1.4) if body == "humanoid" else (0, 0.0)
    for step in range(2):
        sim.qpos[:, -6:] = 0.1 * step
        sim.qpos[:, height] = start - torch.linspace(0.15, 1.33, 4)
        before = [view.clone() for view in (sim.qpos, sim.qvel, sim.ctrl, sim.qacc_warmstart, sim.time, sim.overflow)]
        found = sim.mujoco_data(contacts=True)
        after = sim.qpos, sim.qvel, sim.ctrl, sim.qacc_warmstart, sim.time, sim.overflow
        assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
        data, touching = mujoco.MjData(sim.mj_model), set()
        for world in range(sim.num_envs):
            data.qpos[:] = sim.qpos[world]
            mujoco.mj_fwdPosition(sim.mj_model, data)
            np.testing.assert_allclose(found.geom_xpos.numpy()[world], data.geom_xpos, atol=1e-5)
            touching |= {(world, *geoms) for geoms in data.contact.geom.tolist()}
        count, contact = int(found.nacon.numpy()[0]), found.contact
        rows = np.column_stack([contact.worldid.numpy(), contact.geom.numpy()])[:count]
        deep = contact.dist.numpy()[:count] < 0  # MuJoCo-Warp may list others that are near
        assert len(touching) > 4
        assert set(map(tuple, rows[deep].tolist())) == touching


def test_time_and_substeps(engine):
    sim, mask = simulation("walker", "cpu", ctrl_dt=0.05, engine=engine)
    sim.reset(mask)
    sim.step()
    torch.testing.assert_close(sim.time, torch.full((4,), 0.05))


def test_overflow_is_kept_and_not_printed(capfd):
    sim, mask = simulation("humanoid", "cpu", njmax=2, engine="mujoco_warp")
    sim.reset(mask)
    sim.qpos[0, 2] = 0.3  # one world on the floor, with more contacts than fit
    sim.qpos[1:, 2] = 5.0
    sim.forward(mask)
    for _ in range(3):
        sim.step()
    nefc = int(wp.to_torch(sim.data.overflow)[0]) & 1
    assert nefc == 1
    assert (sim.overflow[1:] == 0).all()
    assert "overflow" not in capfd.readouterr().out


def test_options_come_from_the_config(engine):
    sim, _ = simulation("walker", "cpu", sim_dt=0.005, iterations=7, ls_iterations=9, engine=engine)
    assert sim.mj_model.opt.timestep == 0.005
    assert (sim.model.opt.iterations, sim.model.opt.ls_iterations) == (7, 9)
    playground = sim_config(CONFIGS["walker"], "playground", 1, {})
    cut = Simulation(models.load(MODELS["walker"]), playground, 1, torch.device("cpu"))
    assert cut.mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    assert not sim.mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP


FALLING = """
<mujoco><option integrator="{integrator}"/><worldbody>
  <body pos="0 0 1"><joint type="ball"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.05"/>
    <body pos="0.3 0 0"><joint axis="0 1 0" damping="0.5"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03"/></body>
  </body>
</worldbody></mujoco>
"""


def falling(named="Euler", **overrides):
    config = SimConfig(ctrl_dt=0.02, sim_dt=0.01, naconmax=4, njmax=4, **overrides)
    return Simulation(mujoco.MjModel.from_xml_string(FALLING.format(integrator=named)), config, 1, CPU)


def velocity_in_c_mujoco(model, steps):
    data = mujoco.MjData(model)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data.qvel.copy()


@for_each(("chosen", "replaced"), [("euler", "RK4"), ("implicitfast", "Euler"), ("rk4", "implicit")])
def test_the_integrator_is_that_of_the_config(chosen, replaced, caplog):
    """What the model names is replaced, which is said once; C MuJoCo with the chosen one does the same."""
    caplog.clear()
    sim = falling(replaced, integrator=chosen, engine="mujoco_warp")
    (record,) = caplog.records
    assert f"integrator {replaced.upper()} is replaced by {chosen}, which config names" in record.message
    for _ in range(10):
        sim.step()
    np.testing.assert_allclose(sim.qvel[0], velocity_in_c_mujoco(sim.mj_model, 20), atol=1e-4)
    if chosen != "euler":
        sim.mj_model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        assert np.abs(sim.qvel[0].numpy() - velocity_in_c_mujoco(sim.mj_model, 20)).max() > 1e-2


def test_the_compiled_step_has_no_runge_kutta(caplog):
    assert falling("RK4").engine_choice[0] == "compiled"
    assert "RK4 is replaced by euler" in caplog.text
    with pytest.raises(ValueError, match="does not have: an integrator other than Euler"):
        falling(integrator="rk4", engine="compiled")
    with pytest.raises(ValueError, match="needs integrator='euler', got 'rk4'"):
        falling(integrator="rk4", deterministic=True)


def test_nothing_is_said_where_nothing_is_replaced(caplog):
    for body in ("walker", "humanoid"):
        simulation(body, "cpu", engine="compiled")
    assert not caplog.records


@for_each("name", ["qpos0", "body_mass", "opt.gravity"])
def test_the_model_of_the_compiled_step_cannot_be_written(name):
    """Its numbers are constants there, so that nothing would come of it. They can be read, also by kernels."""
    sim = falling()
    holder, name = (sim.model.opt, "gravity") if name == "opt.gravity" else (sim.model, name)
    array = getattr(holder, name)
    for write in (
        lambda: setattr(holder, name, wp.zeros(1, device="cpu")),
        lambda: setattr(sim.model, "opt", None),
        lambda: array.fill_(1.0),
        lambda: array.zero_(),
        lambda: array.assign(np.ones(array.numpy().shape)),
        lambda: array[0:1].fill_(1.0),
        lambda: array.flatten().zero_(),
        lambda: wp.to_torch(array),
        lambda: torch.from_dlpack(array),
    ):
        with pytest.raises((AttributeError, TypeError), match="edit the model before"):
            write()
    with pytest.raises(ValueError, match="read-only"):
        array.numpy()[:] = 0.0
    source = sim.mj_model.opt.gravity if name == "gravity" else getattr(sim.mj_model, name)
    np.testing.assert_allclose(array.numpy()[0], source)
    copy = wp.zeros_like(array)
    wp.copy(copy, array)
    np.testing.assert_allclose(copy.numpy(), array.numpy())
