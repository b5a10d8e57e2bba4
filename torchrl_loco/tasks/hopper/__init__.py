"""Hopper: a planar body on one leg that learns to stand and to hop."""

from pathlib import Path
from typing import Any

import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.episode import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, small_control, tolerance
from torchrl_loco.sim import fill
from torchrl_loco.sim.sampling import PlanarBody, draw_pitch_and_hinges

STAND_HEIGHT = wp.constant(0.6)  # height of the torso above the foot from which the hopper counts as standing (m)
MAX_HEIGHT = wp.constant(2.0)  # height up to which it counts as standing (m), more than its length


@wp.func
def hopper_reward(height: float, ctrl: wp.array[float], horizontal_velocity: float, target_speed: float):
    """Returns the reward and its factors: ``standing``, and ``hopping`` or, for a speed of 0, ``small_control``."""
    standing = tolerance(height, STAND_HEIGHT, MAX_HEIGHT)
    if target_speed > 0.0:
        factor = tolerance(horizontal_velocity, target_speed, wp.inf, target_speed / 2.0, Sigmoid.LINEAR, 0.5)
    else:
        factor = small_control(ctrl)
    return standing * factor, standing, factor


@wp.struct
class HopperInputs:
    """What observation and reward are computed from; a ``com`` is a center of mass in the frame of its body (m)."""

    torso: int
    torso_com: wp.vec3
    foot: int
    foot_com: wp.vec3
    torso_velocity: int
    touch_toe: int
    touch_heel: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    ctrl: wp.array2d[float]
    xpos: wp.array2d[wp.vec3]
    xmat: wp.array2d[wp.mat33]
    sensordata: wp.array2d[float]
    target_speed: float


@wp.func
def observe_hopper(world: int, inputs: HopperInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    torso_center = inputs.xpos[world, inputs.torso] + inputs.xmat[world, inputs.torso] * inputs.torso_com
    foot_center = inputs.xpos[world, inputs.foot] + inputs.xmat[world, inputs.foot] * inputs.foot_com

    k = observe_row(inputs.qpos[world], 1, observation, 0)  # without the position along x
    k = observe_row(inputs.qvel[world], 0, observation, k)
    observation[k] = wp.log(1.0 + inputs.sensordata[world, inputs.touch_toe])
    observation[k + 1] = wp.log(1.0 + inputs.sensordata[world, inputs.touch_heel])

    height = torso_center[2] - foot_center[2]
    horizontal_velocity = inputs.sensordata[world, inputs.torso_velocity]  # along x
    reward, standing, factor = hopper_reward(height, inputs.ctrl[world], horizontal_velocity, inputs.target_speed)
    terms[0] = standing
    terms[1] = factor
    return reward


class Hopper(LocoEnv):
    """What the hopper's two tasks share; they differ in ``target_speed`` (m/s, 0 to stand)."""

    body = "hopper"
    model = Path(__file__).with_name("hopper.xml")
    config = SimConfig(ctrl_dt=0.02, sim_dt=0.005, naconmax=50_000, njmax=50, iterations=4, ls_iterations=10)
    observation_size = 15
    observation_names = {"positions": 6, "velocities": 7, "touch": 2}
    term_names: tuple[str, ...] = ("standing", "small_control")
    target_speed = 0.0

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""
        model, data = self.mj_model, world.sim.data
        torso, foot = model.body("torso").id, model.body("foot").id
        sensors = {name: int(model.sensor(name).adr[0]) for name in ("torso_velocity", "touch_toe", "touch_heel")}
        return observe_hopper, fill(
            HopperInputs,
            data,
            torso=torso,
            torso_com=wp.vec3(*model.body_ipos[torso]),
            foot=foot,
            foot_com=wp.vec3(*model.body_ipos[foot]),
            target_speed=self.target_speed,
            **sensors,
        )

    def pose_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that draws pitch and hinges, and its inputs."""
        sim, pitch = world.sim, int(self.mj_model.joint("rooty").qposadr[0])
        return draw_pitch_and_hinges, fill(PlanarBody, sim.data, jnt_range=sim.model.jnt_range, pitch=pitch)


class HopperStand(Hopper):
    """Stand upright on one leg.

    Observation:
        15 numbers: height and pitch of the torso and the hinges, qpos[1:] (6, m and rad); qvel (7, m/s and rad/s); what
        toe and heel feel, as log(1 + N) of the contact forces (2).

    Action:
        4 numbers: torques of waist, hip, knee and ankle as a share of their gear, in [-1, 1]; clipped beyond.

    Reward:
        ``standing * small_control``, its two terms: ``standing`` is 1 where the torso's center of mass is 0.6 m to 2 m
        above the foot's, else 0, and
        ``small_control = (4 + mean(tolerance(action, margin 1, quadratic, value_at_margin 0))) / 5``.

    Start:
        At rest, pitch uniform in (-pi, pi), hinges uniform in their ranges.

    Termination:
        None by falling; truncation after 1000 steps; a world that is not finite ends with reward and observation 0.

    Source:
        dm_control ``suite/hopper.py``.
    """

    presets = {
        "reppo": {
            "total_frames": 60_000_000,
            "lr": 1e-3,
            "minibatch_size": 4096,
            "min_temperature": 1e-9,
            # The reward is sparse: noise held for two frames explores further, and more of a short episode is the fall
            # at its start, in which the hopper can still turn to a side from which it gets up.
            "action_repeat": 2,
            "reward_scale": 0.5,
            "episode_length": 100,
        }
    }


class HopperHop(Hopper):
    """Hop forward at 2 m/s or faster.

    As :class:`HopperStand`, but for the reward.

    Reward:
        ``standing * hopping``, its two terms, with ``standing`` as in :class:`HopperStand` and
        ``hopping = tolerance(speed, [2 m/s, inf), margin 1 m/s, linear, value_at_margin 0.5)``, the speed being the
        center of mass's along x.
    """

    target_speed = 2.0
    term_names = ("standing", "hopping")
    presets = {"reppo": {**HopperStand.presets["reppo"], "total_frames": 160_000_000}}
