"""Robots that follow a velocity command: models by their figures, physics by C MuJoCo, the task by formula."""

import dataclasses
import math
import os
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from contact_forces import net_forces
from for_each import for_each
from oracle import arrays, reference_model
from torchrl.envs.utils import check_env_specs

from torchrl_loco import registry
from torchrl_loco.sim import Simulation, models
from torchrl_loco.tasks import velocity
from torchrl_loco.tasks.robots import actuated

ROBOTS = {
    "go1": velocity.Go1Velocity,
    "go2": velocity.Go2Velocity,
    "g1": velocity.G1Velocity,
    "h1": velocity.H1Velocity,
}
JOINTS = {"go1": 12, "go2": 12, "g1": 29, "h1": 19}
FEET = {"go1": 4, "go2": 4, "g1": 2, "h1": 2}
WORLDS = 16

FIELDS = {
    "body": "parentid pos quat mass inertia ipos iquat gravcomp",
    "jnt": "bodyid type axis pos range limited stiffness solref solimp margin actfrclimited actfrcrange",
    "dof": "armature damping frictionloss solref solimp",
    "actuator": "trnid trntype gaintype biastype dyntype gainprm biasprm gear forcelimited forcerange ctrllimited "
    "ctrlrange",
    "site": "bodyid pos quat",
    "geom": "bodyid type pos contype conaffinity condim priority friction solref solimp solmix margin gap",
}
OPTIONS = ("timestep", "iterations", "ls_iterations", "integrator", "cone", "impratio", "gravity", "disableflags")
USED = {2: 1, 3: 2, 6: 3}
"""Numbers of the size of spheres, capsules and boxes."""


@for_each("name", ROBOTS)
def test_a_robot_has_an_id(name):
    assert registry.env_class(f"{name}_velocity") is ROBOTS[name]
    assert registry.task_name(ROBOTS[name]) == f"{name}_velocity"


# The models.


def colliding(contype, conaffinity):
    return np.flatnonzero(np.array(contype) | np.array(conaffinity))


@for_each("name", ROBOTS)
def test_model_has_the_figures_of_the_robot(name):
    m, expected = models.load(ROBOTS[name].model), reference_model(name)
    ours = colliding(m.geom_contype, m.geom_conaffinity)
    theirs = colliding(expected["geom_contype"], expected["geom_conaffinity"])
    for kind, fields in FIELDS.items():
        rows = (ours, theirs) if kind == "geom" else (slice(None), slice(None))
        for field in (f"{kind}_{part}" for part in fields.split()):
            got, figure = np.array(getattr(m, field))[rows[0]], np.array(expected[field])[rows[1]]
            np.testing.assert_allclose(got, figure, rtol=1e-5, atol=2e-6, err_msg=field)
    for kind in ("body", "joint", "site", "actuator", "geom"):
        indices = zip(ours, theirs, strict=True) if kind == "geom" else enumerate(range(len(expected["names"][kind])))
        for i, j in indices:
            assert getattr(m, kind)(i).name == expected["names"][kind][j] or not expected["names"][kind][j]
    for i, j in zip(ours, theirs, strict=True):
        shape, quat = int(m.geom_type[i]), np.array(expected["geom_quat"][j])
        used = USED.get(shape, 0)
        np.testing.assert_allclose(m.geom_size[i, :used], expected["geom_size"][j][:used], rtol=1e-5)
        axes, turned = np.zeros(9), np.zeros(9)
        mujoco.mju_quat2Mat(axes, m.geom_quat[i])
        mujoco.mju_quat2Mat(turned, quat / np.linalg.norm(quat))
        along = (axes * turned).reshape(3, 3).sum(0)  # cosines between their axes
        assert shape == 2 or abs(along[2]) > 1 - 1e-9  # a capsule has no front and no head
        assert shape != 6 or (along > 1 - 1e-9).all()
    for option in OPTIONS:
        np.testing.assert_allclose(getattr(m.opt, option), expected["option"][option], err_msg=option)
    np.testing.assert_allclose(m.qpos0, expected["qpos0"])
    np.testing.assert_allclose(m.key("home").qpos, expected["home"])
    assert sorted(m.exclude_signature) == sorted(expected["exclude_signature"])
    assert m.nmesh == 0


