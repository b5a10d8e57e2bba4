"""Walker: a planar body that learns to stand, walk and run."""

import warp as wp

from torchrl_loco import models
from torchrl_loco.config import DEFAULTS
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim.sampling import world_stream

STAND_HEIGHT = wp.constant(1.2)
"""Height of the torso from which the walker counts as standing (m)."""
WALK_SPEED = 1.0
"""Horizontal speed that counts as walking (m/s)."""
RUN_SPEED = 8.0
"""Horizontal speed that counts as running (m/s)."""

TORSO = wp.constant(1)
"""Id of the torso; the world is body 0."""
PITCH = wp.constant(2)
"""Index of the torso's pitch in qpos; the hinges with limits follow it."""


@wp.kernel(enable_backward=False)
def observe_walker(
    # Data in:
    qvel_in: wp.array2d[float],
    xpos_in: wp.array2d[wp.vec3],
    xmat_in: wp.array2d[wp.mat33],
    sensordata_in: wp.array2d[float],
    # In:
    speed: float,
    true_height: bool,
    mask_in: wp.array[bool],
    # Out:
    observation_out: wp.array2d[float],
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
):
    world = wp.tid()
    if not mask_in[world]:
        return

    k = int(0)
    for body in range(TORSO, xmat_in.shape[1]):
        xmat = xmat_in[world, body]
        observation_out[world, k] = xmat[0, 0]
        observation_out[world, k + 1] = xmat[0, 2]
        k += 2
    height = xpos_in[world, TORSO][2]
    torso_zz = xmat_in[world, TORSO][2, 2]
    observation_out[world, k] = wp.where(true_height, height, torso_zz)
    k += 1
    for i in range(qvel_in.shape[1]):
        observation_out[world, k + i] = qvel_in[world, i]

    standing = tolerance(height, STAND_HEIGHT, wp.inf, STAND_HEIGHT / 2.0)
    upright = wp.clamp((1.0 + torso_zz) / 2.0, 0.0, 1.0)  # zz may pass 1 by a rounding error
    stand = (3.0 * standing + upright) / 4.0
    reward = stand
    terms_out[world, 0] = stand
    if speed > 0.0:
        fast = tolerance(sensordata_in[world, 0], speed, wp.inf, speed / 2.0, Sigmoid.LINEAR, 0.5)
        move = (5.0 * fast + 1.0) / 6.0
        reward *= move
        terms_out[world, 1] = move
    reward_out[world] = reward


@wp.kernel(enable_backward=False)
def pose_walker(
    # Model:
    jnt_range: wp.array2d[wp.vec2],
    # In:
    mask_in: wp.array[bool],
    seed_in: wp.array[wp.uint32],
    episode_in: wp.array[int],
    # Data out:
    qpos_out: wp.array2d[float],
):
    world = wp.tid()
    if not mask_in[world]:
        return
    stream = world_stream(seed_in, world, episode_in[world])
    qpos_out[world, PITCH] = wp.randf(stream, -wp.pi, wp.pi)
    for i in range(PITCH + 1, qpos_out.shape[1]):
        limits = jnt_range[0, i]
        qpos_out[world, i] = wp.randf(stream, limits[0], limits[1])


class Walker(LocoEnv):
    """What the walker's three tasks share; they differ in ``speed`` (m/s, 0 to stand)."""

    body = "walker"
    mjcf = models.PATHS["walker"]
    defaults = DEFAULTS["walker"]
    observation_size = 24
    speed = 0.0

    def _observation_kernel(self) -> tuple[wp.Kernel, list]:
        d = self.sim.data
        return observe_walker, [d.qvel, d.xpos, d.xmat, d.sensordata, self.speed, self.protocol == "dm_control"]

    def _launch_pose(self) -> None:
        self._launch(
            pose_walker,
            [self.sim.model.jnt_range, self._mask, self._seed, self._episode],
            [self.sim.data.qpos],
        )


class WalkerStand(Walker):
    """Stand up and stay upright.

    Arguments as in :class:`~torchrl_loco.LocoEnv`.

    Observation:
        24 numbers: for torso, right thigh, leg, foot and left thigh, leg, foot the pair (xmat_xx, xmat_xz); one height
        entry, which is the torso's height (m) under ``dm_control`` and its zz under ``playground``; qvel (9, m/s and
        rad/s).

    Action:
        6 numbers: torques of hips, knees and ankles as a share of their gear, in [-1, 1]; clipped beyond.

    Reward:
        ``stand = (3 standing + upright) / 4`` with ``standing = tolerance(torso z, [1.2 m, inf), margin 0.6 m)`` and
        ``upright = (1 + torso zz) / 2``. Term: ``stand``.

    Start:
        At rest, pitch uniform in (-pi, pi), hinges uniform in their ranges.

    Termination:
        None by falling; truncation after 1000 steps; a world that is no longer finite is terminated with reward 0 and a
        zero observation.

    Source:
        dm_control ``suite/walker.py``.
    """

    term_names = ("stand",)


class WalkerWalk(Walker):
    """Walk at 1 m/s or faster.

    As :class:`WalkerStand`, but for the reward.

    Reward:
        ``stand * move``, its two terms: ``stand`` is all that :class:`WalkerStand` pays,
        ``(3 standing + upright) / 4``, and ``move = (5 fast + 1) / 6`` with
        ``fast = tolerance(speed, [1 m/s, inf), margin 0.5 m/s, linear, value_at_margin 0.5)``, the speed being the
        center of mass's along x.
    """

    speed = WALK_SPEED
    term_names = ("stand", "move")


class WalkerRun(Walker):
    """Run at 8 m/s or faster.

    As :class:`WalkerWalk`, with a target of 8 m/s and a margin of 4 m/s.
    """

    speed = RUN_SPEED
    term_names = ("stand", "move")
