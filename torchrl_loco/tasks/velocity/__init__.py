"""Velocity: robots that follow a velocity command on flat ground. One recipe, and a table for each robot."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch

from torchrl_loco.checks import NOT_NEGATIVE, Interval, check_float, check_int
from torchrl_loco.conditions import PUSH, PUSH_EVERY
from torchrl_loco.config import SimConfig
from torchrl_loco.envs.names import Elements
from torchrl_loco.envs.task import definer
from torchrl_loco.envs.view import View
from torchrl_loco.sim import models
from torchrl_loco.sim.compiled.collision.kinds import PLANE
from torchrl_loco.tasks.robots import FREE, Robot, com, either, hard_contacts, pushed, sliding, soft, squares
from torchrl_loco.tasks.velocity import commands

FOLDER = Path(__file__).parent
LEGS = ("FR", "FL", "RR", "RL")
MOMENTUM = int(mujoco.mjtSensor.mjSENS_SUBTREEANGMOM)

CURRICULUM: dict[int, commands.Ranges] = {
    0: ((-1.0, 1.0), (-1.0, 1.0), (-0.5, 0.5)),
    120_000: ((-1.5, 2.0), (-1.0, 1.0), (-0.7, 0.7)),
    240_000: ((-2.0, 3.0), (-1.0, 1.0), (-0.7, 0.7)),
}
"""Ranges of the commands by the control step of training from which they hold."""
SETTLING = 1.5  # time after a new command for which its errors do not count (s)
BIAS = 0.015  # greatest error of a joint's encoder in an episode (rad)
MAX_DELAY = 3  # greatest delay that a robot may set (control steps): memory has the actions up to it
START_HEIGHT = (0.01, 0.05)  # least and greatest height above the home pose at the start (m)
STANDS, RUNS = 0.05, 1.5  # speed of a command (m/s + rad/s) up to which a robot stands, and from which it runs
UPSIDE = math.cos(math.radians(70.0))  # cosine of the tilt at which a trunk has fallen

WEIGHTS = {
    "track_linear": 2.0,
    "track_angular": 2.0,
    "upright": 1.0,
    "pose": 1.0,
    "joint_limits": -1.0,
    "action_rate": -0.1,
    "foot_clearance": -2.0,
    "foot_swing_height": -0.25,
    "foot_slip": -0.1,
    "soft_landing": -1e-5,
}
"""Weights of the reward's terms by name."""

HUMANOID = {
    ".*hip_pitch.*": (0.3, 0.5),
    ".*hip_(roll|yaw).*": (0.15, 0.2),
    ".*knee.*": (0.35, 0.6),
    ".*ankle_roll.*": (0.1, 0.15),
    ".*ankle.*": (0.25, 0.35),
    ".*waist_roll.*": (0.08, 0.08),
    ".*waist_pitch.*": (0.1, 0.2),
    ".*waist_yaw.*|torso": (0.2, 0.3),
    ".*shoulder_pitch.*": (0.15, 0.5),
    ".*shoulder_roll.*": (0.15, 0.2),
    ".*shoulder_yaw.*": (0.1, 0.15),
    ".*elbow.*": (0.15, 0.35),
    ".*wrist.*": (0.3, 0.3),
}
"""How far the joints of a humanoid may stray from home while it walks, and while it runs (rad)."""


def memory(joints: int, feet: int) -> dict[str, int | tuple[int, ...]]:
    """Returns what a robot with so many actuated joints and feet remembers."""
    return {
        **commands.ROWS,
        **{"until_push": (), "bias": joints, "delay": ()},  # time until it (s); rad; control steps
        **{"last_action": joints, "earlier_actions": (MAX_DELAY - 1, joints)},  # the newest first
        **{"air_time": feet, "peak": feet},  # s; m
    }


