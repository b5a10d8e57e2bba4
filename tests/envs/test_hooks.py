"""Tasks in plain torch: what hooks see, what becomes of what they return, and what is said where they are wrong."""

import contextlib
import functools
import json
import math
import threading

import mujoco
import numpy as np
import pytest
import torch
from cases import COARSE
from for_each import for_each
from hook_tasks import DOG, Still, WalkBackwards, WalkBlindly
from oracle import tolerance as numpy_tolerance

from torchrl_loco import Go1Velocity, HopperStand, LocoEnv, SimConfig, State, Vary, WalkerWalk, training
from torchrl_loco.envs.fusion import trace
from torchrl_loco.envs.fusion.rules import RULES
from torchrl_loco.envs.hooks import own_hooks
from torchrl_loco.envs.part import Part
from torchrl_loco.envs.precision import own_precision
from torchrl_loco.envs.view import View

SENSORS = ("gyro", "velocimeter", "attitude", "sole_in_trunk", "sole_velocity", "shank_rotation", "geom_axis")
CONFIG = SimConfig(ctrl_dt=0.02, sim_dt=0.005, iterations=20, ls_iterations=20, euler_damping=True)


class SeesEverything(LocoEnv):
    """Returns all that a view shows, as groups of the observation."""

    model = DOG
    config = CONFIG

    def reward(self, s):
        return torch.zeros_like(s.time)

    def observation(self, s):
        bodies, soles, feet = ("trunk", "hr_shank", "fl_thigh"), ".*_sole", [f"{leg}_foot" for leg in ("fl", "hr")]
        return {
            **{name: s.sensor(name) for name in (*SENSORS, "knee", "knee_speed", "velocity")},
            "linvel": s.linvel(bodies),
            "angvel": s.angvel(bodies),
            "one_linvel": s.linvel("trunk"),
            "one_angvel": s.angvel("trunk"),
            "site_xpos": s.site_xpos(soles),
            "site_xmat": s.site_xmat("imu"),
            "site_linvel": s.site_linvel(soles),
            "geom_xpos": s.geom_xpos(feet),
            "force": s.contact_force(".*_foot"),
            "touching": s.in_contact(".*_foot").float(),
            "forces": s.contact_force(["fl_foot", "hr_foot"], history=True),
            "touched": s.in_contact("fl_foot", history=True).float(),
            "joints": s.joint_qpos(["hr_knee", "fl_hip"]),
            "root": s.joint_qvel("root"),
            "gravity": s.projected_gravity("hr_shank"),
            "friction": s.model("geom_friction"),
        }


def random_state(env, seed=0):
    """States on the ground, with all joints moving."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(env.num_envs, *shape, generator=generator) * 2 - 1

    m = env.mj_model
    qpos = torch.cat(
        [
            draw(2),
            torch.zeros(env.num_envs, 1),
            torch.nn.functional.normalize(draw(4), dim=-1),
            0.3 * draw(m.nq - 7) + env.hooks.catalog.home[7:].cpu(),
        ],
        -1,
    )
    data = mujoco.MjData(m)
    for pose in qpos:  # the lowest point in the floor by 4 mm
        data.qpos[:] = pose
        mujoco.mj_fwdPosition(m, data)
        pose[2] -= data.contact.dist.min() + 0.004
    return State({"qpos": qpos, "qvel": draw(m.nv)}, batch_size=[env.num_envs])


@pytest.fixture(scope="module", params=["compiled", "mujoco_warp", "mujoco"])
def everything(request):
    """The worlds, what they see of random states, and C MuJoCo's data of the same."""
    env = SeesEverything(24, "cpu", 0, "dm_control", engine=request.param)
    state = random_state(env)
    td = env.reset(state, set_state=True)
    every = []
    for world in range(env.num_envs):
        data = mujoco.MjData(env.mj_model)
        data.qpos[:], data.qvel[:] = state["qpos"][world], state["qvel"][world]
        flags = env.mj_model.opt.disableflags
        env.mj_model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)  # as after a reset in dm_control
        mujoco.mj_forward(env.mj_model, data)
        env.mj_model.opt.disableflags = flags
        every.append(data)
    return env, td, every


def by_world(td, name, every, expected, atol=2e-5):
    rows = np.stack([np.asarray(expected(data), dtype=float) for data in every])
    np.testing.assert_allclose(td[name].numpy(), rows.reshape(td[name].shape), rtol=1e-5, atol=atol)


def velocity_of(model, data, kind, element):
    result = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, element, result, 0)
    return result


def test_sensors_are_those_of_c_mujoco(everything):
    env, td, every = everything
    for name in (*SENSORS, "knee", "knee_speed", "velocity"):
        if name == "attitude":
            continue
        by_world(td, name, every, lambda data, name=name: data.sensor(name).data)
    quaternions = np.stack([data.sensor("attitude").data for data in every])
    np.testing.assert_allclose(np.abs((td["attitude"].numpy() * quaternions).sum(-1)), 1, rtol=0, atol=1e-5)
    assert env.sim.mj_model.nsensor == 1  # the one that an engine must evaluate


def test_poses_and_velocities_are_those_of_c_mujoco(everything):
    env, td, every = everything
    m, kinds = env.mj_model, mujoco.mjtObj
    bodies = [m.body(name).id for name in ("trunk", "hr_shank", "fl_thigh")]
    soles = [i for i in range(m.nsite) if m.site(i).name.endswith("_sole")]
    feet = [m.geom(name).id for name in ("fl_foot", "hr_foot")]
    of_bodies = lambda data, part: [velocity_of(m, data, kinds.mjOBJ_XBODY, body)[part] for body in bodies]  # noqa: E731
    by_world(td, "linvel", every, lambda data: of_bodies(data, slice(3, 6)))
    by_world(td, "angvel", every, lambda data: of_bodies(data, slice(0, 3)))
    by_world(td, "one_linvel", every, lambda data: of_bodies(data, slice(3, 6))[0])
    by_world(td, "one_angvel", every, lambda data: of_bodies(data, slice(0, 3))[0])
    by_world(td, "site_xpos", every, lambda data: data.site_xpos[soles])
    by_world(td, "site_xmat", every, lambda data: data.site("imu").xmat)
    by_world(
        td,
        "site_linvel",
        every,
        lambda data: [velocity_of(m, data, kinds.mjOBJ_SITE, site)[3:] for site in soles],
    )
    by_world(td, "geom_xpos", every, lambda data: data.geom_xpos[feet])
    by_world(td, "joints", every, lambda data: [data.joint("hr_knee").qpos, data.joint("fl_hip").qpos])
    by_world(td, "root", every, lambda data: data.qvel[:6])
    by_world(td, "gravity", every, lambda data: -data.body("hr_shank").xmat.reshape(3, 3)[2])
    by_world(td, "friction", every, lambda data: m.geom_friction)


