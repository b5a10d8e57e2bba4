"""dm_control's ``tolerance`` in plain torch, for the hooks of a task. In kernels it is ``torchrl_loco.rewards``."""

import math
from collections.abc import Callable

import torch

from torchrl_loco.checks import check_choice

SIGMOIDS: dict[str, Callable[[torch.Tensor, float], torch.Tensor]] = {
    "gaussian": lambda x, value: torch.exp(math.log(value) * x.square()),
    "linear": lambda x, value: (1.0 - x.abs() * (1.0 - value)).clamp(min=0.0),
    "hyperbolic": lambda x, value: 1.0 / torch.cosh(x * math.acosh(1.0 / value)),
    "long_tail": lambda x, value: 1.0 / (1.0 + x.square() * (1.0 / value - 1.0)),
    "reciprocal": lambda x, value: 1.0 / (1.0 + x.abs() * (1.0 / value - 1.0)),
    "cosine": lambda x, value: 0.5 * (1.0 + torch.cos((x.abs() * math.acos(2.0 * value - 1.0)).clamp(max=math.pi))),
    "quadratic": lambda x, value: (1.0 - x.square() * (1.0 - value)).clamp(min=0.0),
    "tanh_squared": lambda x, value: 1.0 - torch.tanh(x * math.atanh(math.sqrt(1.0 - value))).square(),
}
"""By name: 1 at 0, and ``value`` at 1."""

FALLS_TO_ZERO = ("linear", "cosine", "quadratic")  # sigmoids whose value at the margin may be 0


def tolerance(
    x: torch.Tensor,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> torch.Tensor:
    """Returns 1 where ``x`` lies within bounds, falling off outside, in [0, 1]; of the shape of ``x``.

    Args:
        x: the values to judge, in any unit.
        bounds: lower and upper bound, in the unit of ``x``; may be infinite.
        margin: distance from the nearer bound at which the result is ``value_at_margin``, in the unit of ``x``; 0 makes
            it 0 everywhere outside.
        sigmoid: shape of the fall-off, one of ``SIGMOIDS``.
        value_at_margin: result at the margin, in (0, 1); 0 too for the sigmoids ``linear``, ``cosine`` and
            ``quadratic``.

    Raises:
        ValueError: bounds, margin, sigmoid or value are not valid; the message says what is.

    Source: dm_control ``utils/rewards.py``.
    """
    lower, upper = bounds
    check_choice("sigmoid", sigmoid, SIGMOIDS)
    if lower > upper:
        raise ValueError(f"bounds must be (lower, upper), got {bounds}")
    if margin < 0:
        raise ValueError(f"margin must be 0 or more, got {margin}")
    lowest = "[0" if sigmoid in FALLS_TO_ZERO else "(0"
    if not (0 < value_at_margin < 1 or (value_at_margin == 0 and sigmoid in FALLS_TO_ZERO)):
        raise ValueError(f"value_at_margin must lie in {lowest}, 1) for {sigmoid}, got {value_at_margin}")
    inside = (x >= lower) & (x <= upper)
    if margin == 0:
        return inside.to(x.dtype)
    distance = torch.maximum(lower - x, x - upper) / margin
    return torch.where(inside, 1.0, SIGMOIDS[sigmoid](torch.where(inside, 0.0, distance), value_at_margin))
