"""Contact forces of geoms and velocities of points, as every engine has them, against C MuJoCo."""

import mujoco
import numpy as np
import pytest
import torch
import warp as wp
from contact_forces import net_forces

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation, WorldFunc, fill
from torchrl_loco.sim.compiled import step

SCENE = """
<mujoco>
  <option gravity="1 -0.5 -9.6"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1" condim="1"/>
    <geom name="rail" type="capsule" fromto="-1 0.5 0.1 1 0.5 0.1" size="0.1" friction="0.6"/>
    <body name="ball" pos="-0.5 0 0.1"><freejoint/><geom size="0.1" mass="2" condim="1"/></body>
    <body name="rod" pos="0 0.3 0.3" euler="70 0 20"><freejoint/>
      <geom name="rod" type="capsule" size="0.06 0.2" mass="1" friction="0.4"/></body>
    <body name="arm" pos="0.6 0 0.4" euler="0 30 0"><joint type="ball"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0.3 0 0" size="0.05" mass="1"/>
      <body name="hand" pos="0.3 0 0"><joint axis="0 1 0" range="-40 40" limited="true" damping="0.1"/>
        <geom name="hand" type="capsule" fromto="0 0 0 0.2 0 0" size="0.05" mass="0.5"/>
        <body name="tip" pos="0.2 0 0"><geom size="0.06" mass="0.2"/></body></body></body>
  </worldbody>
</mujoco>
"""
PLANAR = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint axis="0 1 0"/>'
STACK = f"""
<mujoco><worldbody>
  <geom type="plane" size="5 5 0.1" condim="1"/>
  <body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="2"/></body>
  <body pos="0 0 0.3"><joint type="slide" axis="0 0 1"/><geom size="0.1" mass="3"/></body>
  <body pos="1 0 0.1">{PLANAR}<geom type="capsule" size="0.1 0.2" euler="0 90 0" mass="1"/></body>
  <body pos="2 0 1"><joint type="slide" axis="0 0 1" stiffness="100"/><geom size="0.1" mass="1"/></body>
  <body pos="1 1 0.1">{PLANAR}<geom type="capsule" size="0.1 0.2" euler="0 90 0" mass="1" condim="1"/></body>
</worldbody></mujoco>
"""
"""As many degrees of freedom as the walker has: MuJoCo-Warp makes kernels for each number."""


@pytest.fixture
def device():
    """One of the tests is run on CUDA too."""
    return "cpu"


@pytest.fixture(params=["traced", "lanes", "mujoco_warp"])
def simulated(request, monkeypatch, device):
    """Makes simulations with each engine, and with both forms of the compiled step."""
    monkeypatch.setattr(step, "TRACED_DOFS", 31 if request.param == "traced" else 0)
    engine = "mujoco_warp" if request.param == "mujoco_warp" else "compiled"

    def make(xml, num_envs=1, ctrl_dt=0.002, **asked):
        model = mujoco.MjModel.from_xml_string(xml)
        config = SimConfig(ctrl_dt=ctrl_dt, sim_dt=0.002, naconmax=64 * num_envs, njmax=96, engine=engine)
        return Simulation(model, config, num_envs, torch.device(device), **asked)

    return make


def every_world(sim):
    return wp.ones(sim.num_envs, dtype=bool, device=sim.device)