def test_contacts_are_those_of_c_mujoco(everything):
    env, td, every = everything
    m = env.mj_model
    geoms = [i for i in range(m.ngeom) if m.geom(i).name.endswith("_foot")]
    some = 0
    for world, data in enumerate(every):
        force, touching = np.zeros((4, 3)), np.zeros(4)
        for i in range(data.ncon):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(m, data, i, wrench)
            pushed = data.contact[i].frame.reshape(3, 3).T @ wrench[:3]
            for side, sign in ((0, -1), (1, 1)):
                if data.contact[i].geom[side] in geoms:
                    row = geoms.index(data.contact[i].geom[side])
                    force[row] += sign * pushed
                    touching[row] = 1
        np.testing.assert_array_equal(td["touching"][world].numpy(), touching)
        np.testing.assert_allclose(td["force"][world].numpy(), force, rtol=5e-3, atol=0.05 + 2e-3 * np.abs(force).max())
        some += touching.sum()
    assert some > 10
    legs = [[m.geom(i).name for i in geoms].index(f"{leg}_foot") for leg in ("fl", "hr")]
    assert td["forces"].shape == (env.num_envs, 4, 2, 3)  # of each substep; after a reset, of the state
    assert torch.equal(td["forces"], td["force"][:, None, legs].expand(-1, 4, -1, -1))
    assert torch.equal(td["touched"], td["touching"][:, legs[:1]].expand(-1, 4))


def test_history_that_was_not_asked_for_at_first_is_refused(shared):
    env = shared("dog_follow", 8, episode_length=40)
    arrays = {"contact_force": env.sim.contact_force, "in_contact": env.sim.in_contact}
    with pytest.raises(ValueError, match="contact_force_history was not asked for when the hooks were first called"):
        View(env.hooks.catalog, arrays, "reward").contact_force(".*_foot", history=True)


def stepped_like_walker_walk(shared, task, actions):
    """Yields, step by step, a task's result and worlds, and what WalkerWalk makes of the same states and actions."""
    env, fused = shared(task, 6), shared("walker_walk", 6)
    td = env.reset()
    for action in actions(env, 40):
        fused.reset(env.get_state(), set_state=True)
        td = env.step(td.exclude("reward").set("action", action))["next"]
        yield td, env, fused.step(td.select("done", "terminated", "truncated").set("action", action))["next"]


def test_reward_in_torch_beside_the_fused_observation(shared, actions):
    for td, env, other in stepped_like_walker_walk(shared, "walker_backwards", actions):
        up, speed = env.sim.xmat[:, 1, 2, 2].double().numpy(), env.sim.data.sensordata.numpy()[:, 0]
        expected = (1 + up) / 2 * numpy_tolerance(-speed, 1, np.inf, 1, "linear", 0)
        np.testing.assert_allclose(td["reward"].squeeze(-1), expected, rtol=1e-5, atol=1e-6)
        assert torch.equal(td["terminated"].squeeze(-1), env.sim.xpos[:, 1, 2] < 0.7)
        assert torch.equal(td["observation"], other["observation"])


def test_observation_in_torch_beside_the_fused_reward(shared, actions):
    for td, env, other in stepped_like_walker_walk(shared, "walker_blindly", actions):
        assert torch.equal(td["observation"], torch.cat([env.sim.qpos[:, 1:], env.sim.qvel], dim=-1))
        assert torch.equal(td["reward"], other["reward"])


def test_an_episode_that_ends_shows_its_true_last_observation_and_begins_anew(shared, device):
    """Falling is termination, the time limit truncation; the first observation of the next episode is another one."""
    env = shared("dog_follow", 8, device, episode_length=40)
    td = env.reset()
    fallen = env.get_state()
    fallen["qpos"][:2, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])  # on its back
    td = env.reset(fallen, set_state=True)
    current, begun = env.step_and_maybe_reset(td.set("action", env.action_spec.zero()))
    after = current["next"]
    assert after["terminated"].squeeze(-1).tolist() == [True] * 2 + [False] * 6
    assert not after["truncated"].any()
    assert (after["observation"][:2, 8] > 0.3).all()  # gravity as it was seen lying
    assert (begun["observation"][:2, 8] < -0.9).all()
    assert not begun["done"].any()
    memory, elapsed = env.get_state()["memory"], env.get_state()["elapsed_steps"]
    assert elapsed.tolist() == [0, 0] + [1] * 6
    assert (memory["last_action"][:2] == 0).all()
    assert (memory["air_time"][:2] == 0).all()
    assert (memory["until_push"] > 0).all()


def test_memory_is_written_by_update_and_events_and_seen_in_this_order():
    class Counts(WalkerWalk):
        memory = {"before": (), "steps": (), "seen": 2}

        def update(self, s):
            return {"steps": s.steps + 1}

        def reward(self, s):
            return {"steps": s.steps * (self.episode_length == 3), "before": s.before}

        def events(self, s):
            return {"before": s.steps, "seen": torch.stack([s.steps, s.before], dim=-1)}

        def observation(self, s):
            return torch.cat([s.seen, s.before.unsqueeze(-1)], dim=-1)

        def begin(self, s):
            return {"before": s.before + 100}  # what the last episode left

    env = Counts(2, "cpu", seed=0, episode_length=3)
    td, rows = env.reset(), []
    for _ in range(4):
        current, td = env.step_and_maybe_reset(td.set("action", env.action_spec.zero()))
        rows.append([current["next", "reward"][0].item(), *current["next", "observation"][0].tolist()])
    assert rows == [[101, 1, 100, 1], [3, 2, 1, 2], [5, 3, 2, 3], [104, 1, 103, 1]]


def test_a_push_moves_the_world_before_it_is_observed(shared):
    """The fused observation and reward: the one is of the pushed state, the other of the state before."""

    class Pushed(WalkerWalk):
        def events(self, s):
            return {"qvel": s.qvel + 1.0}

    pushed, free = Pushed(4, "cpu", seed=0), shared("walker_walk", 4)
    action = free.action_spec.zero()
    one = pushed.step(pushed.reset().set("action", action))["next"]
    other = free.step(free.reset().set("action", action))["next"]
    assert torch.equal(one["reward"], other["reward"])
    torch.testing.assert_close(one["observation"][:, 15:], other["observation"][:, 15:] + 1.0)
    assert torch.equal(one["observation"][:, :15], other["observation"][:, :15])


