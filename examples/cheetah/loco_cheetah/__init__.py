"""Cheetah: a planar body on two legs that learns to run. A body for torchrl_loco that lives outside of it."""

from pathlib import Path

import mujoco
import numpy as np
import warp as wp

from torchrl_loco import LocoEnv, SimConfig
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance

RUN_SPEED = wp.constant(10.0)
"""Horizontal speed that counts as running (m/s)."""


@wp.func
def cheetah_run_reward(horizontal_velocity: float) -> float:
    return tolerance(horizontal_velocity, RUN_SPEED, wp.inf, RUN_SPEED, Sigmoid.LINEAR, 0.0)


@wp.kernel(enable_backward=False)
def observe_cheetah(
    # Model:
    torso_velocity: int,
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
    k = int(0)
    for i in range(1, qpos_in.shape[1]):  # without the position along x
        observation_out[world, k] = qpos_in[world, i]
        k += 1
    for i in range(qvel_in.shape[1]):
        observation_out[world, k + i] = qvel_in[world, i]

    move = cheetah_run_reward(sensordata_in[world, torso_velocity])  # along x
    terms_out[world, 0] = move
    reward_out[world] = move


class CheetahRun(LocoEnv):
    """Run at 10 m/s or faster.

    Observation: height and pitch of the torso and the hinges, qpos[1:] (8, m and rad); qvel (9, m/s and rad/s).
    Action: torques of the hinges as a share of their gear, in [-1, 1] (6).
    Reward: ``move``, the center of mass's speed along x as a share of 10 m/s, clipped to [0, 1].
    Start: at rest, in one of 256 poses into which random poses have settled.
    Source: dm_control ``suite/cheetah.py``; the settings under ``playground`` are MuJoCo Playground's.
    """

    body = "cheetah"
    mjcf = Path(__file__).with_name("cheetah.xml")
    defaults = SimConfig(ctrl_dt=0.01, sim_dt=0.01, naconmax=100_000, njmax=100, iterations=4, ls_iterations=8)
    observation_size = 17
    term_names = ("move",)

    def observation_kernel(self, world: World) -> tuple[wp.Kernel, list]:
        """Returns the kernel that writes observation and reward, and its inputs."""
        torso_velocity = int(self.mj_model.sensor("torso_velocity").adr[0])
        data = world.sim.data
        return observe_cheetah, [torso_velocity, data.qpos, data.qvel, data.sensordata]

    def initial_poses(self) -> np.ndarray:
        """Returns random poses that have settled for 2 s, as dm_control lets them settle before each episode.

        The worlds of a batch begin their episodes at different times, so they cannot settle in place. The springs bring
        the hinges back to much the same standing pose; the slight motion that remains is left out.
        """
        model, rng = self.mj_model, np.random.default_rng(0)
        hinges = slice(3, None)  # x, z and pitch of the torso come first
        poses = np.zeros((256, model.nq))
        for pose in poses:
            data = mujoco.MjData(model)
            data.qpos[hinges] = rng.uniform(*model.jnt_range[hinges].T)
            mujoco.mj_step(model, data, round(2.0 / model.opt.timestep))
            pose[:] = data.qpos
        return poses
