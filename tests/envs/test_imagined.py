"""What a task says of predicted states, and where bodies are there, against C MuJoCo and against the worlds."""

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each

import torchrl_loco as loco
from torchrl_loco.envs.imagined import STATE, Imagined, showing_states
from torchrl_loco.envs.kinematics import Kinematics
from torchrl_loco.registry import resolve
from torchrl_loco.sim import models

JOINTS = """
<mujoco>
  <worldbody>
    <body name="base" pos="0.1 -0.2 1" quat="0.9 0.1 0.3 -0.2">
      <freejoint/><geom size="0.1"/>
      <body pos="0.2 0 0.1" quat="0.7 0.7 0.1 0">
        <joint type="ball" pos="0.05 0 -0.1"/><geom size="0.05" pos="0.1 0 0"/>
        <body pos="0 0.3 0">
          <joint type="slide" axis="1 1 0" ref="0.2"/><joint axis="0 1 1" pos="0 0.1 0" ref="0.3"/><joint axis="1 0 0"/>
          <geom size="0.05"/>
          <body pos="0.1 0.1 0.1"><geom size="0.02"/></body>
        </body>
      </body>
    </body>
    <body pos="1 0 0"><joint axis="0 0 1"/><geom size="0.1" pos="0.2 0 0"/></body>
  </worldbody>
</mujoco>
"""


def moving(model, seed):
    """Returns data of a model somewhere, moving."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 1.0)
    data.qpos, data.qvel = qpos, rng.normal(size=model.nv)
    mujoco.mj_forward(model, data)
    return data


def in_torch(data):
    return tuple(torch.tensor(np.array(each), dtype=torch.float32).unsqueeze(0) for each in (data.qpos, data.qvel))


ARM = """
<mujoco>
  <worldbody>
    <body pos="0 0 1"><joint axis="0 0 1"/><geom size="0.1" pos="0.2 0 0"/>
      <body pos="0.3 0 0"><joint axis="0 1 0"/><geom size="0.1"/>
        <body pos="0.3 0 0"><joint type="slide" axis="1 0 0"/><geom size="0.1"/></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
OWN = {"joints": JOINTS, "arm": ARM}


@pytest.fixture(params=[*OWN, "humanoid_walk", "go1_velocity"])
def model(request):
    return models.load(OWN[request.param] if request.param in OWN else resolve(request.param).model)


def test_bodies_are_where_c_mujoco_has_them(model):
    kinematics = Kinematics(model, torch.device("cpu"))
    for seed in range(3):
        data, velocity = moving(model, seed), np.zeros((model.nbody, 6))
        for body in range(model.nbody):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity[body], 0)
        pos, mat, lin, ang = (each[0].numpy() for each in kinematics(*in_torch(data)))
        np.testing.assert_allclose(pos, data.xpos, atol=2e-6)
        np.testing.assert_allclose(mat.reshape(-1, 9), data.xmat, atol=2e-6)
        np.testing.assert_allclose(np.hstack([ang, lin]), velocity, atol=1e-5)


def test_gradients_of_bodies_are_those_of_differences(model):
    kinematics = Kinematics(model, torch.device("cpu"))
    inputs = [each.requires_grad_() for each in in_torch(moving(model, 0))]
    torch.manual_seed(0)
    weights = [torch.randn_like(each) for each in kinematics(*inputs)]

    def weighed(qpos, qvel):
        return sum((weight * each).sum() for weight, each in zip(weights, kinematics(qpos, qvel), strict=True))

    weighed(*inputs).backward()
    kept = [each.clone() for each in weights]
    slopes = torch.autograd.grad(kinematics(*inputs), inputs, weights)  # which stay as they are
    for found, each in zip((*slopes, *weights), (*(each.grad for each in inputs), *kept), strict=True):
        torch.testing.assert_close(found, each)
    for _ in range(5):
        directions = [torch.randn_like(each) for each in inputs]
        slope = sum((each.grad * d).sum() for each, d in zip(inputs, directions, strict=True))
        with torch.no_grad():
            ahead, behind = (
                weighed(*(each + by * d for each, d in zip(inputs, directions, strict=True))) for by in (1e-3, -1e-3)
            )
        torch.testing.assert_close(slope, (ahead - behind) / 2e-3, rtol=2e-3, atol=2e-2)


BOX = """
<mujoco>
  <worldbody>
    <body pos="0 0 1">
      <freejoint/><geom type="box" size="0.2 0.2 0.1"/>
      <body><joint name="axle" axis="0 0 1"/><geom type="box" size="0.2 0.05 0.05" pos="0.1 0 0"/></body>
    </body>
  </worldbody>
  <actuator><motor name="engine" joint="axle" ctrlrange="-3 2"/></actuator>
</mujoco>
"""


