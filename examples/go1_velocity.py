"""A Unitree Go1 follows velocity commands: a robot's MJCF, and the task in plain torch.

    torchrl-loco train examples/go1_velocity.py:Go1Velocity

How a whole task reads in one file; the package's own ``go1_velocity`` is what to train. Put the MJCF of a Go1 without
meshes beside this file as ``go1.xml``, with position actuators in joint order and sites FR, FL, RR, RL at the soles:
``torchrl_loco/tasks/velocity/go1.xml`` has them. The task is mjlab's flat one for the Go1, but for contact forces and
the variation of the model.
"""

import math

import torch

import torchrl_loco as loco

HOME = torch.tensor([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)
"""Angles of hip, thigh and calf of each leg (rad)."""
HEIGHT, SOLE = 0.278, 0.024
"""Height of the trunk at the start, and below which a sole touches the ground (m)."""
STAND, WALK = torch.tensor([0.05, 0.05, 0.1] * 4), torch.tensor([0.3, 0.3, 0.6] * 4)
"""How far joints may stray from home while standing and walking (rad)."""
NOISE = torch.tensor([0.5] * 3 + [0.2] * 3 + [0.05] * 3 + [0.01] * 12 + [1.5] * 12 + [0.0] * 15)
"""Uniform noise of the policy's observation, either way, in the unit of each entry."""
PUSH = torch.tensor([0.5, 0.5, 0.4, 0.52, 0.52, 0.78])
"""Largest change of the trunk's velocity by a push (m/s, rad/s)."""


class Go1Velocity(loco.LocoEnv):
    """Follow a velocity command (m/s, rad/s), drawn anew every 3 to 8 s; falling ends the episode."""

    model = "go1.xml"
    config = loco.SimConfig(ctrl_dt=0.02, sim_dt=0.005, iterations=10, ls_iterations=20, euler_damping=True)
    episode_length = 1000
    action_range = (-math.inf, math.inf)
    memory = {
        **{"command": 3, "heading": (), "turns": (), "until_command": (), "until_push": ()},
        **{"last_action": 12, "air_time": 4, "peak": 4, "bias": 12},
    }

    def numbers(self, s):
        """Returns home pose, action scale, and middle and half width of 90 % of the joints' ranges, on the device."""
        ranges = s.model("jnt_range")[0, 1:]
        scale = 0.25 * s.model("actuator_forcerange")[0, :, 1] / s.model("actuator_gainprm")[0, :, 0]
        return HOME.to(s.device), scale, ranges.mean(-1), 0.45 * (ranges[:, 1] - ranges[:, 0])

    def control(self, s, action):
        home, scale, _, _ = self.numbers(s)
        return home + scale * action

    def update(self, s):
        height = s.site_xpos("F.|R.")[..., 2]
        touching = height < SOLE
        peak = torch.where(touching, s.peak, torch.maximum(s.peak, height))
        return {"air_time": s.air_time + s.dt, "peak": peak}

    def reward(self, s):
        home, _, middle, half = self.numbers(s)
        linear, angular = s.to_body("trunk", s.linvel("trunk")), s.to_body("trunk", s.angvel("trunk"))
        height, velocity = s.site_xpos("F.|R.")[..., 2], s.site_linvel("F.|R.")[..., :2]
        touching, speed = height < SOLE, s.command[:, :2].norm(dim=-1) + s.command[:, 2].abs()
        landed = touching & (s.air_time > 1.5 * s.dt)
        moving, joints = speed > 0.05, s.qpos[:, 7:]
        spread = torch.where(moving.unsqueeze(-1), WALK.to(s.device), STAND.to(s.device))
        error = (s.command[:, :2] - linear[:, :2]).square().sum(-1) + linear[:, 2].square()
        turn = (s.command[:, 2] - angular[:, 2]).square() + angular[:, :2].square().sum(-1)
        terms = {
            "track_linear": 2.0 * torch.exp(-error / 0.25),
            "track_angular": 2.0 * torch.exp(-turn / 0.5),
            "upright": torch.exp(-s.projected_gravity("trunk")[:, :2].square().sum(-1) / 0.2),
            "pose": torch.exp(-((joints - home) / spread).square().mean(-1)),
            "limits": -((joints - middle).abs() - half).clamp(min=0.0).sum(-1),
            "action_rate": -0.1 * (s.action - s.last_action).square().sum(-1),
            "clearance": -2.0 * moving * ((height - 0.1).abs() * velocity.norm(dim=-1)).sum(-1),
            "swing_height": -0.25 * moving * ((s.peak / 0.1 - 1.0).square() * landed).sum(-1),
            "slip": -0.1 * moving * (velocity.square().sum(-1) * touching).sum(-1),
        }
        return {name: term * s.dt for name, term in terms.items()}

    def terminated(self, s):
        return s.projected_gravity("trunk")[:, 2] > -math.cos(math.radians(70.0))

    def events(self, s):
        touching = s.site_xpos("F.|R.")[..., 2] < SOLE
        due, hit = s.until_command <= 0, s.until_push <= 0
        command = {
            name: torch.where(due.view(-1, *[1] * (new.ndim - 1)), new, getattr(s, name))
            for name, new in self.new_command(s).items()
        }
        qvel = torch.cat(
            [s.qvel[:, :6] + s.uniform(-1.0, 1.0, 6) * PUSH.to(s.device) * hit.unsqueeze(-1), s.qvel[:, 6:]], -1
        )
        return {
            **command,
            "command": self.toward_heading(s, **command),
            "until_command": torch.where(due, s.uniform(3.0, 8.0), s.until_command - s.dt),
            "until_push": torch.where(hit, s.uniform(1.0, 3.0), s.until_push - s.dt),
            "qvel": qvel,
            "last_action": s.action,
            "air_time": torch.where(touching, 0.0, s.air_time),
            "peak": torch.where(touching, 0.0, s.peak),
        }

    def new_command(self, s):
        """Returns a command: a tenth stands, of the others three tenths hold a heading, a fifth goes straight ahead."""
        command, kind = s.uniform(-1.0, 1.0, 3) * torch.tensor([1.0, 1.0, 0.5], device=s.device), s.uniform(0.0, 1.0, 3)
        ahead = command * 0 + torch.tensor([1.0, 0.0, 0.0], device=s.device) * command[:, :1].abs().clamp(min=0.3)
        command = torch.where(kind[:, :1] < 0.2, ahead, command)
        command = torch.where(kind[:, 1:2] < 0.1, 0.0, command)
        holds = (kind[:, 2] < 0.3) & (kind[:, 1] >= 0.1)
        return {"command": command, "heading": s.uniform(-math.pi, math.pi), "turns": holds.float()}

    def toward_heading(self, s, command, heading, turns):
        """Returns the command, whose yaw rate turns worlds that hold a heading toward it."""
        forward = s.xmat("trunk")[:, :2, 0]
        error = heading - torch.atan2(forward[:, 1], forward[:, 0])
        rate = (0.5 * torch.atan2(error.sin(), error.cos())).clamp(-0.5, 0.5)
        return torch.cat([command[:, :2], torch.where(turns > 0, rate, command[:, 2]).unsqueeze(-1)], dim=-1)

    def observation(self, s):
        home, _, _, _ = self.numbers(s)
        base = [s.to_body("trunk", s.linvel("trunk")), s.to_body("trunk", s.angvel("trunk"))]
        clean = torch.cat(
            [*base, s.projected_gravity("trunk"), s.qpos[:, 7:] - home, s.qvel[:, 6:], s.last_action, s.command], dim=-1
        )
        noisy = clean + NOISE.to(s.device) * s.uniform(-1.0, 1.0, 48)
        noisy = torch.cat([noisy[:, :9], noisy[:, 9:21] + s.bias, noisy[:, 21:]], dim=-1)
        height = s.site_xpos("F.|R.")[..., 2]
        privileged = torch.cat([clean, height, s.air_time, (height < SOLE).float()], dim=-1)
        return {"observation": noisy, "privileged": privileged}

    def begin(self, s):
        yaw, zero = s.uniform(-math.pi, math.pi, 1) / 2, torch.zeros_like(s.home[:, :1])
        height = HEIGHT + s.uniform(0.01, 0.05, 1)
        home = self.numbers(s)[0].expand(s.num_envs, -1)
        qpos = torch.cat([s.uniform(-0.5, 0.5, 2), height, yaw.cos(), zero, zero, yaw.sin(), home], dim=-1)
        return {
            **self.new_command(s),
            "qpos": qpos,
            "until_command": s.uniform(3.0, 8.0),
            "until_push": s.uniform(1.0, 3.0),
            "bias": s.uniform(-0.015, 0.015, 12),
        }
