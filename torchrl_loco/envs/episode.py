"""The course of an episode as kernels: action in, finiteness, time limit, beginning anew."""

import warp as wp

from torchrl_loco.sim.sampling import world_stream

MAX_VALUE = 1.0e10
"""Magnitude from which a number counts as not finite: MuJoCo's mjMAXVAL."""


@wp.func
def is_finite(x: float) -> bool:
    return wp.abs(x) < MAX_VALUE  # false for NaN too


@wp.kernel(enable_backward=False)
def apply_action(
    # In:
    action_in: wp.array2d[float],
    # Data out:
    ctrl_out: wp.array2d[float],
    # Out:
    bad_out: wp.array[bool],
):
    world = wp.tid()
    bad = bool(False)
    for i in range(action_in.shape[1]):
        if not is_finite(action_in[world, i]):
            bad = True
    for i in range(action_in.shape[1]):
        ctrl_out[world, i] = wp.where(bad, 0.0, action_in[world, i])
    bad_out[world] = bad


@wp.kernel(enable_backward=False)
def quench(
    # In:
    mask_in: wp.array[bool],
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    # Out:
    bad_out: wp.array[bool],
    observation_out: wp.array2d[float],
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
):
    """Marks worlds that are no longer finite as bad, and zeroes what bad worlds report."""
    world = wp.tid()
    if not mask_in[world]:
        return
    bad = bad_out[world]
    for i in range(qpos_in.shape[1]):
        bad = bad or not is_finite(qpos_in[world, i])
    for i in range(qvel_in.shape[1]):
        bad = bad or not is_finite(qvel_in[world, i])
    for i in range(observation_out.shape[1]):
        bad = bad or not is_finite(observation_out[world, i])
    bad = bad or not is_finite(reward_out[world])
    if bad:
        for i in range(observation_out.shape[1]):
            observation_out[world, i] = 0.0
        for i in range(terms_out.shape[1]):
            terms_out[world, i] = 0.0
        reward_out[world] = 0.0
    bad_out[world] = bad


@wp.kernel(enable_backward=False)
def count_step(
    # In:
    bad_in: wp.array[bool],
    episode_length: int,
    # Out:
    elapsed_steps_out: wp.array[int],
    done_out: wp.array[bool],
    terminated_out: wp.array[bool],
    truncated_out: wp.array[bool],
):
    world = wp.tid()
    elapsed_steps = elapsed_steps_out[world] + 1
    truncated = elapsed_steps >= episode_length
    elapsed_steps_out[world] = elapsed_steps
    terminated_out[world] = bad_in[world]
    truncated_out[world] = truncated
    done_out[world] = truncated or bad_in[world]


@wp.kernel(enable_backward=False)
def any_world(
    # In:
    mask_in: wp.array[bool],
    # Out:
    any_out: wp.array[int],
):
    if mask_in[wp.tid()]:
        any_out[0] = 1


@wp.kernel(enable_backward=False)
def begin_episode(
    # In:
    mask_in: wp.array[bool],
    stagger_in: wp.array[bool],
    seed_in: wp.array[wp.uint32],
    episode_length: int,
    # Out:
    episode_out: wp.array[int],
    elapsed_steps_out: wp.array[int],
    bad_out: wp.array[bool],
    done_out: wp.array[bool],
    terminated_out: wp.array[bool],
    truncated_out: wp.array[bool],
):
    world = wp.tid()
    if not mask_in[world]:
        return
    episode = episode_out[world]
    elapsed_steps = int(0)
    if stagger_in[0]:
        # The complement of the episode keeps this stream apart from the one that draws the pose.
        stream = world_stream(seed_in, world, -1 - episode)
        elapsed_steps = wp.randi(stream, 0, episode_length)
    episode_out[world] = episode + 1
    elapsed_steps_out[world] = elapsed_steps
    bad_out[world] = False
    done_out[world] = False
    terminated_out[world] = False
    truncated_out[world] = False
