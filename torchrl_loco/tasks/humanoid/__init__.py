"""Humanoid: 21 hinges on a free root, learning to stand, walk and run."""

from pathlib import Path
from typing import Any

import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.episode import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, small_control, tolerance
from torchrl_loco.sim import fill
from torchrl_loco.sim.sampling import FreePose, draw_free_pose, make_skeleton

STAND_HEIGHT = wp.constant(1.4)  # height of the head from which the humanoid counts as standing (m)

EXTREMITIES = ("left_hand", "left_foot", "right_hand", "right_foot")  # bodies whose position is observed, in order
ROOT_QPOS = wp.constant(7)  # numbers of qpos that place the root: position and quaternion; the hinges follow


@wp.func
def humanoid_reward(
    head_height: float, torso_upright: float, ctrl: wp.array[float], velocity: wp.vec3, target_speed: float
):
    """Returns the reward and its factors ``standing``, ``upright``, ``small_control`` and ``move``.

    A target speed of 0 asks for standing still.
    """
    standing = tolerance(head_height, STAND_HEIGHT, wp.inf, STAND_HEIGHT / 4.0)
    upright = tolerance(torso_upright, 0.9, wp.inf, 1.9, Sigmoid.LINEAR, 0.0)
    gentle = small_control(ctrl)
    if target_speed > 0.0:
        speed = wp.sqrt(velocity[0] * velocity[0] + velocity[1] * velocity[1])
        move = (5.0 * tolerance(speed, target_speed, wp.inf, target_speed, Sigmoid.LINEAR, 0.0) + 1.0) / 6.0
    else:
        move = 0.5 * (tolerance(velocity[0], 0.0, 0.0, 2.0) + tolerance(velocity[1], 0.0, 0.0, 2.0))
    return standing * upright * gentle * move, standing, upright, gentle, move


@wp.struct
class HumanoidInputs:
    """What observation and reward are computed from."""

    torso: int
    head: int
    extremities: wp.array[int]
    torso_velocity: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    ctrl: wp.array2d[float]
    xpos: wp.array2d[wp.vec3]
    xmat: wp.array2d[wp.mat33]
    sensordata: wp.array2d[float]
    target_speed: float