@for_each("name", ROBOTS)
def test_a_control_step_ends_where_c_mujoco_does(name):
    cls, steps = ROBOTS[name], arrays(f"{name}_steps")
    m = models.load(cls.model)
    m.opt.tolerance = 1e-12
    config = dataclasses.replace(cls.config, iterations=200, ls_iterations=100, engine="compiled")
    sim = Simulation(m, config, len(steps["qpos"]), torch.device("cpu"))
    sim.compile(sim.step)  # in parallel, and not beside another worker
    for ours, theirs in {"qpos": "qpos", "qvel": "qvel", "qacc_warmstart": "warmstart", "ctrl": "ctrl"}.items():
        getattr(sim, ours).copy_(torch.tensor(steps[theirs]))
    sim.step()
    error = np.abs(sim.qpos.numpy() - steps["next_qpos"]).max(axis=1)
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.9) < 1e-3


# The task.


@pytest.fixture(scope="module")
def robot():
    """Makes the environment of each robot once."""
    made = {}

    def get(name):
        if name not in made:
            made[name] = ROBOTS[name](WORLDS, "cpu", 0, reward_terms=True)
        made[name].set_seed(0)
        return made[name]

    return get


@pytest.fixture(scope="module")
def many():
    """Many worlds of a robot, for what is counted: one physics step each time, as the physics does not matter."""
    return type("Hard", (velocity.H1Velocity,), {"max_delay": 3, "push_scale": 1.5})(2000, "cpu", 0, sim_dt=0.02)


@pytest.fixture(scope="module")
def play():
    """A robot to play with."""
    return velocity.H1Velocity(WORLDS, "cpu", 0, play=True)


def with_memory(state, **rows):
    state = state.clone()
    for key, value in rows.items():
        state["memory", key] = torch.full_like(state["memory", key], value)
    return state


def stepped(env, state, action):
    """Steps once from a state, with one action for all worlds and joints or with one each."""
    td = env.reset(state, set_state=True)
    td["action"] = torch.as_tensor(action).expand(env.action_spec.shape).clone()
    return env.step(td)["next"], env.get_state()


def yaw_of(qpos):
    w, x, y, z = qpos[:, 3:7].unbind(-1)
    return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wrapped(angle):
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


@pytest.mark.slow
@for_each("name", ["go1", "g1"])
def test_random_steps_stay_finite_and_have_the_shapes_of_the_specs(robot, name, caplog):
    env, joints, feet = robot(name), JOINTS[name], FEET[name]
    td = env.rollout(50, break_when_any_done=False)
    assert td["next", "observation"].shape == (WORLDS, 50, 12 + 3 * joints)
    assert td["next", "privileged"].shape == (WORLDS, 50, 12 + 3 * joints + 6 * feet + 1)
    assert td["action"].shape == (WORLDS, 50, joints)
    for key in ("observation", "privileged", "reward"):
        assert td["next", key].isfinite().all()
    assert "not compiled" not in caplog.text  # all hooks became kernels


def test_specs_are_those_of_torchrl(play):
    check_env_specs(play)
    world = play.world
    parts = world._control, world._judge, world._observe, world._begin, world._observe_begun
    assert {part.kind for part in parts} == {"kernel"}


def spread(joints, command, stand, walk, run):
    speed = np.linalg.norm(command[:2]) + abs(command[2])
    table = stand if speed < 0.05 else walk if speed < 1.5 else run
    return np.array([next(value for part, value in table if part in joint) for joint in joints])


GO1 = ([("calf", 0.1), ("", 0.05)], [("calf", 0.6), ("", 0.3)], [("calf", 0.6), ("", 0.3)])
COMMON = [("waist_roll", 0.08), ("wrist", 0.3)]
G1 = (
    [("", 0.05)],
    [
        *[("hip_pitch", 0.3), ("hip", 0.15), ("knee", 0.35), ("ankle_pitch", 0.25), ("ankle_roll", 0.1)],
        *[("waist_yaw", 0.2), ("waist_pitch", 0.1), ("shoulder_yaw", 0.1), ("shoulder", 0.15), ("elbow", 0.15)],
        *COMMON,
    ],
    [
        *[("hip_pitch", 0.5), ("hip", 0.2), ("knee", 0.6), ("ankle_pitch", 0.35), ("ankle_roll", 0.15)],
        *[("waist_yaw", 0.3), ("waist_pitch", 0.2), ("shoulder_pitch", 0.5), ("shoulder_roll", 0.2)],
        *[("shoulder_yaw", 0.15), ("elbow", 0.35), *COMMON],
    ],
)
EXPECTED = {"go1": ("trunk", ["FR", "FL", "RR", "RL"], GO1), "g1": ("torso_link", ["left_foot", "right_foot"], G1)}


