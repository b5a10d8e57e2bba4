"""Inchworm: three links that learn to crawl. A body for torchrl_loco that lives outside of it."""

from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from torchrl_loco import LocoEnv, SimConfig
from torchrl_loco.envs.episode import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim import fill

CRAWL_SPEED = wp.constant(0.5)
"""Horizontal speed that earns the full reward (m/s)."""


@wp.func
def inchworm_reward(horizontal_velocity: float) -> float:
    return tolerance(horizontal_velocity, CRAWL_SPEED, wp.inf, CRAWL_SPEED, Sigmoid.LINEAR, 0.0)


@wp.struct
class InchwormInputs:
    """What observation and reward are computed from."""

    velocity: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    sensordata: wp.array2d[float]


@wp.func
def observe_inchworm(world: int, inputs: InchwormInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    k = observe_row(inputs.qpos[world], 1, observation, 0)  # without the position along x
    observe_row(inputs.qvel[world], 0, observation, k)

    move = inchworm_reward(inputs.sensordata[world, inputs.velocity])  # along x
    terms[0] = move
    return move


class InchwormCrawl(LocoEnv):
    """Crawl at 0.5 m/s or faster.

    Observation: height and pitch of the middle link and the bends, qpos[1:] (4, m and rad); qvel (5, m/s and rad/s).
    Action: torques of the bends as a share of their gear, in [-1, 1] (2).
    Reward: ``move``, the center of mass's speed along x as a share of 0.5 m/s, clipped to [0, 1].
    Start: at rest above the ground, in one of 256 poses with bends of up to 60 degrees.
    """

    body = "inchworm"
    model = Path(__file__).with_name("inchworm.xml")
    config = SimConfig(ctrl_dt=0.02, sim_dt=0.005, naconmax=20_000, njmax=50, iterations=4, ls_iterations=8)
    observation_size = 9
    term_names = ("move",)

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""
        velocity = int(self.mj_model.sensor("velocity").adr[0])
        return observe_inchworm, fill(InchwormInputs, world.sim.data, velocity=velocity)

    def initial_states(self) -> np.ndarray:
        """Returns poses with random bends."""
        poses = np.tile(self.mj_model.qpos0, (256, 1))
        poses[:, 3:] = np.random.default_rng(0).uniform(-np.pi / 3, np.pi / 3, (256, 2))
        return poses