def test_draws_depend_on_seed_world_episode_and_step_alone():
    class Draws(WalkerWalk):
        def reward(self, s):
            return s.uniform(2.0, 3.0)

        def observation(self, s):
            return torch.cat([s.uniform(-1.0, 1.0, 2), s.normal(3), s.uniform(-1.0, 1.0, 2)], dim=-1)

    def played(num_envs, seed=0, **options):
        env = Draws(num_envs, "cpu", seed, episode_length=50, **COARSE, **options)
        td = env.rollout(120, Still(env), break_when_any_done=False)
        return torch.cat([td["observation"], td["next", "reward"]], dim=-1)

    many, few = played(300), played(3, world_offset=100)
    assert torch.equal(many[100:103], few)
    assert not torch.equal(played(3, seed=1), few)
    numbers = many.flatten(0, 1).double()
    assert len(torch.unique(numbers[:, 0])) > 0.99 * len(numbers)
    uniform, normal, reward = numbers[:, [0, 1, 5, 6]], numbers[:, 2:5], numbers[:, 7]
    error = 5 / math.sqrt(len(numbers))
    assert (uniform.mean(0).abs() < error).all()
    assert ((uniform.square().mean(0) - 1 / 3).abs() < error).all()
    assert (normal.mean(0).abs() < error).all()
    assert ((normal.square().mean(0) - 1).abs() < 2 * error).all()
    assert ((normal.square().square().mean(0) - 3).abs() < 12 * error).all()
    assert 2 <= reward.min() < 2.01 < 2.99 < reward.max() < 3
    correlation = torch.corrcoef(numbers.T) - torch.eye(8)
    assert correlation.abs().max() < error
    shifted = (uniform[:-1, 0] * uniform[1:, 0]).mean()  # from step to step
    assert shifted.abs() < error


def test_the_most_derived_definition_wins_hook_by_hook():
    class InTorch(WalkerWalk):
        def reward(self, s):
            return s.time

        def begin(self, s):
            return {}

    class FusedAgain(InTorch):
        observation_func, pose_func = WalkerWalk.observation_func, WalkerWalk.pose_func

    assert own_hooks(WalkerWalk) == frozenset()
    assert own_hooks(WalkBackwards) == {"reward", "terminated"}
    assert own_hooks(WalkBlindly) == {"observation"}
    assert own_hooks(InTorch) == {"reward", "begin"}
    assert own_hooks(FusedAgain) == frozenset()
    env = InTorch(2, "cpu", seed=0)
    env.reset()
    assert torch.equal(env.sim.qpos, torch.tensor(env.mj_model.qpos0).float().expand(2, -1))


@pytest.mark.parametrize(
    ("way", "backend"),
    [("kernel", None), ("torch.compile", "aot_eager"), pytest.param("torch.compile", "inductor", marks=pytest.mark.ci)],
)
def test_compiled_hooks_do_the_same(actions, monkeypatch, way, backend):
    """With the same random numbers, up to rounding; torch.compile takes over on CUDA where there can be no kernel."""
    plain = WalkBackwardsInNoise(5, "cpu", seed=0, episode_length=20, compile_hooks=False)
    if way == "torch.compile":
        monkeypatch.setattr(Part, "compile", lambda self, num_envs, device: by_torch(self))
        monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend=backend))
    compiled = WalkBackwardsInNoise(5, "cpu", seed=0, episode_length=20)
    assert {part.kind for part in (compiled.world._judge, compiled.world._observe, compiled.world._begin)} == {way}
    assert plain.world._judge.kind == "plain torch"
    one, other = plain.reset(), compiled.reset()
    for action in actions(plain, 30):
        torch.testing.assert_close(one["observation"], other["observation"], rtol=0, atol=1e-4)
        (current, one), (expected, other) = (
            env.step_and_maybe_reset(td.set("action", action)) for env, td in ((plain, one), (compiled, other))
        )
        torch.testing.assert_close(current["next", "reward"], expected["next", "reward"], rtol=0, atol=1e-4)


def by_torch(part):
    with torch.no_grad():
        part._compile_by_torch(trace(part._work, part._arrays))
    return False


class WalkBackwardsInNoise(WalkBackwards):
    memory = {"command": 2}

    def events(self, s):
        return {"command": s.uniform(0.0, 1.0, 2)}

    def observation(self, s):
        return torch.cat([s.qvel + s.normal(s.qvel.shape[-1]), s.command], dim=-1)

    def begin(self, s):
        return {"command": s.normal(2)}


def test_rows_that_are_returned_together_are_those_of_before():
    """Whatever their order: each may be what another entry was."""

    class Swaps(WalkerWalk):
        memory = {"a": (), "b": (), "was": 9}

        def events(self, s):
            return {"a": s.b, "b": s.a, "qpos": s.qpos + 0.1, "was": s.qpos}

        def begin(self, s):
            return {"b": s.a + 2, "a": torch.ones_like(s.a)}

    for way in (True, False):
        env = Swaps(2, "cpu", seed=0, compile_hooks=way)
        env.step(env.reset().set("action", env.action_spec.zero()))
        memory = env.get_state()["memory"]
        assert memory["a"].tolist() == [2, 2]
        assert memory["b"].tolist() == [1, 1]
        torch.testing.assert_close(memory["was"] + 0.1, env.sim.qpos)


def test_after_a_push_sensors_of_forces_are_those_of_the_step():
    """Found anew, they would be those of a robot without actuators; here a fused function reads them, and a hook."""

    class Pushed(HopperStand):
        memory = {"felt": 2}
        push = torch.zeros(2, 1)

        def events(self, s):
            return {
                "qvel": s.qvel + self.push,
                "felt": torch.cat([s.sensor("touch_toe"), s.sensor("touch_heel")], dim=-1),
            }

        def terminated(self, s):
            return s.felt.sum(-1) < 0  # reads it, so that it is kept

    env = Pushed(2, "cpu", seed=0, engine="mujoco", compile_hooks=False)
    td = env.reset(env.get_state().branch(0), set_state=True)
    action = torch.full((2, 4), 0.7)
    for _ in range(60):
        td = env.step_mdp(env.step(td.set("action", action)))
        if (td["observation"][:, -2:] > 0).all():
            break
    env.push[1] = 1e-3
    after = env.step(td.set("action", action))["next", "observation"]
    assert (after[:, -2:] > 0).any()
    assert (after[0] != after[1]).any()
    torch.testing.assert_close(after[0, -2:], after[1, -2:], rtol=0, atol=0)


