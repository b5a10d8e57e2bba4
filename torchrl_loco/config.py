"""The settings of a simulation and the one place of their defaults."""

import dataclasses
import difflib
import math
import numbers
from typing import Any

PROTOCOLS = ("playground", "dm_control")

# The documented naconmax is for this many worlds (Playground's default batch) and scales with num_envs.
NACONMAX_WORLDS = 2048
# Fewer worlds share this much at least: a curled-up humanoid has more pairs of geoms near each other than contacts.
NACONMAX_FLOOR = 1024


@dataclasses.dataclass(frozen=True)
class SimConfig:
    """Settings of the simulation. Any field can be overridden by keyword in :func:`torchrl_loco.make`.

    Attributes:
        ctrl_dt: time between two actions (s), a whole multiple of ``sim_dt``.
        sim_dt: time step of the physics (s).
        naconmax: contacts stored for all worlds together. The default is meant for 2048 worlds and scales with
            ``num_envs``; a value that you set is taken as it is.
        njmax: constraint rows stored for each world.
        iterations: limit of the constraint solver's iterations.
        ls_iterations: limit of the line search's iterations within one solver iteration.
        euler_damping: whether joint damping is integrated implicitly (MuJoCo's ``eulerdamp`` flag).
        episode_length: control steps after which an episode is truncated.
        deterministic: whether rollouts on CUDA repeat bit for bit on the same kind of device, at three to four times
            the time of a step. On the CPU they always do. What finds no room is lost in any order, see
            :meth:`torchrl_loco.LocoEnv.health`.

    Raises:
        TypeError: a value has the wrong type.
        ValueError: a value is out of range, or ``ctrl_dt`` no multiple of ``sim_dt``.
    """

    ctrl_dt: float
    sim_dt: float
    naconmax: int
    njmax: int
    iterations: int
    ls_iterations: int
    euler_damping: bool = False
    episode_length: int = 1000
    deterministic: bool = False

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check_field(field.name, field.type, getattr(self, field.name))
        if not math.isclose(self.ctrl_dt, self.substeps * self.sim_dt, rel_tol=1e-6) or self.substeps < 1:
            raise ValueError(
                f"ctrl_dt ({self.ctrl_dt} s) must be a whole multiple of sim_dt ({self.sim_dt} s), "
                f"for example ctrl_dt={max(self.substeps, 1) * self.sim_dt:g}"
            )

    @property
    def substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.ctrl_dt / self.sim_dt)


def _check_field(name: str, kind: Any, value: Any) -> None:
    if kind is bool:
        if not isinstance(value, bool):
            raise TypeError(f"{name} must be True or False, got {value!r}")
        return
    if isinstance(value, bool) or not isinstance(value, numbers.Real if kind is float else numbers.Integral):
        raise TypeError(f"{name} must be of type {kind.__name__}, got {value!r}")
    if not (math.isfinite(value) and float(value) > 0):
        raise ValueError(f"{name} must be positive and finite, got {value!r}")
    if kind is int and float(value) >= 2**31:  # kernels count in 32 bits
        raise ValueError(f"{name} must be less than 2**31, got {value!r}")


DEFAULTS = {
    "walker": SimConfig(ctrl_dt=0.025, sim_dt=0.0025, naconmax=50_000, njmax=100, iterations=2, ls_iterations=5),
    "humanoid": SimConfig(ctrl_dt=0.025, sim_dt=0.005, naconmax=200_000, njmax=250, iterations=4, ls_iterations=8),
}
"""By body, under the protocol ``playground``."""

ARGUMENTS = ("num_envs", "device", "seed", "protocol", "reward_terms", "stagger", "on_overflow", "bad_world_file")
"""What an environment takes beside the fields of :class:`SimConfig`."""

CONVERGED: dict[str, Any] = {"iterations": 100, "ls_iterations": 50, "euler_damping": True}
"""What the protocol ``dm_control`` sets otherwise, for any body."""


def sim_config(defaults: SimConfig, protocol: str, num_envs: int, overrides: dict[str, Any]) -> SimConfig:
    """Returns the settings of a body under ``protocol`` for ``num_envs`` worlds, with ``overrides`` on top.

    Args:
        defaults: the body's settings under ``playground``, with ``naconmax`` for 2048 worlds.
        protocol: one of :data:`PROTOCOLS`.
        num_envs: number of worlds, which ``naconmax`` grows with.
        overrides: fields of :class:`SimConfig`.

    Raises:
        ValueError: ``protocol`` or a key of ``overrides`` is unknown, or a value is out of range.
        TypeError: a value has the wrong type.
    """
    if protocol not in PROTOCOLS:
        raise ValueError(f"unknown protocol {protocol!r}: choose one of {', '.join(PROTOCOLS)}")
    names = [field.name for field in dataclasses.fields(SimConfig)]
    for key in overrides:
        if key not in names:
            choices = [*ARGUMENTS, *names]
            raise ValueError(f"unknown setting {key!r}{suggestion(key, choices)}: choose from {', '.join(choices)}")
    changes = CONVERGED if protocol == "dm_control" else {}
    config = dataclasses.replace(defaults, **{**changes, **overrides})
    if "naconmax" in overrides:
        return config
    scaled = math.ceil(config.naconmax * num_envs / NACONMAX_WORLDS)
    return dataclasses.replace(config, naconmax=max(scaled, NACONMAX_FLOOR))


def suggestion(word: str, choices: list[str]) -> str:
    """Returns ``", did you mean 'x'?"`` for the choice nearest to ``word``, or an empty string."""
    near = difflib.get_close_matches(word, choices, n=1)
    return f", did you mean {near[0]!r}?" if near else ""
