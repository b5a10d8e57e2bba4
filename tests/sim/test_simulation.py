"""Simulation and Graph below any environment."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp

from torchrl_loco import models
from torchrl_loco.config import DEFAULTS, sim_config
from torchrl_loco.sim import Simulation

VIEWS = ("qpos", "qvel", "ctrl", "qacc_warmstart", "xpos", "xmat", "time", "overflow")


def simulation(body, device, num_envs=4, **overrides):
    config = sim_config(DEFAULTS[body], "dm_control", num_envs, overrides)
    sim = Simulation(models.load(models.PATHS[body]), config, num_envs, torch.device(device))
    return sim, wp.ones(num_envs, dtype=bool, device=sim.device)


@pytest.fixture(params=["walker", "humanoid"])
def body(request):
    return request.param


def test_views_are_zero_copy_and_never_rebound(body, device, engine):
    sim, mask = simulation(body, device, engine=engine)
    pointers = {name: getattr(sim, name).data_ptr() for name in VIEWS}
    graph = sim.capture(lambda: (sim.reset(mask), sim.step()))
    for _ in range(3):
        graph.replay()
    for name in VIEWS:
        assert getattr(sim, name).data_ptr() == pointers[name] == getattr(sim.data, name).ptr, name
    sim.qpos.fill_(0.25)
    assert (sim.data.qpos.numpy() == 0.25).all()


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


def test_derived_quantities_belong_to_the_new_state(body, device, engine):
    """dm_control's order: after a step, xpos, xmat and sensors are those of the qpos and qvel at hand."""
    sim, mask = simulation(body, device, engine=engine)
    sim.reset(mask)
    for _ in range(8):
        sim.ctrl.uniform_(-1, 1)
        sim.step()
    data = mujoco.MjData(sim.mj_model)
    for world in range(sim.num_envs):
        data.qpos[:], data.qvel[:] = sim.qpos[world].cpu(), sim.qvel[world].cpu()
        mujoco.mj_forward(sim.mj_model, data)
        np.testing.assert_allclose(sim.xpos[world].cpu(), data.xpos, atol=1e-5)
        np.testing.assert_allclose(sim.xmat[world].cpu().reshape(-1, 9), data.xmat, atol=1e-5)
        np.testing.assert_allclose(sim.data.sensordata.numpy()[world], data.sensordata, atol=1e-4)


def test_forward_at_rest_is_forward_for_worlds_at_rest(body, device, engine):
    """What it leaves out is zero after a reset, and the worlds beside keep what they have."""
    states = []
    for at_rest in (False, True):
        sim, mask = simulation(body, device, engine=engine)
        d = sim.data
        arrays = [d.xpos, d.xmat, d.cvel, d.sensordata]
        if engine == "mujoco_warp":
            arrays += [d.geom_xpos, d.efc.J]
        generator = torch.Generator(device).manual_seed(0)
        sim.reset(mask)
        sim.ctrl.uniform_(-1, 1, generator=generator)
        sim.step()
        wp.to_torch(mask)[1:] = False
        sim.reset(mask)
        sim.qpos[0, -5:].uniform_(-1, 1, generator=generator)
        sim.engine.forward(mask, at_rest=at_rest)
        states.append([wp.to_torch(x).clone() for x in arrays])
    for full, less in zip(*states, strict=True):
        torch.testing.assert_close(less, full, rtol=0, atol=0)
    assert all(array[1:].any() for array in states[0])


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
    playground = sim_config(DEFAULTS["walker"], "playground", 1, {})
    cut = Simulation(models.load(models.PATHS["walker"]), playground, 1, torch.device("cpu"))
    assert cut.mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    assert not sim.mj_model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
