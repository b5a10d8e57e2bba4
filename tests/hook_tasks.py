"""Tasks in plain torch, wholly or in part, that tests share under ids of their own."""

import torch

import torchrl_loco as loco
from torchrl_loco import registry

LEG = """
<body name="{name}_thigh" pos="{x} {y} 0">
  <joint name="{name}_hip" axis="0 1 0" range="-1.2 1.2" damping="0.4" armature="0.01"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.025" mass="0.3" contype="0" conaffinity="0"/>
  <body name="{name}_shank" pos="0 0 -0.15">
    <joint name="{name}_knee" axis="0 1 0" range="-2.2 0" damping="0.4" armature="0.01"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.15" size="0.02" mass="0.2" contype="0" conaffinity="0"/>
    <geom name="{name}_foot" type="sphere" pos="0 0 -0.15" size="0.025" mass="0.05"/>
    <site name="{name}_sole" pos="0 0 -0.175"/>
  </body>
</body>"""
LEGS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}
MOTORS = [
    f'<position name="{leg}_{joint}" joint="{leg}_{joint}" kp="25" ctrlrange="{low} {high}"/>'
    for leg in LEGS
    for joint, low, high in (("hip", -1.2, 1.2), ("knee", -2.2, 0.0))
]
DOG = f"""
<mujoco model="dog">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="trunk" pos="0 0 0.3">
      <freejoint name="root"/>
      <geom name="trunk" type="capsule" fromto="-0.2 0 0 0.2 0 0" size="0.07" mass="4"/>
      <site name="imu" pos="0.05 0 0.02" euler="0 0.3 0"/>
      {"".join(LEG.format(name=name, x=x, y=y) for name, (x, y) in LEGS.items())}
    </body>
  </worldbody>
  <actuator>{"".join(MOTORS)}</actuator>
  <sensor>
    <gyro name="gyro" site="imu"/><velocimeter name="velocimeter" site="imu"/><accelerometer name="unread" site="imu"/>
    <framequat name="attitude" objtype="xbody" objname="fl_shank"/>
    <framepos name="sole_in_trunk" objtype="site" objname="hr_sole" reftype="xbody" refname="trunk"/>
    <framelinvel name="sole_velocity" objtype="site" objname="hr_sole" reftype="site" refname="imu"/>
    <frameangvel name="shank_rotation" objtype="body" objname="hr_shank"/>
    <framezaxis name="geom_axis" objtype="geom" objname="fl_foot" reftype="site" refname="imu"/>
    <jointpos name="knee" joint="fl_knee"/><jointvel name="knee_speed" joint="fl_knee"/>
    <subtreelinvel name="velocity" body="trunk"/>
  </sensor>
  <keyframe><key name="home" qpos="0 0 0.29 1 0 0 0 {"0.5 -1 " * 4}"/></keyframe>
</mujoco>"""