def expected_terms(m, name, row):
    """The terms of one world by VELOCITY's formulas, from C MuJoCo's kinematics in float64."""
    trunk, sites, tables = EXPECTED[name]
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = row["qpos"], row["qvel"]
    mujoco.mj_forward(m, d)
    mujoco.mj_subtreeVel(m, d)
    base = d.xmat[1].reshape(3, 3)
    v, w, up = base.T @ d.qvel[:3], d.qvel[3:6], d.body(trunk).xmat.reshape(3, 3)[2]
    command = row["command"]
    names = [m.actuator(i).name for i in range(m.nu)]
    q, q_home = d.qpos[7:], m.key("home").qpos[7:]
    low, high = m.jnt_range[1:].T
    heights, slides = [], []
    for site in sites:
        velocity_of_site = np.zeros(6)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_SITE, m.site(site).id, velocity_of_site, 0)
        heights.append(d.site(site).xpos[2])
        slides.append(np.linalg.norm(velocity_of_site[3:5]))
    heights, slides, contacts = np.array(heights), np.array(slides), row["contacts"]
    landed = contacts * (row["air_time"] > 0)
    peak = np.where(contacts > 0, row["peak"], np.maximum(row["peak"], heights))
    moves = np.linalg.norm(command[:2]) + abs(command[2]) > 0.05
    middle, reach = (low + high) / 2, 0.9 * (high - low) / 2
    rotation = d.body(trunk).xmat.reshape(3, 3).T @ d.cvel[m.body(trunk).id, :3]
    terms = {
        "track_linear": 2 * np.exp(-(np.sum((v[:2] - command[:2]) ** 2) + v[2] ** 2) / 0.25),
        "track_angular": 2 * np.exp(-((w[2] - command[2]) ** 2 + w[0] ** 2 + w[1] ** 2) / 0.5),
        "upright": np.exp(-(up[0] ** 2 + up[1] ** 2) / 0.2),
        "pose": np.exp(-np.mean(((q - q_home) / spread(names, command, *tables)) ** 2)),
        "joint_limits": -np.sum(np.maximum(np.maximum(middle - reach - q, q - middle - reach), 0)),
        "action_rate": -0.1 * np.sum((row["action"] - row["last_action"]) ** 2),
        "foot_clearance": -2 * moves * np.sum(np.abs(heights - 0.1) * slides),
        "foot_swing_height": -0.25 * moves * np.sum(landed * (peak / 0.1 - 1) ** 2),
        "foot_slip": -0.1 * moves * np.sum(contacts * slides**2),
        "soft_landing": -1e-5 * moves * np.sum(landed * np.linalg.norm(row["forces"], axis=1)),
    }
    if name == "g1":
        terms["trunk_rotation"] = -0.05 * (rotation[0] ** 2 + rotation[1] ** 2)
        terms["angular_momentum"] = -0.02 * np.sum(d.subtree_angmom[1] ** 2)
    return {key: 0.02 * value for key, value in terms.items()}


@for_each("name", EXPECTED)
def test_reward_is_the_sum_of_its_terms_by_formula(robot, name):
    env, joints, feet, seen = robot(name), JOINTS[name], FEET[name], set()
    env.rollout(12, break_when_any_done=False)
    centers = env.model_value("body_ipos").numpy()
    for _ in range(4):
        before, action = with_memory(env.get_state(), until_push=9.0), 0.7 * torch.randn(env.action_spec.shape)
        after, state = stepped(env, before, action)
        privileged = after["privileged"].double().numpy()[:, 12 + 3 * joints :]
        contacts, forces = privileged[:, 2 * feet : 3 * feet], privileged[:, 3 * feet : -1].reshape(WORLDS, feet, 3)
        for world in range(WORLDS):
            row = {key: before["memory", key][world].double().numpy() for key in ("command", "last_action", "air_time")}
            row |= {key: state[key][world].double().numpy() for key in ("qpos", "qvel")}
            row |= {"peak": before["memory", "peak"][world].double().numpy(), "action": action[world].double().numpy()}
            row |= {"contacts": contacts[world], "forces": np.sign(forces[world]) * np.expm1(np.abs(forces[world]))}
            m = env.mj_model
            nominal = m.body_ipos.copy()
            m.body_ipos[:] = centers[world]
            expected = expected_terms(m, name, row)
            m.body_ipos[:] = nominal
            terms = {key: values[world].item() for key, values in after["reward_terms"].items()}
            if name == "g1":
                assert terms.pop("self_collision") <= 0.0
            assert terms == pytest.approx(expected, rel=2e-3, abs=2e-6)
            seen |= {key for key, value in terms.items() if value != 0.0}
        total = sum(after["reward_terms"].values())
        torch.testing.assert_close(after["reward"], total)
    assert seen >= expected.keys() - {"joint_limits"}


