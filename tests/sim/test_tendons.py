"""Fixed tendons, equalities, activations and sensors at sites, against C MuJoCo in float64."""

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each

from torchrl_loco.config import SimConfig
from torchrl_loco.sim import Simulation
from torchrl_loco.sim.compiled import unsupported

WORLDS, SUBSTEPS = 32, 4
MODEL = """
<mujoco>
  <option timestep=".002"/>
  <default><geom density="800"/></default>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="trunk" pos="0 0 .4">
      <freejoint/>
      <geom type="ellipsoid" size=".2 .15 .1"/>
      <site name="trunk" pos=".05 .02 .03" euler="20 -40 70"/>
      {legs}
    </body>
    <body pos="1 0 .1">
      <freejoint/><geom size=".05"/>
      <body pos="0 .02 -.05"><joint axis="1 0 0"/><geom size=".04"/><site name="stone" pos=".01 0 0"/></body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="sum">
      <joint joint="hip0" coef=".4"/><joint joint="knee0" coef=".3"/><joint joint="reach0" coef="2"/>
    </fixed>
    <fixed name="difference"><joint joint="hip1" coef=".5"/><joint joint="knee1" coef="-.5"/></fixed>
    <fixed name="across"><joint joint="hip1" coef="1"/><joint joint="hip2" coef="-1"/></fixed>
    <fixed name="still"><joint joint="knee2" coef="1.5"/></fixed>
  </tendon>
  <equality>
    <tendon tendon1="sum" polycoef=".02 0 0 0 0" solref=".005 .5"/>
    <tendon tendon1="still" tendon2="{other}" polycoef=".01 .5 .2 -.1 .05"/>
    <joint joint1="hip3" joint2="knee3" polycoef="-.02 .7 .3 0 .1" solimp=".9 .95 .01"/>
    <joint joint1="reach3" polycoef=".01 1 1 1 1"/>
    <joint joint1="knee1" active="false"/>
  </equality>
  <actuator>
    <general joint="hip0" dyntype="filter" dynprm=".05" gainprm="20" biastype="affine" biasprm="1 -20 -.5"
             ctrlrange="-1 1" ctrllimited="true"/>
    <general tendon="sum" dyntype="filterexact" dynprm=".02" gainprm="30" biastype="affine" biasprm="0 -30 -1"
             gear="1.5"/>
    <general tendon="difference" dyntype="integrator" gainprm="15" actlimited="true" actrange="-.01 .02"/>
    <motor tendon="across" gear="3" ctrlrange="-.5 .5" ctrllimited="true"/>
    <position joint="knee3" kp="30" forcerange="-4 4"/>
    <general tendon="still" dyntype="filter" dynprm=".1" gainprm="10" forcerange="-2 2"/>
  </actuator>
  <sensor>
    <accelerometer site="trunk"/><gyro site="trunk"/><velocimeter site="trunk"/>
    <force site="foot0"/><torque site="foot0"/><torque site="shank1"/><force site="shank1"/>
    <accelerometer site="foot2"/><velocimeter site="foot3"/><gyro site="shank1"/><subtreelinvel body="trunk"/>
    <force site="stone"/><torque site="stone"/>
  </sensor>
</mujoco>
"""
LEG = """
<body pos="{x} {y} 0">
  <joint name="hip{i}" axis="0 1 .2" damping=".5" armature=".01"/>
  <geom type="capsule" size=".03" fromto="0 0 0 .1 0 -.15"/>
  <body pos=".1 0 -.15">
    <joint name="knee{i}" axis="1 .3 0" damping=".4" armature=".01" range="-60 60" limited="true"/>
    <geom type="capsule" size=".025" fromto="0 0 0 -.05 0 -.12"/>
    <site name="shank{i}" pos=".01 0 -.05" euler="10 50 -30"/>
    <body pos="-.05 0 -.12">
      <joint name="reach{i}" type="slide" axis="0 0 1" damping="5" armature=".02" stiffness="200"/>
      <geom size=".04" friction=".8"/>
      <body euler="0 30 0"><geom type="box" size=".02 .01 .01" pos="0 0 .03" contype="0" conaffinity="0"/>
        <site name="foot{i}" pos="0 .01 0" euler="0 0 45"/></body>
    </body>
  </body>
</body>
"""


