"""Verification: an exported policy, played in C MuJoCo on the robot's model at full accuracy.

What comes from an ONNX file alone needs MuJoCo, NumPy and onnxruntime; :mod:`.training_simulator` needs torch and the
task.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_loco.checks import COUNT, FRACTION, NOT_NEGATIVE, SEED, check_float, check_int, check_packages
from torchrl_loco.verification import velocity
from torchrl_loco.verification.c_mujoco import CMujoco
from torchrl_loco.verification.exported import Exported


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What a policy must hold in. All but number, length and seed of the episodes is for robots with a velocity."""

    episodes: int = 256
    """Number of episodes."""
    seconds: float | None = None
    """Length of an episode (s); default: 20 s for robots, else that of the task."""
    seed: int = 0
    """Seed of the episodes."""
    delay: tuple[int, int] = (0, 2)
    """Least and greatest delay of an action (control steps); episodes take turns."""
    friction: tuple[float, float] = (0.4, 1.2)
    """Least and greatest sliding friction, drawn for each episode."""
    noise: float = 1.0
    """Errors of the observation, as a share of those of the training."""
    pushes: float = 1.0
    """Changes of the velocity by pushes, as a share of those of the training."""
    max_falls: float = 0.01
    """Greatest share of episodes with a fall."""
    min_return: float = 0.9
    """For other tasks: least return, as a share of that in the simulator of the training."""

    def check(self) -> None:
        """Checks all values.

        Raises:
            ValueError: one is out of range.
            TypeError: one has the wrong type.
        """
        check_int("episodes", self.episodes)
        check_int("seed", self.seed, SEED)
        if self.seconds is not None:
            check_float("seconds", self.seconds)
        for name, values, check, interval in (
            ("delay", self.delay, check_int, COUNT),
            ("friction", self.friction, check_float, NOT_NEGATIVE),
        ):
            least, most = (check(name, value, interval) for value in values)
            if least > most:
                raise ValueError(f"{name}: the least, {least}, must not be greater than the greatest, {most}")
        for name in ("noise", "pushes", "min_return"):
            check_float(name, getattr(self, name), NOT_NEGATIVE)
        check_float("max_falls", self.max_falls, FRACTION)


@dataclasses.dataclass(frozen=True)
class Report:
    """What was found.

    Attributes:
        holds: whether the policy holds.
        lines: it, to be printed.
        figures: it, as JSON can hold it.
    """

    holds: bool
    lines: list[str]
    figures: dict[str, Any]


def verify(path: Path, conditions: Conditions = Conditions(), device: str | None = None) -> Report:
    """Plays an exported policy in C MuJoCo, beside the simulator in which it was trained.

    Robots that follow a velocity command meet fixed and drawn commands, late actions, errors of the observation,
    friction and pushes, the same ones in both simulators. For other tasks, returns of episodes from the same starts are
    compared. First it is checked that the file's layout is what the task observes and controls.

    Args:
        path: an ONNX file that :func:`torchrl_loco.export_policy` wrote.
        conditions: what it must hold in.
        device: where the simulator of the training computes; ``None`` takes CUDA if there is any.

    Returns:
        What was found. Without the task of a robot at hand, it is of C MuJoCo alone, and says so.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it does not say how to play it, its layout is not what the task observes, or the task cannot be
            verified.
        ImportError: onnxruntime is missing, or the task of a policy without a velocity is.
    """
    check_packages("verifying", ("onnxruntime",), "onnx")
    conditions.check()
    exported = Exported(path)
    play = _velocity if "velocity" in exported.facts else _returns
    return play(exported, conditions, device)


