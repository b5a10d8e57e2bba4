"""C MuJoCo as an engine: its numbers to the bit, and all that hooks, states and monitors ask of an engine."""

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each
from hook_tasks import DOG
from tensordict import TensorDict
from torchrl.envs import check_env_specs

import torchrl_loco
from torchrl_loco import LocoEnv, SimConfig, State, Vary, WalkerWalk
from torchrl_loco.sim.mujoco import _contact_forces

TASKS = ("walker_walk", "quadruped_walk", "g1_velocity")  # planar, with activations, with servos and hooks


@for_each("task", TASKS)
def test_numbers_are_those_of_c_mujoco_to_the_bit(task):
    env = torchrl_loco.make(task, 3, "cpu", 0, engine="mujoco", play=True)
    td, state, m = env.reset(), env.get_state(), env.mj_model
    by_hand = [mujoco.MjData(m) for _ in range(3)]
    for i, d in enumerate(by_hand):
        d.qpos, d.qvel = state["qpos"][i].double().numpy(), state["qvel"][i].double().numpy()
        if m.na:
            d.act = state["act"][i].double().numpy()
    generator = torch.Generator().manual_seed(0)
    for _ in range(40):
        action = 2 * torch.rand(3, m.nu, generator=generator) - 1
        td = env.step(td.set("action", action))["next"].exclude("reward")
        for i, d in enumerate(by_hand):
            d.ctrl = env.sim.ctrl[i].double().numpy()
            mujoco.mj_step(m, d, env.config.substeps)
            assert np.array_equal(env.sim.engine.worlds[i].qpos, d.qpos)
            assert np.array_equal(env.sim.qvel[i].numpy(), d.qvel.astype(np.float32))
    expected = mujoco.MjSpec.from_file(str(type(env).model)).compile().opt
    assert (m.opt.iterations, m.opt.solver, m.opt.disableflags) == (100, expected.solver, expected.disableflags)


def test_what_follows_from_a_step_is_that_of_the_compiled_engine():
    """Rewards, terminal observations and sums of contact forces; a float32 step differs by rounding."""
    envs = [torchrl_loco.make("go1_velocity", 4, "cpu", 0, engine=engine) for engine in ("mujoco", "compiled")]
    state = None
    for env in envs:
        env.reset()
        state = env.get_state() if state is None else state
        state["qpos"][:, 2] = 0.28
    assert state is not None
    results = []
    for env in envs:
        td = env.reset(state.clone(), set_state=True)
        for _ in range(2):
            after = env.step(td.set("action", torch.zeros(4, 12)))["next"]
            td = after.exclude("reward")
        results.append((after, env.sim.contact_force.clone(), env.sim.in_contact.clone()))
    (ours, force, touching), (theirs, other_force, other_touching) = results
    assert force.norm(dim=-1).max() > 20.0
    assert torch.equal(touching, other_touching)
    torch.testing.assert_close(force, other_force, rtol=0.05, atol=0.5)
    for key, most in (("privileged", 0.02), ("reward", 1e-3)):
        torch.testing.assert_close(ours[key], theirs[key], rtol=most, atol=most)


