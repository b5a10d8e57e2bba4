"""Quadruped: four legs on a free torso, learning to walk and run."""

import warp as wp

from torchrl_loco import models
from torchrl_loco.config import DEFAULTS
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.kernels import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim.sampling import draw_orientation_above_floor, make_outline

WALK_SPEED = 0.5
"""Forward speed that counts as walking (m/s)."""
RUN_SPEED = 5.0
"""Forward speed that counts as running (m/s)."""
INCREMENT = 0.01
"""A start is raised in steps of this height until it is off the floor (m)."""

ROOT_QPOS = wp.constant(7)
"""Numbers of qpos that place the root: position and quaternion; the hinges follow."""
ROOT_QVEL = wp.constant(6)
"""Numbers of qvel that move the root."""
IMU = wp.constant(6)
"""Numbers of the accelerometer (m/s^2) and the gyroscope (rad/s)."""
FORCES = wp.constant(24)
"""Numbers of the forces at the toes (N), then of the torques (Nm)."""


@wp.func
def arcsinh(x: float) -> float:
    return wp.sign(x) * wp.log(wp.abs(x) + wp.sqrt(x * x + 1.0))


@wp.func
def quadruped_reward(torso_upright: float, forward_velocity: float, target_speed: float):
    """Returns the reward and its factors ``upright`` and ``move``."""
    upright = tolerance(torso_upright, 1.0, wp.inf, 2.0, Sigmoid.LINEAR, 0.0)
    move = tolerance(forward_velocity, target_speed, wp.inf, target_speed, Sigmoid.LINEAR, 0.5)
    return upright * move, upright, move


@wp.kernel(enable_backward=False)
def observe_and_reward_quadruped(
    # Model:
    torso: int,
    imu: int,
    velocimeter: int,
    force_torque: int,
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    act_in: wp.array2d[float],
    xmat_in: wp.array2d[wp.mat33],
    sensordata_in: wp.array2d[float],
    # In:
    target_speed: float,
    mask_in: wp.array[bool],
    # Out:
    observation_out: wp.array2d[float],
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
):
    world = wp.tid()
    if not mask_in[world]:
        return
    torso_upright = xmat_in[world, torso][2, 2]

    k = observe_row(qpos_in[world], ROOT_QPOS, observation_out[world], 0)
    k = observe_row(qvel_in[world], ROOT_QVEL, observation_out[world], k)
    k = observe_row(act_in[world], 0, observation_out[world], k)
    for i in range(3):
        observation_out[world, k + i] = sensordata_in[world, velocimeter + i]
    k += 3
    observation_out[world, k] = torso_upright
    k += 1
    for i in range(IMU):
        observation_out[world, k + i] = sensordata_in[world, imu + i]
    k += IMU
    for i in range(FORCES):
        observation_out[world, k + i] = arcsinh(sensordata_in[world, force_torque + i])

    forward_velocity = sensordata_in[world, velocimeter]  # along the torso's own x axis
    reward, upright, move = quadruped_reward(torso_upright, forward_velocity, target_speed)
    reward_out[world] = reward
    terms_out[world, 0] = upright
    terms_out[world, 1] = move


class Quadruped(LocoEnv):
    """What the quadruped's two tasks share; they differ in ``target_speed`` (m/s)."""

    body = "quadruped"
    mjcf = models.PATHS["quadruped"]
    defaults = DEFAULTS["quadruped"]
    observation_size = 78
    term_names = ("upright", "move")
    target_speed = WALK_SPEED

    def observation_kernel(self, world: World) -> tuple[wp.Kernel, list]:
        """Returns the kernel that writes observation and reward, and its inputs."""
        model, data = self.mj_model, world.sim.data
        first = (int(model.sensor(name).adr[0]) for name in ("imu_accel", "velocimeter", "force_toe_front_left"))
        arrays = [data.qpos, data.qvel, data.act, data.xmat, data.sensordata]
        return observe_and_reward_quadruped, [model.body("torso").id, *first, *arrays, self.target_speed]

    def pose_kernel(self, world: World) -> tuple[wp.Kernel, list, list]:
        """Returns the kernel that draws the orientation and raises the torso, its inputs and its outputs."""
        outline = make_outline(self.mj_model, world.sim.device)
        return draw_orientation_above_floor, [outline, INCREMENT], [world.sim.data.qpos]


class QuadrupedWalk(Quadruped):
    """Walk forward at 0.5 m/s or faster.

    Arguments as in :class:`~torchrl_loco.LocoEnv`.

    Observation:
        78 numbers: hinge angles (16, rad), their velocities (16, rad/s) and the actuators' activations (12); velocity
        of the torso in its own frame (3, m/s); torso zz (1); accelerometer (3, m/s^2) and gyroscope (3, rad/s) of the
        torso; arcsinh of the forces (12, N) and torques (12, Nm) at the toes front left, front right, back right and
        back left.

    Action:
        12 numbers in [-1, 1], clipped beyond, scaled to the actuators' control ranges: for each leg a set point of its
        yaw, its lift and its extension, which activations approach with a time constant of 0.1 s.

    Reward:
        ``upright * move``, its two terms: ``upright = (1 + torso zz) / 2`` and
        ``move = tolerance(speed, [0.5 m/s, inf), margin 0.5 m/s, linear, value_at_margin 0.5)``, the speed being the
        torso's along its own x axis.

    Start:
        At rest with straight hinges, in any orientation, just above the ground.

    Termination:
        None by falling; truncation after 1000 steps; a non-finite world is terminated with reward 0 and a
        zero observation.

    Source:
        dm_control ``suite/quadruped.py``.
    """


class QuadrupedRun(Quadruped):
    """Run forward at 5 m/s or faster.

    As :class:`QuadrupedWalk`, with target and margin of 5 m/s.
    """

    target_speed = RUN_SPEED