class Rich(loco.LocoEnv):
    """A task whose hooks read and write everything that can be imagined."""

    body = "box"
    model = BOX
    config = loco.SimConfig(ctrl_dt=0.02, sim_dt=0.005, episode_length=1000)
    action_range = (-float("inf"), float("inf"))
    memory = {"last": 1, "count": torch.int32, "odd": torch.bool, "updates": (), "ends": ()}
    constants = {"table": torch.arange(5.0)}
    shared = {"total": ()}
    randomize = [loco.Vary("body_mass", 0.5, 2.0)]

    def control(self, s, action):
        return 0.5 * action + s.last + 0.01 * s.count.unsqueeze(-1) % 3

    def update(self, s):
        return {"updates": s.updates + s.qvel[:, 6]}

    def reward(self, s):
        turned = torch.sin(s.joint_qpos("axle")) + s.model("body_mass")[:, 1] + s.ctrl[:, 0]
        return {"turn": turned, "clock": torch.sin(6.0 * s.time) + s.env_index, "updates": s.updates}

    def terminated(self, s):
        return s.table[s.count % 8] > 2.5  # NaN beyond the table, which ends a world too

    def truncated(self, s):
        return s.time > 0.25

    def events(self, s):
        push = torch.where(s.count % 2 == 0, 0.5, 0.0).unsqueeze(-1)
        rows = {"last": s.action, "count": s.count + 70_001, "odd": ~s.odd, "ends": s.ends + s.terminated}
        return {**rows, "qvel": s.qvel + push}

    def adapt(self, s):
        return {"total": s.total + 1.0}

    def observation(self, s):
        rows = {
            "joint": s.joint_qpos("axle").unsqueeze(-1),
            "last": s.last,
            "up": s.projected_gravity("world"),
            "odd": s.odd.float(),
        }
        return {"observation": rows, "privileged": torch.stack([s.updates, s.ends, s.time], dim=-1)}


PLAIN = {"engine": "mujoco", "compile_hooks": False}
"""What makes worlds without compiling: neither physics nor kernels of hooks are what is looked at."""


def imagined_beside(env, td, action):
    """Returns what is said of the step that an environment takes, and the step."""
    after, m = env.step(td.set("action", action))["next"], env.mj_model
    imagined = Imagined(env, env.num_envs)
    state = td[STATE][:, : imagined.size]
    found = after[STATE][:, -m.nq - m.nv - m.nu :]
    qpos, qvel, ctrl = found.split([m.nq, m.nv, m.nu], dim=-1)
    *before, rest = imagined.unpacked(state)
    torch.testing.assert_close(imagined.control(*before, action, rest), ctrl)
    over = torch.zeros(env.num_envs, dtype=torch.bool)
    units = torch.rand(env.num_envs, imagined.drawn)
    return imagined, imagined.judge(qpos, qvel, action, rest, state, over, units), after


@pytest.mark.parametrize("task", [Rich, "g1_tracking", "g1_velocity"])
def test_a_task_says_of_predicted_states_what_it_says_in_its_worlds(task):
    """But for what it reads of contacts, as most of a velocity task's terms do."""
    cls = task if isinstance(task, type) else resolve(task)
    env = loco.make(showing_states(cls), num_envs=4, seed=3, reward_terms=True, noise_scale=0.0, **PLAIN)
    td, ended = env.reset(), False
    torch.manual_seed(0)
    for _ in range(4):
        imagined, said, after = imagined_beside(env, td, 0.1 * torch.randn(4, env.mj_model.nu))
        assert (said.terminated == after["terminated"][:, 0]).all()
        assert (said.over == after["done"][:, 0]).all()
        ended = ended or said.over.all()
        if task == "g1_velocity":
            td = after.select("observation", "privileged", STATE)
            continue
        of_contacts, earned = after["reward_terms"].get("self_collision", torch.zeros(4, 1)), imagined.earned([said])
        torch.testing.assert_close(earned.reward[0], (after["reward"] - of_contacts)[:, 0], rtol=1e-4, atol=1e-5)
        seen = {"observation": said.observation, "privileged": earned.observations["privileged"][0]}
        for group, rows in seen.items():
            torch.testing.assert_close(rows, after[group], rtol=1e-5, atol=1e-5)
        there, back = (imagined.unpacked(each[STATE][:, : imagined.size]) for each in (after, td))
        for row, expected, start in zip(said.rest, there[2], back[2], strict=True):
            torch.testing.assert_close(row[~said.over], expected[~said.over].to(row.dtype))
            torch.testing.assert_close(row[said.over], start[said.over].to(row.dtype))
        torch.testing.assert_close(said.qpos[said.over], back[0][said.over])
        td = after.select("observation", "privileged", STATE)
    assert ended == (task is Rich)
    if ended:
        start = torch.zeros(4, imagined.size)
        lost, none = said.qpos * float("nan"), torch.zeros(4, imagined.drawn)
        gone = imagined.judge(lost, said.qvel, torch.zeros(4, 1), said.rest, start, said.over, none)
        earned = imagined.earned([gone])
        assert gone.over.all()
        assert earned.terminated.all()
        assert not earned.reward.any()
        assert not earned.observations["privileged"].any()
        assert not gone.observation.any()
        assert not gone.qpos.any()
        *clock, numbers, last, count, odd, updates, ends = said.rest
        going = [*clock, numbers, last, 0 * count, odd]
        endless = [*going, updates + float("inf"), ends]  # memory, as where it is simulated
        over = imagined.judge(said.qpos, said.qvel, torch.zeros(4, 1), endless, start, said.over & False, none)
        assert over.terminated.all()
        heavy = [*clock, numbers + float("inf"), *going[-3:], updates, ends]  # the reward reads it, the actor does not
        said = imagined.judge(said.qpos, said.qvel, torch.zeros(4, 1), heavy, start, said.over & False, none)
        earned = imagined.earned([said])
        assert not said.terminated.any()
        assert earned.terminated.all()
        assert not earned.reward.any()
        assert not earned.observations["privileged"].any()