def test_a_hard_contact_of_the_robot_with_itself_costs_each_physics_step(robot):
    """As many as C MuJoCo counts, stepped with the same targets: arms swing into the torso or out of it."""
    env = robot("g1")
    env.reset()
    state = env.get_state()
    elbows = [env.mj_model.joint(f"{side}_shoulder_roll_joint") for side in ("left", "right")]
    state["qpos"][:, 2] += 1.0  # far above the ground
    for side, joint in zip((-1.0, 1.0), elbows, strict=True):
        state["qpos"][:, joint.qposadr[0]] = side * torch.linspace(0.0, 0.6, WORLDS)
        state["qvel"][:, joint.dofadr[0]] = side * torch.tensor([6.0, -9.0]).repeat(WORLDS // 2)
    after, _ = stepped(env, state, 0.0)
    own = [i for i in range(env.mj_model.ngeom) if re.fullmatch(env.own_geoms, env.mj_model.geom(i).name)]
    expected = []
    for world in range(WORLDS):
        m = env.mujoco_model(world)
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:], d.ctrl[:] = state["qpos"][world], state["qvel"][world], env.sim.ctrl[world]
        hard = 0
        for _ in range(env.config.substeps):
            mujoco.mj_step(m, d)
            hard += (np.linalg.norm(net_forces(m, d)[0][own], axis=1) > 10.0).any()
        expected.append(hard)
    cost = after["reward_terms", "self_collision"].squeeze(-1)
    torch.testing.assert_close(cost, -0.02 * torch.tensor(expected).float())
    assert {0, 4} < set(expected)


@for_each(("tilt", "ends"), [(65, False), (75, True)])
def test_an_episode_ends_when_the_trunk_is_tilted_by_70_degrees(robot, tilt, ends):
    env = robot("go1")
    env.reset()
    state = env.get_state()
    half = math.radians(tilt) / 2
    state["qpos"][:, 2:7] = torch.tensor([1.0, math.cos(half), 0.0, math.sin(half), 0.0])
    assert (stepped(env, state, 0.0)[0]["terminated"] == ends).all()


def test_actions_are_targets_around_home(robot):
    env, scale = robot("go1"), 0.25 * 35.55 / 35.7643
    env.reset()
    action = torch.zeros(env.action_spec.shape)
    action[:, 2] = 2.0
    stepped(env, with_memory(env.get_state(), delay=0.0), action)
    target = torch.tensor(env.mj_model.key("home").qpos[7:], dtype=torch.float32).repeat(WORLDS, 1)
    target[:, 2] += 2.0 * scale
    torch.testing.assert_close(env.sim.ctrl, target)


# Commands.


def share(flags):
    return flags.float().mean().item()


def test_commands_have_their_shares_and_ranges(many):
    many.set_seed(0)
    many.reset()
    state = many.get_state()
    command, memory = state["memory", "command"], state["memory"]
    stands = (command == 0).all(-1)
    holds, straight = memory["holds_heading"] > 0, (command[:, 1:] == 0).all(-1) & ~stands
    free = ~(stands | holds | straight)
    assert share(stands) == pytest.approx(0.1, abs=0.025)
    assert share(straight) == pytest.approx(0.9 * 0.2, abs=0.03)
    assert share(holds) == pytest.approx(0.9 * 0.8 * 0.3, abs=0.03)
    assert command[straight, 0].min() >= 0.3
    assert share(command[straight, 0] == 0.3) == pytest.approx(0.3, abs=0.08)
    for column, most in enumerate((1.0, 1.0, 0.5)):
        values = command[free, column]
        assert values.abs().max() == pytest.approx(most, abs=0.02)
        assert values.std() == pytest.approx(most / math.sqrt(3), rel=0.06)
    turn = (0.5 * wrapped(memory["heading"] - yaw_of(state["qpos"]))).clamp(-0.5, 0.5)
    torch.testing.assert_close(command[holds, 2], turn[holds], rtol=1e-3, atol=1e-3)
    assert memory["until_command"].min() >= 3.0
    assert memory["until_command"].max() == pytest.approx(8.0, abs=0.05)


def test_commands_are_drawn_anew_when_they_are_due(many):
    many.reset()
    state = with_memory(many.get_state(), until_command=1.0, holds_heading=0.0)
    _, kept = stepped(many, state, 0.1)
    torch.testing.assert_close(kept["memory", "command"], state["memory", "command"])
    torch.testing.assert_close(kept["memory", "until_command"], torch.full((2000,), 1.0 - 0.02))
    _, after = stepped(many, with_memory(state, until_command=0.0), 0.1)
    command = after["memory", "command"]
    assert share((command != state["memory", "command"]).any(-1)) > 0.97  # some stand again
    assert share((command == 0).all(-1)) == pytest.approx(0.1, abs=0.025)
    assert after["memory", "until_command"].min() >= 3.0