def in_c_mujoco(sim, world, substeps=0):
    """Returns data of C MuJoCo in the state of a world, or so many substeps later."""
    data = mujoco.MjData(sim.mj_model)
    for name in ("qpos", "qvel", "qacc_warmstart"):
        getattr(data, name)[:] = getattr(sim, name)[world].cpu()
    for _ in range(substeps):
        mujoco.mj_step(sim.mj_model, data)
    mujoco.mj_forward(sim.mj_model, data)
    return data


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_forces_of_each_substep_and_of_a_state_are_those_of_c_mujoco(simulated):
    """From where everything lies and leans, with a velocity that differs from world to world."""
    geoms, worlds, contacts = [6, 0, 3, 1, 4], range(6), set()
    sim = simulated(SCENE, len(worlds), ctrl_dt=0.008, contact_geoms=geoms, contact_history=True)
    sim.reset(every_world(sim))
    for _ in range(50):
        sim.step()
    sim.qvel.add_(0.5 * torch.randn(sim.qvel.shape).to(sim.qvel.device))

    def in_c(substeps):
        return [net_forces(sim.mj_model, in_c_mujoco(sim, world, substeps)) for world in worlds]

    def check(forces, touching, expected, relative, absolute):
        for world, (net, size, touches) in enumerate(expected):
            error = np.abs(forces[world].cpu().numpy() - net[geoms]).max(axis=1)
            assert (error <= relative * size[geoms] + absolute).all(), (world, forces[world], net[geoms])
            assert touching[world].tolist() == touches[geoms].tolist()
            contacts.update(np.flatnonzero(touches[geoms]))

    substeps = [in_c(k) for k in range(4)]
    sim.step()
    for k, expected in enumerate(substeps):
        check(sim.contact_force_history[:, k], sim.in_contact_history[:, k], expected, 5e-3, 5e-2)
    touches = np.array([[touches[geoms] for _, _, touches in expected] for expected in substeps])
    assert (touches.any(axis=0) & ~touches[-1]).any()  # a contact that ended before the last substep
    assert torch.equal(sim.contact_force, sim.contact_force_history[:, -1])
    state = in_c(0)
    sim.forward(every_world(sim))
    check(sim.contact_force, sim.in_contact, state, 2e-3, 1e-2)
    for history, last in ((sim.contact_force_history, sim.contact_force), (sim.in_contact_history, sim.in_contact)):
        assert torch.equal(history, last.unsqueeze(1).expand_as(history))  # of a state, all rows are its own
    assert len(contacts) == 4  # all but the arm


def test_what_lies_still_feels_what_lies_on_it(simulated):
    """A ball with another on it, capsules with two contacts, with and without friction, and a ball on a spring."""
    sim = simulated(STACK, ctrl_dt=0.02, contact_geoms=range(6))
    step = sim.capture(sim.step)
    sim.reset(every_world(sim))
    for _ in range(60):
        step.replay()
    up = 9.81 * np.array([-7, 2, 3, 1, 0, 1])
    np.testing.assert_allclose(sim.contact_force[0, :, 2], up, atol=2e-2)
    np.testing.assert_allclose(sim.contact_force[0, :, :2], 0.0, atol=2e-2)
    assert sim.in_contact.tolist() == [[True, True, True, True, False, True]]
    sim.qpos[0, 0] += 1.0  # the lower ball is lifted, and so only the capsules touch
    sim.forward(every_world(sim))
    assert sim.in_contact.tolist() == [[True, False, False, True, False, True]]
    assert sim.contact_force[0, [1, 2, 4]].abs().max() == 0.0


def test_other_worlds_keep_their_forces(simulated):
    sim = simulated(STACK, 3, ctrl_dt=0.02, contact_geoms=range(6))
    sim.reset(every_world(sim))
    for _ in range(10):
        sim.step()
    before, mask = sim.contact_force.clone(), every_world(sim)
    wp.to_torch(mask)[1] = False
    sim.qpos[:, 3] += 1.0
    sim.forward(mask)
    assert before[1, 3, 2] > 5.0
    assert torch.equal(sim.contact_force[1], before[1])
    assert sim.in_contact[:, 3].tolist() == [False, True, False]


def test_asking_for_forces_does_not_change_the_physics(simulated):
    ends = []
    for asked in ({}, {"contact_geoms": range(3)}):
        sim = simulated(SCENE, 2, ctrl_dt=0.02, **asked)
        step = sim.capture(sim.step)
        sim.reset(every_world(sim))
        for _ in range(20):
            step.replay()
        ends.append(torch.cat([sim.qpos, sim.qvel], dim=1))
    assert torch.equal(*ends)
    assert sim.contact_force.shape == (2, 3, 3)


def test_geoms_are_named_once_and_exist():
    model = mujoco.MjModel.from_xml_string(SCENE)
    config = SimConfig(ctrl_dt=0.002, sim_dt=0.002)
    for geoms, message in (([1, 2, 1], r"each geom once, got \(1, 2, 1\)"), ([0, 99, -1], r"\[0, 7\), got 99")):
        with pytest.raises(ValueError, match=message):
            Simulation(model, config, 1, torch.device("cpu"), contact_geoms=geoms)
    sim = Simulation(model, config, 2, torch.device("cpu"))
    assert (sim.contact_force.shape, sim.in_contact.shape) == ((2, 0, 3), (2, 0))