def test_a_hook_that_leaves_torch_is_not_frozen(caplog):
    class Leaves(WalkerWalk):
        leave = staticmethod(lambda x: torch.tensor(x.numpy()))

        def reward(self, s):
            return self.leave(s.qvel[:, 0].clone())

        def terminated(self, s):
            return self.leave(s.xpos("torso")[:, 2].clone()) < 1.25

        def observation(self, s):
            return self.leave(s.qpos.clone())

    class LeavesAsLists(Leaves):
        leave = staticmethod(lambda x: torch.tensor(x.tolist()))

    for task in (Leaves, LeavesAsLists):
        env = task(2, "cpu", seed=0)
        td = env.rollout(5, break_when_any_done=False)
        assert torch.equal(td["next", "reward"][:, -1, 0], env.sim.qvel[:, 0])
        assert torch.equal(td["next", "observation"][:, -1], env.sim.qpos)
        assert f"{task.__name__}: reward, terminated: not compiled" in caplog.text
        assert caplog.text.count(f"{task.__name__}: observation: not compiled") == 1


def sine(self, s):
    return torch.sin(s.qpos[:, 1])


AT = sine.__code__.co_firstlineno + 1


def fails(*args):
    raise TypeError("unhashable type")


@for_each(
    ("rule", "why"),
    [
        (RULES["cos"], "its kernel gives another reward than the hooks, which is an error of this package"),
        (fails, f"the rule of aten.sin.default fails: unhashable type (test_hooks.py, line {AT})"),
    ],
)
def test_a_kernel_that_is_wrong_or_cannot_be_written_is_done_without(caplog, monkeypatch, rule, why):
    monkeypatch.setitem(RULES, "sin", rule)
    env = type("Sine", (WalkerWalk,), {"reward": sine})(2, "cpu", seed=0)
    assert env.world._judge.kind == "plain torch"
    assert caplog.text.count(f"Sine: reward: not compiled, runs as plain torch: {why}") == 1
    assert torch.equal(env.rollout(2)["next", "reward"][:, -1, 0], torch.sin(env.sim.qpos[:, 1]))


def test_hooks_that_refuse_all_other_numbers_are_not_compiled(caplog):
    class Picky(WalkerWalk):
        def reward(self, s):
            if np.from_dlpack(s.qpos).any():  # in which no operator of torch takes part
                raise ValueError("it moves")
            return s.time

    assert Picky(2, "cpu", seed=0).world._judge.kind == "plain torch"
    assert "nothing can be compared: it moves" in caplog.text


@for_each("kept", [{}, {"compile_hooks": False}])
def test_an_attribute_that_is_fixed_says_so_when_it_is_set(kept):
    class Faster(WalkerWalk):
        target, notes = 1.0, None

        def reward(self, s):
            return self.scaled(s)

        def scaled(self, s):
            return s.qvel[:, 1] * self.target

    for cls, fixed in ((Faster, not kept), (WalkerWalk, True)):  # a Warp function reads its target_speed
        env, name = cls(2, "cpu", seed=0, **kept), "target" if cls is Faster else "target_speed"
        assert type(env) is cls
        env.notes = "nobody's concern"  # warnings are errors
        with pytest.warns(UserWarning, match=f"{name} was read") if fixed else contextlib.nullcontext():
            setattr(env, name, 2.0)
        env.close()
        setattr(env, name, 3.0)
        reward = env.rollout(2)["next", "reward"][:, -1, 0]
        if cls is Faster:
            torch.testing.assert_close(reward, 3 * env.sim.qvel[:, 1])


def test_a_table_may_have_as_many_rows_as_there_are_worlds():
    class Nearest(WalkerWalk):
        table = torch.linspace(-1, 1, 64)

        def reward(self, s):
            return (s.qpos[:, 1:2] - self.table).abs().amin(1) + self.table.sum()

    env = Nearest(64, "cpu", seed=0)
    assert env.world._judge.kind == "kernel"
    reward = env.rollout(2)["next", "reward"][:, -1, 0]
    torch.testing.assert_close(reward, (env.sim.qpos[:, 1:2] - env.table).abs().amin(1) + env.table.sum())


def test_memory_can_be_an_index():
    """A trace is compared with the hooks on numbers that may never occur, such as an index out of range."""

    class Stages(WalkerWalk):
        memory = {"stage": 1}

        def update(self, s):
            return {"stage": (s.stage + 1) % 3}

        def reward(self, s):
            return s.qpos[:, :3].gather(1, s.stage.long()).squeeze(1)

    env = Stages(4, "cpu", seed=0)
    assert env.world._judge.kind == "kernel"
    env.reset()
    for stage in (1, 2, 0, 1):
        reward = env.rand_step()["next", "reward"]
        assert torch.equal(reward[:, 0], env.sim.qpos[:, stage])


def test_a_tensor_that_is_an_index_can_change():
    class Stages(WalkerWalk):
        speeds, stage = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0])

        def reward(self, s):
            return s.time * 0 + self.speeds[self.stage]

    env = Stages(2, "cpu", seed=0)
    td = env.reset()
    for stage in (0, 2):
        env.stage.fill_(stage)
        assert (env.step(td.set("action", env.action_spec.zero()))["next", "reward"] == stage + 1).all()


def test_time_is_that_of_the_state():
    """Also where worlds begin at a random point of their time limit."""

    class Clock(WalkerWalk):
        def observation(self, s):
            return s.time.unsqueeze(-1)

    env = Clock(4, "cpu", seed=0, stagger=True)
    td = env.rollout(3, break_when_any_done=False)[:, -1]["next"]
    again = env.reset(env.get_state(), set_state=True)
    assert torch.equal(td["observation"], again["observation"])
    assert td["observation"].std() > 0


def test_numbers_of_memory_that_are_not_finite_end_their_world():
    update = lambda self, s: {"air_time": torch.where(s.qpos[:, :1] < 0, torch.nan, s.air_time)}  # noqa: E731
    env = type("Breaks", (LocoEnv,), {**BASE, "memory": {"air_time": 4}, "update": update})(4, "cpu", seed=0)
    env.reset()
    state = env.get_state()
    state["qpos"][:, 0] = torch.tensor([1.0, -1.0, 1.0, 1.0])
    td = env.reset(state, set_state=True)
    current, _ = env.step_and_maybe_reset(td.set("action", env.action_spec.zero()))
    assert current["next", "terminated"].squeeze(-1).tolist() == [False, True, False, False]
    env.load_state_dict(env.state_dict())


def test_a_hook_that_cannot_be_compiled_runs_as_it_is_and_says_why(caplog):
    class Looks(WalkerWalk):
        def reward(self, s):
            return s.time if bool((s.time > 0).all()) else s.time + 1

    env = Looks(2, "cpu", seed=0)
    assert "Looks: reward: not compiled, runs as plain torch: a hook reads a number out of a tensor" in caplog.text
    assert env.rollout(2)["next", "reward"].shape == (2, 2, 1)


# Errors, at construction.

