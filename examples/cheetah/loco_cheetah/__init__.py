"""Cheetah: a planar body on two legs that learns to run. A body for torchrl_loco that lives outside of it."""

from pathlib import Path

import mujoco
import numpy as np
import warp as wp

from torchrl_loco import LocoEnv, SimConfig
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim.sampling import world_stream

RUN_SPEED = wp.constant(10.0)
"""Horizontal speed that counts as running (m/s)."""
HINGES = 3
"""Index of the first hinge with limits in qpos; before it x, z and pitch of the torso."""
NUM_STARTS = 256
"""Poses that an episode can start in."""
SETTLING_TIME = 2.0
"""How long a start settles before it is one (s)."""


@wp.kernel(enable_backward=False)
def observe_cheetah(
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    sensordata_in: wp.array2d[float],
    # In:
    mask_in: wp.array[bool],
    # Out:
    observation_out: wp.array2d[float],
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
):
    world = wp.tid()
    if not mask_in[world]:
        return
    nq = qpos_in.shape[1]
    for i in range(1, nq):  # where it is along x is nobody's business
        observation_out[world, i - 1] = qpos_in[world, i]
    for i in range(qvel_in.shape[1]):
        observation_out[world, nq - 1 + i] = qvel_in[world, i]
    move = tolerance(sensordata_in[world, 0], RUN_SPEED, wp.inf, RUN_SPEED, Sigmoid.LINEAR, 0.0)
    terms_out[world, 0] = move
    reward_out[world] = move


@wp.kernel(enable_backward=False)
def pose_cheetah(
    # In:
    starts_in: wp.array2d[float],
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
    start = wp.randi(stream, 0, starts_in.shape[0])
    for i in range(qpos_out.shape[1]):
        qpos_out[world, i] = starts_in[start, i]


class CheetahRun(LocoEnv):
    """Run at 10 m/s or faster.

    Arguments as in :class:`~torchrl_loco.LocoEnv`.

    Observation:
        17 numbers: height and pitch of the torso and the hinges, qpos[1:] (8, m and rad); qvel (9, m/s and rad/s).

    Action:
        6 numbers: torques of the hinges as a share of their gear, in [-1, 1]; clipped beyond.

    Reward:
        ``move = tolerance(speed, [10 m/s, inf), margin 10 m/s, linear, value_at_margin 0)``, the speed being the center
        of mass's along x. It is the only term.

    Start:
        At rest, in one of 256 poses that random ones have settled into.

    Termination:
        None by falling; truncation after 1000 steps of 10 ms; a world that is no longer finite is terminated with
        reward 0 and a zero observation.

    Source:
        dm_control ``suite/cheetah.py``; the settings under ``playground`` are MuJoCo Playground's.
    """

    body = "cheetah"
    mjcf = Path(__file__).with_name("cheetah.xml")
    defaults = SimConfig(
        ctrl_dt=0.01, sim_dt=0.01, naconmax=100_000, njmax=100, iterations=4, ls_iterations=8, euler_damping=False
    )
    observation_size = 17
    term_names = ("move",)

    def _prepare(self) -> None:
        """Lets random poses settle, once, for the resets to draw from.

        dm_control draws the hinges uniformly in their ranges and steps the physics for 2 s before every episode. Worlds
        of a batch begin at different times, so that here they cannot settle in place; and they need not, because the
        springs bring the draws back to much the same standing pose. The slight motion that remains is left out.
        """
        model, data, rng = self.mj_model, mujoco.MjData(self.mj_model), np.random.default_rng(0)
        starts = np.zeros((NUM_STARTS, model.nq))
        for start in starts:
            mujoco.mj_resetData(model, data)
            data.qpos[HINGES:] = rng.uniform(*model.jnt_range[HINGES:].T)
            mujoco.mj_step(model, data, round(SETTLING_TIME / model.opt.timestep))
            start[:] = data.qpos
        self._starts = wp.array(starts, dtype=float, device=self.sim.device)

    def _launch_observe(self, mask: wp.array) -> None:
        d = self.sim.data
        self._launch(
            observe_cheetah,
            [d.qpos, d.qvel, d.sensordata, mask],
            [self._observation, self._reward, self._terms],
        )

    def _launch_pose(self) -> None:
        self._launch(
            pose_cheetah,
            [self._starts, self._mask, self._seed, self._episode],
            [self.sim.data.qpos],
        )