def test_sums_do_not_depend_on_the_order_of_contacts():
    """Under MuJoCo-Warp, where threads list them as they come: forces that rounding would add up differently."""
    model = mujoco.MjModel.from_xml_string(STACK)
    config = SimConfig(ctrl_dt=0.002, sim_dt=0.002, naconmax=64, njmax=96, engine="mujoco_warp")
    sim = Simulation(model, config, 1, torch.device("cpu"), contact_geoms=[0, 3])
    data, count, found = sim.data, 60, []
    forces = torch.rand(count) * 10.0 ** torch.linspace(-3, 4, count)
    for order in (torch.arange(count), torch.arange(count).flip(0), torch.randperm(count)):
        wp.to_torch(data.nacon)[0] = count
        wp.to_torch(data.contact.dim)[:] = 1
        wp.to_torch(data.contact.frame)[:] = torch.eye(3)
        wp.to_torch(data.contact.geom)[:] = torch.tensor([0, 3], dtype=torch.int32)
        wp.to_torch(data.contact.efc_address)[:count, 0] = order.int()
        wp.to_torch(data.efc.force)[0, :count] = forces
        sim.engine.contact_forces.update(sim.model, data, every_world(sim))
        found.append(sim.contact_force.clone())
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])
    np.testing.assert_allclose(found[0][0, :, 0], float(forces.sum()) * np.array([-1, 1]), rtol=1e-6)


def test_velocities_of_points_follow_from_those_of_bodies(simulated):
    """Of the origins of all bodies, from what is asked for before the first step; after a reset they are at rest."""
    sim = simulated(SCENE, 3, ctrl_dt=0.02)
    cvel, com, model = sim.cvel, sim.subtree_com, sim.mj_model
    sim.qvel.copy_(torch.randn(sim.qvel.shape))
    sim.qpos.copy_(torch.as_tensor(model.qpos0))
    for _ in range(5):
        sim.step()
    center = com[:, torch.as_tensor(model.body_rootid).to(com.device)]
    velocity = (cvel[..., 3:] + torch.linalg.cross(cvel[..., :3], sim.xpos - center)).cpu()
    for world in range(3):
        data, expected = in_c_mujoco(sim, world), np.zeros((model.nbody, 6))
        for body in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, expected[body], 0)
        assert (np.abs(expected[1:, 3:]).max(axis=1) > 0.05).sum() == 4  # the arm turns about its origin
        np.testing.assert_allclose(velocity[world], expected[:, 3:], atol=1e-4)
        np.testing.assert_allclose(cvel[world, :, :3].cpu(), expected[:, :3], atol=1e-4)
    sim.reset(every_world(sim))
    data, roots = in_c_mujoco(sim, 0), sorted(set(model.body_rootid) - {0})
    np.testing.assert_allclose(com[0, roots].cpu(), data.subtree_com[roots], atol=1e-6)
    assert not cvel.any()


@wp.struct
class Center:
    subtree_com: wp.array2d[wp.vec3]
    found: wp.array[wp.vec3]


@wp.func
def read_center(world: int, args: Center):
    args.found[world] = args.subtree_com[world, 1]


def test_a_function_after_a_reset_reads_the_center_of_mass(simulated):
    sim = simulated(SCENE, 2)
    found = wp.zeros(2, dtype=wp.vec3, device=sim.device)
    read = WorldFunc(read_center, fill(Center, sim.data, found=found))
    sim.reset(every_world(sim), after=[read])
    np.testing.assert_allclose(found.numpy(), [[-0.5, 0.0, 0.1]] * 2, atol=1e-6)


def test_it_is_too_late_to_ask_after_a_step():
    config = SimConfig(ctrl_dt=0.002, sim_dt=0.002, engine="compiled")
    sim = Simulation(mujoco.MjModel.from_xml_string(STACK), config, 1, torch.device("cpu"))
    sim.step()
    with pytest.raises(RuntimeError, match=r"ask for data\.subtree_com before the first step"):
        _ = sim.subtree_com