BASE = {"model": DOG, "config": CONFIG, "reward": lambda self, s: s.time, "observation": lambda self, s: s.qpos}


MAGNETIC = DOG.replace("<accelerometer", "<magnetometer").replace("<option", '<option magnetic="0 1 -2"', 1)
WRONG = [
    ({"reward": None}, TypeError, "must define reward"),
    ({"metrics": 3}, TypeError, "metrics must be a method, got 3"),
    ({"config": 1}, TypeError, "config must be a torchrl_loco.SimConfig"),
    ({"model": "nowhere.xml"}, FileNotFoundError, "no model 'nowhere.xml'"),
    ({"reward": lambda self, s: s.qpos}, ValueError, r"must return shape \(4,\)"),
    ({"reward": lambda self, s: {"a": s.time, "b": 0.0}}, TypeError, r"reward\['b'\] must return a tensor"),
    ({"terminated": lambda self, s: s.time}, TypeError, "must return a bool tensor"),
    ({"observation": lambda self, s: {"reward": s.qpos}}, ValueError, "'reward' is no name"),
    ({"observation": lambda self, s: s.action}, ValueError, "keep what you need of it in memory"),
    ({"update": lambda self, s: {"command": s.time}}, ValueError, "which has no entries"),
    ({"memory": {"comand": 3}, "events": lambda self, s: {"command": s.time}}, ValueError, "did you mean 'comand'"),
    ({"memory": {"a": 3}, "events": lambda self, s: {"a": s.qpos}}, ValueError, r"a of shape \(4, 3\)"),
    ({"events": lambda self, s: {"qvel": s.qvel[:, :1]}}, ValueError, r"events must return qvel of shape \(4, \d+\)"),
    ({"begin": lambda self, s: {"qpos": s.home[:1]}}, ValueError, r"begin must return qpos of shape \(4, \d+\)"),
    ({"memory": {"qpos": 3}}, ValueError, "'qpos' is taken"),
    ({"memory": {"a": 0}}, ValueError, "sizes of 1 or more"),
    ({"command_ranges": {"a": {"x": (0, 1)}}}, ValueError, "'a' is no entry of memory, which has none"),
    ({"memory": {"a": 2}, "command_ranges": {"a": {"x": (0, 1)}}}, ValueError, "must be a row of 1 numbers"),
    ({"memory": {"a": 1}, "command_ranges": {"a": {"x": (1, 1)}}}, ValueError, "a least and a greatest value"),
    ({"memory": {"a": 1}, "command_ranges": {"a": (0, 1)}}, TypeError, "must be a dict such as"),
    ({"begin": lambda self, s: {"qpos": s.home / 0}}, ValueError, "not finite"),
    ({"control": lambda self, s, action: action[:, :2]}, ValueError, r"shape \(4, 8\)"),
    ({"action_range": (0, 1)}, ValueError, r"must be \(-1, 1\) or"),
    ({"action_range": 1}, TypeError, "must be two numbers"),
    ({"action_range": (-math.inf, math.inf)}, TypeError, "must define control"),
    ({"reward": lambda self, s: s.xpos("trunc")[:, 0]}, KeyError, "did you mean 'trunk'"),
    ({"reward": lambda self, s: s.qvel.add_(1.0)[:, 0]}, ValueError, r"reward writes to s\.qvel"),
    ({"reward": lambda self, s: setattr(self, "last", s.time) or s.time}, ValueError, r"reward sets self\.last"),
    ({"reward": lambda self, s: {}}, ValueError, "tensors by name"),
    ({"observation": lambda self, s: {"memory": s.qpos}}, ValueError, "'memory' is no name"),
    ({"memory": {"a": 4}, "begin": lambda self, s: {"a": s.time}}, ValueError, r"a of shape \(4, 4\)"),
    ({"control": lambda self, s, action: s.ctrl + action}, ValueError, r"last controls in memory.*update\(\)"),
    ({"control": lambda self, s, action: s.actuator_force}, ValueError, "last controls in memory"),
    ({"reward": lambda self, s: s.comand}, AttributeError, "memory, shared and constants have no entries"),
    ({"reward": lambda self, s: s.model("geom_fiction")}, AttributeError, "no array 'geom_fiction'"),
    ({"reward": lambda self, s: s.model("kp")[:, 0]}, AttributeError, "gains are in actuator_gainprm"),
    ({"reward": lambda self, s: s.normal(0.0, 1.0)}, TypeError, r"mean \+ deviation \* s\.normal"),
    ({"reward": lambda self, s: s.normal(0, 1)}, TypeError, r"mean \+ deviation \* s\.normal"),
    ({"model": mujoco.MjModel.from_xml_string(DOG)}, TypeError, "MJCF text or a mujoco.MjSpec, got <mujoco"),
    ({"reward": lambda self, s: s.joint_qpos(".*")[:, 0]}, ValueError, "name a free or ball joint alone"),
    (
        {"model": MAGNETIC, "reward": lambda self, s: s.sensor("unread")[:, 0], "engine": "compiled"},
        ValueError,
        "'unread'",
    ),
]


def test_options_are_of_the_type_of_their_default():
    """Text that was read from a file would count as True."""
    options = {"on": (False, "whether"), "count": (3, "how many"), "most": (1.0, "how far")}
    cls = type("Optional", (WalkerWalk,), {"options": options, "reward": lambda self, s: self.most * s.time})
    for name, value in (("on", "False"), ("on", 1), ("count", 3.5), ("count", True), ("most", "fast"), ("most", None)):
        with pytest.raises(TypeError, match=rf"Optional: option '{name}' must be [a-zTF ]+, got {value!r}"):
            cls(2, "cpu", **{name: value})
    with pytest.raises(ValueError, match="'most' must lie in"):
        cls(2, "cpu", most=math.nan)
    assert cls(2, "cpu", most=math.inf).most == math.inf
    env = cls(2, "cpu", on=True, count=np.int64(4), most=2)
    assert (env.on, env.count, env.most) == (True, 4, 2.0)
    assert json.dumps(env.options_given) == '{"on": true, "count": 4, "most": 2.0}'


@for_each("compile_hooks", [True, False])
def test_an_index_beyond_a_table_ends_its_world_however_it_is_written(compile_hooks):
    """Of integers, too, which have no NaN."""
    ways = {
        "brackets": lambda table, i: table[i],
        "select": lambda table, i: table.index_select(0, i),
        "named": lambda table, i: torch.index_select(table, dim=0, index=i),
        "take": torch.take,
        "embedding": lambda table, i: torch.nn.functional.embedding(i, table.unsqueeze(-1)).squeeze(-1),
    }
    for name, way in ways.items():
        entries = {"constants": {"table": torch.tensor([10, 20, 30])}, "memory": {"seen": torch.int64}}
        hooks = {"events": lambda self, s, way=way: {"seen": way(s.table, s.env_index)}}
        env = type("Looks", (WalkerWalk,), {**entries, **hooks})(5, "cpu", seed=0, compile_hooks=compile_hooks)
        td = env.rollout(1)["next"]
        assert td["terminated"].flatten().tolist() == [False] * 3 + [True] * 2, name
        assert env.health()["total"]["index_error"] == 2, name
        assert env.get_state()["memory", "seen"][:3].tolist() == [10, 20, 30], name


