"""Independent formulas in float64: NumPy on top of C MuJoCo, sharing nothing with the package but its models."""

import json
from pathlib import Path

import mujoco
import numpy as np

DATA = Path(__file__).parent / "data"
SPEEDS = {
    "walker": {"stand": 0, "walk": 1, "run": 8},
    "humanoid": {"stand": 0, "walk": 1, "run": 10},
    "cheetah": {"run": 10},
    "hopper": {"stand": 0, "hop": 2},
    "quadruped": {"walk": 0.5, "run": 5},
}


FORCES = {"hopper": np.r_[13:15], "quadruped": np.r_[48:51, 54:78]}
"""By body, the entries of an observation that are forces or accelerations: of the last physics step, not of the state
after it."""


def arrays(name):
    """Returns the arrays of a recording in tests/data by name."""
    with np.load(DATA / f"{name}.npz") as file:
        return dict(file)


def without_forces(body, observation):
    """Returns the entries that follow from the state."""
    return np.delete(np.asarray(observation), FORCES.get(body, []), axis=-1)


def reference_model(body):
    return json.loads((DATA / f"{body}_model.json").read_text())


def recorded(task):
    """The rollout of a task that dm_control recorded: arrays of 192 control steps."""
    return arrays(f"{task}_dm_control")


def tolerance(x, lower=0.0, upper=0.0, margin=0.0, sigmoid="gaussian", value=0.1):
    x = np.asarray(x, dtype=np.float64)
    inside = (lower <= x) & (x <= upper)
    if margin == 0:
        return np.where(inside, 1.0, 0.0)
    d = np.where(x < lower, lower - x, x - upper) / margin
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if sigmoid == "gaussian":
            outside = np.exp(-0.5 * (d * np.sqrt(-2 * np.log(value))) ** 2)
        elif sigmoid == "hyperbolic":
            outside = 1 / np.cosh(d * np.arccosh(1 / value))
        elif sigmoid == "long_tail":
            outside = 1 / ((d * np.sqrt(1 / value - 1)) ** 2 + 1)
        elif sigmoid == "reciprocal":
            outside = 1 / (np.abs(d) * (1 / value - 1) + 1)
        elif sigmoid == "cosine":
            s = d * np.arccos(2 * value - 1) / np.pi
            outside = np.where(np.abs(s) < 1, (1 + np.cos(np.pi * s)) / 2, 0.0)
        elif sigmoid == "linear":
            s = d * (1 - value)
            outside = np.where(np.abs(s) < 1, 1 - s, 0.0)
        elif sigmoid == "quadratic":
            s = d * np.sqrt(1 - value)
            outside = np.where(np.abs(s) < 1, 1 - s**2, 0.0)
        elif sigmoid == "tanh_squared":
            outside = 1 - np.tanh(d * np.arctanh(np.sqrt(1 - value))) ** 2
        else:
            raise ValueError(sigmoid)
    return np.where(inside, 1.0, outside)


class Oracle:
    """Evaluates one task at given states with C MuJoCo in float64."""

    def __init__(self, task, path):
        self.body, self.goal = task.split("_")
        self.speed = SPEEDS[self.body][self.goal]
        self.model = mujoco.MjModel.from_xml_path(str(path))
        self.data = mujoco.MjData(self.model)

    def forward(self, qpos, qvel, act=0.0):
        self.data.qpos[:], self.data.qvel[:], self.data.act[:] = qpos, qvel, act
        mujoco.mj_forward(self.model, self.data)
        return self.data

    def observation(self, protocol, qpos, qvel, act=0.0):
        """Returns the observation of a state."""
        return np.array(getattr(self, f"_observe_{self.body}")(self.forward(qpos, qvel, act), protocol))

    def _observe_walker(self, d, protocol):
        mats = d.xmat[1:].reshape(-1, 3, 3)
        height = d.body("torso").xpos[2] if protocol == "dm_control" else mats[0, 2, 2]
        return [*mats[:, 0, [0, 2]].ravel(), height, *d.qvel]

    def _observe_humanoid(self, d, protocol):
        torso, mat = d.body("torso").xpos, d.body("torso").xmat.reshape(3, 3)
        limbs = ("left_hand", "left_foot", "right_hand", "right_foot")
        near = np.concatenate([(d.body(name).xpos - torso) @ mat for name in limbs])
        return [*d.qpos[7:], d.body("head").xpos[2], *near, *mat[2], *d.sensordata, *d.qvel]

    def _observe_cheetah(self, d, protocol):
        return [*d.qpos[1:], *d.qvel]

    def _observe_hopper(self, d, protocol):
        return [*d.qpos[1:], *d.qvel, *np.log1p(d.sensordata[3:])]

    def _observe_quadruped(self, d, protocol):
        accelerometer, gyro, velocimeter, forces = np.split(d.sensordata, [3, 6, 9])
        upright = d.body("torso").xmat[8]
        return [*d.qpos[7:], *d.qvel[6:], *d.act, *velocimeter, upright, *accelerometer, *gyro, *np.arcsinh(forces)]

    def reward(self, qpos, qvel, action):
        """Returns the reward of a state that the action led to."""
        return float(getattr(self, f"_reward_{self.body}")(self.forward(qpos, qvel), action))

    def _reward_walker(self, d, action):
        standing = tolerance(d.body("torso").xpos[2], 1.2, np.inf, 0.6)
        stand = (3 * standing + (1 + d.body("torso").xmat[8]) / 2) / 4
        if self.speed == 0:
            return stand
        move = tolerance(d.sensordata[0], self.speed, np.inf, self.speed / 2, "linear", 0.5)
        return stand * (5 * move + 1) / 6

    def _reward_humanoid(self, d, action):
        vx, vy, _ = d.sensordata
        standing = tolerance(d.body("head").xpos[2], 1.4, np.inf, 0.35)
        upright = tolerance(d.body("torso").xmat[8], 0.9, np.inf, 1.9, "linear", 0)
        control = (4 + tolerance(action, margin=1, sigmoid="quadratic", value=0).mean()) / 5
        if self.speed == 0:
            still = (tolerance(vx, margin=2) + tolerance(vy, margin=2)) / 2
            return standing * upright * control * still
        move = tolerance(np.hypot(vx, vy), self.speed, np.inf, self.speed, "linear", 0)
        return standing * upright * control * (5 * move + 1) / 6

    def _reward_cheetah(self, d, action):
        return tolerance(d.sensordata[0], 10, np.inf, 10, "linear", 0)

    def _reward_hopper(self, d, action):
        height = d.body("torso").xipos[2] - d.body("foot").xipos[2]
        standing = tolerance(height, 0.6, 2)
        if self.speed == 0:
            return standing * (4 + tolerance(action, margin=1, sigmoid="quadratic", value=0).mean()) / 5
        return standing * tolerance(d.sensordata[0], 2, np.inf, 1, "linear", 0.5)

    def _reward_quadruped(self, d, action):
        upright = tolerance(d.body("torso").xmat[8], 1, np.inf, 2, "linear", 0)
        return upright * tolerance(d.sensor("velocimeter").data[0], self.speed, np.inf, self.speed, "linear", 0.5)
