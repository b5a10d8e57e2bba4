"""Robots that follow a velocity command: falls and tracking errors, the same episodes in any simulator.

A file's ``velocity`` holds ``base`` and ``trunk``, names of bodies; ``fallen``, the cosine of the tilt at which the
trunk has fallen; ``command_low`` and ``command_high`` (m/s, m/s, rad/s), ``command_every``, least and greatest time for
which a command holds (s), and ``still``, the share of commands that stand still; ``push``, the greatest change of the
base's velocity (m/s, rad/s), ``push_every``, least and greatest time between pushes (s); ``start_height``, least and
greatest height above the home pose at the start (m).
"""

import dataclasses
import itertools
from typing import Any, Protocol

import numpy as np
from tqdm.auto import trange

from torchrl_loco.verification.conditions import Conditions
from torchrl_loco.verification.exported import Exported
from torchrl_loco.verification.layout import State, into_frame

SETTLING = 1.5
"""Time after a new command for which errors do not count (s)."""


class Simulator(Protocol):
    """What plays the episodes: worlds of either simulator."""

    state: State
    failed: np.ndarray

    def begin(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Puts all worlds into states."""

    def act(self, action: np.ndarray, worlds: np.ndarray) -> None:
        """Steps the worlds of a mask by a control step under the policy's actions ``(n, nu)``."""

    def push(self, change: np.ndarray) -> None:
        """Changes the velocities of the bases, ``(n, 6)`` (m/s, rad/s)."""


@dataclasses.dataclass(frozen=True)
class Episodes:
    """What happens in n episodes, whatever the policy does: all that is drawn.

    Attributes:
        qpos: poses at the start, ``(n, nq)``.
        command: command of each control step, ``(steps, n, 3)`` (m/s, m/s, rad/s).
        age: control steps since it was new, ``(steps, n)``.
        is_fixed: whether an episode has one command throughout, ``(n,)``.
        push: change of the base's velocity after each control step, ``(steps, n, 6)`` (m/s, rad/s).
        delay: control steps by which actions are late, ``(n,)``.
        friction: sliding friction, ``(n,)``.
        noise: errors of the observation, a share of those of the training.
        seed: seed of these errors.
    """

    qpos: np.ndarray
    command: np.ndarray
    age: np.ndarray
    is_fixed: np.ndarray
    push: np.ndarray
    delay: np.ndarray
    friction: np.ndarray
    noise: float
    seed: int


def draw(exported: Exported, conditions: Conditions, seconds: float) -> Episodes:
    """Returns what happens in episodes.

    The first half have one of the fixed commands throughout: standing, and each way and both turns at the limits of the
    range; the others draw a new one as in training.

    Args:
        exported: the policy.
        conditions: what they are drawn from.
        seconds: their length (s).

    Raises:
        ValueError: the base is not the model's first joint.
    """
    facts, dt = exported.facts["velocity"], exported.facts["control_timestep"]
    n, steps, generator = conditions.episodes, max(round(seconds / dt), 1), np.random.default_rng(conditions.seed)
    if int(exported.model.body(facts["base"]).jntadr[0]) != 0:
        raise ValueError(f"the free joint of {facts['base']}, which is pushed, must be the model's first joint")
    qpos, yaw = np.tile(np.array(exported.facts["home"]), (n, 1)), generator.uniform(-np.pi, np.pi, n)
    lowest, highest = facts["start_height"]
    qpos[:, 2] += generator.uniform(lowest, highest, n)
    qpos[:, 3:7] = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)

    low, high = np.array(facts["command_low"]), np.array(facts["command_high"])
    is_fixed = np.arange(n) < n // 2
    command, age, push = np.zeros((steps, n, 3)), np.zeros((steps, n), dtype=int), np.zeros((steps, n, 6))
    fixed = itertools.cycle(fixed_commands(low, high))
    for i in range(n):
        if is_fixed[i]:
            command[:, i], age[:, i] = next(fixed), np.arange(steps)
        else:
            for first, last in _intervals(generator, facts["command_every"], steps, dt):
                goes = generator.random() >= facts["still"]
                command[first:last, i] = generator.uniform(low, high) * goes
                age[first:last, i] = np.arange(last - first)
        for _, last in _intervals(generator, facts["push_every"], steps, dt):
            if last < steps:
                push[last, i] = conditions.pushes * generator.uniform(-1.0, 1.0, 6) * facts["push"]
    least, most = conditions.delay
    return Episodes(
        qpos=qpos,
        command=command,
        age=age,
        is_fixed=is_fixed,
        push=push,
        delay=generator.permutation(least + np.arange(n) % (most - least + 1)),
        friction=generator.uniform(*conditions.friction, size=n),
        noise=conditions.noise,
        seed=conditions.seed,
    )


