"""Simulation settings and their defaults."""

import dataclasses
import math
from collections.abc import Collection
from typing import Any

from torchrl_loco.checks import check_choice, check_fields, check_multiple

PROTOCOLS = ("playground", "dm_control")

ENGINES = ("auto", "compiled", "mujoco_warp")

# The documented naconmax is for this many worlds (Playground's default batch) and scales with num_envs.
NACONMAX_WORLDS = 2048
# Minimum for few worlds: naconmax also limits broadphase pairs, and a curled-up humanoid has more pairs than contacts.
NACONMAX_FLOOR = 1024


@dataclasses.dataclass(frozen=True)
class SimConfig:
    """Settings of the simulation. Any field can be overridden by keyword in :func:`torchrl_loco.make`.

    Attributes:
        ctrl_dt: time between two actions (s), a whole multiple of ``sim_dt``.
        sim_dt: time step of the physics (s).
        naconmax: contacts stored for all worlds together under the engine ``mujoco_warp``. The default is for 2048
            worlds and scales with ``num_envs``; a value that you set is used as it is.
        njmax: constraint rows stored for each world under the engine ``mujoco_warp``.
        iterations: limit of the constraint solver's iterations.
        ls_iterations: limit of the line search's iterations within one solver iteration.
        euler_damping: whether joint damping is integrated implicitly (MuJoCo's ``eulerdamp`` flag).
        episode_length: control steps after which an episode is truncated.
        deterministic: whether rollouts on CUDA repeat bit for bit on the same kind of device. On the CPU, and under the
            engine ``compiled``, they always do, at no cost. Under ``mujoco_warp`` a step then takes three to four times
            as long, and which constraints are dropped when ``njmax`` or ``naconmax`` is too small still varies, see
            :meth:`torchrl_loco.LocoEnv.health`.
        engine: what steps the physics. ``compiled`` is one kernel made for the model, 6 to 50 times as fast on an
            H200; ``mujoco_warp`` is MuJoCo-Warp; ``auto`` takes ``compiled`` if it supports the model,
            else ``mujoco_warp``.

    Raises:
        TypeError: a value has the wrong type.
        ValueError: a value is out of range, or ``ctrl_dt`` is no multiple of ``sim_dt``.
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
    engine: str = "auto"

    def __post_init__(self) -> None:
        check_fields(self, {})
        check_choice("engine", self.engine, ENGINES)
        check_multiple("ctrl_dt", self.ctrl_dt, "sim_dt", self.sim_dt)

    @property
    def substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.ctrl_dt / self.sim_dt)


DEFAULTS = {
    "walker": SimConfig(ctrl_dt=0.025, sim_dt=0.0025, naconmax=50_000, njmax=100, iterations=2, ls_iterations=5),
    "humanoid": SimConfig(ctrl_dt=0.025, sim_dt=0.005, naconmax=200_000, njmax=250, iterations=4, ls_iterations=8),
    "cheetah": SimConfig(ctrl_dt=0.01, sim_dt=0.01, naconmax=100_000, njmax=100, iterations=4, ls_iterations=8),
    "hopper": SimConfig(ctrl_dt=0.02, sim_dt=0.005, naconmax=50_000, njmax=50, iterations=4, ls_iterations=10),
    "quadruped": SimConfig(
        ctrl_dt=0.02,
        sim_dt=0.005,
        naconmax=50_000,
        njmax=100,
        iterations=4,
        ls_iterations=10,
        euler_damping=True,  # its hinges are damped so strongly that without it a control step errs by 0.01 rad
    ),
}
"""By body, under the protocol ``playground``."""

CONVERGED: dict[str, Any] = {"iterations": 100, "ls_iterations": 50, "euler_damping": True}
"""Settings of the protocol ``dm_control`` that differ from ``playground``, for any body."""


def sim_config(
    defaults: SimConfig,
    protocol: str,
    num_envs: int,
    overrides: dict[str, Any],
    arguments: Collection[str] = (),
) -> SimConfig:
    """Returns the settings of a body under ``protocol`` for ``num_envs`` worlds, with ``overrides`` on top.

    Args:
        defaults: the body's settings under ``playground``, with ``naconmax`` for 2048 worlds.
        protocol: one of :data:`PROTOCOLS`.
        num_envs: number of worlds, by which ``naconmax`` is scaled.
        overrides: fields of :class:`SimConfig`.
        arguments: other argument names of the caller, for suggestions when a key is misspelt.

    Raises:
        ValueError: ``protocol`` or a key of ``overrides`` is unknown, or a value is out of range.
        TypeError: a value has the wrong type.
    """
    check_choice("protocol", protocol, PROTOCOLS)
    for key in overrides:
        check_choice("argument", key, [*arguments, *(field.name for field in dataclasses.fields(SimConfig))])
    changes = CONVERGED if protocol == "dm_control" else {}
    config = dataclasses.replace(defaults, **{**changes, **overrides})
    if "naconmax" in overrides:
        return config
    scaled = math.ceil(config.naconmax * num_envs / NACONMAX_WORLDS)
    if scaled >= 2**31:
        raise ValueError(f"num_envs={num_envs} is too large: contacts are indexed with 32 bits")
    return dataclasses.replace(config, naconmax=max(scaled, NACONMAX_FLOOR))
