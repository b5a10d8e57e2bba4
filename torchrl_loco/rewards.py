"""dm_control's ``tolerance``, its eight sigmoids and what its rewards share, as Warp functions for use in kernels."""

import enum

import warp as wp


class Sigmoid(enum.IntEnum):
    """Shape of :func:`tolerance` outside its bounds; the names are dm_control's."""

    GAUSSIAN = 0
    LINEAR = 1
    HYPERBOLIC = 2
    LONG_TAIL = 3
    RECIPROCAL = 4
    COSINE = 5
    QUADRATIC = 6
    TANH_SQUARED = 7


@wp.func
def sigmoid(x: float, value_at_1: float, kind: int) -> float:
    """Value at ``x`` of a sigmoid that is 1 at 0 and ``value_at_1`` at 1."""
    if kind == Sigmoid.LINEAR:
        return wp.max(1.0 - wp.abs(x) * (1.0 - value_at_1), 0.0)
    if kind == Sigmoid.HYPERBOLIC:
        inverse = 1.0 / value_at_1
        return 1.0 / wp.cosh(x * wp.log(inverse + wp.sqrt(inverse * inverse - 1.0)))  # the logarithm is arccosh
    if kind == Sigmoid.LONG_TAIL:
        return 1.0 / (1.0 + x * x * (1.0 / value_at_1 - 1.0))
    if kind == Sigmoid.RECIPROCAL:
        return 1.0 / (1.0 + wp.abs(x) * (1.0 / value_at_1 - 1.0))
    if kind == Sigmoid.COSINE:
        angle = wp.min(wp.abs(x) * wp.acos(2.0 * value_at_1 - 1.0), wp.pi)
        return 0.5 * (1.0 + wp.cos(angle))
    if kind == Sigmoid.QUADRATIC:
        return wp.max(1.0 - x * x * (1.0 - value_at_1), 0.0)
    if kind == Sigmoid.TANH_SQUARED:
        root = wp.sqrt(1.0 - value_at_1)
        tanh = wp.tanh(x * (0.5 * wp.log((1.0 + root) / (1.0 - root))))  # the factor of x is arctanh
        return 1.0 - tanh * tanh
    return wp.exp(wp.log(value_at_1) * x * x)  # GAUSSIAN


@wp.func
def tolerance(
    x: float, lower: float, upper: float, margin: float = 0.0, kind: int = 0, value_at_margin: float = 0.1
) -> float:
    """Returns 1 where ``lower <= x <= upper`` and falls off outside, in [0, 1].

    Args:
        x: the value to judge, in any unit.
        lower: lower bound, in the unit of ``x``; may be ``-wp.inf``.
        upper: upper bound, in the unit of ``x``; may be ``wp.inf``.
        margin: distance from the nearer bound at which the result is ``value_at_margin``, in the unit of ``x``;
            0 makes it 0 everywhere outside.
        kind: the :class:`Sigmoid` of the fall-off.
        value_at_margin: result at the margin, within [0, 1) for LINEAR, COSINE and QUADRATIC and within (0, 1) for
            the others, which never reach 0.

    Source: dm_control ``utils/rewards.py``.
    """
    if x >= lower and x <= upper:
        return 1.0
    if margin <= 0.0:
        return 0.0
    distance = lower - x
    if x > upper:
        distance = x - upper
    return sigmoid(distance / margin, value_at_margin, kind)


@wp.func
def small_control(ctrl: wp.array[float]) -> float:
    """Returns dm_control's factor for small controls: 1 where all are 0, 0.8 where all are -1 or 1.

    Args:
        ctrl: controls of a world, ``(nu,)``.
    """
    small = float(0.0)
    for i in range(ctrl.shape[0]):
        small += tolerance(ctrl[i], 0.0, 0.0, 1.0, Sigmoid.QUADRATIC, 0.0)
    return (4.0 + small / float(ctrl.shape[0])) / 5.0
