"""Kernels of an episode: clip actions, mark and zero non-finite worlds, count steps, begin episodes."""

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
    non_finite_out: wp.array[bool],
):
    """Clips the action into ``ctrl``. A world whose action is NaN or infinite is marked, and stepped with zeros."""
    world = wp.tid()
    non_finite = bool(False)
    for i in range(action_in.shape[1]):
        if not wp.isfinite(action_in[world, i]):
            non_finite = True
    for i in range(action_in.shape[1]):
        ctrl_out[world, i] = wp.where(non_finite, 0.0, wp.clamp(action_in[world, i], -1.0, 1.0))
    non_finite_out[world] = non_finite


@wp.kernel(enable_backward=False)
def zero_non_finite(
    # In:
    mask_in: wp.array[bool],
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    # Out:
    non_finite_out: wp.array[bool],
    observation_out: wp.array2d[float],
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
):
    """Marks worlds that are non-finite, and zeroes observation, reward and terms of all marked worlds."""
    world = wp.tid()
    if not mask_in[world]:
        return
    non_finite = non_finite_out[world]
    for i in range(qpos_in.shape[1]):
        non_finite = non_finite or not is_finite(qpos_in[world, i])
    for i in range(qvel_in.shape[1]):
        non_finite = non_finite or not is_finite(qvel_in[world, i])
    for i in range(observation_out.shape[1]):
        non_finite = non_finite or not is_finite(observation_out[world, i])
    non_finite = non_finite or not is_finite(reward_out[world])
    if non_finite:
        for i in range(observation_out.shape[1]):
            observation_out[world, i] = 0.0
        for i in range(terms_out.shape[1]):
            terms_out[world, i] = 0.0
        reward_out[world] = 0.0
    non_finite_out[world] = non_finite


@wp.kernel(enable_backward=False)
def count_step(
    # In:
    non_finite_in: wp.array[bool],
    episode_length: int,
    # Out:
    elapsed_steps_out: wp.array[int],
    done_out: wp.array[bool],
    terminated_out: wp.array[bool],
    truncated_out: wp.array[bool],
):
    """Counts a control step: a world is truncated at the time limit, and terminated if it is not finite."""
    world = wp.tid()
    elapsed_steps = elapsed_steps_out[world] + 1
    truncated = elapsed_steps >= episode_length
    elapsed_steps_out[world] = elapsed_steps
    terminated_out[world] = non_finite_in[world]
    truncated_out[world] = truncated
    done_out[world] = truncated or non_finite_in[world]


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
    world_offset: int,
    episode_length: int,
    # Out:
    episode_out: wp.array[int],
    stream_out: wp.array[wp.uint32],
    elapsed_steps_out: wp.array[int],
    non_finite_out: wp.array[bool],
    done_out: wp.array[bool],
    terminated_out: wp.array[bool],
    truncated_out: wp.array[bool],
):
    """Starts the next episode: its random stream, its clock, its flags."""
    world = wp.tid()
    if not mask_in[world]:
        return
    episode = episode_out[world]
    elapsed_steps = int(0)
    if stagger_in[0]:
        # The complement of the episode separates this stream from the one that draws the pose.
        stream = world_stream(seed_in[0], world_offset + world, -1 - episode)
        elapsed_steps = wp.randi(stream, 0, episode_length)
    stream_out[world] = world_stream(seed_in[0], world_offset + world, episode)
    episode_out[world] = episode + 1
    elapsed_steps_out[world] = elapsed_steps
    non_finite_out[world] = False
    done_out[world] = False
    terminated_out[world] = False
    truncated_out[world] = False
