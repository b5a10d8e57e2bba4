"""What happens in each world beside the physics: actions, observations, the time limit, counters, new episodes."""

from typing import Any

import warp as wp

from torchrl_loco.sim import WorldFunc, fill
from torchrl_loco.sim.sampling import world_stream
from torchrl_loco.sim.world_func import write_rows

MAX_VALUE = 1.0e10  # magnitude from which a number counts as not finite: MuJoCo's mjMAXVAL

AT_ONCE = 16  # numbers of a row that are read before any is written

Numbers = wp.types.vector(length=AT_ONCE, dtype=wp.float32)


@wp.struct
class Outputs:
    """Observations ``(nworld, size)``, rewards ``(nworld,)`` and their factors ``(nworld, count)``."""

    observation: wp.array2d[float]
    reward: wp.array[float]
    terms: wp.array2d[float]


@wp.struct
class Flags:
    """How the episodes are: each ``(nworld,)``."""

    non_finite: wp.array[bool]
    done: wp.array[bool]
    terminated: wp.array[bool]
    truncated: wp.array[bool]


# Before the physics.


@wp.struct
class Control:
    """Actions in [-1, 1] ``(nworld, nu)``; ``ctrl`` and ``non_finite`` are written."""

    ctrlrange: wp.array2d[wp.vec2]
    action: wp.array2d[float]
    ctrl: wp.array2d[float]
    non_finite: wp.array[bool]


@wp.func
def read_some(row: wp.array[float], first: int):
    """Returns numbers of a row from ``first`` on; beyond its end, the last one.

    Several are read before any is written: a read that follows a write waits for it, as both may be the same number.
    """
    some = Numbers()
    for j in range(AT_ONCE):
        some[j] = row[wp.min(first + j, row.shape[0] - 1)]
    return some


@wp.func
def apply_action(world: int, args: Control):
    """Clips the action and scales it to ``ctrl``.

    A world whose action is NaN or infinite is marked, and stepped with an action of zeros.
    """
    action, ctrl = args.action[world], args.ctrl[world]
    count = int(0)
    for i in range(0, action.shape[0], AT_ONCE):
        some = read_some(action, i)
        for j in range(AT_ONCE):
            count += wp.where(wp.isfinite(some[j]), 0, 1)
    non_finite = count > 0
    for i in range(0, action.shape[0], AT_ONCE):
        some = read_some(action, i)
        for j in range(AT_ONCE):
            limits = args.ctrlrange[0, wp.min(i + j, action.shape[0] - 1)]
            used = wp.where(non_finite, 0.0, wp.clamp(some[j], -1.0, 1.0))
            some[j] = 0.5 * (limits[0] + limits[1]) + 0.5 * (limits[1] - limits[0]) * used
        for j in range(AT_ONCE):
            if i + j < action.shape[0]:
                ctrl[i + j] = some[j]
    args.non_finite[world] = non_finite


# After it.


def observer(
    func: wp.Function, inputs: Any, outputs: Any, non_finite: wp.array, size: int, *, coalesced: bool
) -> WorldFunc:
    """Returns what writes observation, reward and terms, from what a body names in its ``observation_func``.

    It sets ``non_finite`` where an observation is not finite. If ``coalesced``, the threads of a warp take neighbouring
    worlds, and write observations, which have this size, together.
    """
    Inputs: Any = inputs._cls  # noqa: N806

    @wp.struct
    class Observer:
        inputs: Inputs
        outputs: Outputs
        non_finite: wp.array[bool]

    @wp.func
    def write_observation(world: int, args: Observer):
        out = args.outputs
        if wp.static(coalesced):
            observation = wp.zeros(shape=size, dtype=float)
            out.reward[world] = func(world, args.inputs, observation, out.terms[world])
            write_rows(observation, out.observation[world])
            mark_non_finite(observation, world, args.non_finite)
        else:
            out.reward[world] = func(world, args.inputs, out.observation[world], out.terms[world])
            mark_non_finite(out.observation[world], world, args.non_finite)

    return WorldFunc(write_observation, fill(Observer, inputs=inputs, outputs=outputs, non_finite=non_finite))


@wp.func
def observe_row(row: wp.array[float], first: int, observation: wp.array[float], k: int) -> int:
    """Copies the numbers of a row from ``first`` on into an observation at ``k``; returns where they end."""
    for i in range(first, row.shape[0], AT_ONCE):
        some = read_some(row, i)
        for j in range(AT_ONCE):
            if i + j < row.shape[0]:
                observation[k + j] = some[j]
        k += wp.min(AT_ONCE, row.shape[0] - i)
    return k


