"""From an exported policy to a report: whether it holds in C MuJoCo, beside the simulator in which it was trained."""

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from torchrl_loco.checks import check_bool, check_packages
from torchrl_loco.verification import velocity
from torchrl_loco.verification.c_mujoco import CMujoco
from torchrl_loco.verification.conditions import DEFAULT, Conditions
from torchrl_loco.verification.exported import Exported


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


def verify(
    path: Path,
    conditions: Conditions = DEFAULT,
    device: str | None = None,
    *,
    alone: bool = False,
    task: str | None = None,
) -> Report:
    """Plays an exported policy in C MuJoCo, beside the simulator in which it was trained.

    Robots that follow a velocity command meet fixed and drawn commands, late actions, errors of the observation,
    friction and pushes, the same ones in both simulators. For other tasks, returns of episodes from the same starts are
    compared. First it is checked that the file's layout is what the task observes and controls.

    Args:
        path: an ONNX file that :func:`torchrl_loco.export_policy` wrote.
        conditions: what it must hold in.
        device: where the simulator of the training computes; ``None`` takes CUDA if there is any.
        alone: whether to play a robot in C MuJoCo alone, which is quicker on a CPU.
        task: the name of its task, as the user says; ``None`` for what the file says.

    Returns:
        What was found. Without the task of a robot at hand, it is of C MuJoCo alone, and says so.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it does not say how to play it, its layout is not what the task observes, or the task cannot be
            verified, or not alone.
        ImportError: onnxruntime is missing, or the task of a policy without a velocity is.
    """
    check_packages("verifying", ("onnxruntime",), "onnx")
    conditions.check()
    check_bool("alone", alone)
    exported = Exported(path, task)
    if "velocity" in exported.facts:
        return _velocity(exported, conditions, device, alone)
    if alone:
        raise ValueError(
            "only robots with a velocity command can be played alone: what others earn is found by their own code, in "
            "the simulator of the training"
        )
    return _returns(exported, conditions, device)


def _velocity(exported: Exported, conditions: Conditions, device: str | None, alone: bool) -> Report:
    n, seed = conditions.episodes, conditions.seed
    seconds = 20.0 if conditions.seconds is None else conditions.seconds
    episodes = velocity.draw(exported, conditions, seconds)
    unknown, training = why_not_at_hand(exported.task), None
    if not unknown:
        from torchrl_loco.verification import training_simulator

        worlds = training_simulator.RANDOM_STATES if alone else n
        training = training_simulator.TrainingSimulator(exported, np.resize(episodes.friction, worlds), seed, device)
        training_simulator.check_layout(exported, training.env, seed)
    outcomes = {"C MuJoCo": velocity.play(exported, CMujoco(exported, n, episodes.friction), episodes, "C MuJoCo")}
    if training is not None and not alone:
        outcomes["training simulator"] = velocity.play(exported, training, episodes, "training simulator")

    rows = {"all": np.ones(n, dtype=bool)}
    if n > 1:
        rows |= {"fixed commands": episodes.is_fixed, "drawn commands": ~episodes.is_fixed}
    if len(delays := np.unique(episodes.delay)) > 1:
        rows |= {f"delay {delay}": episodes.delay == delay for delay in delays}
    table = {simulator: {name: played.of(row) for name, row in rows.items()} for simulator, played in outcomes.items()}
    falls = float(outcomes["C MuJoCo"].fell.mean())
    holds = falls <= conditions.max_falls
    length = f"{n} episodes of {seconds:g} s"
    head = f"{exported.task} in C MuJoCo {mujoco.__version__}, {length}, {_describe(conditions)}"
    bound = f"falls in {falls:.1%} of the episodes, {conditions.max_falls:.1%} are allowed"
    lines = [head, *_lines(table), *([f"not beside the training simulator: {unknown}"] if unknown else [])]
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
    alike = n > 1 and training_simulator.begin_alike(env)
    if alike:
        env.close()
        env, n = training_simulator.make(exported, 1, conditions.seed, device), 1
    env.set_seed(conditions.seed)
    steps = env.config.episode_length
    if conditions.seconds is not None:
        steps = min(steps, max(round(conditions.seconds / env.config.ctrl_dt), 1))
    returns = training_simulator.compare_returns(exported, env, steps)
    there, here = returns.there.mean(), returns.here.mean()
    least = here - (1.0 - conditions.min_return) * abs(here)
    bound = f"return {there:.1f}, at least {least:.1f} is asked for"
    episodes = "1 episode, since all begin alike," if alike else f"{n} episodes"
    lines = [f"{exported.task} in C MuJoCo {mujoco.__version__}, {episodes} of {steps} control steps"]
    figures = {}
    for name, values in (("C MuJoCo", returns.there), ("training simulator", returns.here)):
        figures[name] = {"mean": values.mean(), "std": values.std(), "min": values.min(), "max": values.max()}
        words = "return {mean:.1f} +- {std:.1f} (min {min:.1f}, max {max:.1f})".format(**figures[name])
        lines.append(f"{name:<20}{words}")
    holds = bool(there >= least)
    return _report(holds, lines, bound, exported, conditions, {"returns": figures})


def _report(
    holds: bool, lines: list[str], bound: str, exported: Exported, conditions: Conditions, found: dict[str, Any]
) -> Report:
    lines = [*lines, f"{'holds' if holds else 'DOES NOT HOLD'}: {bound}"]
    about = {"task": exported.task, "protocol": exported.facts["protocol"], "mujoco": mujoco.__version__}
    figures = {"holds": holds, **about, "conditions": dataclasses.asdict(conditions), **found}
    return Report(holds, lines, figures)


def _describe(conditions: Conditions) -> str:
    """Returns the conditions of robots in words."""
    (first, last), (low, high) = conditions.delay, conditions.friction
    delay = f"{first}" if first == last else f"{first} to {last}"
    return (
        f"actions {delay} control steps late, friction {low:g} to {high:g}, "
        f"noise x {conditions.noise:g}, pushes x {conditions.pushes:g}"
    )


def _lines(table: dict[str, dict[str, dict[str, Any]]]) -> list[str]:
    """Returns falls and errors of all simulators, a line for each kind of episodes."""
    heads = "".join(f"{simulator:>36}" for simulator in table)
    units = "".join(f"{'falls':>12}{'error m/s':>12}{'rad/s':>12}" for _ in table)
    lines = [f"{'':<16}{heads}", f"{'':<16}{units}"]
    for name in next(iter(table.values())):
        words = ""
        for rows in table.values():
            row = rows[name]
            errors = (row["linear_error"], row["angular_error"])
            shown = ["-" if error is None else f"{error:.3f}" for error in errors]
            words += "".join(f"{word:>12}" for word in (f"{row['falls']} of {row['episodes']}", *shown))
        lines.append(f"{name:<16}{words}")
    return lines
