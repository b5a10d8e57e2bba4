"""What hooks must not do, or may do, with numbers that change: those of tensors, of the last episode, of the model."""

import math

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each

from torchrl_loco import HumanoidStand, LocoEnv, QuadrupedWalk, SimConfig, Vary, WalkerWalk
from torchrl_loco.cli.errors import user_errors


class Pendulum(LocoEnv):
    """A pole that hangs from the world."""

    model = """
<mujoco><worldbody><body name="pole"><joint name="hinge" axis="0 1 0" damping="0.1"/>
<site name="tip" pos="0 0 0.5"/><geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.03"/></body></worldbody>
<actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator>
<sensor><framepos name="middle" objtype="body" objname="pole"/></sensor></mujoco>"""
    config = SimConfig(ctrl_dt=0.02, sim_dt=0.01, engine="mujoco")

    def reward(self, s):
        return s.qpos[:, 0]

    def observation(self, s):
        return s.qpos


def reward_of(env):
    return env.step(env.reset().set("action", torch.zeros(2, 1)))["next", "reward"].flatten().tolist()


@for_each(
    "number",
    [
        lambda self, s: self.gains[self.stage],
        lambda self, s: self.stage.item() + 1.0,
        lambda self, s: float(self.stage) + 1.0,
        lambda self, s: 3.0 if self.stage else 1.0,
        lambda self, s: self.stage.numpy() + 1.0,
        lambda self, s: self.stage.tolist() + 1.0,
        lambda self, s: torch.tensor([self.stage, 1.0]).sum(),
        lambda self, s: torch.full((), self.stage) + 1.0,
    ],
)
def test_a_number_that_python_reads_out_of_a_tensor_is_not_frozen(number, caplog):
    class Staged(Pendulum):
        def __init__(self, *args, **kwargs):
            self.stage, self.gains = torch.zeros((), dtype=torch.int64), torch.tensor([1.0, 2.0, 3.0])
            super().__init__(*args, **kwargs)

        def reward(self, s):
            return number(self, s) + torch.zeros_like(s.time)

    env = Staged(num_envs=2, device="cpu", seed=0)
    assert reward_of(env) == [1.0, 1.0]
    env.stage.fill_(2)
    assert reward_of(env) == [3.0, 3.0]
    assert "reward: not compiled, runs as plain torch: a hook reads a number out of a tensor" in caplog.text


def test_constants_of_a_task_may_be_read_as_numbers(caplog):
    class Known(Pendulum):
        constants = {"gain": torch.tensor(3.0)}

        def reward(self, s):
            return s.time * 0.0 + float(s.gain)

    assert reward_of(Known(num_envs=2, device="cpu", seed=0)) == [3.0, 3.0]
    assert "not compiled" not in caplog.text


@for_each(
    "reads",
    [
        lambda s: s.xpos("pole"),
        lambda s: s.site_xpos("tip"),
        lambda s: s.angvel("pole"),
        lambda s: s.sensor("middle"),
        lambda s: s.contact_force("pole"),
        lambda s: s.depth("eye", 4, 4),
    ],
)
def test_an_episode_does_not_begin_from_poses_of_the_last_one(reads):
    class Begins(Pendulum):
        model = Pendulum.model.replace('<geom type="capsule"', '<camera name="eye"/><geom name="pole" type="capsule"')

        def begin(self, s):
            reads(s)
            return {}

    with pytest.raises(ValueError, match=r"would be of the last episode: begin from s\.home"):
        Begins(num_envs=1, device="cpu", seed=0)


@for_each("writes", [lambda s: s.home.add_(0.1), lambda s: s.model("body_mass").mul_(2.0)])
def test_what_belongs_to_the_model_is_not_written_to_in_one_world(writes):
    class Writes(Pendulum):
        def begin(self, s):
            writes(s)
            return {}

    with pytest.raises(ValueError, match=r"writes to (s\.home|'body_mass' of the model): work on a clone"):
        Writes(num_envs=1, device="cpu", seed=0)