@for_each(
    ("trained", "low", "high"),
    [
        (119_000, (-1, -1, -0.5), (1, 1, 0.5)),
        (120_000, (-1.5, -1, -0.7), (2, 1, 0.7)),
        (240_000, (-2, -1, -0.7), (3, 1, 0.7)),
    ],
)
def test_ranges_of_commands_widen_with_training(many, trained, low, high):
    many.reset()
    _, after = stepped(many, with_memory(many.get_state(), until_command=0.0, trained=trained), 0.1)
    assert (after["memory", "trained"] == trained + 1).all()
    command = after["memory", "command"]
    for column in range(3):
        assert command[:, column].min().item() == pytest.approx(low[column], abs=0.03)
        assert command[:, column].max().item() == pytest.approx(high[column], abs=0.03)
    many.reset()
    assert (many.get_state()["memory", "trained"] == trained + 1).all()  # it counts on in the next episode


# What is random.


def test_pushes_change_the_velocity_of_the_base_alone(many):
    many.reset()
    state, action = many.get_state(), 0.1 * torch.randn(many.action_spec.shape)
    _, calm = stepped(many, with_memory(state, until_push=0.5), action)
    _, pushed = stepped(many, with_memory(state, until_push=0.0), action)
    change = pushed["qvel"] - calm["qvel"]
    for column, most in enumerate((0.75, 0.75, 0.6, 0.78, 0.78, 1.17)):
        assert change[:, column].abs().max().item() == pytest.approx(most, abs=0.01)
        assert change[:, column].std().item() == pytest.approx(most / math.sqrt(3), rel=0.06)
    assert (change[:, 6:] == 0).all()
    torch.testing.assert_close(calm["memory", "until_push"], torch.full((2000,), 0.48))
    wait = pushed["memory", "until_push"]
    assert wait.min() >= 1.0
    assert wait.max() == pytest.approx(3.0, abs=0.03)


def test_actions_are_late_by_the_delay_of_the_episode(many):
    td = many.reset()
    delay = many.get_state()["memory", "delay"]
    torch.testing.assert_close(td["privileged"][:, -1], delay)
    for steps in range(4):
        assert share(delay == steps) == pytest.approx(1 / 4, abs=0.03)
    home = torch.tensor(many.mj_model.key("home").qpos[7:], dtype=torch.float32)
    sent = torch.randn(8, *many.action_spec.shape)
    sent[:3] = 0.0  # as before the first step
    for step in range(3, 8):
        td = many.step(td.set("action", sent[step]))["next"]
        arrived = sent[step - delay.long(), torch.arange(len(delay))]
        torch.testing.assert_close(many.sim.ctrl, home + 0.25 * arrived)


def test_the_policy_sees_noise_and_a_bias_that_the_critic_does_not(many):
    td = many.reset()
    joints = JOINTS["h1"]
    bias = many.get_state()["memory", "bias"]
    assert bias.abs().max().item() == pytest.approx(0.015, abs=1e-3)
    error = td["observation"] - td["privileged"][:, : 12 + 3 * joints]
    error[:, 9 : 9 + joints] -= bias
    first = 0
    for most, size in ((0.5, 3), (0.2, 3), (0.05, 3), (0.01, joints), (1.5, joints)):
        noise = error[:, first : first + size]
        assert noise.abs().max().item() == pytest.approx(most, rel=0.01)
        assert noise.std().item() == pytest.approx(most / math.sqrt(3), rel=0.03)
        first += size
    assert (error[:, first:] == 0).all()


def test_episodes_start_near_home_above_the_ground(many):
    many.reset()
    state = many.get_state()
    qpos, home = state["qpos"], torch.tensor(many.mj_model.key("home").qpos, dtype=torch.float32)
    assert (state["qvel"] == 0).all()
    assert qpos[:, :2].abs().max().item() == pytest.approx(0.5, abs=0.01)
    assert (qpos[:, 2] - home[2]).aminmax().min.item() == pytest.approx(0.01, abs=1e-3)
    assert (qpos[:, 2] - home[2]).aminmax().max.item() == pytest.approx(0.05, abs=1e-3)
    torch.testing.assert_close(qpos[:, 7:], home[7:].expand(2000, -1))
    assert yaw_of(qpos).std().item() == pytest.approx(math.pi / math.sqrt(3), rel=0.06)
    assert (state["memory", "last_action"] == 0).all()


