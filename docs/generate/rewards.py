"""The rewards as formulas. A test computes them from the same numbers and compares with the environments."""

import dataclasses
import math

from torchrl_loco.registry import env_class
from torchrl_loco.tasks import hopper, humanoid, walker

UPRIGHT = "$u$ the z component of the torso's z axis (1 upright, -1 upside down)"
VELOCITY = "$v$ the velocity of the center of mass (m/s)"


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """A call of dm_control's ``tolerance``, with LaTeX for what it judges."""

    of: str
    lower: float
    upper: float
    margin: float
    sigmoid: str = "gaussian"
    value: float = 0.1

    def latex(self) -> str:
        """Returns the call as LaTeX: bounds, margin, and the sigmoid if it is not the Gaussian."""
        bounds = rf"[{self.lower:g}, \infty)" if math.isinf(self.upper) else f"[{self.lower:g}, {self.upper:g}]"
        kind = "" if self.sigmoid == "gaussian" else rf",\ \text{{{self.sigmoid}}},\ {self.value:g}"
        return rf"\mathrm{{tol}}\left({self.of};\ {bounds},\ {self.margin:g}{kind}\right)"


@dataclasses.dataclass(frozen=True)
class Reward:
    """How the reward of a task is put together.

    Args:
        parts: the tolerances, by name.
        lines: name and LaTeX of each line of the formula, but for the last, which multiplies the terms.
        symbols: what the symbols mean, as Markdown.
    """

    parts: dict[str, Tolerance]
    lines: list[tuple[str, str]]
    symbols: str


def reward(task: str) -> Reward:
    """Returns how the reward of a task is put together."""
    cls = env_class(task)
    return BODIES[cls.body](cls.target_speed)


def _walker(speed: float) -> Reward:
    height = float(walker.STAND_HEIGHT)
    parts = {"standing": Tolerance("z", height, math.inf, height / 2)}
    symbols = f"$z$ the height of the torso (m), {UPRIGHT}"
    lines = [
        ("standing", parts["standing"].latex()),
        ("upright", r"\tfrac{1}{2} (1 + u)"),
        ("stand", r"\tfrac{1}{4} (3\,\text{standing} + \text{upright})"),
    ]
    if speed > 0:
        parts["fast"] = Tolerance("v_x", speed, math.inf, speed / 2, "linear", 0.5)
        lines.append(("move", _share(parts["fast"])))
        symbols += f", {VELOCITY}"
    return Reward(parts, lines, symbols)


def _humanoid(speed: float) -> Reward:
    height = float(humanoid.STAND_HEIGHT)
    parts = {
        "standing": Tolerance("z", height, math.inf, height / 4),
        "upright": Tolerance("u", 0.9, math.inf, 1.9, "linear", 0.0),
        "gentle": Tolerance("a_i", 0.0, 0.0, 1.0, "quadratic", 0.0),
    }
    if speed > 0:
        parts["fast"] = Tolerance(r"\sqrt{v_x^2 + v_y^2}", speed, math.inf, speed, "linear", 0.0)
        move = _share(parts["fast"])
    else:
        parts |= {"still_x": Tolerance("v_x", 0.0, 0.0, 2.0), "still_y": Tolerance("v_y", 0.0, 0.0, 2.0)}
        move = rf"\tfrac{{1}}{{2}} \left({parts['still_x'].latex()} + {parts['still_y'].latex()}\right)"
    lines = [
        ("standing", parts["standing"].latex()),
        ("upright", parts["upright"].latex()),
        ("small_control", _gentle(parts["gentle"], 21)),
        ("move", move),
    ]
    return Reward(parts, lines, f"$z$ the height of the head (m), {UPRIGHT}, {VELOCITY}, $a$ the action")


def _cheetah(speed: float) -> Reward:
    parts = {"fast": Tolerance("v_x", speed, math.inf, speed, "linear", 0.0)}
    return Reward(parts, [("move", parts["fast"].latex())], VELOCITY)


def _hopper(speed: float) -> Reward:
    parts = {"standing": Tolerance("z", float(hopper.STAND_HEIGHT), float(hopper.MAX_HEIGHT), 0.0)}
    symbols = "$z$ the height of the torso's center of mass above the foot's (m)"
    if speed > 0:
        parts["fast"] = Tolerance("v_x", speed, math.inf, speed / 2, "linear", 0.5)
        line, symbols = ("hopping", parts["fast"].latex()), f"{symbols}, {VELOCITY}"
    else:
        parts["gentle"] = Tolerance("a_i", 0.0, 0.0, 1.0, "quadratic", 0.0)
        line, symbols = ("small_control", _gentle(parts["gentle"], 4)), f"{symbols}, $a$ the action"
    return Reward(parts, [("standing", parts["standing"].latex()), line], symbols)


def _quadruped(speed: float) -> Reward:
    parts = {
        "upright": Tolerance("u", 1.0, math.inf, 2.0, "linear", 0.0),
        "fast": Tolerance("v_x", speed, math.inf, speed, "linear", 0.5),
    }
    lines = [("upright", parts["upright"].latex()), ("move", parts["fast"].latex())]
    return Reward(parts, lines, f"{UPRIGHT}, $v$ the velocity of the torso in its own frame (m/s)")


BODIES = {"walker": _walker, "humanoid": _humanoid, "cheetah": _cheetah, "hopper": _hopper, "quadruped": _quadruped}
"""What puts the reward of a body's task together from its target speed."""


def _share(fast: Tolerance) -> str:
    """Returns the factor by which dm_control rewards speed beside standing."""
    return rf"\tfrac{{1}}{{6}} \left(1 + 5\,{fast.latex()}\right)"


def _gentle(gentle: Tolerance, actuators: int) -> str:
    """Returns the factor by which dm_control rewards small actions."""
    return rf"\tfrac{{1}}{{5}} \left(4 + \tfrac{{1}}{{{actuators}}} \sum_i {gentle.latex()}\right)"


def formula(task: str) -> str:
    """Returns a task's reward as an aligned display of LaTeX, and what its symbols mean, as Markdown."""
    made, names = reward(task), env_class(task).term_names
    product = r" \cdot ".join(rf"\text{{{term}}}" for term in names)
    aligned = " \\\\\n".join(rf"\text{{{name}}} &= {latex}" for name, latex in [*made.lines, ("reward", product)])
    terms = ", ".join(f"`{term}`" for term in names)
    listed = f"Terms under `reward_terms=True`, which multiply to the reward: {terms}."
    return (
        f"```math\n\\begin{{aligned}}\n{aligned}\n\\end{{aligned}}\n```\n\n"
        f"with {made.symbols}. $\\mathrm{{tol}}$ is dm_control's "
        "[tolerance](../api/rewards.md): 1 within the bounds; outside it decreases to 0.1 at the margin, as a Gaussian "
        "unless another sigmoid and value are given, and is 0 without a margin.\n\n"
        f"{listed if len(names) > 1 else f'The only term under `reward_terms=True` is {terms}.'}\n"
    )
