"""Writes the motions of the package: squats with a wave, side steps with a bow, punches.

PYTHONPATH=docs python -m generate.motions

Each is a script of keyframes: where the pelvis and the feet are, and what the upper body does. Between two keyframes
everything moves with the least jerk; the legs follow by inverse kinematics.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.envs.task import folder_of
from torchrl_loco.motion import PENETRATES, lowest_points, poses
from torchrl_loco.sim import models
from torchrl_loco.tasks.tracking import FOLDER, G1Tracking, H1Tracking, Tracking

RATE = 25
"""Frames per second of the files."""
SIDES = {"left": 1.0, "right": -1.0}
SWING = 0.07
"""Height of a foot in the middle of a step (m)."""

LEAN, SHIFT = 0.08, 0.8
"""How far the pelvis moves over the foot that carries (m), and how long it takes (s)."""

Keys = list[tuple[float, float]]
"""Times (s) and values."""


@dataclasses.dataclass(frozen=True)
class Robot:
    """What the scripts must know of a robot.

    Attributes:
        task: its task.
        foot: body of a foot, without the side.
        joints: names of joints by what the scripts call them, without the side.
        arms: angles (rad) at which a left arm hangs, is before the chest, is stretched forward, and is up.
        bows: joint that bows; without one the pelvis does.
    """

    task: type[Tracking]
    foot: str
    joints: Mapping[str, str]
    arms: Mapping[str, tuple[float, float, float, float]]
    turns: str
    bows: str = ""


ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
ROBOTS = {
    "g1": Robot(
        G1Tracking,
        "ankle_roll_link",
        {name: f"{name}_joint" for name in ARM},
        {
            "hang": (0.2, 0.2, 0.0, 0.6),
            "guard": (-0.3, 0.25, 0.0, -0.6),
            "punch": (-1.4, 0.1, 0.0, 1.35),
            "up": (-0.4, 1.9, 0.0, 0.9),
        },
        "waist_yaw_joint",
        "waist_pitch_joint",
    ),
    "h1": Robot(
        H1Tracking,
        "ankle_link",
        {name: name for name in ARM},
        {
            "hang": (0.2, 0.15, 0.0, 0.3),
            "guard": (-0.2, 0.2, 0.0, -0.8),
            "punch": (-1.4, 0.1, 0.0, 1.2),
            "up": (-0.4, 1.9, 0.0, 0.6),
        },
        "torso",
    ),
}


class Script:
    """Keyframes of named channels; a channel without any is 0.

    Args:
        seconds: length of the motion.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._keys: dict[str, Keys] = {}

    def key(self, t: float, **values: float) -> None:
        """Has channels reach values at a time (s)."""
        for name, value in values.items():
            self._keys.setdefault(name, [(0.0, 0.0)]).append((t, value))

    def hold(self, t: float, *names: str) -> None:
        """Has channels stay as they are until a time (s)."""
        for name in names:
            self.key(t, **{name: self._keys.get(name, [(0.0, 0.0)])[-1][1]})

    def arm(self, t: float, side: str, pose: str) -> None:
        """Has an arm reach a pose at a time (s), beginning where it was before."""
        self._keys.setdefault(f"{side}:{pose}", [(0.0, 0.0)])
        for name in [name for name in self._keys if name.startswith(f"{side}:")]:
            self.key(t, **{name: float(name == f"{side}:{pose}")})

    def step(self, t: float, side: str, to: float, swing: float = 0.6) -> None:
        """Has a foot step sideways (m from where it stood at first), from ``t`` on, while the other one carries."""
        other = -SIDES[side]
        self.key(t, shift=self._value("shift"), **{f"{side}_y": self._value(f"{side}_y"), f"{side}_z": 0.0})
        carried = self._value(f"{'left' if other > 0 else 'right'}_y") + other * LEAN
        self.key(t + SHIFT, shift=carried, **{f"{side}_y": self._value(f"{side}_y"), f"{side}_z": 0.0})
        self.key(t + SHIFT + 0.5 * swing, **{f"{side}_z": SWING})
        self.key(t + SHIFT + swing, shift=carried, **{f"{side}_y": to, f"{side}_z": 0.0})

    def _value(self, name: str) -> float:
        return self._keys.get(name, [(0.0, 0.0)])[-1][1]

    def at(self, t: float) -> dict[str, float]:
        """Returns the value of each channel at a time (s)."""
        found = {}
        for name, keys in self._keys.items():
            keys = sorted(keys, key=lambda key: key[0])
            after = next((k for k, (at, _) in enumerate(keys) if at > t), None)
            if after is None:
                found[name] = keys[-1][1]
                continue
            (t0, one), (t1, other) = keys[after - 1], keys[after]
            s = (t - t0) / (t1 - t0)
            found[name] = one + (other - one) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        return found