class Velocity(Robot):
    """What robots that follow a velocity command share; a robot sets the attributes without a value.

    The command is a velocity forward and to the left (m/s) and a yaw rate (rad/s), drawn anew every 3 to 8 s. The base
    must have the first joint, a free one; actuators must be servos of joints with a range; the pose is kept around the
    keyframe ``home``. A robot also sets ``memory`` and ``randomize``, for which
    :func:`~torchrl_loco.tasks.velocity.memory`, :func:`~torchrl_loco.tasks.velocity.sliding`,
    :func:`~torchrl_loco.tasks.velocity.soft` and :func:`~torchrl_loco.tasks.velocity.com` make entries.

    Observation:
        ``observation``: linear and angular velocity of the base and gravity in its frame (9), joint positions relative
        to home, joint velocities, last action, command (3); with noise. ``privileged``: the same without noise, then
        height, time in the air, contact and contact force of the feet, and the delay of actions (control steps).

    Action:
        Changes of the joints' targets from home, scaled, without bounds; in each episode by a number of control steps
        late, up to :attr:`max_delay`.

    Reward:
        :meth:`terms` times :attr:`weights` and the control step.

    Start:
        At rest in the home pose, just above the ground, with any yaw.

    Termination:
        When the trunk is tilted by more than 70 degrees; truncation after 1000 steps.

    Source:
        mjlab 1.6.0, flat velocity task, where actions are never late.
    """

    config = SimConfig(ctrl_dt=0.02, sim_dt=0.005, iterations=10, ls_iterations=20)
    episode_length = 1000
    command_ranges = {"command": commands.first(CURRICULUM)}  # presets end before they widen
    presets = {
        "ppo": {
            "num_envs": 8192,
            "num_steps": 12,
            "total_frames": 120_000_000,
            "reward_scale": 1.0,
            "gamma": 0.99,
            "lr": 1e-3,
            "target_kl": 0.01,
            "epochs": 4,
            "minibatch_size": 24_576,
            "hidden": (512, 256, 128),
            "entropy_coeff": 0.01,
            "eval_interval": 20_000_000,
            "bf16": True,
        },
        "reppo": {
            "num_envs": 8192,
            "num_steps": 16,
            "total_frames": 30_000_000,
            "reward_scale": 10.0,
            "gamma": 0.97,
            "minibatch_size": 8192,
            "hidden": (512, 512),
            "min_value": -60.0,
            "max_value": 60.0,
            "bf16": True,
            "eval_interval": 10_000_000,
        },
    }

    holds: ClassVar[Mapping[str, Any]] = {"falls": 0.01, "delay": (0, 2), "friction": (0.4, 1.2), "pushes": 1.0}
    noise: ClassVar[Mapping[str, Any]] = {
        "linear_velocity": 0.5,  # m/s
        "angular_velocity": 0.2,  # rad/s
        "gravity": 0.05,
        "joint_positions": (0.01, "bias"),  # rad
        "joint_velocities": 1.5,  # rad/s
    }

    trunk: ClassVar[str]
    """Body that is to stay upright."""
    feet: ClassVar[Mapping[str, str]]
    """Sites of the feet, and a regular expression of the geoms of each."""
    stand: ClassVar[Mapping[str, float]]
    """How far joints may stray from home while the robot stands (rad), by regular expressions of their names."""
    walk: ClassVar[Mapping[str, float]]
    """The same while it walks."""
    run: ClassVar[Mapping[str, float]]
    """The same while it runs."""
    weights: ClassVar[Mapping[str, float]] = WEIGHTS
    """Weights of the reward's terms; that of ``angular_momentum`` needs a sensor ``subtreeangmom`` of this name."""
    curriculum: ClassVar[dict[int, commands.Ranges]] = CURRICULUM
    """Ranges of the commands by the control step of training from which they hold."""
    step_height: ClassVar[float] = 0.1
    """Height of a foot in mid-swing (m)."""
    longest_delay = MAX_DELAY
    max_delay: ClassVar[int] = 2
    """Greatest delay of an action in training (control steps), at most 3; ``verify`` delays by up to 2."""
    push_scale: ClassVar[float] = 1.0
    """Strength of the pushes in training, as a multiple of those of ``verify``."""

    table = ("base", "trunk", "feet", "stand", "walk", "run")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Lets sliders have the commands of its own curriculum."""
        super().__init_subclass__(**kwargs)
        owner = definer(cls, "curriculum")
        if owner is cls or not issubclass(owner, Velocity):  # which is mixed in
            commands.check(cls.curriculum)
            cls.command_ranges = {**cls.command_ranges, "command": commands.first(cls.curriculum)}

    @classmethod
    def check_class(cls) -> None:
        """Checks the table of the robot beside what :meth:`torchrl_loco.LocoEnv.check_class` does.

        Raises:
            TypeError: an attribute is missing, or has the wrong type.
            ValueError: ``max_delay`` is not 0, 1, 2 or 3, ``push_scale`` is negative, ``action_scale`` or
                ``step_height`` is not positive, or ``own_geoms`` are missing.
        """
        super().check_class()
        if not isinstance(cls.feet, Mapping):
            raise TypeError(f"feet of {cls.__name__} must be a dict from sites to geoms, got {cls.feet!r}")
        check_int(f"max_delay of {cls.__name__}", cls.max_delay, Interval(0, cls.longest_delay, with_high=True))
        check_float(f"push_scale of {cls.__name__}", cls.push_scale, NOT_NEGATIVE)
        check_float(f"step_height of {cls.__name__}", cls.step_height)
        if "self_collision" in cls.weights and not cls.own_geoms:
            raise ValueError(f"the weight of self_collision needs own_geoms of {cls.__name__}")

    @classmethod
    def faults(cls, m: mujoco.MjModel) -> list[str]:
        """Returns what is wrong with a model: also a floor elsewhere, a base that is not level, or shared feet."""
        wrong = super().faults(m)
        sensors = [m.sensor(i).name for i in range(m.nsensor) if m.sensor_type[i] == MOMENTUM]
        if "angular_momentum" in cls.weights and "angular_momentum" not in sensors:
            sensor = f'<subtreeangmom name="angular_momentum" body="{cls.base}"/>'
            wrong.append(f"the weight of angular_momentum needs {sensor}")
        level = (m.geom_type == PLANE) & (m.geom_bodyid == 0) & (np.abs(m.geom_quat[:, 1:3]) < 0.1).all(axis=1)
        if (np.abs(m.geom_pos[level, 2]) > 1e-6).any():
            wrong.append("its floor must be at height 0, from which feet are measured")
        floats = m.njnt > 0 and m.jnt_type[0] == FREE
        if floats and models.has_home(m) and not np.allclose(models.home_pose(m)[3:7], (1, 0, 0, 0)):
            wrong.append("the base must be level in 'home', with its x axis ahead: its quaternion must be 1 0 0 0")
        elements = Elements(m)
        feet = [geom for pattern in cls.feet.values() for geom in elements.ids("geom", pattern)[0]]
        if twice := [m.geom(geom).name for geom in feet if feet.count(geom) > 1]:
            wrong.append(f"each geom must be of one foot, but {twice[0]!r} is of several")
        if cls.memory.get("air_time") != len(cls.feet):
            wrong.append(f"memory is that of {cls.memory.get('air_time')} feet, but there are {len(cls.feet)}")
        return wrong

    # What hooks share.

    def stray(self, s: View, table: Mapping[str, float]) -> torch.Tensor:
        """Returns how far each joint may stray by a table of the class (rad), ``(joints,)``."""
        return torch.tensor([find(table, name) for name in self.joints], device=s.device)

    def touching(self, s: View) -> torch.Tensor:
        """Returns whether each foot touches something, bool ``(num_envs, feet)``."""
        return torch.stack([s.in_contact([geoms]).any(-1) for geoms in self.feet.values()], dim=-1)

    def forces(self, s: View) -> torch.Tensor:
        """Returns the contact force on each foot, world frame (N), ``(num_envs, feet, 3)``."""
        return torch.stack([s.contact_force([geoms]).sum(1) for geoms in self.feet.values()], dim=1)

    def heights(self, s: View) -> torch.Tensor:
        """Returns the heights of the feet (m), ``(num_envs, feet)``."""
        return s.site_xpos(list(self.feet))[..., 2]

    def seen(self, s: View) -> dict[str, torch.Tensor]:
        """Returns what a policy sees, without noise, by name, each ``(num_envs, n)``.

        Velocities and gravity are in the frame of the base (m/s, rad/s), joint positions relative to home (rad).
        """
        return {
            "linear_velocity": s.to_body(self.base, s.linvel(self.base)),
            "angular_velocity": s.to_body(self.base, s.angvel(self.base)),
            "gravity": s.projected_gravity(self.base),
            "joint_positions": s.joint_qpos(self.joints) - self.home(s),
            "joint_velocities": s.joint_qvel(self.joints),
            "last_action": s.last_action,
            "command": s.command,
        }

    @classmethod
    def facts(cls, m: mujoco.MjModel, info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns how actions become targets of the joints, and what commands the policy follows."""
        low, high = commands.reached(cls.curriculum, steps_of_training(info))
        velocity = {"base": cls.base, "trunk": cls.trunk, "command_low": low, "command_high": high}
        return {**super().facts(m, info), "velocity": velocity}

    @classmethod
    def stage_of(cls, info: Mapping[str, Any]) -> Mapping[str, Any]:
        """Returns the stage of the curriculum; files of earlier revisions tell it by the frames of their training."""
        return info.get("stage") or {"memory": {"trained": [float(steps_of_training(info))]}}

    @classmethod
    def fixed_commands(cls, info: Mapping[str, Any]) -> Mapping[str, Sequence[Sequence[float]]]:
        """Returns standing, each limit of the commands alone, and both limits of all together."""
        low, high = commands.reached(cls.curriculum, steps_of_training(info))
        alone = [[limit[k] if j == k else 0.0 for j in range(3)] for k in range(3) for limit in (high, low)]
        return {"command": [[0.0, 0.0, 0.0], *alone, high, low]}

    # The hooks, in the order in which they are called.

    def update(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the greatest height of each foot since it left the ground."""
        peak = torch.maximum(s.peak, self.heights(s))
        return {"peak": torch.where(self.touching(s), s.peak, peak)}

    def reward(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the terms of the reward: :meth:`terms` times their weights and the control step."""
        terms = self.terms(s)
        if terms.keys() != self.weights.keys():
            apart = ", ".join(sorted(terms.keys() ^ self.weights.keys()))
            raise ValueError(f"weights of {type(self).__name__} must name its terms, {', '.join(terms)}: see {apart}")
        return {name: self.weights[name] * s.dt * term for name, term in terms.items()}

    def terms(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the terms of the reward by name, each ``(num_envs,)``, before they are weighted."""
        seen = self.seen(s)
        linear, angular, stray, command = (
            seen[name] for name in ("linear_velocity", "angular_velocity", "joint_positions", "command")
        )
        speed = command[:, :2].norm(dim=-1) + command[:, 2].abs()
        moves, stands, runs = speed > STANDS, (speed < STANDS).unsqueeze(-1), (speed >= RUNS).unsqueeze(-1)
        walking = torch.where(runs, self.stray(s, self.run), self.stray(s, self.walk))
        spread = torch.where(stands, self.stray(s, self.stand), walking)
        touching, heights = self.touching(s), self.heights(s)
        landed = touching & (s.air_time > 0.0)
        slides = s.site_linvel(list(self.feet))[..., :2].square().sum(-1)
        terms = {
            "track_linear": torch.exp(-(squares((command - linear)[:, :2]) + linear[:, 2].square()) / 0.25),
            "track_angular": torch.exp(-((command - angular)[:, 2].square() + squares(angular[:, :2])) / 0.5),
            "upright": torch.exp(-squares(s.projected_gravity(self.trunk)[:, :2]) / 0.2),
            "pose": torch.exp(-(stray / spread).square().mean(-1)),
            "joint_limits": self.beyond_limits(s),
            "action_rate": squares(s.action - s.last_action),
            "foot_clearance": moves * ((heights - self.step_height).abs() * slides.sqrt()).sum(-1),
            "foot_swing_height": moves * (landed * (s.peak / self.step_height - 1.0).square()).sum(-1),
            "foot_slip": moves * (touching * slides).sum(-1),
            "soft_landing": moves * (landed * self.forces(s).norm(dim=-1)).sum(-1),
        }
        if "trunk_rotation" in self.weights:
            terms["trunk_rotation"] = squares(s.to_body(self.trunk, s.angvel(self.trunk))[:, :2])
        if "angular_momentum" in self.weights:
            terms["angular_momentum"] = squares(s.sensor("angular_momentum"))
        if "self_collision" in self.weights:
            terms["self_collision"] = hard_contacts(s, self.own_geoms)
        return terms

    def terminated(self, s: View) -> torch.Tensor:
        """Returns whether the trunk is tilted by more than 70 degrees."""
        return s.projected_gravity(self.trunk)[:, 2] > -UPSIDE

    def metrics(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the errors of horizontal velocity (m/s) and yaw rate (rad/s), once a command has settled."""
        seen, settled = self.seen(s), s.command_age >= SETTLING
        linear = (s.command - seen["linear_velocity"])[:, :2].norm(dim=-1)
        angular = (s.command - seen["angular_velocity"])[:, 2].abs()
        errors = {"linear_error": linear, "angular_error": angular}
        return {name: torch.where(settled, error, math.nan) for name, error in errors.items()}

    def events(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the command that holds next, the last action, how long feet are in the air, and pushes."""
        due, forward, touching = s.until_command <= 0.0, s.xmat(self.base)[:, :2, 0], self.touching(s)
        goes_on = {name: getattr(s, name) for name in ("command", "heading", "holds_heading")}
        goes_on |= {"until_command": s.until_command - s.dt, "command_age": s.command_age + s.dt}
        rows = either(due, commands.draw(s, self.curriculum), goes_on)
        return {
            **commands.turned(s, rows, torch.atan2(forward[:, 1], forward[:, 0]), self.curriculum),
            **({} if self.play else pushed(s, PUSH, self.push_scale)),
            "trained": s.trained + 1.0,
            "last_action": s.action,
            "earlier_actions": torch.cat([s.last_action.unsqueeze(1), s.earlier_actions[:, :-1]], dim=1),
            "air_time": torch.where(touching, 0.0, s.air_time + s.dt),
            "peak": torch.where(touching, 0.0, s.peak),
        }

    def observation(self, s: View) -> dict[str, dict[str, torch.Tensor]]:
        """Returns what the policy sees, and for the critic the same without noise and the feet."""
        seen, forces = self.seen(s), self.forces(s).flatten(1)
        hidden = {
            "foot_heights": self.heights(s),
            "air_time": s.air_time,
            "foot_contacts": self.touching(s).float(),
            "foot_forces": forces.sign() * torch.log1p(forces.abs()),
            "delay": s.delay,
        }
        return {"observation": seen, "privileged": {**seen, **hidden}}

    def begin(self, s: View) -> dict[str, torch.Tensor]:
        """Returns the home pose, somewhere within half a meter and just above the ground, and a command."""
        yaw, zero = s.uniform(-math.pi, math.pi), torch.zeros_like(s.home[:, 0])
        place = s.home[:, :2] + s.uniform(-0.5, 0.5, 2)
        height = s.home[:, 2:3] + s.uniform(*START_HEIGHT, 1)
        turn = torch.stack([(0.5 * yaw).cos(), zero, zero, (0.5 * yaw).sin()], dim=-1)
        return {
            **commands.turned(s, commands.draw(s, self.curriculum), yaw, self.curriculum),
            "qpos": torch.cat([place, height, turn, s.home[:, 7:]], dim=-1),
            "until_push": s.uniform(*PUSH_EVERY),
            "bias": s.uniform(-BIAS, BIAS, len(self.joints)),
            "delay": torch.zeros_like(yaw) if self.play else s.uniform(0.0, self.max_delay + 1.0).floor(),
            "trained": s.trained,  # it counts on over all episodes
        }


def steps_of_training(info: Mapping[str, Any]) -> int:
    """Returns after how many control steps of each world a policy was saved; of earlier revisions, on one GPU."""
    if trained := info.get("stage", {}).get("memory", {}).get("trained"):
        return int(min(trained))
    return int(info.get("frames", 0)) // int(info.get("num_envs", 1))


def find(table: Mapping[str, float], name: str) -> float:
    """Returns the entry of the first regular expression that matches a whole name."""
    for pattern, value in table.items():
        if re.fullmatch(pattern, name):
            return value
    raise KeyError(f"no entry for {name}: the expressions are {', '.join(table)}")


class Go1Velocity(Velocity):
    """A Unitree Go1, a quadruped of 12 kg, follows a velocity command."""

    body = "go1"
    model = FOLDER / "go1.xml"
    config = dataclasses.replace(Velocity.config, integrator="implicitfast")
    memory = memory(joints=12, feet=4)
    base = trunk = "trunk"
    feet = {leg: f"{leg}_foot_collision" for leg in LEGS}
    stand = {".*calf.*": 0.1, ".*": 0.05}
    walk = run = {".*calf.*": 0.6, ".*": 0.3}
    randomize = [sliding(".*_foot_collision", high=1.5), *soft(".*_foot_collision"), com("trunk")]


class Go2Velocity(Velocity):
    """A Unitree Go2, a quadruped of 15 kg, follows a velocity command."""

    body = "go2"
    model = FOLDER / "go2.xml"
    memory = memory(joints=12, feet=4)
    base = trunk = "base"
    feet = {f"{leg}_foot": leg for leg in ("FL", "FR", "RL", "RR")}
    action_scale = 0.3
    stand, walk, run = Go1Velocity.stand, Go1Velocity.walk, Go1Velocity.run
    randomize = [sliding("FL|FR|RL|RR", high=1.5), *soft("FL|FR|RL|RR"), com("base")]


class G1Velocity(Velocity):
    """A Unitree G1, a humanoid of 29 joints and 33 kg, follows a velocity command."""

    body = "g1"
    model = FOLDER / "g1.xml"
    config = dataclasses.replace(Velocity.config, integrator="implicitfast")
    memory = memory(joints=29, feet=2)
    base, trunk = "pelvis", "torso_link"
    feet = {side: rf"{side}\d_collision" for side in ("left_foot", "right_foot")}
    own_geoms = "(?!.*foot).*_collision"
    max_delay, push_scale = 3, 1.3  # more than `verify` asks for; it then falls a third as often
    presets = {
        **Velocity.presets,
        "ppo": {
            **Velocity.presets["ppo"],
            "total_frames": 420_000_000,
            "epochs": 3,
            "minibatch_size": 32_768,
            "entropy_coeff": 0.005,
        },
    }
    stand = {".*": 0.05}
    walk = {joints: walking for joints, (walking, _) in HUMANOID.items()}
    run = {joints: running for joints, (_, running) in HUMANOID.items()}
    weights = {**WEIGHTS, "trunk_rotation": -0.05, "angular_momentum": -0.02, "self_collision": -1.0}
    randomize = [sliding(r".*_foot\d_collision"), com("torso_link")]


class H1Velocity(Velocity):
    """A Unitree H1, a humanoid of 19 joints and 51 kg, follows a velocity command."""

    body = "h1"
    model = FOLDER / "h1.xml"
    config = dataclasses.replace(Velocity.config, sim_dt=0.004)
    memory = memory(joints=19, feet=2)
    base, trunk = "pelvis", "torso_link"
    feet = {side: rf"{side}\d" for side in ("left_foot", "right_foot")}
    action_scale = 0.25
    presets = {**Velocity.presets, "ppo": {**Velocity.presets["ppo"], "total_frames": 150_000_000}}
    stand, walk, run = G1Velocity.stand, G1Velocity.walk, G1Velocity.run
    weights = {**WEIGHTS, "trunk_rotation": -0.05}
    randomize = [sliding(r"floor|.*_foot\d"), com("torso_link")]