class Shares(Rich):
    """Its reward is what worlds share."""

    def reward(self, s):
        return s.total.expand(s.num_envs)


def test_what_worlds_share_is_that_of_the_last_refresh():
    env = loco.make(showing_states(Shares), num_envs=2, seed=0, **PLAIN)
    td = env.reset()
    imagined = Imagined(env, 2)
    qpos, qvel, rest = imagined.unpacked(td[STATE][:, : imagined.size])
    start, none, units = td[STATE][:, : imagined.size], torch.zeros(2) > 0, torch.zeros(2, imagined.drawn)

    def earned():
        said = imagined.judge(qpos, qvel, torch.zeros(2, 1), rest, start, none, units)
        return imagined.earned([said]).reward.flatten().tolist()

    assert earned() == [0.0, 0.0]
    env.step(td.set("action", torch.zeros(2, 1)))
    assert earned() == [0.0, 0.0]
    imagined.refresh()
    assert earned() == [1.0, 1.0]


def beside_g1(steps=1):
    env = loco.make(showing_states(resolve("g1_tracking")), num_envs=2, seed=0, **PLAIN)
    state = env.reset()[STATE]
    imagined = Imagined(env, 2, steps)
    qpos, qvel, rest = imagined.unpacked(state[:, : imagined.size])
    over, action = torch.zeros(2, dtype=torch.bool), torch.zeros(2, env.mj_model.nu)
    return (
        imagined,
        qvel,
        lambda qvel: imagined.judge(
            qpos, qvel, action, rest, state[:, : imagined.size], over, torch.rand(2, imagined.drawn)
        ),
    )


def test_noise_is_drawn_anew():
    imagined, qvel, judge = beside_g1()
    first, second = (judge(qvel) for _ in range(2))
    of_critic = [imagined.earned([said]).observations["privileged"] for said in (first, second)]
    assert (of_critic[0] == of_critic[1]).all()
    apart = (first.observation - second.observation).abs()
    assert 0.8 < apart.max() <= 1.0  # rates have noise of up to 0.5, either way
    assert (apart[:, :58] == 0.0).all()  # the reference has none


def test_rewards_of_steps_in_a_row_have_gradients():
    imagined, qvel, judge = beside_g1(steps=2)
    direction = torch.randn_like(qvel)

    def earned(by):
        return imagined.earned([judge(qvel + by * direction), judge(qvel - 2.0 * by * direction)]).reward

    by = torch.zeros(2, 1, requires_grad=True)
    rewards = earned(by)
    torch.testing.assert_close(rewards[0], rewards[1])
    slopes = [torch.autograd.grad(reward.sum(), by, retain_graph=True)[0] for reward in rewards]
    with torch.no_grad():
        ahead, behind = earned(torch.tensor(1e-2)), earned(torch.tensor(-1e-2))
    expected = (ahead - behind) / 2e-2
    torch.testing.assert_close(torch.stack(slopes).squeeze(-1), expected, rtol=2e-2, atol=2e-4)
    assert (expected[0] - expected[1]).abs().min() > 1e-3


class LeavesTorch(Rich):
    """Its reward is computed in NumPy."""

    def reward(self, s):
        return torch.from_numpy(np.sin(np.from_dlpack(s.qvel[:, 6].detach())))


class Drawing(Rich):
    """Its controls are random."""

    def control(self, s, action):
        return action + s.uniform(-1.0, 1.0, 1)


class Poses(Rich):
    """Its controls depend on where a body is."""

    def control(self, s, action):
        return action + s.xpos(["world"])[:, 0, :1]


class Long(Rich):
    """Its memory has long integers."""

    memory = {**Rich.memory, "long": torch.int64}


class Remembers(Rich):
    """Its policy sees the past."""

    history = {"observation": 3}


@for_each(
    ("task", "why"),
    [
        ("walker_walk", "its reward is a Warp function"),
        ("go1_rough", "it scans the ground"),
        (LeavesTorch, "leaves torch"),
        (Drawing, "its control draws random numbers"),
        (Poses, "its control reads more than positions"),
        (Long, "int32"),
        (Remembers, "history"),
    ],
)
def test_what_cannot_be_imagined_is_refused(task, why):
    cls = task if isinstance(task, type) else resolve(task)
    with pytest.raises(ValueError, match=why):
        Imagined(loco.make(showing_states(cls), num_envs=2, **PLAIN), 2)
