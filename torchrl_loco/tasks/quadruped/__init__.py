"""Quadruped: four legs on a free torso, learning to walk and run."""

from pathlib import Path
from typing import Any

import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.episode import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim import fill
from torchrl_loco.sim.sampling import RootAboveFloor, draw_orientation_above_floor, make_outline

INCREMENT = 0.01  # a start is raised in steps of this height until it is off the floor (m)

ROOT_QPOS = wp.constant(7)  # numbers of qpos that place the root: position and quaternion; the hinges follow
ROOT_QVEL = wp.constant(6)  # numbers of qvel that move the root
IMU = wp.constant(6)  # numbers of the accelerometer (m/s^2) and the gyroscope (rad/s)
FORCES = wp.constant(24)  # numbers of the forces at the toes (N), then of the torques (Nm)


@wp.func
def arcsinh(x: float) -> float:
    return wp.sign(x) * wp.log(wp.abs(x) + wp.sqrt(x * x + 1.0))


@wp.func
def quadruped_reward(torso_upright: float, forward_velocity: float, target_speed: float):
    """Returns the reward and its factors ``upright`` and ``move``."""
    upright = tolerance(torso_upright, 1.0, wp.inf, 2.0, Sigmoid.LINEAR, 0.0)
    move = tolerance(forward_velocity, target_speed, wp.inf, target_speed, Sigmoid.LINEAR, 0.5)
    return upright * move, upright, move


@wp.struct
class QuadrupedInputs:
    """What observation and reward are computed from."""

    torso: int
    imu: int
    velocimeter: int
    force_torque: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    act: wp.array2d[float]
    xmat: wp.array2d[wp.mat33]
    sensordata: wp.array2d[float]
    target_speed: float


@wp.func
def observe_quadruped(
    world: int, inputs: QuadrupedInputs, observation: wp.array[float], terms: wp.array[float]
) -> float:
    torso_upright = inputs.xmat[world, inputs.torso][2, 2]
    sensors = inputs.sensordata[world]

    k = observe_row(inputs.qpos[world], ROOT_QPOS, observation, 0)
    k = observe_row(inputs.qvel[world], ROOT_QVEL, observation, k)
    k = observe_row(inputs.act[world], 0, observation, k)
    for i in range(3):
        observation[k + i] = sensors[inputs.velocimeter + i]
    k += 3
    observation[k] = torso_upright
    k += 1
    for i in range(IMU):
        observation[k + i] = sensors[inputs.imu + i]
    k += IMU
    for i in range(FORCES):
        observation[k + i] = arcsinh(sensors[inputs.force_torque + i])

    forward_velocity = sensors[inputs.velocimeter]  # along the torso's own x axis
    reward, upright, move = quadruped_reward(torso_upright, forward_velocity, inputs.target_speed)
    terms[0] = upright
    terms[1] = move
    return reward


class Quadruped(LocoEnv):
    """What the quadruped's two tasks share; they differ in ``target_speed`` (m/s)."""

    body = "quadruped"
    model = Path(__file__).with_name("quadruped.xml")
    config = SimConfig(
        ctrl_dt=0.02,
        sim_dt=0.005,
        naconmax=50_000,
        njmax=100,
        iterations=4,
        ls_iterations=10,
        euler_damping=True,  # its hinges are damped so strongly that without it a control step errs by 0.01 rad
    )
    observation_size = 78
    observation_names = {
        "joint_angles": 16,
        "joint_velocities": 16,
        "activations": 12,
        "torso_velocity": 3,
        "upright": 1,
        "imu": 6,
        "foot_forces": 24,
    }
    term_names = ("upright", "move")
    target_speed = 0.5

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""
        model, data = self.mj_model, world.sim.data
        return observe_quadruped, fill(
            QuadrupedInputs,
            data,
            torso=model.body("torso").id,
            imu=int(model.sensor("imu_accel").adr[0]),
            velocimeter=int(model.sensor("velocimeter").adr[0]),
            force_torque=int(model.sensor("force_toe_front_left").adr[0]),
            target_speed=self.target_speed,
        )

    def pose_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that draws the orientation and raises the torso, and its inputs."""
        outline = make_outline(self.mj_model, world.sim.device)
        return draw_orientation_above_floor, fill(RootAboveFloor, world.sim.data, outline=outline, increment=INCREMENT)


class QuadrupedWalk(Quadruped):
    """Walk forward at 0.5 m/s or faster.

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
        None by falling; truncation after 1000 steps; a world that is not finite ends with reward and observation 0.

    Source:
        dm_control ``suite/quadruped.py``.
    """

    presets = {"reppo": {"total_frames": 30_000_000, "lr": 1e-3, "minibatch_size": 4096, "min_temperature": 1e-9}}


class QuadrupedRun(Quadruped):
    """Run forward at 5 m/s or faster.

    As :class:`QuadrupedWalk`, with target and margin of 5 m/s.
    """

    target_speed = 5.0
    presets = {"reppo": {**QuadrupedWalk.presets["reppo"], "total_frames": 50_000_000}}