def _velocity(exported: Exported, conditions: Conditions, device: str | None) -> Report:
    n, seed = conditions.episodes, conditions.seed
    seconds = 20.0 if conditions.seconds is None else conditions.seconds
    varied = {name: getattr(conditions, name) for name in ("delay", "friction", "noise", "pushes")}
    episodes = velocity.draw(exported, n, seconds, seed, **varied)
    why_alone = why_not_at_hand(exported.task)
    if not why_alone:
        from torchrl_loco.verification import training_simulator

        training = training_simulator.TrainingSimulator(exported, episodes.friction, seed, device)
        training_simulator.check_layout(exported, training.env, seed)
    outcomes = {"C MuJoCo": velocity.play(exported, CMujoco(exported, n, episodes.friction), episodes, "C MuJoCo")}
    if not why_alone:
        outcomes["training simulator"] = velocity.play(exported, training, episodes, "training simulator")

    rows = {"all": np.ones(n, dtype=bool)}
    if conditions.episodes > 1:
        rows |= {"fixed commands": episodes.is_fixed, "drawn commands": ~episodes.is_fixed}
    if len(delays := np.unique(episodes.delay)) > 1:
        rows |= {f"delay {delay}": episodes.delay == delay for delay in delays}
    table = {simulator: {name: played.of(row) for name, row in rows.items()} for simulator, played in outcomes.items()}
    falls = table["C MuJoCo"]["all"]["falls"] / n
    holds = falls <= conditions.max_falls
    length = f"{n} episodes of {seconds:g} s"
    head = f"{exported.task} in C MuJoCo {_version()}, {length}, {_describe(conditions)}"
    bound = f"falls in {falls:.1%} of the episodes, {conditions.max_falls:.1%} are allowed"
    lines = [head, *_lines(table), *([f"not beside the training simulator: {why_alone}"] if why_alone else [])]
    return _report(holds, lines, bound, exported, conditions, {"outcomes": table})


def why_not_at_hand(task: str) -> str:
    """Returns why a task cannot be made here, an empty string if it can."""
    try:
        from torchrl_loco.registry import resolve

        resolve(task)
    except (ValueError, OSError, ImportError) as error:
        return str(error)
    return ""


def _returns(exported: Exported, conditions: Conditions, device: str | None) -> Report:
    from torchrl_loco.verification import training_simulator

    n = conditions.episodes
    env = training_simulator.make(exported, n, conditions.seed, device)
    training_simulator.check_layout(exported, env, conditions.seed)
    env.set_seed(conditions.seed)
    steps = env.config.episode_length
    if conditions.seconds is not None:
        steps = min(steps, max(round(conditions.seconds / env.config.ctrl_dt), 1))
    returns = training_simulator.compare_returns(exported, env, steps)
    there, here = returns.there.mean(), returns.here.mean()
    bound = f"return {there:.1f}, {conditions.min_return:.0%} of {here:.1f} are asked for"
    lines = [f"{exported.task} in C MuJoCo {_version()}, {n} episodes of {steps} control steps"]
    figures = {}
    for name, values in (("C MuJoCo", returns.there), ("training simulator", returns.here)):
        figures[name] = {"mean": values.mean(), "std": values.std(), "min": values.min(), "max": values.max()}
        words = "return {mean:.1f} +- {std:.1f} (min {min:.1f}, max {max:.1f})".format(**figures[name])
        lines.append(f"{name:<20}{words}")
    holds = bool(there >= conditions.min_return * here)
    return _report(holds, lines, bound, exported, conditions, {"returns": figures})


def _report(
    holds: bool, lines: list[str], bound: str, exported: Exported, conditions: Conditions, found: dict[str, Any]
) -> Report:
    lines = [*lines, f"{'holds' if holds else 'DOES NOT HOLD'}: {bound}"]
    about = {"task": exported.task, "protocol": exported.facts["protocol"], "mujoco": _version()}
    figures = {"holds": holds, **about, "conditions": dataclasses.asdict(conditions), **found}
    return Report(holds, lines, figures)


def _version() -> str:
    import mujoco

    return mujoco.__version__


def _describe(conditions: Conditions) -> str:
    """Returns the conditions of robots in words."""
    (first, last), (low, high) = conditions.delay, conditions.friction
    delay = f"{first}" if first == last else f"{first} to {last}"
    return (
        f"actions {delay} control steps late, friction {low:g} to {high:g}, "
        f"{conditions.noise:g} x the noise and {conditions.pushes:g} x the pushes of the training"
    )


def _lines(table: dict[str, dict[str, dict[str, float]]]) -> list[str]:
    """Returns falls and errors of all simulators, a line for each kind of episodes."""
    heads = "".join(f"{simulator:>36}" for simulator in table)
    units = "".join(f"{'falls':>12}{'error m/s':>12}{'rad/s':>12}" for _ in table)
    lines = [f"{'':<16}{heads}", f"{'':<16}{units}"]
    for name in next(iter(table.values())):
        words = ""
        for rows in table.values():
            row = rows[name]
            falls = f"{row['falls']} of {row['episodes']}"
            words += f"{falls:>12}{row['linear_error']:>12.3f}{row['angular_error']:>12.3f}"
        lines.append(f"{name:<16}{words}")
    return lines
