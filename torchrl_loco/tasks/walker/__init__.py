"""Walker: a planar body that learns to stand, walk and run."""

from pathlib import Path
from typing import Any

import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.envs.base import LocoEnv
from torchrl_loco.envs.episode import observe_row
from torchrl_loco.envs.world import World
from torchrl_loco.rewards import Sigmoid, tolerance
from torchrl_loco.sim import fill
from torchrl_loco.sim.sampling import PlanarBody, draw_pitch_and_hinges

STAND_HEIGHT = wp.constant(1.2)  # height of the torso from which the walker counts as standing (m)

SHORT_EPISODES = {
    "lr": 1e-3,
    "minibatch_size": 4096,
    "min_temperature": 1e-9,  # none: it trains well without a lower bound
    # Most of the return is lost while the body gets up, which is much of a short episode.
    "episode_length": 100,
    "gamma": 0.98,
    "max_value": 75.0,
}
"""Settings of the training that standing and walking share."""

BODIES = wp.constant(7)
Rows = wp.types.matrix(shape=(7, 3), dtype=wp.float32)  # first rows of the bodies' orientations


@wp.func
def walker_reward(torso_height: float, torso_upright: float, horizontal_velocity: float, target_speed: float):
    """Returns the reward and its factors ``stand`` and ``move``; a target speed of 0 asks for standing only."""
    standing = tolerance(torso_height, STAND_HEIGHT, wp.inf, STAND_HEIGHT / 2.0)
    upright = wp.clamp((1.0 + torso_upright) / 2.0, 0.0, 1.0)  # torso_upright may pass 1 by a rounding error
    stand = (3.0 * standing + upright) / 4.0
    move = float(1.0)
    if target_speed > 0.0:
        fast = tolerance(horizontal_velocity, target_speed, wp.inf, target_speed / 2.0, Sigmoid.LINEAR, 0.5)
        move = (5.0 * fast + 1.0) / 6.0
    return stand * move, stand, move


@wp.struct
class WalkerInputs:
    """What observation and reward are computed from."""

    torso: int
    torso_velocity: int
    qvel: wp.array2d[float]
    xpos: wp.array2d[wp.vec3]
    xmat: wp.array2d[wp.mat33]
    sensordata: wp.array2d[float]
    target_speed: float
    observe_height: bool


@wp.func
def observe_walker(world: int, inputs: WalkerInputs, observation: wp.array[float], terms: wp.array[float]) -> float:
    torso_height = inputs.xpos[world, inputs.torso][2]
    torso_upright = inputs.xmat[world, inputs.torso][2, 2]

    rows = Rows()  # all are read before the first is written, as in observe_row
    for i in range(BODIES):
        rows[i] = inputs.xmat[world, 1 + i][0]  # body 0 is the world
    k = int(0)
    for i in range(BODIES):
        observation[k] = rows[i, 0]
        observation[k + 1] = rows[i, 2]
        k += 2
    observation[k] = wp.where(inputs.observe_height, torso_height, torso_upright)
    k = observe_row(inputs.qvel[world], 0, observation, k + 1)

    horizontal_velocity = inputs.sensordata[world, inputs.torso_velocity]  # along x
    reward, stand, move = walker_reward(torso_height, torso_upright, horizontal_velocity, inputs.target_speed)
    terms[0] = stand
    if terms.shape[0] > 1:
        terms[1] = move
    return reward


class Walker(LocoEnv):
    """What the walker's three tasks share; they differ in ``target_speed`` (m/s, 0 to stand)."""

    body = "walker"
    model = Path(__file__).with_name("walker.xml")
    config = SimConfig(ctrl_dt=0.025, sim_dt=0.0025, naconmax=50_000, njmax=100, iterations=2, ls_iterations=5)
    observation_size = 24
    observation_names = {"orientations": 14, "height": 1, "velocities": 9}
    term_names: tuple[str, ...] = ("stand",)
    target_speed = 0.0

    def observation_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that writes observation and reward, and its inputs."""
        model, data = self.mj_model, world.sim.data
        return observe_walker, fill(
            WalkerInputs,
            data,
            torso=model.body("torso").id,
            torso_velocity=int(model.sensor("torso_velocity").adr[0]),
            target_speed=self.target_speed,
            observe_height=self.protocol == "dm_control",
        )

    def pose_func(self, world: World) -> tuple[wp.Function, Any]:
        """Returns the function that draws pitch and hinges, and its inputs."""
        sim, pitch = world.sim, int(self.mj_model.joint("rooty").qposadr[0])
        return draw_pitch_and_hinges, fill(PlanarBody, sim.data, jnt_range=sim.model.jnt_range, pitch=pitch)


class WalkerStand(Walker):
    """Stand up and stay upright.

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
        None by falling; truncation after 1000 steps; a world that is not finite ends with reward and observation 0.

    Source:
        dm_control ``suite/walker.py``.
    """

    presets = {"reppo": {**SHORT_EPISODES, "total_frames": 34_000_000, "epochs": 2}}


class WalkerWalk(Walker):
    """Walk at 1 m/s or faster.

    As :class:`WalkerStand`, but for the reward.

    Reward:
        ``stand * move``, its two terms: ``stand`` is all that :class:`WalkerStand` pays,
        ``(3 standing + upright) / 4``, and ``move = (5 fast + 1) / 6`` with
        ``fast = tolerance(speed, [1 m/s, inf), margin 0.5 m/s, linear, value_at_margin 0.5)``, the speed being the
        center of mass's along x.
    """

    target_speed = 1.0
    term_names = ("stand", "move")
    presets = {"reppo": {**SHORT_EPISODES, "total_frames": 19_000_000, "eval_interval": 2_000_000, "bf16": True}}


class WalkerRun(Walker):
    """Run at 8 m/s or faster.

    As :class:`WalkerWalk`, with a target of 8 m/s and a margin of 4 m/s.
    """

    target_speed = 8.0
    term_names = ("stand", "move")
    presets = {
        "reppo": {
            "total_frames": 75_000_000,
            "episode_length": 200,
            "min_temperature": 1e-9,
            # Less noise, and twice the gradient steps of WalkerWalk at twice the learning rate. With the steps and the
            # rate of WalkerWalk three of four runs under dm_control settled on a crouching gait, which earns a tenth
            # less; with these two of ten in 40 million frames, none of six in 65 million, and none of five in 60
            # million after the better of two trials.
            "lr": 2e-3,
            "minibatch_size": 2048,
            "target_entropy": -1.0,
            # Gaits are decided early, by chance. Of eleven runs under playground with one trial at this learning rate,
            # the three that ended below 920 had the lowest returns after 15 million frames.
            "trials": 2,
            "trial_fraction": 0.2,
        }
    }
