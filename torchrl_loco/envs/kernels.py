"""Kernels of an episode: clip actions, mark and zero non-finite worlds, count steps, begin episodes."""

import warp as wp

from torchrl_loco.sim.sampling import world_stream
from torchrl_loco.sim.simulation import put_at_rest

MAX_VALUE = 1.0e10
"""Magnitude from which a number counts as not finite: MuJoCo's mjMAXVAL."""

Eight = wp.types.vector(length=8, dtype=wp.float32)


@wp.func
def observe_row(row: wp.array[float], first: int, observation: wp.array[float], k: int) -> int:
    """Copies the numbers of a row from ``first`` on into an observation at ``k``; returns where they end.

    Eight are read before any is written: a read that follows a write waits for it, as both may be the same number.
    """
    i = int(first)
    while i + 8 <= row.shape[0]:
        some = Eight()
        for j in range(8):
            some[j] = row[i + j]
        for j in range(8):
            observation[k + j] = some[j]
        i += 8
        k += 8
    while i < row.shape[0]:
        observation[k] = row[i]
        i += 1
        k += 1
    return k


@wp.func
def count_non_finite(row: wp.array[float]) -> int:
    """Counts without a branch: else a thread would wait for each number before it asks for the next."""
    count = int(0)
    for i in range(row.shape[0]):
        count += wp.where(wp.abs(row[i]) < MAX_VALUE, 0, 1)  # counts NaN too
    return count


@wp.kernel(enable_backward=False)
def apply_action(
    # Model:
    actuator_ctrlrange: wp.array2d[wp.vec2],
    # In:
    action_in: wp.array2d[float],
    # Out:
    action_out: wp.array2d[float],
    # Data out:
    ctrl_out: wp.array2d[float],
    # Out:
    non_finite_out: wp.array[bool],
    any_out: wp.array[int],
):
    """Keeps the action, clips it and scales it to ``ctrl``.

    A world whose action is NaN or infinite is marked, and stepped with an action of zeros.
    """
    world = wp.tid()
    if world == 0:
        any_out[0] = 0  # until finish_step finds a world that is done
    count = int(0)
    for i in range(action_in.shape[1]):
        count += wp.where(wp.isfinite(action_in[world, i]), 0, 1)
    non_finite = count > 0
    for i in range(action_in.shape[1]):
        action = action_in[world, i]
        action_out[world, i] = action
        limits = actuator_ctrlrange[0, i]
        used = wp.where(non_finite, 0.0, wp.clamp(action, -1.0, 1.0))
        ctrl_out[world, i] = 0.5 * (limits[0] + limits[1]) + 0.5 * (limits[1] - limits[0]) * used
    non_finite_out[world] = non_finite


@wp.func
def zero_if_non_finite(
    non_finite: bool,
    qpos: wp.array[float],
    qvel: wp.array[float],
    observation: wp.array[float],
    reward: wp.array[float],
    terms: wp.array[float],
    world: int,
) -> bool:
    """Returns whether a world is non-finite; if it is, zeroes its observation, reward and terms."""
    found = count_non_finite(qpos) + count_non_finite(qvel) + count_non_finite(observation)
    non_finite = non_finite or found > 0 or not (wp.abs(reward[world]) < MAX_VALUE)
    if non_finite:
        for i in range(observation.shape[0]):
            observation[i] = 0.0
        for i in range(terms.shape[0]):
            terms[i] = 0.0
        reward[world] = 0.0
    return non_finite


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
    non_finite_out[world] = zero_if_non_finite(
        non_finite_out[world],
        qpos_in[world],
        qvel_in[world],
        observation_out[world],
        reward_out,
        terms_out[world],
        world,
    )


@wp.kernel(enable_backward=False)
def finish_step(
    # In:
    episode_length: int,
    counter_bits: wp.array[int],
    # Data in:
    qpos_in: wp.array2d[float],
    qvel_in: wp.array2d[float],
    # Data out:
    overflow_out: wp.array[int],
    # Out:
    non_finite_out: wp.array[bool],
    observation_out: wp.array2d[float],
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
    elapsed_steps_out: wp.array[int],
    done_out: wp.array[bool],
    terminated_out: wp.array[bool],
    truncated_out: wp.array[bool],
    mask_out: wp.array[bool],
    any_out: wp.array[int],
    counts_out: wp.array2d[int],
):
    """Ends a control step: marks and zeroes non-finite worlds, applies the time limit, counts what went wrong.

    A world is truncated at the time limit, and terminated if it is not finite; what is done is masked for the reset
    that may follow. The bits of ``overflow`` are cleared.
    """
    world = wp.tid()
    non_finite = zero_if_non_finite(
        non_finite_out[world],
        qpos_in[world],
        qvel_in[world],
        observation_out[world],
        reward_out,
        terms_out[world],
        world,
    )
    elapsed_steps = elapsed_steps_out[world] + 1
    truncated = elapsed_steps >= episode_length
    non_finite_out[world] = non_finite
    elapsed_steps_out[world] = elapsed_steps
    terminated_out[world] = non_finite
    truncated_out[world] = truncated
    done = truncated or non_finite
    done_out[world] = done
    mask_out[world] = done
    if done:
        any_out[0] = 1

    bits = overflow_out[world]
    for i in range(counter_bits.shape[0]):
        if bits & counter_bits[i] != 0:
            counts_out[world, i] += 1
    if non_finite:
        counts_out[world, counter_bits.shape[0]] += 1
    overflow_out[world] = 0


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
    # Model:
    qpos0: wp.array2d[float],
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
    # Data out:
    qpos_out: wp.array2d[float],
    qvel_out: wp.array2d[float],
    qacc_warmstart_out: wp.array2d[float],
    act_out: wp.array2d[float],
    ctrl_out: wp.array2d[float],
    time_out: wp.array[float],
):
    """Starts the next episode: its random stream, its clock, its flags, and the world at rest."""
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
    put_at_rest(world, qpos0, qpos_out, qvel_out, qacc_warmstart_out, act_out, ctrl_out, time_out)
