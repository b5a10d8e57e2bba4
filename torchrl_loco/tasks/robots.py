"""What tasks of robots share, whether they follow commands or motions."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch

from torchrl_loco.checks import Interval, check_float, check_int
from torchrl_loco.conditions import PUSH_EVERY
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.task import definer
from torchrl_loco.envs.vary import Vary
from torchrl_loco.envs.view import View
from torchrl_loco.sim import models

FREE, JOINT = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtTrn.mjTRN_JOINT)
FIXED, AFFINE = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_AFFINE)
INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
HARD_CONTACT = 10.0  # force from which a contact of the robot with itself counts (N)


class Robot(LocoEnv):
    """What robots share whose base floats, and whose actions are changes of their joints' targets from home, scaled.

    Actuators are servos of joints.
    """

    action_range = (-math.inf, math.inf)

    base: ClassVar[str]
    """Body that floats."""
    action_scale: ClassVar[float | None] = None
    """Change of a joint's target by an action of 1 (rad); ``None`` is a quarter of what needs the greatest torque."""
    longest_delay: ClassVar[int] = 0
    """Control steps by which :meth:`control` can hold an action back, as ``delay`` of :attr:`memory` says."""
    own_geoms: ClassVar[str] = ""
    """Regular expression of the geoms of which ``self_collision`` counts the contacts."""
    table: ClassVar[Sequence[str]] = ("base",)
    """Attributes that a robot must set beside what every task does."""

    @classmethod
    def check_class(cls) -> None:
        """Checks the table of the robot beside what :meth:`torchrl_loco.LocoEnv.check_class` does."""
        if missing := [name for name in cls.table if not hasattr(cls, name)]:
            of = definer(cls, "table").__name__
            raise TypeError(f"{cls.__name__} must set {', '.join(missing)}: see help(torchrl_loco.{of})")
        super().check_class()
        if cls.action_scale is not None:
            check_float(f"action_scale of {cls.__name__}", cls.action_scale)
        for delay in cls.holds.get("delay", ()):
            check_int(
                f"the delay that holds names of {cls.__name__}", delay, Interval(0, cls.longest_delay, with_high=True)
            )

    @classmethod
    def check_model(cls, mj_model: mujoco.MjModel) -> None:
        """Raises ValueError for :meth:`faults` of a model, which the formulas take for granted not to be there."""
        if wrong := cls.faults(mj_model):
            raise ValueError(f"the model of {cls.__name__} does not do for this task: {'; '.join(wrong)}")

    @classmethod
    def faults(cls, m: mujoco.MjModel) -> list[str]:
        """Returns what is wrong with a model, in words; nothing if it will do.

        The base must float first, actuators must be servos with a greatest force, their joints must have a range with
        the home pose in it, and there must be as many actuators as :attr:`memory` says.
        """
        wrong = []
        if m.njnt == 0 or m.jnt_type[0] != FREE or m.body(m.jnt_bodyid[0]).name != cls.base:
            wrong.append(f"its first joint must be a free joint of the base {cls.base!r}")
        of_joint = (m.actuator_trntype == JOINT) & (m.actuator_gaintype == FIXED) & (m.actuator_biastype == AFFINE)
        gain, stiffness = m.actuator_gainprm[:, 0], -m.actuator_biasprm[:, 1]
        servo = of_joint & (gain > 0) & np.isclose(gain, stiffness) & (m.actuator_biasprm[:, 0] == 0)
        servo &= (m.actuator_gear[:, 0] == 1) & (m.actuator_dyntype != INTEGRATOR)
        names = [m.actuator(i).name or f"number {i}" for i in range(m.nu)]
        if not servo.all() or m.nu == 0:
            of = some(names, ~servo)
            wrong.append(f"actuators must be servos of gear 1, as a spec's set_to_position(kp) makes them{of}")
        strong = m.actuator_forcelimited.astype(bool) & (m.actuator_forcerange[:, 1] > 0)
        if cls.action_scale is None and not strong.all():
            wrong.append(f"actuators need a forcerange, or {cls.__name__} an action_scale{some(names, ~strong)}")
        if servo.all():
            joints = m.actuator_trnid[:, 0]
            home, (low, high) = models.home_pose(m)[m.jnt_qposadr[joints]], m.jnt_range[joints].T
            free = m.jnt_limited[joints] == 0
            outside = ~free & ((home < low) | (home > high))
            for said, which in (("joints need a range", free), ("'home' is beyond the range of joints", outside)):
                wrong += [f"{said}{some(actuated(m), which)}"] if which.any() else []
        if not models.has_home(m):
            wrong.append("it needs a keyframe 'home', the pose around which actions move the joints")
        if cls.memory.get("last_action") != m.nu:
            wrong.append(f"memory is that of {cls.memory.get('last_action')} joints, but it has {m.nu} actuators")
        return wrong

    @property
    def joints(self) -> list[str]:
        """Names of the actuated joints, in the order of the actuators."""
        return actuated(self.mj_model)

    @classmethod
    def facts(cls, m: mujoco.MjModel, info: Mapping[str, Any]) -> dict[str, Any]:
        """Returns how actions become targets of the joints (rad): ``action_offset + action_scale * action``."""
        home = models.home_pose(m)[[int(m.joint(name).qposadr[0]) for name in actuated(m)]].tolist()
        scale = np.full(m.nu, cls.action_scale or 0.0)
        if cls.action_scale is None:
            scale = 0.25 * m.actuator_forcerange[:, 1] / m.actuator_gainprm[:, 0]
        return {"action_offset": home, "action_scale": scale.tolist()}

    def home(self, s: View) -> torch.Tensor:
        """Returns the joint positions of the home pose (rad), ``(num_envs, joints)``."""
        return s.home[:, [int(self.mj_model.joint(name).qposadr[0]) for name in self.joints]]

    def limits(self, s: View) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns the least and greatest positions of the joints (rad), each ``(num_envs, joints)``."""
        low, high = s.model("jnt_range")[:, [self.mj_model.joint(name).id for name in self.joints]].unbind(-1)
        return low, high

    def beyond_limits(self, s: View) -> torch.Tensor:
        """Returns how far the joints are beyond 0.9 of their ranges (rad), summed, ``(num_envs,)``."""
        low, high = self.limits(s)
        beyond = (s.joint_qpos(self.joints) - 0.5 * (low + high)).abs() - 0.45 * (high - low)
        return beyond.clamp(min=0.0).sum(-1)

    def control(self, s: View, action: torch.Tensor) -> torch.Tensor:
        """Returns the targets of the joints (rad): the home pose and a multiple of the action that arrives.

        That is the one of ``s.delay`` control steps ago; ``earlier_actions`` go on from ``last_action``, newest first.
        """
        earlier = [s.last_action] if self.longest_delay else []
        earlier += s.earlier_actions.unbind(1) if self.longest_delay > 1 else ()
        for steps, before in enumerate(earlier, start=1):
            action = torch.where(s.delay.unsqueeze(-1) < steps, action, before)
        if self.action_scale is not None:
            return self.home(s) + self.action_scale * action
        m = self.mj_model  # an action means the same in all worlds, whatever their gains are
        limit, gain = (np.float32(numbers) for numbers in (m.actuator_forcerange[:, 1], m.actuator_gainprm[:, 0]))
        return self.home(s) + torch.tensor((np.float32(0.25) * limit / gain).tolist(), device=s.device) * action


def some(names: Sequence[str], which: np.ndarray) -> str:
    """Returns the names of the first elements of a mask, for a message."""
    chosen = [name for name, yes in zip(names, which, strict=True) if yes]
    return f": {', '.join(chosen[:3])}{f' and {len(chosen) - 3} more' if len(chosen) > 3 else ''}" if chosen else ""


def actuated(m: mujoco.MjModel) -> list[str]:
    """Returns the names of a model's actuated joints, in the order of the actuators."""
    return [m.joint(int(joint)).name for joint in m.actuator_trnid[:, 0]]


