"""Structs of what functions of a world read and write."""

import warp as wp

from torchrl_loco.sim import holds


@wp.struct
class State:
    qpos: wp.array[float]
    qvel: wp.array[float]


@wp.struct
class Pose:
    height: float
    state: State


def test_an_array_is_found_in_nested_structs():
    qpos, qvel, other = (wp.zeros(3, dtype=float, device="cpu") for _ in range(3))
    pose = Pose()
    pose.state.qpos, pose.state.qvel = qpos, qvel
    assert holds(pose, qvel)
    assert not holds(pose, other)
