"""Hopper: a planar body on one leg that learns to stand and to hop."""

import warp as wp

from torchrl_loco import models
from torchrl_loco.config import DEFAULTS
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.kernels import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, small_control, tolerance
from torchrl_loco.sim.sampling import draw_pitch_and_hinges

STAND_HEIGHT = wp.constant(0.6)
"""Height of the torso above the foot from which the hopper counts as standing (m)."""
MAX_HEIGHT = wp.constant(2.0)
"""Height up to which it counts as standing (m), more than its length."""
HOP_SPEED = 2.0
"""Horizontal speed that counts as hopping (m/s)."""


@wp.func
def hopper_reward(height: float, ctrl: wp.array[float], horizontal_velocity: float, target_speed: float):
    """Returns the reward and its factors: ``standing``, and ``hopping`` or, for a speed of 0, ``small_control``."""
    standing = tolerance(height, STAND_HEIGHT, MAX_HEIGHT)
    if target_speed > 0.0:
        factor = tolerance(horizontal_velocity, target_speed, wp.inf, target_speed / 2.0, Sigmoid.LINEAR, 0.5)
    else:
        factor = small_control(ctrl)
    return standing * factor, standing, factor


@wp.kernel(enable_backward=False)
def observe_and_reward_hopper(
    # Model:
    torso: int,
    torso_com: wp.vec3,
    foot: int,
    foot_com: wp.vec3,
    torso_velocity: int,
    touch: wp.vec2i,
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    ctrl_in: wp.array2d[float],
    xpos_in: wp.array2d[wp.vec3],
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
    torso_center = xpos_in[world, torso] + xmat_in[world, torso] * torso_com
    foot_center = xpos_in[world, foot] + xmat_in[world, foot] * foot_com

    k = observe_row(qpos_in[world], 1, observation_out[world], 0)  # without the position along x
    k = observe_row(qvel_in[world], 0, observation_out[world], k)
    for i in range(2):
        observation_out[world, k + i] = wp.log(1.0 + sensordata_in[world, touch[i]])

    height = torso_center[2] - foot_center[2]
    horizontal_velocity = sensordata_in[world, torso_velocity]  # along x
    reward, standing, factor = hopper_reward(height, ctrl_in[world], horizontal_velocity, target_speed)
    reward_out[world] = reward
    terms_out[world, 0] = standing
    terms_out[world, 1] = factor


class Hopper(LocoEnv):
    """What the hopper's two tasks share; they differ in ``target_speed`` (m/s, 0 to stand)."""

    body = "hopper"
    mjcf = models.PATHS["hopper"]
    defaults = DEFAULTS["hopper"]
    observation_size = 15
    target_speed = 0.0

    def observation_kernel(self, world: World) -> tuple[wp.Kernel, list]:
        """Returns the kernel that writes observation and reward, and its inputs."""
        model, data = self.mj_model, world.sim.data
        bodies = []
        for name in ("torso", "foot"):
            body = model.body(name).id
            bodies += [body, wp.vec3(*model.body_ipos[body])]
        velocity, *touch = (int(model.sensor(name).adr[0]) for name in ("torso_velocity", "touch_toe", "touch_heel"))
        arrays = [data.qpos, data.qvel, data.ctrl, data.xpos, data.xmat, data.sensordata]
        return observe_and_reward_hopper, [*bodies, velocity, wp.vec2i(*touch), *arrays, self.target_speed]

    def pose_kernel(self, world: World) -> tuple[wp.Kernel, list, list]:
        """Returns the kernel that draws pitch and hinges, its inputs and its outputs."""
        pitch = int(self.mj_model.joint("rooty").qposadr[0])
        return draw_pitch_and_hinges, [world.sim.model.jnt_range, pitch], [world.sim.data.qpos]


class HopperStand(Hopper):
    """Stand upright on one leg.

    Arguments as in :class:`~torchrl_loco.LocoEnv`.

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
        None by falling; truncation after 1000 steps; a non-finite world is terminated with reward 0 and a
        zero observation.

    Source:
        dm_control ``suite/hopper.py``.
    """

    term_names = ("standing", "small_control")


class HopperHop(Hopper):
    """Hop forward at 2 m/s or faster.

    As :class:`HopperStand`, but for the reward.

    Reward:
        ``standing * hopping``, its two terms, with ``standing`` as in :class:`HopperStand` and
        ``hopping = tolerance(speed, [2 m/s, inf), margin 1 m/s, linear, value_at_margin 0.5)``, the speed being the
        center of mass's along x.
    """

    target_speed = HOP_SPEED
    term_names = ("standing", "hopping")