def com(trunk: str) -> Vary:
    """Returns how the center of mass of a trunk differs from world to world (m)."""
    return Vary("body_ipos", (-0.025, -0.025, -0.03), (0.025, 0.025, 0.03), of=trunk, how="add", once=True)


def sliding(geoms: str, low: float = 0.3, high: float = 1.2) -> Vary:
    """Returns how the sliding friction of geoms, alike for all of them, differs from world to world."""
    return Vary("geom_friction", low, high, of=geoms, how="set", once=True)


def soft(geoms: str) -> list[Vary]:
    """Returns how torsional and rolling friction of round feet (m) differ from world to world."""
    ranges = {1: (1e-4, 2e-2), 2: (1e-5, 5e-3)}
    settings: dict[str, Any] = {"of": geoms, "how": "set", "log": True, "once": True}
    return [Vary("geom_friction", *bounds, component=k, **settings) for k, bounds in ranges.items()]


def squares(values: torch.Tensor) -> torch.Tensor:
    """Returns the sum of the squares of each row, ``(num_envs,)``."""
    return values.square().sum(-1)


def either(
    mask: torch.Tensor, new: Mapping[str, torch.Tensor], old: Mapping[str, torch.Tensor]
) -> dict[str, torch.Tensor]:
    """Returns rows by name: the new ones in the worlds of a mask ``(num_envs,)``, else the old ones."""
    return {name: torch.where(mask.view(-1, *[1] * (row.ndim - 1)), row, old[name]) for name, row in new.items()}


def hard_contacts(s: View, geoms: str) -> torch.Tensor:
    """Returns in how many physics steps one of some geoms had a hard contact, ``(num_envs,)``."""
    hard = s.contact_force([geoms], history=True).norm(dim=-1) > HARD_CONTACT
    return hard.any(-1).float().sum(-1)


def pushed(s: View, greatest: Sequence[float], scale: float = 1.0) -> dict[str, torch.Tensor]:
    """Returns velocities, which a push changes every 1 to 3 s, and ``until_push``, the time until the next (s)."""
    push = s.until_push <= 0.0
    change = scale * s.uniform(-1.0, 1.0, 6) * torch.tensor(greatest, device=s.device)
    base = s.qvel[:, :6] + torch.where(push.unsqueeze(-1), change, 0.0)
    until_push = torch.where(push, s.uniform(*PUSH_EVERY), s.until_push - s.dt)
    return {"qvel": torch.cat([base, s.qvel[:, 6:]], dim=-1), "until_push": until_push}