@for_each("cone", ["pyramidal", "elliptic"])
def test_contact_forces_are_mujocos_own(cone):
    """Of contacts of one, three, four and six numbers."""
    balls = "".join(
        f'<body pos="{i} 0 .09"><freejoint/><geom name="b{i}" size=".1" condim="{dim}" friction=".7 .02 .01"/></body>'
        for i, dim in enumerate((1, 3, 4, 6))
    )
    m = mujoco.MjModel.from_xml_string(
        f'<mujoco><option cone="{cone}" gravity="2 1 -9"/><worldbody><geom name="floor" type="plane" size="9 9 1" '
        f'condim="1"/>{balls}<body pos="0 .19 .09"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    d = mujoco.MjData(m)
    d.qvel[:] = np.random.default_rng(0).normal(size=m.nv)
    mujoco.mj_step(m, d, 3)
    found, wrench = _contact_forces(m, d, np.arange(d.ncon)), np.zeros(6)
    assert sorted(set(d.contact.dim.tolist())) == [1, 3, 4, 6]
    for i in range(d.ncon):
        mujoco.mj_contactForce(m, d, i, wrench)
        np.testing.assert_allclose(found[i], wrench[:3] @ d.contact[i].frame.reshape(3, 3), atol=1e-9)


class Varied(WalkerWalk):
    """Draws its own masses and gears, and changes velocities by itself."""

    randomize = (Vary("body_mass", 0.5, 2.0, shared=False), Vary("actuator_gear", 0.5, 1.5))

    def reward(self, s):
        return s.sensor("torso_velocity")[:, 0] + s.model("body_mass")[:, 1]

    def events(self, s):
        return {"qvel": s.qvel + torch.where(s.uniform(0.0, 1.0) < 0.2, 1.0, 0.0).unsqueeze(-1)}


def test_each_world_has_its_own_model_and_state():
    env = Varied(3, "cpu", 0, engine="mujoco")
    check_env_specs(env)
    env.reset()
    models = [env.mujoco_model(i) for i in range(3)]
    assert len({m.body_mass[1] for m in models}) == 3
    for m, own in zip(models, env.sim.engine._worlds, strict=True):
        assert np.array_equal(m.body_mass, own.model.body_mass)
        assert np.array_equal(m.actuator_gear, own.model.actuator_gear)
    action = TensorDict({"action": torch.full((3, 6), 0.3)}, batch_size=[3])
    state = env.get_state()
    first = [env.step(action.clone())["next"] for _ in range(10)]
    env.reset(state, set_state=True)
    for before in first:
        again = env.step(action.clone())["next"]
        torch.testing.assert_close(again["observation"], before["observation"], rtol=1e-4, atol=1e-4)
    alone, among = (Varied(n, "cpu", 0, engine="mujoco", world_offset=3 - n) for n in (1, 3))
    for each in (alone, among):
        td = each.reset()
        for _ in range(5):
            td = each.step(td.set("action", torch.full((each.num_envs, 6), 0.3)))["next"].exclude("reward")
    assert torch.equal(alone.sim.qpos[0], among.sim.qpos[2])
    env.close()
    assert env.reset()["observation"].isfinite().all()


SENSING = """<mujoco><worldbody><body name="b" pos="0 0 1"><joint name="hinge" axis="0 1 0"/>
  <geom size=".1" pos=".1 0 0"/></body></worldbody><actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator><sensor>
  <framepos name="unread" objtype="body" objname="b"/><subtreelinvel name="read" body="b"/></sensor></mujoco>"""


def test_varied_worlds_have_the_sensors_that_are_stepped():
    """Others are left out of the physics, also of the models of single worlds."""

    class Senses(LocoEnv):
        model = SENSING
        randomize = (Vary("body_mass", 0.5, 2.0),)

        def reward(self, s):
            return s.time

        def observation(self, s):
            return s.sensor("read")

    env = Senses(3, "cpu", 0, engine="mujoco")
    seen = env.rollout(5, break_when_any_done=False)["next", "observation"][:, -1]
    for world, d in zip(env.sim.engine._worlds, env.sim.engine.worlds, strict=True):
        assert world.model.nsensordata == len(d.sensordata) == 3
        mujoco.mj_subtreeVel(world.model, d)
    expected = np.array([d.subtree_linvel[1] for d in env.sim.engine.worlds])
    np.testing.assert_allclose(seen.numpy(), expected, atol=1e-5)


def test_what_is_written_between_steps_counts_beside_resets_of_others():
    env = torchrl_loco.make("walker_walk", 3, "cpu", 0, engine="mujoco")
    td = env.reset()
    env.sim.qvel[2] = 0.5
    td = env.reset(td.set("_reset", torch.tensor([True, False, False]).unsqueeze(-1)))
    env.step(td.set("action", torch.zeros(3, 6)))
    assert env.sim.engine.worlds[2].qvel[1] == pytest.approx(0.5, abs=0.2)
    assert abs(env.sim.engine.worlds[1].qvel[1]) < 0.2


def test_what_goes_wrong_is_counted():
    env = torchrl_loco.make("walker_walk", 4, "cpu", 0, engine="mujoco")
    env.reset()
    state = env.get_state()
    state["qvel"][1] = 1e9
    env.reset(state, set_state=True)
    action = torch.zeros(4, 6)
    action[2] = torch.nan
    after = env.step(TensorDict({"action": action}, batch_size=[4]))["next"]
    assert after["terminated"].flatten().tolist() == [False, True, True, False]
    assert env.health()["worlds", "non_finite"].tolist() == [0, 1, 1, 0]
    assert after["observation"].isfinite().all()
    td = env.maybe_reset(after.exclude("reward"))
    assert not env.step(td.set("action", torch.zeros(4, 6)))["next", "done"].any()


def test_what_other_engines_do_not_have():
    """A solver that no other engine has; and the picture and the data that come of MuJoCo-Warp."""

    class Pushed(LocoEnv):
        model = DOG.replace('"implicitfast"/>', '"implicitfast" solver="PGS"/>', 1)
        config = SimConfig(ctrl_dt=0.02, sim_dt=0.005, integrator="implicitfast", engine="mujoco")

        def reward(self, s):
            return s.contact_force([".*"]).sum((-1, -2))

        def observation(self, s):
            return torch.cat([s.qpos, s.qvel], dim=-1)

    env = Pushed(2, "cpu", 0)
    assert env.mj_model.opt.solver == mujoco.mjtSolver.mjSOL_PGS
    assert "replaced" not in repr(env)
    assert env.rollout(3)["next", "observation"].isfinite().all()
    if torch.cuda.is_available():
        with pytest.raises(ValueError, match="computes on the CPU: pass device='cpu'"):
            Pushed(2, "cuda")
    with pytest.raises(ValueError, match="choose one of auto, compiled, mujoco_warp, mujoco"):
        torchrl_loco.make("walker_walk", 1, "cpu", engine="mujocoo")


def test_a_reset_is_that_of_a_fresh_world():
    env = torchrl_loco.make("humanoid_stand", 2, "cpu", 0, engine="mujoco")
    env.rollout(20)
    state = State({"qpos": env.get_state()["qpos"], "qvel": torch.zeros(2, env.mj_model.nv)}, batch_size=[2])
    env.reset(state, set_state=True)
    fresh = mujoco.MjData(env.mj_model)
    fresh.qpos = state["qpos"][0].double().numpy()
    mujoco.mj_step(env.mj_model, fresh, env.config.substeps)
    env.step(TensorDict({"action": torch.zeros(2, 21)}, batch_size=[2]))
    assert np.array_equal(env.sim.engine.worlds[0].qpos, fresh.qpos)
