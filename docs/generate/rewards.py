"""The rewards as formulas. A test computes them from the same numbers and compares with the environments."""

import dataclasses
import math

from torchrl_loco.envs import humanoid, walker
from torchrl_loco.registry import env_class


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
        return rf"\operatorname{{tol}}\left({self.of};\ {bounds},\ {self.margin:g}{kind}\right)"


def tolerances(task: str) -> dict[str, Tolerance]:
    """Returns the tolerances that a task's reward is made of, by name."""
    cls = env_class(task)
    speed = cls.target_speed
    if cls.body == "walker":
        height = float(walker.STAND_HEIGHT)
        parts = {"standing": Tolerance("z", height, math.inf, height / 2)}
        if speed > 0:
            parts["fast"] = Tolerance("v_x", speed, math.inf, speed / 2, "linear", 0.5)
        return parts
    height = float(humanoid.STAND_HEIGHT)
    parts = {
        "standing": Tolerance("z", height, math.inf, height / 4),
        "upright": Tolerance("u", 0.9, math.inf, 1.9, "linear", 0.0),
        "gentle": Tolerance("a_i", 0.0, 0.0, 1.0, "quadratic", 0.0),
    }
    if speed > 0:
        return parts | {"fast": Tolerance(r"\sqrt{v_x^2 + v_y^2}", speed, math.inf, speed, "linear", 0.0)}
    return parts | {"still_x": Tolerance("v_x", 0.0, 0.0, 2.0), "still_y": Tolerance("v_y", 0.0, 0.0, 2.0)}


def formula(task: str) -> str:
    """Returns a task's reward as an aligned display of LaTeX, and what its symbols mean, as Markdown."""
    parts = {name: part.latex() for name, part in tolerances(task).items()}
    cls = env_class(task)
    lines = [("standing", parts["standing"])]
    if cls.body == "walker":
        lines.append(("upright", r"\tfrac{1}{2} (1 + u)"))
        lines.append(("stand", r"\tfrac{1}{4} (3\,\text{standing} + \text{upright})"))
    else:
        lines += [
            ("upright", parts["upright"]),
            ("small_control", rf"\tfrac{{1}}{{5}} \left(4 + \tfrac{{1}}{{21}} \sum_i {parts['gentle']}\right)"),
        ]
    if "fast" in parts:
        lines.append(("move", rf"\tfrac{{1}}{{6}} \left(1 + 5\,{parts['fast']}\right)"))
    elif cls.body == "humanoid":
        lines.append(("move", rf"\tfrac{{1}}{{2}} \left({parts['still_x']} + {parts['still_y']}\right)"))
    product = r" \cdot ".join(rf"\text{{{term}}}" for term in cls.term_names)
    lines.append(("reward", product))
    aligned = " \\\\\n".join(rf"\text{{{name}}} &= {latex}" for name, latex in lines)
    part, mover = ("torso", "") if cls.body == "walker" else ("head", ", $a$ the action")
    velocity = "" if task == "walker_stand" else ", $v$ the velocity of the center of mass (m/s)"
    terms = ", ".join(f"`{term}`" for term in cls.term_names)
    return (
        f"$$\n\\begin{{aligned}}\n{aligned}\n\\end{{aligned}}\n$$\n\n"
        f"with $z$ the height of the {part} (m), $u$ the z component of the torso's z axis (1 upright, -1 upside down)"
        f"{velocity}{mover}. $\\operatorname{{tol}}$ is dm_control's "
        "[tolerance](../api/rewards.md): 1 within the bounds; outside it decreases to 0.1 at the margin, as a Gaussian "
        "unless another sigmoid and value are given.\n\n"
        f"Terms under `reward_terms=True`, which multiply to the reward: {terms}.\n"
    )
