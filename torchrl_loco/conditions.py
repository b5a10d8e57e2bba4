"""What a policy must hold in, as ``torchrl-loco verify`` plays it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from torchrl_loco.checks import COUNT, FRACTION, NOT_NEGATIVE, SEED, check_fields, check_float, check_int, within

PUSH = (0.5, 0.5, 0.4, 0.52, 0.52, 0.78)
"""Greatest change of a floating base's velocity by a push (m/s, rad/s), as mjlab 1.6 has it."""
PUSH_EVERY = (1.0, 3.0)  # least and greatest time between two pushes (s)


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What a policy must hold in. What is ``None`` is as the task says (:attr:`torchrl_loco.LocoEnv.holds`)."""

    episodes: int = 256
    """Number of episodes."""
    seconds: float | None = None
    """Length of an episode (s), at most that of the task."""
    seed: int = within(SEED, 0)
    """Seed of the episodes."""
    delay: tuple[int, int] | None = None
    """Least and greatest delay of an action (control steps); each has as many episodes."""
    friction: tuple[float, float] | None = None
    """Least and greatest sliding friction, drawn for each episode, of all geoms; of those of the robot alone where the
    ground is a torchrl_loco.terrain.Terrain, so that its feet need the priority, as those of ``go1_rough``."""
    noise: float = within(NOT_NEGATIVE, 1.0)
    """What the task's noise of the observation is multiplied by."""
    pushes: float | None = within(NOT_NEGATIVE, None)
    """Changes of a floating base's velocity by pushes, as a multiple of mjlab's."""
    max_falls: float | None = within(FRACTION, None)
    """Greatest share of episodes that terminate."""
    min_return: float | None = within(NOT_NEGATIVE, None)
    """Least return, as a share of that in the training simulator, or when its training ended if that is more."""

    def check(self) -> None:
        """Checks all values.

        Raises:
            ValueError: one is out of range.
            TypeError: one has the wrong type.
        """
        for name, check, interval in (("delay", check_int, COUNT), ("friction", check_float, NOT_NEGATIVE)):
            if (values := getattr(self, name)) is not None:
                if not isinstance(values, tuple | list) or len(values) != 2:
                    raise TypeError(f"{name} must be two numbers, the least and the greatest, got {values!r}")
                least, most = (check(name, value, interval) for value in values)
                if least > most:
                    raise ValueError(f"{name}: the least, {least}, must not be greater than the greatest, {most}")
        check_fields(self)

    def of(self, holds: Mapping[str, Any]) -> "Conditions":
        """Returns the conditions of a task: what is ``None`` here is as its ``holds`` says, else without."""
        none = {"delay": (0, 0), "pushes": 0.0}
        asked = {**none, **{name: value for name, value in holds.items() if name in vars(self)}}
        return dataclasses.replace(
            self, **{name: value for name, value in asked.items() if getattr(self, name) is None}
        )


DEFAULT = Conditions()  # what each task asks for
