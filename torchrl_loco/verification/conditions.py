"""What a policy must hold in."""

import dataclasses

from torchrl_loco.checks import COUNT, FRACTION, NOT_NEGATIVE, SEED, check_float, check_int


@dataclasses.dataclass(frozen=True)
class Conditions:
    """What a policy must hold in. All but number, length and seed of the episodes is for robots with a velocity."""

    episodes: int = 256
    """Number of episodes."""
    seconds: float | None = None
    """Length of an episode (s), by default 20 s for robots with a velocity, else that of the task."""
    seed: int = 0
    """Seed of the episodes."""
    delay: tuple[int, int] = (0, 2)
    """Least and greatest delay of an action (control steps); each has as many episodes."""
    friction: tuple[float, float] = (0.4, 1.2)
    """Least and greatest sliding friction, drawn for each episode."""
    noise: float = 1.0
    """Errors of the observation, as a multiple of those of the training."""
    pushes: float = 1.0
    """Changes of the velocity by pushes, as a multiple of those of a training with push_scale 1."""
    max_falls: float = 0.01
    """Greatest share of episodes with a fall."""
    min_return: float = 0.9
    """Least return of other tasks, as a share of that in the simulator of the training."""

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


DEFAULT = Conditions()