@for_each("name, low, high", [("go1", 0.3, 1.5), ("g1", 0.3, 1.2)])
def test_worlds_differ_in_friction_and_mass(robot, name, low, high):
    env = robot(name)
    env.reset()  # before, all have the numbers of the model
    friction, ipos, m = env.model_value("geom_friction"), env.model_value("body_ipos"), env.mj_model
    feet = [geom for geom in range(m.ngeom) if "_foot" in m.geom(geom).name]
    sliding = friction[:, feet, 0]
    assert (sliding == sliding[:, :1]).all()
    assert low <= sliding.min() < sliding.max() <= high
    assert len(sliding[:, 0].unique()) == WORLDS
    trunk = m.body(type(env).trunk).id
    moved = ipos[:, trunk] - torch.tensor(m.body_ipos[trunk], dtype=torch.float32)
    assert 0 < moved.abs().max() <= 0.03
    assert (moved.abs() <= torch.tensor([0.025, 0.025, 0.03]) + 1e-7).all()


# Play.


def test_play_has_no_noise_no_pushes_no_variation_and_a_command_that_is_set(play):
    assert play.randomize == ()
    play.set_command(None)
    size = play.reset()["observation"].shape[-1]
    assert len(play.get_state()["memory", "command"].unique(dim=0)) > WORLDS // 2
    play.set_command((0.5, 0.0, 0.2))
    state = with_memory(play.get_state(), until_push=0.0, until_command=0.0)
    after, pushed = stepped(play, state, 0.1)
    torch.testing.assert_close(after["observation"], after["privileged"][:, :size])
    torch.testing.assert_close(after["observation"][:, -3:], torch.tensor([[0.5, 0.0, 0.2]]).expand(WORLDS, 3))
    _, calm = stepped(play, with_memory(state, until_push=9.0), 0.1)
    assert torch.equal(pushed["qvel"], calm["qvel"])
    each = torch.rand(WORLDS, 3)
    play.set_command(each)
    torch.testing.assert_close(play.reset()["observation"][:, -3:], each)