def test_sensors_and_sums_follow_masses_and_their_places():
    class Varied(Pendulum):
        randomize = [Vary("body_ipos", 0.1, 0.2, how="add"), Vary("body_mass", 2.0, 3.0)]

        def observation(self, s):
            return torch.cat([s.sensor("middle"), s.model("body_subtreemass")], dim=-1)

    env = Varied(num_envs=2, device="cpu", seed=0)
    seen = env.reset()["observation"]
    for world in range(2):
        m = env.mujoco_model(world)
        data = mujoco.MjData(m)
        mujoco.mj_forward(m, data)
        expected = torch.from_numpy(np.concatenate([data.sensor("middle").data, m.body_subtreemass])).float()
        torch.testing.assert_close(seen[world], expected)
        torch.testing.assert_close(env.model_value("body_subtreemass")[world], expected[3:])


@for_each("name", ["depth", "noise_scale", "training", "world", "batch_size", "reward", "ctrl_dt"])
def test_an_option_has_a_name_of_its_own(name):
    with pytest.raises(ValueError, match="no name that an option can have"):
        type("Named", (Pendulum,), {"options": {name: (0.5, "Depth of the pit (m).")}})(num_envs=1, device="cpu")


def test_shapes_of_draws_come_as_torch_takes_them_and_memory_may_be_called_lost():
    class Draws(Pendulum):
        memory = {"lost": 2}

        def begin(self, s):
            assert s.normal((2, 3)).shape == (s.num_envs, np.int64(2), 3)
            s.normal(np.int64(2))
            return {"lost": s.uniform(1.0, 2.0, (2,))}

        def reward(self, s):
            return s.lost.sum(-1)

    env = Draws(num_envs=2, device="cpu", seed=0)
    assert min(reward_of(env)) > 2.0


def test_a_stage_has_the_type_of_its_entry():
    class Levels(Pendulum):
        memory = {"level": torch.int32, "height": ()}

        def begin(self, s):
            return {"level": s.level, "height": s.height}

    env = Levels(num_envs=2, device="cpu", seed=0)
    env.set_stage({"memory": {"level": 3}})
    env.reset()
    assert env.get_state()["memory", "level"].tolist() == [3, 3]
    env.set_stage({"memory": {"height": np.array([0.1, math.nan])}})  # of double precision
    with pytest.raises(ValueError, match=r"'level' of a stage must be numbers of torch\.int32"):
        env.set_stage({"memory": {"level": [1.5]}})


def test_the_command_line_says_what_a_model_has_none_of(capsys):
    class Sites(Pendulum):
        model = Pendulum.model.replace('<site name="tip" pos="0 0 0.5"/>', "")

        def reward(self, s):
            return s.site_xpos("tip")[:, 2]

    with pytest.raises(SystemExit), user_errors():
        Sites(num_envs=1, device="cpu", seed=0)
    assert "torchrl-loco: the model has no site 'tip': it has none" in capsys.readouterr().err


def test_a_group_without_terms_is_said():
    class Blind(Pendulum):
        def observation(self, s):
            return {"observation": {}}

    with pytest.raises(ValueError, match="'observation' has no terms"):
        Blind(num_envs=1, device="cpu", seed=0)


def test_gravity_is_seen_where_it_points():
    class Leaning(WalkerWalk):
        randomize = [Vary("gravity", (3.0, 0.0, -4.0), (3.0, 0.0, -4.0), how="set")]

        def observation(self, s):
            return torch.cat([s.projected_gravity("torso"), s.to_body("torso", s.model("gravity"))], dim=-1)

    seen = Leaning(2, "cpu", 0).reset()["observation"]
    torch.testing.assert_close(5.0 * seen[:, :3], seen[:, 3:])