def squat_and_wave() -> Script:
    """Returns two squats, then a wave with the right arm."""
    script = Script(8.0)
    for t in (0.5, 2.5):
        script.key(t, down=0.0)
        script.key(t + 0.9, down=0.16)
        script.key(t + 1.8, down=0.0)
    script.arm(4.5, "right", "hang")
    script.arm(5.3, "right", "up")
    script.key(5.3, wave=0.0)
    for k in range(4):
        script.key(5.55 + 0.35 * k, wave=0.45 * (-1.0) ** k)
    script.key(7.0, wave=0.0)
    script.arm(7.0, "right", "up")
    script.arm(7.8, "right", "hang")
    return script


def side_steps_and_bow() -> Script:
    """Returns two steps to the left, two back, and a bow."""
    script, width = Script(10.5), 0.15
    script.key(0.4, down=0.07)
    t = 0.4
    for side, to in (("left", width), ("right", width), ("right", 0.0), ("left", 0.0)):
        script.step(t, side, to)
        t += SHIFT + 0.75
    script.hold(t, "down", "shift")
    script.key(t + 0.6, down=0.0, shift=0.0)
    script.key(t + 1.0, bow=0.0)
    script.key(t + 1.8, bow=0.6)
    script.key(t + 2.3, bow=0.6)
    script.key(t + 3.1, bow=0.0)
    return script


def punches() -> Script:
    """Returns the guard, and six punches, left and right in turn."""
    script = Script(7.0)
    script.key(0.2, down=0.0)
    script.key(0.9, down=0.07)
    for side in SIDES:
        script.arm(0.2, side, "hang")
        script.arm(0.9, side, "guard")
    for k in range(6):
        t, side = 1.2 + 0.75 * k, "left" if k % 2 == 0 else "right"
        script.arm(t, side, "guard")
        script.key(t, turn=0.0)
        script.arm(t + 0.28, side, "punch")
        script.key(t + 0.28, turn=-0.35 * SIDES[side])
        script.arm(t + 0.65, side, "guard")
        script.key(t + 0.65, turn=0.0)
    for side in SIDES:
        script.arm(5.9, side, "guard")
        script.arm(6.7, side, "hang")
    script.hold(5.9, "down")
    script.key(6.7, down=0.0)
    return script


SCRIPTS = {"squat_and_wave": squat_and_wave, "side_steps_and_bow": side_steps_and_bow, "punches": punches}