WELDED = """
<mujoco>
  <option timestep=".002"/>
  <default><geom density="800"/><equality solref=".02 1" solimp=".9 .95 .01"/></default>
  <worldbody>
    <geom type="plane" size="5 5 .1" pos="0 0 -.15"/>
    <site name="hook" pos=".3 0 .6" euler="30 20 10"/>
    <body name="trunk" pos="0 0 .4">
      <freejoint/>
      <geom type="box" size=".1 .08 .05"/>
      {legs}
    </body>
    <body name="load" pos="0 0 .25">
      <freejoint/><geom size=".05"/><site name="handle" pos="0 .02 .05" euler="10 0 50"/>
    </body>
    <body name="arm" pos=".5 0 .5">
      <joint type="ball" damping=".2"/><geom type="capsule" size=".02" fromto="0 0 0 .2 0 0"/>
      <body name="hand" pos=".2 0 0" euler="0 40 0">
        <joint axis="0 1 0" damping=".1"/><geom size=".04" pos=".05 0 0"/><site name="palm" pos=".08 0 .01"/>
      </body>
    </body>
  </worldbody>
  <equality>{equalities}</equality>
</mujoco>
"""
EQUALITIES = {
    "connect bodies": '<connect body1="load" body2="trunk" anchor=".02 .03 .04"/>',
    "connect to the world": '<connect body1="hand" anchor=".1 0 .02"/><connect body1="load" anchor="0 0 .05"/>',
    "connect sites": '<connect site1="palm" site2="handle"/><connect site1="hook" site2="foot1"/>',
    "weld bodies": '<weld body1="load" body2="hand" torquescale=".3" anchor=".01 .02 .03"/>',
    "weld with a pose": '<weld body1="trunk" body2="load" relpose=".1 .2 -.1 .8 .1 -.5 .3" torquescale="2"/>',
    "weld to the world": '<weld body1="hand" torquescale=".5"/>',
    "weld sites": '<weld site1="handle" site2="palm"/><weld site1="foot0" site2="hook" torquescale=".1"/>',
}