@for_each("table", [torch.tensor([10, 20, 30]), torch.tensor([0.1, 0.2, 0.3])])
def test_an_index_beyond_a_tensor_of_the_task_shows(table):
    """In a kernel; plain torch raises its error for all worlds. NaN ends a world; integers have the lowest number."""
    look_up = lambda self, s: {"seen": self.rows[(s.qpos[:, 1] > 100.0).long() * 7]}  # noqa: E731
    entries = {"memory": {"seen": table.dtype}, "rows": table, "events": look_up}
    env = type("Looks", (WalkerWalk,), entries)(3, "cpu", seed=0)
    assert env.world.kinds["events"] == "kernel"
    td = env.reset()
    env.sim.qpos[2, 1] = 200.0
    after = env.step(td.set("action", torch.zeros(3, 6)))["next"]
    ended, *_, last = after["terminated"].flatten().tolist(), env.get_state()["memory", "seen"][2]
    assert ended == [False, False, table.is_floating_point()]
    assert last.isnan() if table.is_floating_point() else last == torch.iinfo(table.dtype).min


def test_a_step_is_counted_in_whole_numbers():
    """A time is a product of single precision: some quotients with the control step are below their number."""

    class Counts(WalkerWalk):
        def reward(self, s):
            return s.step.float()

        def truncated(self, s):
            return s.step >= 30

    env = Counts(2, "cpu", seed=0, sim_dt=0.025)
    td = env.rollout(40, break_when_any_done=False)["next"]
    assert td["reward"][0, :, 0].tolist() == [*range(1, 31), *range(1, 11)]
    assert td["truncated"][0, :, 0].nonzero().tolist() == [[29]]


def test_what_hooks_read_must_be_there_when_the_environment_is_made():
    class Late(WalkerWalk):
        def __init__(self, *args, **settings):
            super().__init__(*args, **settings)
            self.scale = 2.0

        def reward(self, s):
            return self.scale * s.time

    with pytest.raises(AttributeError, match="no attribute 'scale'") as raised:
        Late(2, "cpu")
    assert "set what they read of self before" in raised.value.__notes__[0]


def test_noise_of_a_class_above_is_said_to_be_that():
    class Other(Go1Velocity):
        def observation(self, s):
            return {"observation": s.qpos}

    with pytest.raises(ValueError, match=r"unknown Velocity.noise \(of which Other is a subclass, where noise = {} "):
        Other(2, "cpu")


class Commanded(WalkerWalk):
    """Two commands, drawn anew at every step; the reward is what it was told."""

    memory = {"speed": (), "turn": 2}
    command_ranges = {"speed": {"m/s": (0.0, 1.0)}, "turn": {"rad/s": (0.0, 1.0), "rad": (-1.0, 1.0)}}
    randomize = [Vary("body_mass", 0.5, 2.0, of="torso")]

    def reward(self, s):
        return s.speed

    def begin(self, s):
        return {"speed": s.uniform(0.0, 1.0), "turn": s.uniform(0.0, 1.0, 2)}

    def events(self, s):
        return self.begin(s)

    def observation(self, s):
        return torch.cat([s.qpos, s.speed.unsqueeze(-1), s.turn], dim=-1)


