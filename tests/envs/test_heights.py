"""Heights of the ground and scans of it, against rays of MuJoCo."""

import mujoco
import numpy as np
import pytest
import torch
from for_each import for_each

from torchrl_loco import LocoEnv, SimConfig, terrain

GRID = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 5), np.linspace(-0.5, 0.5, 3)), axis=-1).reshape(-1, 2)
KINDS = {"rough": terrain.rough, "wave": terrain.wave, "stairs": terrain.stairs, "stones": terrain.stepping_stones}
MODEL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>{more}
    <body name="drone"><freejoint/><geom size=".05"/></body>
  </worldbody>
</mujoco>
"""


def task(spec, states, scan=None, **settings):
    """Returns what an environment of these states observes: the scan, and the height of the ground below the body."""

    class Drone(LocoEnv):
        model, config = spec, SimConfig(ctrl_dt=0.02, sim_dt=0.002)
        constants = {"states": states}

        def reward(self, s):
            return s.qpos[:, 2]

        def observation(self, s):
            seen = s.height_scan("drone", GRID if scan is None else scan, **settings)
            below = s.terrain_height(s.xpos("drone"))
            return {"observation": {"scan": seen, "below": torch.where(below.isnan(), -9.0, below)}}

        def begin(self, s):
            return {"qpos": s.states[s.env_index]}

    return Drone(len(states), "cpu", seed=0)


def test_scans_are_those_of_rays():
    """Of fields and boxes, for any orientation of the body, and beyond the border, where there is nothing."""
    ground = terrain.Terrain(KINDS, rows=2, columns=4, size=6.0, border=2.0, seed=3)
    spec, rng = ground.under(MODEL.format(more="")), np.random.default_rng(0)
    states = np.zeros((60, 7))
    states[:, :2] = rng.uniform(-1.0, 1.0, (60, 2)) * (np.array(ground.half) + 2.5)
    states[:, 2] = rng.uniform(1.0, 3.0, 60)
    states[:, 3:] = rng.normal(size=(60, 4))
    states[::6, 3:] = np.array([1.0, 0.0, -1.0, 0.0]) + 0.01 * rng.normal(size=(10, 4))  # the x axis is upright
    states[:, 3:] /= np.linalg.norm(states[:, 3:], axis=1, keepdims=True)
    env = task(spec, states, miss=7.0)
    seen = env.reset()["observation"].numpy()
    assert "observation" in repr(env).split("kernel:")[1]
    m = spec.compile()
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    only_ground, hit, down = (
        np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8),
        np.zeros(1, np.int32),
        np.array([0.0, 0.0, -1.0]),
    )
    expected = np.full((60, len(GRID) + 1), 7.0)
    for row, state in zip(expected, states, strict=True):
        turn = np.empty(9)
        mujoco.mju_quat2Mat(turn, state[3:])
        turn = turn.reshape(3, 3)
        ahead = turn[:2, 0] if np.linalg.norm(turn[:2, 0]) > 0.1 else np.array([turn[1, 1], -turn[0, 1]])
        ahead = ahead / np.linalg.norm(ahead)
        points = state[:2] + GRID @ np.array([ahead, [-ahead[1], ahead[0]]])
        for k, (x, y) in enumerate([*points, state[:2]]):
            far = mujoco.mj_ray(m, data, np.array([x, y, 50.0]), down, only_ground, 1, 1, hit)
            if far >= 0:
                row[k] = state[2] - (50.0 - far) if k < len(GRID) else 50.0 - far
            elif k == len(GRID):
                row[k] = -9.0
    assert (expected[:, -1] == -9.0).any()
    assert (expected == 7.0).any()
    np.testing.assert_allclose(seen, expected, atol=5e-6)


def test_a_plane_is_ground_too_but_not_a_ceiling():
    ceiling = '<geom type="plane" size="1 1 1" pos="0 0 9" euler="180 0 0"/>'
    env = task(mujoco.MjSpec.from_string(MODEL.format(more=ceiling)), np.array([[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]]))
    torch.testing.assert_close(env.reset()["observation"], torch.tensor([[3.0] * len(GRID) + [0.0]]))


LID = """<geom name="lid" type="hfield" hfield="f" euler="180 0 0"/></worldbody>
<asset><hfield name="f" nrow="2" ncol="2" size="1 1 1 1"/></asset><worldbody>"""


@for_each(
    ("more", "grid", "message"),
    [
        ('<geom type="box" size="1 1 1" euler="0 0 30"/>', GRID, "geom 1 is turned"),
        ('<geom name="ramp" type="plane" size="1 1 1" euler="0 9 0"/>', GRID, "geom 'ramp' is turned"),
        (LID, GRID, "geom 'lid' is turned"),
        ("", GRID * np.nan, "grid must be finite"),
        ("", GRID[:, 0], r"grid must be points ahead and to the left, \(points, 2\), got \(15,\)"),
    ],
)
def test_what_has_no_height(more, grid, message):
    with pytest.raises(ValueError, match=message):
        task(mujoco.MjSpec.from_string(MODEL.format(more=more)), np.zeros((1, 7)), grid)


def test_there_must_be_ground(caplog):
    nothing = MODEL.format(more="").replace('<geom name="floor" type="plane" size="5 5 .1"/>', "")
    with pytest.raises(ValueError, match="there is no ground below"):
        task(mujoco.MjSpec.from_string(nothing), np.zeros((1, 7)))
    task(
        mujoco.MjSpec.from_string(MODEL.format(more='<geom name="pole" type="cylinder" size="1 1"/>')), np.zeros((1, 7))
    )
    assert "without geoms pole" in caplog.text