def test_a_pose_that_begins_with_a_quaternion_of_zeros_is_not_turned():
    class Begins(HumanoidStand):
        def begin(self, s):
            return {"qpos": torch.cat([s.home[:, :3], torch.zeros_like(s.home[:, 3:])], dim=-1)}

    env = Begins(2, "cpu", 0)
    assert env.reset()["observation"].isfinite().all()
    assert env.sim.qpos[:, 3:7].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2


def test_forces_of_actuators_are_mujocos():
    """Under the controls of a step, in the state after it; gears, ranges and gains of each world among them."""

    class Driven(LocoEnv):
        model = """
<mujoco><option timestep="0.01"/><worldbody><body name="arm"><joint name="shoulder" axis="0 1 0" damping="0.5"/>
<geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.03"/><body pos="0 0 0.5"><joint name="elbow" axis="0 1 0"/>
<joint name="slide" type="slide" axis="0 0 1"/><geom size="0.1" pos="0 0 0.2"/></body></body></worldbody>
<actuator><position joint="shoulder" kp="20" kv="1" gear="1.5" forcerange="-8 8"/><velocity joint="elbow" kv="0.2"/>
<motor joint="slide" gear="-2" ctrlrange="-0.3 0.3"/><position joint="elbow" kp="3"/></actuator></mujoco>"""
        randomize = [Vary("kp", 0.5, 2.0)]
        action_range = (-math.inf, math.inf)

        def control(self, s, action):
            return action

        def reward(self, s):
            return dict(zip("abcd", s.actuator_force.unbind(-1), strict=True))

        def observation(self, s):
            return torch.cat([s.qpos, s.qvel], dim=-1)

    action = torch.tensor([[1.0, -0.5, 2.0, 0.3], [0.01, 3.0, 0.1, -1.0], [0.05, 0.0, -0.2, 0.6]])
    for compiles in (True, False):
        env = Driven(3, "cpu", seed=0, reward_terms=True, compile_hooks=compiles, engine="mujoco")
        td = env.reset()
        for _ in range(3):
            after = env.step(td.set("action", action))["next"]
            td = after.exclude("reward", "reward_terms")
        found = torch.cat([after["reward_terms", name] for name in "abcd"], dim=-1)
        for world in range(3):
            m = env.mujoco_model(world)
            data = mujoco.MjData(m)
            data.qpos[:], data.qvel[:] = after["observation"][world].double().split(m.nq)
            data.ctrl[:] = action[world]
            mujoco.mj_forward(m, data)
            np.testing.assert_allclose(found[world], data.actuator_force, rtol=1e-5, atol=1e-6)
        assert found.abs().max() == 8.0  # one is at its limit
    off = Driven.model.replace(
        '<option timestep="0.01"/>', '<option timestep="0.01"><flag actuation="disable"/></option>'
    )
    with pytest.raises(ValueError, match="needs actuators that work"):
        type("Off", (Driven,), {"model": off})(1, "cpu", engine="mujoco")
    lifts = type("Lift", (QuadrupedWalk,), {"reward": lambda self, s: s.actuator_force.sum(-1)})
    with pytest.raises(ValueError, match="motors and servos at hinges and slides"):
        lifts(1, "cpu", engine="mujoco")


def test_an_environment_does_not_move_or_change_its_type():
    env = Pendulum(num_envs=1, device="cpu", seed=0)
    assert env.cpu() is env
    for convert in (env.double, env.half, env.bfloat16):
        with pytest.raises(TypeError, match="it computes in float32"):
            convert()
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="no device 'cuda'"):
            env.cuda()


def test_draws_between_bounds_in_the_wrong_order_are_refused():
    class Wrong(Pendulum):
        def begin(self, s):
            return {"qpos": s.uniform(1.0, 0.0, 1)}

    with pytest.raises(ValueError, match="the first must be the lower"):
        Wrong(num_envs=1, device="cpu", seed=0)