def test_commands_of_a_task_can_be_set_where_it_is_played():
    env = Commanded(4, "cpu", seed=0, play=True, compile_hooks=False)
    assert env.randomize == ()
    drawn = env.rollout(2)["observation"][..., -3:]
    assert len(drawn.reshape(-1, 3).unique(dim=0)) == 8
    env.set_command(0.7, "speed")
    each = torch.rand(4, 2)
    env.set_command(each, "turn")
    td = env.rollout(3)
    torch.testing.assert_close(
        td["observation"][..., -3:], torch.cat([torch.full((4, 1), 0.7), each], 1)[:, None].expand(4, 3, 3)
    )
    assert (td["next", "reward"] == 0.7).all()
    env.set_command(None, "turn")
    td = env.rand_step()["next"]["observation"]
    assert (td[:, -3] == 0.7).all()
    assert not torch.isclose(td[:, -2:], each).any()
    for command, entry, message in (
        (0.7, None, "pass one of speed, turn"),
        (0.7, "spede", "did you mean 'speed'"),
        ([0.7], "turn", r"must have shape \(2,\) or \(4, 2\), got \(1,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            env.set_command(command, entry)
    with pytest.raises(ValueError, match="has no command"):
        WalkBlindly(2, "cpu", play=True, compile_hooks=False).set_command([1.0])
    trained = Commanded(4, "cpu", seed=0, compile_hooks=False)
    assert len(trained.randomize) == 1
    with pytest.raises(ValueError, match="play=True"):
        trained.set_command(0.7, "speed")


def test_wrong_tasks_are_refused():
    for changes, error, message in WRONG:
        options = {"engine": changes["engine"]} if "engine" in changes else {}
        entries = {name: value for name, value in {**BASE, **changes}.items() if value is not None and name != "engine"}
        with pytest.raises(error, match=message):
            type("Wrong", (LocoEnv,), entries)(4, "cpu", seed=0, **options)


@for_each("engine", ["compiled", "mujoco_warp", "mujoco"])
def test_an_accelerometer_feels_what_holds_a_body(engine):
    task = type("Feels", (LocoEnv,), {**BASE, "reward": lambda self, s: s.sensor("unread")[:, 2]})
    env = task(2, "cpu", seed=0, engine=engine)
    td = env.rollout(100, Still(env))
    assert (td["next", "reward"][:, -1].abs() < 100).all()
    assert (td["next", "reward"] != 0).all()


def test_bounds_of_actions():
    entries = {**BASE, "control": lambda self, s, action: s.home[:, 7:] + 0.5 * action}
    unbounded = torch.tensor([-math.inf, math.inf])
    for action_range in (unbounded, unbounded.numpy(), unbounded.tolist(), (-math.inf, math.inf)):
        free = type("Free", (LocoEnv,), {**entries, "action_range": action_range})(2, "cpu", seed=0)
        td = free.step(free.reset().set("action", torch.full((2, 8), 3.0)))
        expected = torch.tensor(free.mj_model.key_qpos[0][7:]).float() + 1.5
        torch.testing.assert_close(free.sim.ctrl, expected.expand(2, -1))
        assert free.action_spec.contains(td["action"] * 1e6)
    bound = type("Bound", (LocoEnv,), entries)(2, "cpu", seed=0)
    bound.step(bound.reset().set("action", torch.full((2, 8), 3.0)))
    torch.testing.assert_close(bound.sim.ctrl, (expected - 1.0).expand(2, -1))


def test_the_model_as_text_path_and_spec(tmp_path, monkeypatch):
    (tmp_path / "dog.xml").write_text(DOG)
    monkeypatch.chdir(tmp_path)
    spec = mujoco.MjSpec.from_string(DOG)
    envs = [type("Dog", (LocoEnv,), {**BASE, "model": m})(2, "cpu", seed=0) for m in (DOG, "dog.xml", spec)]
    rollouts = [env.rollout(3, Still(env)) for env in envs]
    for rollout in rollouts[1:]:
        assert torch.equal(rollout["observation"], rollouts[0]["observation"])
    assert spec.sensor("unread") is not None  # it stays as it was
    assert envs[0].sim.mj_model.nsensor == 0
    assert envs[0].mj_model.nsensor == 11


DAMPED = """<mujoco><option timestep="0.004" iterations="7" integrator="implicitfast"/><worldbody>
  <body name="a"><joint name="hinge" axis="0 1 0" damping="3"/><geom size=".1" pos="0 0 -.2"/></body></worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator></mujoco>"""


def test_options_of_a_model_that_config_replaces_are_said(caplog):
    """And kept by a task without a config, or with one of the model."""
    entries = {"model": DAMPED, "reward": lambda self, s: s.qpos[:, 0], "observation": lambda self, s: s.qpos}
    own = {"config": SimConfig(ctrl_dt=0.02, sim_dt=0.005)}
    env = type("Replacing", (LocoEnv,), {**entries, **own})(1, "cpu", 0)
    said = "sim_dt 0.004 -> 0.005, iterations 7 -> 100, euler_damping True -> False"
    assert any(f"Replacing: config replaces options of the model: {said}. " in message for message in caplog.messages)
    assert "'integrator': 'implicitfast -> euler'" in repr(env)
    explicit = DAMPED.replace("/><worldbody>", '><flag eulerdamp="disable"/></option><worldbody>', 1)
    config = SimConfig(ctrl_dt=0.02, sim_dt=0.004, euler_damping=True)
    env = type("Damping", (LocoEnv,), {**entries, "model": explicit, "config": config})(1, "cpu", 0)
    assert "'euler_damping': 'False -> True'" in repr(env)
    caplog.clear()
    of_model = SimConfig.of(DAMPED, ctrl_dt=0.008, episode_length=20)
    assert (of_model.ctrl_dt, of_model.episode_length, of_model.substeps) == (0.008, 20, 2)
    for config in ({}, {"config": of_model}):
        env = type("Keeping", (LocoEnv,), {**entries, **config})(1, "cpu", 0)
        opt = env.mj_model.opt
        kept = opt.timestep, opt.iterations, opt.integrator, opt.disableflags
        assert kept == (0.004, 7, mujoco.mjtIntegrator.mjINT_IMPLICITFAST, 0)
        assert "replaced" not in repr(env) + caplog.text
    assert type(env).config.ctrl_dt == 0.008
    assert SimConfig.of(env.mj_model).ctrl_dt == 0.02  # the nearest to 0.02 s
    including = DAMPED.replace("<worldbody>", '<include file="scene.xml"/><worldbody>', 1)
    assert SimConfig.of(including).iterations == 7


def test_a_body_without_a_floor_or_actuators_is_told_of(caplog):
    floating = '<mujoco><worldbody><body name="a"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    entries = {"model": floating, "reward": lambda self, s: s.time, "observation": lambda self, s: s.qpos}
    type("Floating", (LocoEnv,), entries)(1, "cpu", 0)
    assert "bodies fall for ever" in caplog.text
    assert "no actuators" in caplog.text
    filtered = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody><actuator>
<position joint="j" timeconst=".5" ctrlrange="-1 1"/></actuator>
<keyframe><key name="home" qpos=".6" act=".6"/></keyframe></mujoco>"""
    type("Filtered", (LocoEnv,), {**entries, "model": filtered})(1, "cpu", 0)
    assert "those of the keyframe 'home' are not used" in caplog.text
    entries["control"] = lambda self, s, action: s.time.unsqueeze(-1)
    with pytest.raises(ValueError, match=r"control must return shape \(1, 0\)"):
        type("Moved", (LocoEnv,), entries)(1, "cpu", 0)


@contextlib.contextmanager
def autocast():
    with torch.autocast("cpu", dtype=torch.bfloat16):
        yield


@contextlib.contextmanager
def float64():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@for_each("caller", [autocast, float64])
@for_each("compile_hooks", [True, False])
@for_each("play", [False, True])
def test_the_callers_precision_is_for_the_callers_own_networks(play, compile_hooks, caller, caplog):
    """Neither where an environment is made in it nor where it is stepped; sorted numbers make no kernel."""

    class Mixed(WalkerWalk):
        memory = {"speed": 1}
        command_ranges = {"speed": {"m/s": (0.0, 1.0)}}
        randomize = [Vary("dof_armature", 0.9, 1.1, of="(left|right)_hip")]

        def observation(self, s):
            return {"observation": s.qpos.sort(-1).values @ s.uniform(0, 1, 9, 4)[0]}

        def events(self, s):
            return {"speed": s.speed + 1.0}

        def reward(self, s):
            if play:  # a kernel, with commands that can be set
                return s.speed[:, 0] * torch.tensor(0.1)
            return (s.qpos @ s.qvel.T).diagonal() * torch.tensor([1.1, 1.2, 1.3]) / torch.tensor(3.0)

    action, seen, kinds = torch.full((3, 6), 0.3), [], []
    for made, stepped in ((contextlib.nullcontext, contextlib.nullcontext), (caller, caller)):
        with made():
            env = Mixed(3, "cpu", 0, world_offset=0, compile_hooks=compile_hooks, play=play)
            kinds.append({**env.world.kinds, "vary": getattr(env.world._vary, "kind", None)})
        with stepped():
            assert (torch.get_default_dtype() == torch.float64) == (stepped is float64)
            seen.append(env.rollout(3, lambda td: td.set("action", action)))
            assert (torch.get_default_dtype() == torch.float64) == (stepped is float64)
    assert (seen[0] == seen[1]).all()
    assert kinds[0] == kinds[1]
    assert kinds[0]["events"] == ("kernel" if play and compile_hooks else "plain torch")
    assert "bfloat16" not in caplog.text
    assert "its trace gives another" not in caplog.text


def test_the_callers_default_dtype_is_back_when_the_last_thread_leaves():
    """Torch has one for all threads: the first that leaves must not take it from the others."""
    inside, leave, found = threading.Event(), threading.Event(), []

    def first():
        with own_precision(torch.device("cpu")):
            inside.set()
            leave.wait(10.0)

    with float64():
        thread = threading.Thread(target=first)
        thread.start()
        assert inside.wait(10.0)
        with own_precision(torch.device("cpu")):
            leave.set()
            thread.join()
            found.append(torch.get_default_dtype())
        found.append(torch.get_default_dtype())
    assert found == [torch.float32, torch.float64]


def test_a_group_of_what_warp_observes_is_a_kernel():
    """Though reward and what Warp rewards are one memory where the reward is not the task's own."""
    observe = lambda self, s: {"observation": {"all": super(WalkerWalk, self).observation(s)}}  # noqa: E731
    env = type("Grouped", (WalkerWalk,), {"observation": observe})(2, "cpu", seed=0)
    assert env.world._observe.kind == "kernel"
    expected = WalkerWalk(2, "cpu", seed=0).rollout(3, lambda td: td.set("action", torch.full((2, 6), 0.3)))
    td = env.rollout(3, lambda td: td.set("action", torch.full((2, 6), 0.3)))
    assert (td == expected).all()


def test_settings_that_change_after_construction_are_told_of():
    env = WalkerWalk(2, "cpu", seed=0)
    for name in ("noise_scale", "episode_length"):
        with pytest.warns(UserWarning, match=rf"WalkerWalk\.{name} was read .*: make another with this setting"):
            setattr(env, name, 3)
    with pytest.warns(UserWarning, match=r"WalkerWalk\.seed was read .*: call set_seed\(\)"):
        env.seed = 7
    env.set_seed(3)
    assert env.seed == 3


def test_torchs_own_random_numbers_are_told_of(caplog):
    type("Drawn", (WalkerWalk,), {"reward": lambda self, s: torch.rand(s.time.shape)})(2, "cpu", 0)
    assert "draws by torch.rand instead of s.uniform" in caplog.text


class Falling(LocoEnv):
    """A ball that falls from a height that is an option; the episode is cut off after some steps, or ends far below."""

    model = """<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""
    config = CONFIG
    options = {"height": (1.0, "Height at the start (m)."), "steps": (5, "Steps to cut it off after.")}

    def begin(self, s):
        return {"qpos": s.home + torch.tensor([0, 0, self.height - 1.0, 0, 0, 0, 0], device=s.device)}

    def reward(self, s):
        return s.qpos[:, 2]

    def observation(self, s):
        return s.qpos[:, 2:3]

    def terminated(self, s):
        return s.qpos[:, 2] < self.height - 0.05

    def truncated(self, s):
        return s.time > (self.steps - 0.5) * s.dt


def test_an_episode_is_cut_off_by_its_own_hook(device):
    for steps, at in ((3, 2), (100, 4)):  # 0.05 m take five steps
        env = Falling(2, device, 0, height=3.0, steps=steps, on_overflow="ignore")
        td = env.rollout(8, break_when_any_done=False)
        truncated, terminated, done = (
            td["next", flag][0, :, 0].tolist() for flag in ("truncated", "terminated", "done")
        )
        assert done.index(True) == at
        assert (truncated[at], terminated[at]) == (steps == 3, steps != 3)
        assert td["observation"][:, at + 1].allclose(torch.tensor(3.0, device=env.device))


def test_metrics_may_be_none():
    class Silent(Falling):
        def metrics(self, s):
            return {}

    env = Silent(2, "cpu", 0, metrics=True, on_overflow="ignore")
    assert env.rollout(2).shape == (2, 2)


def test_options_are_arguments_attributes_and_part_of_a_run(tmp_path):
    env = Falling(1, "cpu", 0, height=2.0, on_overflow="ignore")
    assert (env.height, env.steps) == (2.0, 5)
    assert env.options_given == env.settings()["options"] == {"height": 2.0}
    with pytest.raises(ValueError, match="unknown argument 'heigth', did you mean 'height'"):
        Falling(1, "cpu", 0, heigth=2.0)
    wrong = [1.0, ([1.0], "of a kind that no word can name"), (None, "of none"), ((1, 2.5), "of two kinds")]
    for options in ({"reward": (1.0, "taken")}, {"sim_dt": (0.1, "taken")}, *({"speed": value} for value in wrong)):
        with pytest.raises((TypeError, ValueError), match=r"Wrong\.options"):
            type("Wrong", (Falling,), {"options": options})(1, "cpu")
    with pytest.raises(TypeError, match="speed is an option, whose value belongs in options"):
        type("Twice", (Falling,), {"options": {"speed": (1.0, "Speed (m/s).")}, "speed": 2.0})(1, "cpu")
    with pytest.raises(ValueError, match="'gpus' is a setting of training, too"):
        training.preset(type("Taken", (Falling,), {"options": {"gpus": (1, "Cards.")}}), "cpu")
    pair = type(
        "Pair", (Falling,), {"options": {**Falling.options, "pair": ((0.5, 1.0), "Two."), "names": ((), "Some.")}}
    )
    env = pair(1, "cpu", 0, pair=np.array([1, 2]), names="x", on_overflow="ignore")
    assert (env.pair, env.names, env.options_given) == ((1.0, 2.0), ("x",), {"pair": [1.0, 2.0], "names": ["x"]})
    assert pair(1, "cpu", 0, on_overflow="ignore").pair == (0.5, 1.0)
    # The nearest class counts, whether it says a value or another default.
    again = {name: (default, words) for name, (default, words) in Falling.options.items()}
    high = type("High", (Falling,), {"options": {**again, "height": (4.0, "Other.")}})
    classes = {
        4.0: type("Same", (high,), {}),
        1.0: type("First", (high,), {"options": {**Falling.options, "more": (1, "More.")}}),
        3.0: type("Value", (high,), {"height": 3.0}),
    }
    assert [cls(1, "cpu", 0, on_overflow="ignore").height for cls in classes.values()] == [*classes]
    with pytest.raises(TypeError, match="option 'pair' must be"):
        pair(1, "cpu", pair=("a", "b"))
    config = training.preset(Falling, "cpu", height=3.0)
    assert config.options == {"height": 3.0}
    assert config.of_env["height"] == 3.0
    assert training.config.config_from_json(json.loads(json.dumps(config.to_json()))) == config
    with pytest.raises(ValueError, match="setting"):
        training.preset(Falling, "cpu", heigth=3.0)
