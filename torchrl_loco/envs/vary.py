"""Vary: a number of the model that differs from world to world."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Literal

from torchrl_loco.checks import ANY, Interval, check_bool, check_choice, check_float, check_int
from torchrl_loco.envs.names import Names

Bound = float | Sequence[float]
HOWS = ("scale", "add", "set")


@dataclasses.dataclass(frozen=True)
class Field:
    """What a field of the model is."""

    of: str  # kind of the elements that have it, as their names are given; empty if the model has it
    size: int  # numbers of an element
    unit: str
    meaning: str
    valid: str = "finite"  # or positive (0 stays allowed where the model has it), not negative, rising, inertia
    drawn: tuple[tuple[int, ...], ...] = ((0,),)  # what add and set change by default; those of a group by one draw


EACH_OF_THREE = ((0,), (1,), (2,))
FIELDS = {
    "geom_friction": Field("geom", 3, "1, m, m", "sliding, torsional and rolling friction", "not negative"),
    "pair_friction": Field(
        "pair", 5, "1, 1, m, m, m", "twice sliding, torsional and twice rolling friction", "not negative", ((0, 1),)
    ),
    "body_mass": Field("body", 1, "kg", "mass", "positive"),
    "body_inertia": Field("body", 3, "kg m²", "principal moments of inertia", "inertia", EACH_OF_THREE),
    "body_ipos": Field("body", 3, "m", "center of mass, in the frame of the body", drawn=EACH_OF_THREE),
    "dof_damping": Field("joint", 1, "N s/m, N m s/rad", "damping of the joint", "not negative"),
    "dof_armature": Field("joint", 1, "kg, kg m²", "inertia of the rotor", "not negative"),
    "dof_frictionloss": Field("joint", 1, "N, N m", "dry friction of the joint", "not negative"),
    "jnt_stiffness": Field("joint", 1, "N/m, N m/rad", "stiffness of the joint's spring", "not negative"),
    "actuator_gear": Field("actuator", 6, "1, m", "transmission ratio"),
    "actuator_gainprm": Field("actuator", 10, "as the actuator has it", "parameters of the gain"),
    "actuator_biasprm": Field("actuator", 10, "as the actuator has it", "parameters of the bias", drawn=()),
    "kp": Field("actuator", 1, "N/m, N m/rad", "position gain of a position actuator", "not negative"),
    "kv": Field("actuator", 1, "N s/m, N m s/rad", "velocity gain of a position or velocity actuator", "not negative"),
    "actuator_forcerange": Field("actuator", 2, "N, N m", "lower and upper limit of the force", "rising", ((0,), (1,))),
    "gravity": Field("", 3, "m/s²", "acceleration of gravity", drawn=EACH_OF_THREE),
}
"""The fields that can vary, by name: those of ``mujoco.MjModel``, and the gains ``kp`` and ``kv``."""


@dataclasses.dataclass(frozen=True, repr=False)
class Vary:
    """Numbers of the model that each world draws at its resets, for ``randomize=[...]``.

    Of several that name the same number, each changes what the one before it has made. The draws are functions of
    (seed, world, episode) and of what is varied, so they are the same for any number of worlds, device and engine. A
    number that is 0 is left out under ``"scale"``. What MuJoCo derives from masses for the solver
    (``body_invweight0``, ``dof_invweight0``) stays that of the model.

    Args:
        field: what varies, one of the fields in the table of docs/api/model-numbers.md.
        low: least draw, for each number, or a sequence with one for each number of an element.
        high: greatest draw, likewise.
        of: name of a body, geom, joint, actuator or pair, several, or a regular expression; ``None`` is all that can
            vary, but for free joints.
        how: whether a draw is a factor (``"scale"``), an offset (``"add"``) or the number (``"set"``). One factor
            scales all numbers of an element, unless ``low`` or ``high`` is a sequence. An offset or number is drawn for
            each (``body_ipos``, ``body_inertia``, ``gravity``, ``actuator_forcerange``), or is that of sliding
            friction and of the first of ``actuator_gear`` and ``actuator_gainprm``.
        shared: whether all elements that are named take one draw, or each its own.
        log: whether the logarithm of a draw is uniform; ``low`` must be positive.
        once: whether a world draws from (seed, world), and so keeps its numbers in all episodes.
        component: index of the number of an element that varies, or several, instead of those above.

    Raises:
        ValueError: there is no such field, or bounds or components are wrong; the message names the choices.
        TypeError: an argument has the wrong type.
    """

    field: str
    low: Bound
    high: Bound
    of: Names | None = None
    how: Literal["scale", "add", "set"] = "scale"
    shared: bool = True
    log: bool = False
    once: bool = False
    component: int | Sequence[int] | None = None

    def __post_init__(self) -> None:
        check_choice("field", self.field, FIELDS)
        check_choice("how", self.how, HOWS)
        for name in ("shared", "log", "once"):
            self._set(name, check_bool(name, getattr(self, name)))
        for name in ("low", "high"):
            self._set(name, _one_or_several(check_float, name, getattr(self, name), ANY))
        if self.of is not None and not isinstance(self.of, str):
            names = list(self.of) if isinstance(self.of, Sequence) else [self.of]
            if not names or not all(isinstance(name, str) for name in names):
                raise TypeError(f"of must be a name, names or a regular expression, got {self.of!r}")
            self._set("of", tuple(names))
        if self.component is not None:
            interval = Interval(0, FIELDS[self.field].size)
            self._set("component", _one_or_several(check_int, "component", self.component, interval))
        if self.of is not None and not FIELDS[self.field].of:
            raise ValueError(f"{self}: {self.field} is of the model, so it takes no of=")
        for low, high in self.bounds:
            if low > high:
                raise ValueError(f"{self}: low must not be greater than high")
            if self.log and low <= 0:
                raise ValueError(f"{self}: log=True needs low greater than 0")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        fields = [f for f in dataclasses.fields(self)[3:] if getattr(self, f.name) != f.default]
        words = [repr(value) for value in (self.field, self.low, self.high)]
        words += [f"{f.name}={getattr(self, f.name)!r}" for f in fields]
        return f"Vary({', '.join(words)})"

    @property
    def groups(self) -> list[tuple[int, ...]]:
        """Which numbers of an element vary; those of a group by one draw.

        Raises:
            ValueError: it is to be said which.
        """
        field = FIELDS[self.field]
        chosen = (self.component,) if isinstance(self.component, int) else self.component
        if any(isinstance(bound, tuple) for bound in (self.low, self.high)) or (
            chosen is not None and self.how != "scale"
        ):
            return [(index,) for index in (range(field.size) if chosen is None else chosen)]
        if self.how == "scale":
            return [tuple(range(field.size) if chosen is None else chosen)]
        if not field.drawn:
            raise ValueError(f"{self}: say which of the {field.size} numbers of an element, such as component=1")
        return list(field.drawn)

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Least and greatest draw of each group.

        Raises:
            ValueError: there are not as many of them.
        """
        count = len(self.groups)
        low, high = ([bound] * count if isinstance(bound, float) else list(bound) for bound in (self.low, self.high))
        if not len(low) == len(high) == count:
            raise ValueError(
                f"{self}: low and high must be numbers, or have {count}, one for each number of an element"
            )
        return list(zip(low, high, strict=True))


def _one_or_several(check: Callable[..., Any], name: str, value: Any, interval: Interval) -> Any:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(check(name, number, interval) for number in value)
    return check(name, value, interval)


def check_randomize(name: str, value: Any) -> tuple[Vary, ...]:
    """Returns what ``randomize`` names."""
    if not isinstance(value, Sequence) or not all(isinstance(vary, Vary) for vary in value):
        raise TypeError(f"{name} must be a list of torchrl_loco.Vary, got {value!r}")
    return tuple(value)
