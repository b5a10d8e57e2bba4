"""Inchworm: three links that learn to crawl. A body for torchrl_loco that lives outside of it."""

from pathlib import Path

import numpy as np
import warp as wp

from torchrl_loco import LocoEnv, SimConfig
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance

CRAWL_SPEED = wp.constant(0.5)
"""Horizontal speed that earns the full reward (m/s)."""


@wp.func
def inchworm_reward(horizontal_velocity: float) -> float:
    return tolerance(horizontal_velocity, CRAWL_SPEED, wp.inf, CRAWL_SPEED, Sigmoid.LINEAR, 0.0)


@wp.kernel(enable_backward=False)
def observe_inchworm(
    # Model:
    velocity: int,
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
    for i in range(1, nq):  # without the position along x
        observation_out[world, i - 1] = qpos_in[world, i]
    for i in range(qvel_in.shape[1]):
        observation_out[world, nq - 1 + i] = qvel_in[world, i]

    move = inchworm_reward(sensordata_in[world, velocity])  # along x
    terms_out[world, 0] = move
    reward_out[world] = move


class InchwormCrawl(LocoEnv):
    """Crawl at 0.5 m/s or faster.

    Observation: height and pitch of the middle link and the bends, qpos[1:] (4, m and rad); qvel (5, m/s and rad/s).
    Action: torques of the bends as a share of their gear, in [-1, 1] (2).
    Reward: ``move``, the center of mass's speed along x as a share of 0.5 m/s, clipped to [0, 1].
    Start: at rest above the ground, in one of 256 poses with bends of up to 60 degrees.
    """

    body = "inchworm"
    mjcf = Path(__file__).with_name("inchworm.xml")
    defaults = SimConfig(ctrl_dt=0.02, sim_dt=0.005, naconmax=20_000, njmax=50, iterations=4, ls_iterations=8)
    observation_size = 9
    term_names = ("move",)

    def observation_kernel(self, world: World) -> tuple[wp.Kernel, list]:
        """Returns the kernel that writes observation and reward, and its inputs."""
        velocity, data = int(self.mj_model.sensor("velocity").adr[0]), world.sim.data
        return observe_inchworm, [velocity, data.qpos, data.qvel, data.sensordata]

    def initial_states(self) -> np.ndarray:
        """Returns poses with random bends."""
        poses = np.tile(self.mj_model.qpos0, (256, 1))
        poses[:, 3:] = np.random.default_rng(0).uniform(-np.pi / 3, np.pi / 3, (256, 2))
        return poses