@wp.func
def count_non_finite(row: wp.array[float]) -> int:
    """Returns zero if all numbers are finite, else how many are not, the last perhaps more than once.

    It has no branch, which would wait for each number.
    """
    count = int(0)
    for i in range(0, row.shape[0], AT_ONCE):
        some = read_some(row, i)
        for j in range(AT_ONCE):
            count += wp.where(wp.abs(some[j]) < MAX_VALUE, 0, 1)  # counts NaN too
    return count


@wp.func
def mark_non_finite(row: wp.array[float], world: int, non_finite: wp.array[bool]):
    """Marks a world one of whose numbers in a row is not finite."""
    if count_non_finite(row) > 0:
        non_finite[world] = True


@wp.struct
class FiniteCheck:
    """What is checked besides the observation; where a number is not finite, ``outputs`` are zeroed."""

    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    outputs: Outputs
    non_finite: wp.array[bool]


@wp.func
def zero_non_finite(world: int, args: FiniteCheck):
    """Marks a world whose state or reward is not finite; zeroes observation, reward and terms of one that is marked."""
    out = args.outputs
    found = count_non_finite(args.qpos[world]) + count_non_finite(args.qvel[world])
    found += count_non_finite(args.qacc_warmstart[world])
    if args.non_finite[world] or found > 0 or not (wp.abs(out.reward[world]) < MAX_VALUE):
        args.non_finite[world] = True
        for i in range(out.observation.shape[1]):
            out.observation[world, i] = 0.0
        for i in range(out.terms.shape[1]):
            out.terms[world, i] = 0.0
        out.reward[world] = 0.0


@wp.struct
class StepEnd:
    """What ends a control step: all but the length, the bits and ``ended`` is written.

    ``ended`` and ``cut_off`` ``(nworld,)`` are what a task's hooks say of the episode; ``counts``
    ``(nworld, counters)`` has a last column for steps that end non-finite.
    """

    episode_length: int
    counter_bits: wp.array[int]
    overflow: wp.array[int]
    ended: wp.array[bool]
    cut_off: wp.array[bool]
    flags: Flags
    elapsed_steps: wp.array[int]
    mask: wp.array[bool]
    counts: wp.array2d[int]


@wp.func
def finish_step(world: int, args: StepEnd):
    """Ends a control step: applies the time limit, and counts what went wrong.

    A world is truncated at the time limit, and both as the task says, and terminated if it is not finite; what is done
    is masked for the reset that may follow. The bits of ``overflow`` are cleared.
    """
    non_finite = args.flags.non_finite[world]
    terminated = non_finite or args.ended[world]
    elapsed_steps = args.elapsed_steps[world] + 1
    truncated = elapsed_steps >= args.episode_length or args.cut_off[world]
    args.elapsed_steps[world] = elapsed_steps
    args.flags.terminated[world] = terminated
    args.flags.truncated[world] = truncated
    args.flags.done[world] = truncated or terminated
    args.mask[world] = truncated or terminated

    bits = args.overflow[world]
    for i in range(args.counter_bits.shape[0]):
        if bits & args.counter_bits[i] != 0:
            args.counts[world, i] += 1
    if non_finite:
        args.counts[world, args.counter_bits.shape[0]] += 1
    args.overflow[world] = 0


# At a reset.


@wp.struct
class EpisodeStart:
    """What begins an episode: from ``episode`` on all is written.

    ``stream`` ``(nworld,)`` is where its random numbers start.
    """

    stagger: wp.array[bool]
    seed: wp.array[wp.uint32]
    world_offset: int
    episode_length: int
    episode: wp.array[int]
    stream: wp.array[wp.uint32]
    elapsed_steps: wp.array[int]
    flags: Flags


@wp.func
def begin_episode(world: int, args: EpisodeStart):
    """Starts the next episode: its random stream, its clock and its flags."""
    episode = args.episode[world]
    elapsed_steps = int(0)
    if args.stagger[0]:
        # The complement of the episode separates this stream from the one that draws the pose.
        stream = world_stream(args.seed[0], args.world_offset + world, -1 - episode)
        elapsed_steps = wp.randi(stream, 0, args.episode_length)
    args.stream[world] = world_stream(args.seed[0], args.world_offset + world, episode)
    args.episode[world] = episode + 1
    args.elapsed_steps[world] = elapsed_steps
    args.flags.non_finite[world] = False
    args.flags.done[world] = False
    args.flags.terminated[world] = False
    args.flags.truncated[world] = False


def poser(func: wp.Function, inputs: Any, stream: wp.array) -> WorldFunc:
    """Returns what draws initial states from ``stream`` ``(nworld,)``, from what a body names in its ``pose_func``."""
    Inputs: Any = inputs._cls  # noqa: N806

    @wp.struct
    class Poser:
        inputs: Inputs
        stream: wp.array[wp.uint32]

    @wp.func
    def draw_pose(world: int, args: Poser):
        func(world, args.inputs, args.stream[world])

    return WorldFunc(draw_pose, fill(Poser, inputs=inputs, stream=stream))