def test_commands_are_set_in_play_alone_and_have_three_numbers(play, many):
    with pytest.raises(ValueError, match="play=True"):
        many.set_command((1.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"\(3,\) or \(16, 3\)"):
        play.set_command((1.0, 0.0))


# Robots of users.


class Table(velocity.Velocity):
    """A table for a robot with four joints, which stands on two feet."""

    model = """
<mujoco>
  <asset><mesh name="shell" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 .33">
      <freejoint/><geom type="box" size=".1 .1 .05" mass="2"/>
      <geom type="mesh" mesh="shell" contype="0" conaffinity="0"/>
      <body name="left" pos="0 .08 0">
        <joint name="left_hip" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".02" contype="0" conaffinity="0"/>
        <body name="left_shank" pos="0 0 -.15"><joint name="left_knee" axis="0 1 0" range="-90 90"/>
          <geom name="left_foot" type="capsule" fromto="-.04 0 -.15 .04 0 -.15" size=".02"/>
          <site name="left_sole" pos="0 0 -.17"/></body></body>
      <body name="right" pos="0 -.08 0">
        <joint name="right_hip" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.15" size=".02" contype="0" conaffinity="0"/>
        <body name="right_shank" pos="0 0 -.15"><joint name="right_knee" axis="0 1 0" range="-90 90"/>
          <geom name="right_foot" type="capsule" fromto="-.04 0 -.15 .04 0 -.15" size=".02"/>
          <site name="right_sole" pos="0 0 -.17"/></body></body>
    </body>
  </worldbody>
  <actuator>
    <position joint="left_hip" kp="20" kv=".5" forcerange="-10 10"/>
    <position joint="left_knee" kp="20" kv=".5" forcerange="-10 10"/>
    <position joint="right_hip" kp="20" kv=".5" forcerange="-10 10"/>
    <position joint="right_knee" kp="20" kv=".5" forcerange="-10 10"/>
  </actuator>
  <keyframe><key name="home" qpos="0 0 .33 1 0 0 0 .2 -.4 .2 -.4"/></keyframe>
</mujoco>"""
    memory = velocity.memory(joints=4, feet=2)
    base = trunk = "trunk"
    feet = {"left_sole": "left_foot", "right_sole": "right_foot"}
    stand = walk = run = {".*": 0.3}
    step_height = 0.05


def test_a_table_makes_a_task_of_a_users_robot(caplog):
    env = Table(4, "cpu", 0)
    assert env.rollout(40, break_when_any_done=False)["next", "observation"].isfinite().all()
    assert "meshes without contacts are drawn and touch nothing: shell" in caplog.text
    with pytest.raises(TypeError, match="Bare must set base, trunk, feet, stand, walk, run"):
        type("Bare", (velocity.Velocity,), {"model": Table.model})(1, "cpu")
    of_number = {"max_delay": 4, "push_scale": -1.0, "step_height": 0.0, "action_scale": math.nan}
    for name, wrong in (*of_number.items(), ("holds", {"delay": (0, 4)})):
        with pytest.raises(ValueError, match=rf"{name}.* of Slow must lie in"):
            type("Slow", (Table,), {name: wrong})(1, "cpu")


def test_commands_stay_within_a_curriculum_of_ones_own():
    narrow = {0: ((-1.0, 0.2), (-0.1, 0.1), (-0.3, 0.0))}
    wider = {**narrow, 40: ((-2.0, 2.0), (-1.0, 1.0), (-1.0, 1.0))}
    info = {"frames": 8 * 48, "num_envs": 8, "stage": {"memory": {"trained": [24.0]}}}  # by two ranks
    low, _ = velocity.commands.reached(wider, velocity.steps_of_training(info))
    assert [*low] == [-1.0, -0.1, -0.3]
    mixed = type("Mixed", (type("Slow", (), {"curriculum": narrow}), Table), {})
    assert [*mixed.command_ranges["command"].values()] == [*narrow[0]]
    # A wall is no floor.
    wall = '<geom type="plane" size="1 1 1" pos="9 0 1" euler="0 -90 0"/><body name="trunk"'
    walled = Table.model.replace('<body name="trunk"', wall)
    env = type("Narrow", (Table,), {"curriculum": narrow, "model": walled})(
        500, "cpu", 0, engine="mujoco", compile_hooks=False
    )
    env.reset()
    commands = env.world.memory["command"]
    for k, (name, (low, high)) in enumerate(zip(velocity.commands.NAMES, narrow[0], strict=True)):
        assert ((commands[:, k] >= low) & (commands[:, k] <= high)).all()
        assert env.command_ranges["command"][name] == (low, high)
    assert (commands[:, 0] == 0.2).sum() > 50  # straight ahead


UNFIT_TABLES = [
    ({"feet": ["left_sole", "right_sole"]}, TypeError, "feet of Other must be a dict from sites to geoms"),
    ({"feet": {"left_sole": ".*_foot", "right_sole": "right_foot"}}, ValueError, "'right_foot' is of several"),
    ({"feet": {"left_sole": "left_foot(", "right_sole": "right_foot"}}, KeyError, "nor a regular expression"),
    ({"memory": velocity.memory(joints=5, feet=2)}, ValueError, "memory is that of 5 joints, but it has 4 actuators"),
    ({"memory": velocity.memory(joints=4, feet=3)}, ValueError, "memory is that of 3 feet, but there are 2"),
    ({"weights": {**Table.weights, "self_collision": -1.0}}, ValueError, "self_collision needs own_geoms of Other"),
    ({"weights": {**Table.weights, "foot_slipp": -1.0}}, ValueError, "must name its terms, .*: see foot_slipp"),
    ({"weights": {"upright": 1.0}}, ValueError, "must name its terms, .*: see action_rate, foot_clearance"),
    ({"curriculum": {9: velocity.CURRICULUM[0]}}, ValueError, r"rise from 0, got \[9\]"),
    ({"curriculum": {0: ((1.0, -1.0), (0.0, 0.0), (0.0, 0.0))}}, ValueError, "a least and a greatest value"),
]
UNFIT = [
    ("<freejoint/>", '<joint type="slide"/>', "first joint must be a free joint of the base 'trunk'"),
    ('position joint="left_hip" kp="20" kv=".5"', 'motor name="m" joint="left_hip"', "must be servos of gear 1, .*: m"),
    (' forcerange="-10 10"', "", "actuators need a forcerange, or Table an action_scale"),
    ('range="-90 90"', "", "joints need a range: left_knee, right_knee"),
    ('name="home" ', "", "a keyframe 'home'"),
    ('joint="left_hip" kp', 'joint="left_hip" gear="2" kp', "servos of gear 1, .*: number 0"),
    ('position joint="left_hip" kp="20"', 'intvelocity joint="left_hip" kp="20" actrange="-1 1"', "must be servos"),
    ('name="floor"', 'name="floor" pos="0 0 -.5"', "its floor must be at height 0"),
    ("0 0 .33 1 0 0 0 .2", "0 0 .33 .7 0 .7 0 .2", "the base must be level in 'home'"),
    ('.2 -.4 .2 -.4"', '.2 -.4 2. -.4"', "'home' is beyond the range of joints: right_hip"),
]


def test_a_table_or_a_model_that_the_formulas_do_not_fit_is_refused():
    for given, error, message in UNFIT_TABLES:
        with pytest.raises(error, match=message):
            type("Other", (Table,), given)(1, "cpu", engine="mujoco", compile_hooks=False)
    weights = {**Table.weights, "angular_momentum": -0.02}
    with pytest.raises(ValueError, match='needs <subtreeangmom name="angular_momentum" body="trunk"/>'):
        type("Table", (Table,), {"weights": weights})(1, "cpu")
    for old, new, message in UNFIT:
        model = Table.model.replace(old, new)
        if "slide" in new:
            model = model.replace("0 0 .33 1 0 0 0 .2", "0 .2")
        with pytest.raises(ValueError, match=message):
            type("Table", (Table,), {"model": model})(1, "cpu")


def of_menagerie(folder, scene, base, trunk, feet):
    """Returns a model of Menagerie as the recipe needs it: with servos, a home pose, and sites and names of feet."""
    spec = mujoco.MjSpec.from_file(str(folder / scene))
    for actuator in spec.actuators:
        if actuator.biastype == mujoco.mjtBias.mjBIAS_NONE:
            actuator.forcerange = actuator.ctrlrange
            actuator.set_to_position(kp=actuator.ctrlrange[1], kv=0.03 * actuator.ctrlrange[1])
    for mesh in spec.meshes:
        mesh.maxhullvert = 64
    if "home" not in [key.name for key in spec.keys]:
        spec.keys[0].name = "home"
    found = {}
    for foot, body in feet.items():
        geoms = [
            g for g in spec.body(body).geoms if g.contype and (g.name == foot or foot not in ("FL", "FR", "RL", "RR"))
        ]
        for i, geom in enumerate(geoms):
            geom.name = f"{foot}_{i}"
        spec.body(body).add_site(name=f"{foot}_sole", pos=geoms[0].pos)
        found[f"{foot}_sole"] = rf"{foot}_\d+"
    table = {"model": spec, "base": base, "trunk": trunk, "feet": found, "action_scale": 0.25, "randomize": []}
    joints = actuated(spec.compile())
    return type("Menagerie", (Table,), {**table, "memory": velocity.memory(len(joints), len(found))})


LEGS = {leg: f"{leg}_calf" for leg in ("FL", "FR", "RL", "RR")}
SIDES = ("left", "right")


@pytest.mark.slow
@pytest.mark.skipif("MUJOCO_MENAGERIE" not in os.environ, reason="MUJOCO_MENAGERIE names no checkout of Menagerie")
@for_each(
    ("scene", "contacts", "base", "trunk", "feet"),
    [
        ("unitree_go2/scene_mjx.xml", "all", "base", "base", LEGS),
        ("unitree_go2/scene.xml", "ground", "base", "base", LEGS),
        ("unitree_g1/scene.xml", "ground", "pelvis", "torso_link", {s: f"{s}_ankle_roll_link" for s in SIDES}),
        ("unitree_h1/scene.xml", "ground", "pelvis", "torso_link", {s: f"{s}_ankle_link" for s in SIDES}),
    ],
)
def test_a_robot_of_menagerie_does_the_same_task(scene, contacts, base, trunk, feet, caplog):
    cls = of_menagerie(Path(os.environ["MUJOCO_MENAGERIE"]), scene, base, trunk, feet)
    env = cls(4, "cpu", 0, contacts=contacts, play=True, iterations=100, ls_iterations=50)
    assert "meshes without contacts are drawn" in caplog.text
    assert env.engine == "compiled"
    td = env.reset()
    for _ in range(10):
        before, action = env.get_state(), 0.3 * torch.randn(env.action_spec.shape)
        td = env.step(td.set("action", action))["next"].exclude("reward", "reward_terms")
    m, d, error = env.sim.mj_model, mujoco.MjData(env.sim.mj_model), []
    for world in range(4):
        d.qpos[:], d.qvel[:], d.ctrl[:] = before["qpos"][world], before["qvel"][world], env.sim.ctrl[world]
        d.qacc_warmstart[:] = before["qacc_warmstart"][world]
        for _ in range(env.config.substeps):
            mujoco.mj_step(m, d)
        error.append(np.abs(env.sim.qpos[world].numpy() - d.qpos).max())
    assert np.median(error) < 1e-4