def fixed_commands(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Returns the fixed commands: standing, each limit of a component alone, and both limits of all together."""
    alone = [np.eye(3)[k] * bound[k] for k in range(3) for bound in (high, low)]
    return [np.zeros(3), *alone, high, low]


def _intervals(generator: np.random.Generator, every: Any, steps: int, dt: float) -> list[tuple[int, int]]:
    """Returns first and last control step, exclusive, of intervals whose lengths are drawn (s)."""
    ends = [0]
    while ends[-1] < steps:
        ends.append(ends[-1] + max(round(generator.uniform(*every) / dt), 1))
    return list(itertools.pairwise([*ends[:-1], steps]))


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a policy did, by episode.

    Attributes:
        fell: whether the trunk fell, the simulation failed or an action was not finite, ``(n,)``.
        steps: control steps until then or to the end, ``(n,)``.
        linear: sum of the errors of the horizontal velocity (m/s), ``(n,)``.
        angular: sum of the errors of the yaw rate (rad/s), ``(n,)``.
        counted: control steps in these sums, ``(n,)``.
    """

    fell: np.ndarray
    steps: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    counted: np.ndarray

    def of(self, episodes: np.ndarray) -> dict[str, float | None]:
        """Returns falls, mean length (control steps) and mean errors of the episodes of a mask.

        An error is ``None`` if no control step of these episodes counted.
        """
        counted = int(self.counted[episodes].sum())
        errors = {"linear_error": self.linear, "angular_error": self.angular}  # m/s, rad/s
        return {
            "episodes": int(episodes.sum()),
            "falls": int(self.fell[episodes].sum()),
            "mean_steps": float(self.steps[episodes].mean()),
            **{name: float(sums[episodes].sum() / counted) if counted else None for name, sums in errors.items()},
        }


def play(exported: Exported, simulator: Simulator, episodes: Episodes, label: str) -> Outcome:
    """Plays the policy in worlds of a simulator.

    Args:
        exported: the policy.
        simulator: its worlds, one for each episode.
        episodes: what happens in them.
        label: of the progress bar.

    Returns:
        How it did.
    """
    facts, layout, m = exported.facts["velocity"], exported.layout, exported.model
    base, trunk = m.body(facts["base"]).id, m.body(facts["trunk"]).id
    steps, n, settling = *episodes.command.shape[:2], round(SETTLING / exported.facts["control_timestep"])
    generator, worlds = np.random.default_rng([episodes.seed, 1]), np.arange(n)
    bias = episodes.noise * generator.uniform(-1.0, 1.0, (n, layout.size)) * layout.bias
    late = np.zeros((episodes.delay.max() + 1, n, m.nu))  # actions, the newest first
    alive, played, counted = np.ones(n, dtype=bool), np.zeros(n, dtype=int), np.zeros(n, dtype=int)
    linear, angular = np.zeros(n), np.zeros(n)

    simulator.begin(episodes.qpos, np.zeros((n, m.nv)))
    for t in trange(steps, desc=label, leave=False, disable=None):  # no bar in logs
        if t % exported.hold == 0:
            seen = layout(simulator.state, late[0], episodes.command[t])
            noise = episodes.noise * generator.uniform(-1.0, 1.0, seen.shape) * layout.noise
            action = exported.act(seen + noise + bias)
            alive &= np.isfinite(action).all(1)
        late = np.concatenate([np.where(np.isfinite(action), action, 0.0)[None], late[:-1]])
        simulator.act(late[episodes.delay, worlds], alive)
        state = simulator.state
        alive &= ~simulator.failed & (state.xmat[:, trunk, 2, 2] >= facts["fallen"])
        played += alive

        velocity, rate = into_frame(state.xmat[:, base], state.qvel[:, :3]), state.qvel[:, 5]
        counts = alive & (episodes.age[t] >= settling)
        command = episodes.command[t]
        linear += np.where(counts, np.linalg.norm(command[:, :2] - velocity[:, :2], axis=1), 0.0)
        angular += np.where(counts, np.abs(command[:, 2] - rate), 0.0)
        counted += counts
        simulator.push(episodes.push[t] * alive[:, None])
        if not alive.any():
            break
    return Outcome(~alive, played, linear, angular, counted)