class FollowVelocity(loco.LocoEnv):
    """A dog follows a velocity command: every hook, memory, two groups of observations, pushes, an early end."""

    body = "dog"
    model = DOG
    config = loco.SimConfig(ctrl_dt=0.02, sim_dt=0.005, iterations=4, ls_iterations=8, euler_damping=True)
    memory = {"command": 3, "last_action": 8, "air_time": 4, "until_push": ()}
    episode_length = 200

    def control(self, s, action):
        return s.joint_qpos(".*_(hip|knee)") * 0 + s.home[:, 7:] + 0.5 * action

    def update(self, s):
        touching = s.in_contact(".*_foot")
        return {"air_time": torch.where(touching, 0.0, s.air_time + s.dt)}

    def reward(self, s):
        velocity = s.to_body("trunk", s.linvel("trunk"))
        load = s.contact_force(".*_foot")[..., 2].sum(-1)
        return {
            "track": torch.exp(-(velocity[:, :2] - s.command[:, :2]).square().sum(-1) / 0.25),
            "turn": 0.5 * torch.exp(-(s.sensor("gyro")[:, 2] - s.command[:, 2]).square() / 0.25),
            "rate": -0.05 * (s.action - s.last_action).square().sum(-1),
            "load": -1e-4 * (load - 60.0).abs(),
            "slip": -0.1 * (s.site_linvel(".*_sole")[..., :2].square().sum(-1) * s.in_contact(".*_foot")).sum(-1),
        }

    def terminated(self, s):
        return (s.projected_gravity("trunk")[:, 2] > -0.3) | (s.xpos("trunk")[:, 2] < 0.1)

    def events(self, s):
        anew = s.uniform(0.0, 1.0) < 0.05
        command = torch.where(anew.unsqueeze(-1), s.uniform(-0.5, 0.5, 3), s.command)
        push = s.until_push <= 0
        qvel = torch.cat([s.qvel[:, :2] + 0.3 * s.normal(2) * push.unsqueeze(-1), s.qvel[:, 2:]], dim=-1)
        until_push = torch.where(push, s.uniform(0.2, 0.6), s.until_push - s.dt)
        return {"command": command, "last_action": s.action, "qvel": qvel, "until_push": until_push}

    def observation(self, s):
        clean = torch.cat(
            [
                s.to_body("trunk", s.linvel("trunk")),
                s.to_body("trunk", s.angvel("trunk")),
                s.projected_gravity("trunk"),
                s.joint_qpos(".*_(hip|knee)") - s.home[:, 7:],
                s.joint_qvel(".*_(hip|knee)"),
                s.last_action,
                s.command,
            ],
            dim=-1,
        )
        noisy = clean + s.uniform(-0.05, 0.05, clean.shape[-1])
        return {"observation": noisy, "privileged": torch.cat([clean, s.air_time, s.site_xpos(".*_sole")[..., 2]], -1)}

    def begin(self, s):
        height = s.home[:, 2:3] + s.uniform(0.0, 0.05, 1)
        yaw = s.uniform(-3.14, 3.14, 1)
        zero = torch.zeros_like(yaw)
        qpos = torch.cat([s.home[:, :2], height, (yaw / 2).cos(), zero, zero, (yaw / 2).sin(), s.home[:, 7:]], dim=-1)
        return {"qpos": qpos, "command": s.uniform(-0.5, 0.5, 3), "until_push": s.uniform(0.2, 0.6)}


class WalkBackwards(loco.WalkerWalk):
    """Walk backwards at 1 m/s or faster; an episode ends when the torso falls. The observation stays the fused one."""

    def reward(self, s):
        upright = (1 + s.xmat("torso")[:, 2, 2]) / 2
        speed = -s.sensor("torso_velocity")[:, 0]
        return upright * loco.tolerance(speed, (1.0, torch.inf), margin=1.0, value_at_margin=0.0, sigmoid="linear")

    def terminated(self, s):
        return s.xpos("torso")[:, 2] < 0.7


class WalkBlindly(loco.WalkerWalk):
    """As WalkerWalk, whose fused reward stays, with an observation in torch."""

    def observation(self, s):
        return torch.cat([s.qpos[:, 1:], s.qvel], dim=-1)


class Unsteady(loco.WalkerStand):
    """Every hook, on a body that is quick to make: memory, two groups of observations, pushes, an early end."""

    memory = {"last_action": 6, "until_push": (), "low": ()}

    def control(self, s, action):
        return 0.8 * action + 0.2 * s.last_action

    def update(self, s):
        return {"low": torch.where(s.xpos("torso")[:, 2] < 1.0, s.low + s.dt, 0.0)}

    def reward(self, s):
        height = s.xpos("torso")[:, 2] - 1.0
        return {"height": height, "rate": -0.1 * (s.action - s.last_action).square().sum(-1), "low": -s.low}

    def terminated(self, s):
        return s.low > 1.0

    def events(self, s):
        push = s.until_push <= 0
        qvel = s.qvel + 0.3 * s.normal(9) * push.unsqueeze(-1)
        return {"last_action": s.action, "qvel": qvel, "until_push": torch.where(push, 0.1, s.until_push - s.dt)}

    def observation(self, s):
        clean = torch.cat([s.qpos[:, 1:], s.qvel, s.last_action], dim=-1)
        return {
            "observation": clean + s.uniform(-0.05, 0.05, 23),
            "privileged": torch.cat([clean, s.xpos("torso")], -1),
        }

    def begin(self, s):
        drawn = s.uniform(-0.1, 0.1, 10)
        return {"qpos": s.home + drawn[:, :9], "until_push": 0.1 + drawn[:, 9]}


registry.register("dog_follow", FollowVelocity)
registry.register("walker_backwards", WalkBackwards)
registry.register("walker_blindly", WalkBlindly)
registry.register("walker_unsteady", Unsteady)


class Still:
    """A policy that does nothing."""

    def __init__(self, env):
        self.env = env

    def __call__(self, td):
        return td.set("action", self.env.action_spec.zero())
