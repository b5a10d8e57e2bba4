"""Cheetah: a planar body on a back and a front leg that learns to run."""

import functools
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.episode import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim import fill

SETTLED_STATES = 512  # states in the table from which episodes start
SETTLING_TIME = 2.0  # time for which a random pose settles (s): 200 physics steps of 0.01 s


@wp.struct
class CheetahInputs:
    """What observation and reward are computed from."""

    torso_velocity: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    sensordata: wp.array2d[float]
    target_speed: float


@wp.func
def observe_cheetah(world: int, inputs: CheetahInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    k = observe_row(inputs.qpos[world], 1, observation, 0)  # without the position along x
    k = observe_row(inputs.qvel[world], 0, observation, k)

    speed, target = inputs.sensordata[world, inputs.torso_velocity], inputs.target_speed  # along x
    move = tolerance(speed, target, wp.inf, target, Sigmoid.LINEAR, 0.0)
    terms[0] = move
    return move


class CheetahRun(LocoEnv):
    """Run at 10 m/s or faster.

    Observation:
        17 numbers: height and pitch of the torso and the hinges, qpos[1:] (8, m and rad); qvel (9, m/s and rad/s).

    Action:
        6 numbers: torques of the hinges as a share of their gear, in [-1, 1]; clipped beyond.

    Reward:
        ``move = tolerance(speed, [10 m/s, inf), margin 10 m/s, linear, value_at_margin 0)``, the speed being the center
        of mass's along x. It is the only term.

    Start:
        One of 512 states, in each of which random hinges have settled for 2 s without action.

    Termination:
        None by falling; truncation after 1000 steps; a world that is not finite ends with reward and observation 0.

    Source:
        dm_control ``suite/cheetah.py``.
    """

    body = "cheetah"
    model = Path(__file__).with_name("cheetah.xml")
    config = SimConfig(ctrl_dt=0.01, sim_dt=0.01, naconmax=100_000, njmax=100, iterations=4, ls_iterations=8)
    observation_size = 17
    observation_names = {"positions": 8, "velocities": 9}
    term_names = ("move",)
    presets = {"reppo": {"total_frames": 30_000_000, "lr": 1e-3, "minibatch_size": 4096, "min_temperature": 1e-9}}
    target_speed = 10.0  # m/s

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""
        data = world.sim.data
        return observe_cheetah, fill(
            CheetahInputs,
            data,
            torso_velocity=int(self.mj_model.sensor("torso_velocity").adr[0]),
            target_speed=self.target_speed,
        )

    def initial_states(self) -> np.ndarray:
        """Returns states into which random poses have settled, ``(512, nq + nv)``.

        dm_control lets a random pose settle at each reset. Here worlds begin their episodes at different times, and
        those that settle would keep all others waiting for 200 physics steps.
        """
        saved = np.empty(mujoco.mj_sizeModel(self.mj_model), np.uint8)
        mujoco.mj_saveModel(self.mj_model, None, saved)
        return settled_states(saved.tobytes()).copy()


@functools.lru_cache(maxsize=8)
def settled_states(saved: bytes) -> np.ndarray:
    """Returns states into which random poses of a saved model have settled, ``(SETTLED_STATES, nq + nv)``.

    It takes a second.
    """
    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": saved})
    rng, hinges = np.random.default_rng(0), model.jnt_limited.astype(bool)
    states = np.empty((SETTLED_STATES, model.nq + model.nv))
    data = mujoco.MjData(model)
    for state in states:
        mujoco.mj_resetData(model, data)
        data.qpos[hinges] = rng.uniform(*model.jnt_range[hinges].T)
        mujoco.mj_step(model, data, round(SETTLING_TIME / model.opt.timestep))
        state[:] = *data.qpos, *data.qvel
    return states