def legs():
    return "".join(LEG.format(i=i, x=0.15 * (-1) ** (i // 2), y=0.12 * (-1) ** i) for i in range(4))


@for_each("other", ["difference", "across"])
def test_steps_and_sensors_are_those_of_c_mujoco(other, device):
    """The second model couples two legs, which are not eliminated side by side then."""
    m = mujoco.MjModel.from_xml_string(MODEL.format(legs=legs(), other=other))
    assert unsupported(m) == []
    settings = {"ctrl_dt": SUBSTEPS * 0.002, "sim_dt": 0.002, "iterations": 50, "ls_iterations": 50}
    config = SimConfig(**settings, naconmax=100, njmax=100, engine="compiled", euler_damping=True)
    sim, rng = Simulation(m, config, WORLDS, torch.device(device)), np.random.default_rng(0)
    data, touched = mujoco.MjData(m), 0
    start = np.tile(m.qpos0, (WORLDS, 1))
    start[:, 7:] += 0.1 * rng.normal(size=(WORLDS, m.nq - 7))
    start[:, 2] = rng.uniform(0.25, 0.5, WORLDS)
    sim.qpos[:] = torch.as_tensor(start)
    sim.qvel[:] = 0.3 * torch.as_tensor(rng.normal(size=(WORLDS, m.nv)))
    sim.act[:] = 0.02 * torch.as_tensor(rng.normal(size=(WORLDS, m.na)))
    moved = m.sensor_needstage[np.repeat(np.arange(m.nsensor), m.sensor_dim)] < int(mujoco.mjtStage.mjSTAGE_ACC)
    for _ in range(20):
        sim.ctrl[:] = torch.as_tensor(rng.normal(size=(WORLDS, m.nu)))
        before = [x.cpu().numpy().copy() for x in (sim.qpos, sim.qvel, sim.act, sim.qacc_warmstart, sim.ctrl)]
        sim.step()
        qpos, qvel, act = (x.cpu().numpy() for x in (sim.qpos, sim.qvel, sim.act))
        for world in range(WORLDS):
            mujoco.mj_resetData(m, data)
            names = "qpos", "qvel", "act", "qacc_warmstart", "ctrl"
            for name, rows in zip(names, before, strict=True):
                getattr(data, name)[:] = rows[world]
            for _ in range(SUBSTEPS):
                mujoco.mj_step(m, data)
            touched += data.ncon > 0
            felt = data.sensordata.copy()  # of the last substep; what moves is sensed in the present state
            mujoco.mj_step1(m, data)
            expected = np.where(moved, data.sensordata, felt)
            np.testing.assert_allclose(act[world], data.act, rtol=0, atol=1e-6)
            np.testing.assert_allclose(qpos[world], data.qpos, rtol=0, atol=2e-6)
            np.testing.assert_allclose(qvel[world], data.qvel, rtol=0, atol=1e-3)
            sensors = sim.data.sensordata.numpy()[world]
            scale = np.maximum(1.0, np.abs(expected).max())
            np.testing.assert_allclose(sensors, expected, rtol=0, atol=1e-3 * scale)
    assert touched > WORLDS
    assert sim.overflow.max() == 0
    np.testing.assert_array_equal(sim.mujoco_data().act.numpy(), act)


@for_each("kind", EQUALITIES)
def test_welds_and_connections_are_those_of_c_mujoco(kind, device):
    m = mujoco.MjModel.from_xml_string(WELDED.format(legs=legs(), equalities=EQUALITIES[kind]))
    assert unsupported(m) == []
    settings = {"ctrl_dt": 0.002, "sim_dt": 0.002, "iterations": 100, "ls_iterations": 50}
    config = SimConfig(**settings, naconmax=100, njmax=100, engine="compiled", euler_damping=True)
    sim, rng = Simulation(m, config, WORLDS, torch.device(device)), np.random.default_rng(0)
    data = mujoco.MjData(m)
    for world in range(WORLDS):
        data.qpos[:] = m.qpos0
        mujoco.mj_integratePos(m, data.qpos, rng.normal(size=m.nv), 0.2)
        sim.qpos[world] = torch.as_tensor(data.qpos, dtype=torch.float32)
    sim.qvel[:] = 0.3 * torch.as_tensor(rng.normal(size=(WORLDS, m.nv)))
    for _ in range(3):
        before = [x.cpu().numpy().copy() for x in (sim.qpos, sim.qvel, sim.qacc_warmstart)]
        sim.step()
        qvel, overflow = sim.qvel.cpu().numpy(), sim.overflow.cpu().numpy()
        for world in range(WORLDS):
            mujoco.mj_resetData(m, data)
            for name, rows in zip(("qpos", "qvel", "qacc_warmstart"), before, strict=True):
                getattr(data, name)[:] = rows[world]
            mujoco.mj_step(m, data)
            change = np.abs(data.qvel - before[1][world]).max()
            if not overflow[world]:
                np.testing.assert_allclose(qvel[world], data.qvel, rtol=0, atol=1e-4 + 5e-4 * change)
    assert (sim.overflow > 0).sum() <= 2  # they lie on the floor in more places than there are


def test_equalities_of_what_cannot_move_change_nothing():
    """C MuJoCo leaves them out; as rows they would be heavy, and hide all others from the solver."""
    held = '<weld body1="shelf" body2="world" anchor=".3 0 0" relpose="1 0 0 1 0 0 0"/><tendon tendon1="slack"/>'
    slack = '<tendon><fixed name="slack"><joint joint="j" coef="0"/></fixed></tendon>'
    body = '<body pos="0 0 1"><joint name="j" axis="0 1 0"/><geom size=".1" pos=".3 0 0"/></body>'
    world = f'<worldbody><body name="shelf" pos="1 0 0"/>{body}</worldbody>'
    text = f"<mujoco>{world}{slack}<equality>{{}}</equality></mujoco>"
    moved = []
    for equalities in (held, ""):
        m = mujoco.MjModel.from_xml_string(text.format(equalities))
        config = SimConfig(ctrl_dt=0.02, sim_dt=0.002, naconmax=9, njmax=9, engine="compiled", euler_damping=True)
        sim = Simulation(m, config, 1, torch.device("cpu"))
        sim.step()
        moved.append(sim.qvel[0].tolist())
    assert moved[0] == pytest.approx(moved[1], rel=1e-5)
    assert abs(moved[1][0]) > 1e-3


WRONG = {
    "tendons": '<tendon><spatial><site site="a"/><site site="b"/></spatial></tendon>',
    "more than a length": '<tendon><fixed range="0 1" limited="true"><joint joint="j" coef="1"/></fixed></tendon>',
    "activation": '<actuator><general joint="j" dyntype="filter" actearly="true"/></actuator>',
    "holds a body to itself": '<equality><weld site1="a" site2="c"/></equality>',
    "friction resists turning": '<sensor><force site="a"/></sensor>',
    "nor a weld": '<equality><weld body1="b"/></equality><sensor><torque site="a"/></sensor>',
}


def test_a_ball_joint_is_the_last_of_its_body():
    """In a world of lanes, to which a sensor at a site sends a small body."""
    joints = '<joint name="turn" type="ball"/><joint type="slide"/>'
    body = f'<body pos="0 0 1">{joints}<geom size=".1"/><site name="s"/></body>'
    for sensor, reasons in (("", 0), ('<sensor><accelerometer site="s"/></sensor>', 1)):
        m = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody>{sensor}</mujoco>")
        assert ["joint 'turn': a ball joint that another" in reason for reason in unsupported(m)] == [True] * reasons


@for_each("reason", WRONG)
def test_what_is_not_there_is_said(reason):
    sites = '<site name="a"/><site name="c"/>'
    body = f'<body name="b" pos="0 0 1"><joint name="j"/><geom size=".1" condim="4"/>{sites}</body>'
    world = f'<worldbody><geom type="plane" size="1 1 1"/><site name="b" pos="0 0 1"/>{body}</worldbody>'
    m = mujoco.MjModel.from_xml_string(f"<mujoco>{world}{WRONG[reason]}</mujoco>")
    assert any(reason in line for line in unsupported(m)), unsupported(m)