class Body:
    """Poses of a robot that stands on its feet.

    Args:
        robot: the robot.
    """

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.m = models.load(robot.task.model, folder_of(robot.task))
        self.d = mujoco.MjData(self.m)
        self.d.qpos[:] = models.home_pose(self.m)
        mujoco.mj_kinematics(self.m, self.d)
        self.home = self.d.qpos.copy()
        self.feet = {side: self.m.body(f"{side}_{robot.foot}").id for side in SIDES}
        self.places = {side: self.d.xpos[foot].copy() for side, foot in self.feet.items()}

    def pose(self, values: Mapping[str, float]) -> np.ndarray:
        """Returns the pose of a script's channels, ``(nq,)``."""
        value: Any = lambda name: values.get(name, 0.0)  # noqa: E731
        d, robot = self.d, self.robot
        bow = value("bow")
        d.qpos[:3] = self.home[:3] + np.array([-0.06 * bow, value("shift"), -value("down")])
        d.qpos[3:7] = (np.cos(0.1 * bow), 0.0, np.sin(0.1 * bow), 0.0) if robot.bows else self._pitch(0.7 * bow)
        self._set(robot.turns, value("turn"))
        if robot.bows:
            self._set(robot.bows, 0.8 * bow)
        for side, sign in SIDES.items():
            poses = {name: value(f"{side}:{name}") for name in robot.arms}
            poses["hang"] += 1.0 - sum(poses.values())
            wave = np.array([0.0, 0.0, value("wave") if side == "right" else 0.0, 0.0])
            angles = wave + sum(share * np.array(robot.arms[name]) for name, share in poses.items())
            for name, angle, mirrored in zip(ARM, angles, (1.0, sign, sign, 1.0), strict=True):
                self._set(f"{side}_{robot.joints[name]}", mirrored * angle)
            place = self.places[side] + np.array([0.0, value(f"{side}_y"), value(f"{side}_z")])
            self._follow(side, place)
        return d.qpos.copy()

    def _pitch(self, angle: float) -> tuple[float, float, float, float]:
        return np.cos(0.5 * angle), 0.0, np.sin(0.5 * angle), 0.0

    def _set(self, joint: str, angle: float) -> None:
        low, high = self.m.joint(joint).range
        self.d.joint(joint).qpos[:] = np.clip(angle, low, high)

    def _follow(self, side: str, place: np.ndarray) -> None:
        """Has a leg put its foot flat at a place, by damped least squares."""
        m, d, foot = self.m, self.d, self.feet[side]
        joints = [j for j in range(m.njnt) if m.joint(j).name.startswith(side) and _leads_to(m, j, foot)]
        dofs, adrs = m.jnt_dofadr[joints], m.jnt_qposadr[joints]
        jac = np.zeros((6, m.nv))
        for _ in range(50):
            mujoco.mj_kinematics(m, d)
            mujoco.mj_comPos(m, d)
            mujoco.mj_jacBody(m, d, jac[:3], jac[3:], foot)
            mat = d.xmat[foot].reshape(3, 3)
            tilt = 0.5 * np.cross(mat.T, np.eye(3)).sum(0)
            error = np.concatenate([place - d.xpos[foot], 0.3 * tilt])
            if np.abs(error).max() < 1e-5:
                break
            part = jac[:, dofs] * np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])[:, None]
            d.qpos[adrs] += part.T @ np.linalg.solve(part @ part.T + 1e-4 * np.eye(6), error)
            d.qpos[adrs] = d.qpos[adrs].clip(*m.jnt_range[joints].T)


def _leads_to(m: mujoco.MjModel, joint: int, body: int) -> bool:
    """Returns whether a joint moves a body."""
    while body:
        if body == m.jnt_bodyid[joint]:
            return True
        body = m.body_parentid[body]
    return False


def main() -> None:
    """Writes a CSV file of each motion of each robot."""
    for name, robot in ROBOTS.items():
        for motion, script in SCRIPTS.items():
            body, written = Body(robot), script()
            rows = np.array([body.pose(written.at(t)) for t in np.arange(0.0, written.seconds, 1.0 / RATE)])
            lowest = lowest_points(body.m, *poses(body.m, rows))
            rows[:, 2] -= lowest.min() + PENETRATES
            rows = rows[:, [0, 1, 2, 4, 5, 6, 3, *range(7, rows.shape[1])]]
            path = FOLDER / name / f"{motion}.csv"
            path.parent.mkdir(exist_ok=True)
            np.savetxt(path, rows, fmt="%.4g", delimiter=",")
            print(path, f"{len(rows)} frames, {path.stat().st_size / 1024:.0f} KB")


if __name__ == "__main__":
    main()