@wp.func
def observe_humanoid(world: int, inputs: HumanoidInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    head_height = inputs.xpos[world, inputs.head][2]
    torso_pos = inputs.xpos[world, inputs.torso]
    torso_mat = inputs.xmat[world, inputs.torso]
    sensors = inputs.sensordata[world]
    v = inputs.torso_velocity
    velocity = wp.vec3(sensors[v], sensors[v + 1], sensors[v + 2])

    k = observe_row(inputs.qpos[world], ROOT_QPOS, observation, 0)
    observation[k] = head_height
    k += 1
    for i in range(inputs.extremities.shape[0]):
        limb = wp.transpose(torso_mat) * (inputs.xpos[world, inputs.extremities[i]] - torso_pos)
        for j in range(3):
            observation[k + j] = limb[j]
        k += 3
    for j in range(3):
        observation[k + j] = torso_mat[2, j]
        observation[k + 3 + j] = velocity[j]
    k += 6
    k = observe_row(inputs.qvel[world], 0, observation, k)

    reward, standing, upright, gentle, move = humanoid_reward(
        head_height, torso_mat[2, 2], inputs.ctrl[world], velocity, inputs.target_speed
    )
    terms[0] = standing
    terms[1] = upright
    terms[2] = gentle
    terms[3] = move
    return reward


class Humanoid(LocoEnv):
    """What the humanoid's three tasks share; they differ in ``target_speed`` (m/s, 0 to stand)."""

    body = "humanoid"
    model = Path(__file__).with_name("humanoid.xml")
    config = SimConfig(ctrl_dt=0.025, sim_dt=0.005, naconmax=200_000, njmax=250, iterations=4, ls_iterations=8)
    observation_size = 67
    observation_names = {
        "joint_angles": 21,
        "head_height": 1,
        "extremities": 12,
        "torso_vertical": 3,
        "com_velocity": 3,
        "velocities": 27,
    }
    term_names = ("standing", "upright", "small_control", "move")
    target_speed = 0.0

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""
        model, data = self.mj_model, world.sim.data
        extremities = [model.body(name).id for name in EXTREMITIES]
        return observe_humanoid, fill(
            HumanoidInputs,
            data,
            torso=model.body("torso").id,
            head=model.body("head").id,
            extremities=wp.array(extremities, dtype=int, device=world.sim.device),
            torso_velocity=int(model.sensor("torso_velocity").adr[0]),
            target_speed=self.target_speed,
        )

    def pose_func(self, world: World) -> tuple[wp.Function, Any] | None:
        """Returns the function that draws a pose free of contact under ``dm_control``, else the default pose."""
        if self.protocol != "dm_control":
            return None
        sim = world.sim
        skeleton = make_skeleton(self.mj_model, sim.model.nxn_geom_pair_filtered.numpy(), sim.device)
        xquat = wp.empty(sim.data.xpos.shape, dtype=wp.quat, device=sim.device)
        return draw_free_pose, fill(FreePose, sim.data, skeleton=skeleton, xquat=xquat)


class HumanoidStand(Humanoid):
    """Stand still and upright.

    Observation:
        67 numbers: hinge angles, qpos[7:] (21, rad); head height (1, m); left hand, left foot, right hand and right
        foot relative to the torso, in its frame (12, m); the torso's z row of xmat (3); velocity of the torso
        subtree's center of mass (3, m/s); qvel (27, m/s and rad/s).

    Action:
        21 numbers: torques of the hinges as a share of their gear, in [-1, 1]; clipped beyond.

    Reward:
        ``standing * upright * small_control * move`` with
        ``standing = tolerance(head z, [1.4 m, inf), margin 0.35 m)``,
        ``upright = tolerance(torso zz, [0.9, inf), margin 1.9, linear, value_at_margin 0)``,
        ``small_control = (4 + mean(tolerance(action, margin 1, quadratic, value_at_margin 0))) / 5`` and
        ``move = mean(tolerance(vx, margin 2 m/s), tolerance(vy, margin 2 m/s))``. The four are the terms.

    Start:
        At rest; the default pose under ``playground``, a random one free of contact under ``dm_control``.

    Termination:
        None by falling; truncation after 1000 steps; a world that is not finite ends with reward and observation 0.

    Source:
        dm_control ``suite/humanoid.py``.
    """

    presets = {
        "reppo": {
            "total_frames": 80_000_000,
            "min_temperature": 1e-9,
            # A lower bound of the divergence's weight, which falls far near the best return: without one, three of six
            # runs of humanoid_walk broke down.
            "init_kl_weight": 0.02,
            "min_kl_weight": 0.02,
            # Most of the return is lost while the body gets up, which is much of a short episode.
            "episode_length": 100,
            "gamma": 0.98,
            "max_value": 75.0,
        }
    }


class HumanoidWalk(Humanoid):
    """Walk at 1 m/s or faster, in any direction.

    As :class:`HumanoidStand`, but for the reward.

    Reward:
        The last factor is ``move = (5 fast + 1) / 6`` with
        ``fast = tolerance(|v_xy|, [1 m/s, inf), margin 1 m/s, linear, value_at_margin 0)``.
    """

    target_speed = 1.0
    presets = {"reppo": {**HumanoidStand.presets["reppo"], "total_frames": 100_000_000, "bf16": True}}


class HumanoidRun(Humanoid):
    """Run at 10 m/s or faster, in any direction.

    As :class:`HumanoidWalk`, with target and margin of 10 m/s.
    """

    target_speed = 10.0
    presets = {"reppo": {"total_frames": 300_000_000, "episode_length": 200}}
