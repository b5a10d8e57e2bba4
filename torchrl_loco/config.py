"""Simulation settings."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from torchrl_loco.checks import check_choice, check_fields, check_multiple

SCENE = Path(__file__).parent / "sim" / "scene.xml"
"""What every model can include by its name, from any folder: light, materials, the look of the floor."""

PROTOCOLS = ("playground", "dm_control")

ENGINES = ("auto", "compiled", "mujoco_warp", "mujoco")

INTEGRATORS = ("euler", "implicitfast", "rk4")

CONTACTS = ("all", "ground")
SOLIDS_ON_TERRAIN = ("exact", "spheres")

# The documented naconmax is for this many worlds (Playground's default batch) and scales with num_envs.
NACONMAX_WORLDS = 2048
# Minimum for few worlds: naconmax also limits broadphase pairs, and a curled-up humanoid has more pairs than contacts.
NACONMAX_FLOOR = 1024
# Maximum: contacts are indexed with 32 bits. So many fill 360 GB, and their worlds more: memory is what refuses them.
NACONMAX_CEILING = 2**31 - 1


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
            else ``mujoco_warp``. ``mujoco`` is C MuJoCo in float64 on the CPU, a thread for each core, with the options
            of the model but for time step and integrator, and a solver that converges: it judges the others.
        integrator: how velocities and positions advance: ``euler`` (semi-implicit), ``implicitfast``, or ``rk4``
            (under ``mujoco_warp`` only). It replaces the one that the model names, as ``sim_dt``, iterations and
            ``euler_damping`` do. For tasks of yours a line of the log and ``repr(env)`` say so, where the model names
            another than MuJoCo's default; :meth:`of` keeps those of the model.
        contacts: what bodies touch: ``all`` that the model says, or the ``ground``, that is, what is fixed to the
            world and not each other. Under all engines, and in :attr:`torchrl_loco.LocoEnv.mj_model`.
        solids_on_terrain: what boxes, cylinders, ellipsoids and meshes do on height fields: ``exact`` is what MuJoCo
            finds, which the engine ``compiled`` does not have, as it jumps with rounding; ``spheres`` gives the model
            of an environment spheres in their corners, of up to 0.02 m, which in their place touch height fields and,
            where there are any, boxes of the world too: an edge between two corners is not felt.

    Raises:
        TypeError: a value has the wrong type.
        ValueError: a value is out of range, ``ctrl_dt`` is no multiple of ``sim_dt``, or ``deterministic`` does not go
            with the integrator.
    """

    ctrl_dt: float
    sim_dt: float
    naconmax: int = 100_000
    njmax: int = 300
    iterations: int = 100
    ls_iterations: int = 50
    euler_damping: bool = False
    episode_length: int = 1000
    deterministic: bool = False
    engine: str = "auto"
    integrator: str = "euler"
    contacts: str = "all"
    solids_on_terrain: str = "exact"

    def __post_init__(self) -> None:
        check_fields(self)
        check_choice("engine", self.engine, ENGINES)
        check_choice("integrator", self.integrator, INTEGRATORS)
        check_choice("contacts", self.contacts, CONTACTS)
        check_choice("solids_on_terrain", self.solids_on_terrain, SOLIDS_ON_TERRAIN)
        if self.deterministic and self.integrator != "euler":
            raise ValueError(f"deterministic=True needs integrator='euler', got {self.integrator!r}")
        check_multiple("ctrl_dt", self.ctrl_dt, "sim_dt", self.sim_dt)

    @classmethod
    def of(cls, model: Any, ctrl_dt: float | None = None, **others: Any) -> "SimConfig":
        """Returns settings that keep the options of a model: time step, integrator, iterations, damping.

        Args:
            model: a ``mujoco.MjModel`` or ``MjSpec``, MJCF text, or the path of a file from the working directory; a
                task without a config finds its model beside its own file.
            ctrl_dt: time between two actions (s); ``None`` is the multiple of the time step that is nearest to 0.02 s.
            others: further fields.

        Raises:
            ValueError: the model's integrator is none of those of :attr:`integrator`, or its time step is not positive.
        """
        import mujoco

        if not isinstance(model, mujoco.MjModel | mujoco.MjSpec):
            model = read_mjcf(model)
        fields = options_of(model.opt if isinstance(model, mujoco.MjModel) else model.option) | others
        if not fields["sim_dt"] > 0:
            raise ValueError(f"sim_dt, by default the model's timestep, must be greater than 0, got {fields['sim_dt']}")
        if "integrator" not in others and fields["integrator"] not in INTEGRATORS:
            raise ValueError(
                f"the model's integrator is {fields['integrator']!r}, which no engine has: name one of "
                f"{', '.join(INTEGRATORS)} in the model, or by SimConfig.of(model, integrator=...)"
            )
        steps = max(1, round(0.02 / fields["sim_dt"]))
        return cls(**{"ctrl_dt": steps * fields["sim_dt"] if ctrl_dt is None else ctrl_dt, **fields})

    @property
    def substeps(self) -> int:
        """Physics steps in one control step."""
        return round(self.ctrl_dt / self.sim_dt)


def read_mjcf(source: Path | str) -> Any:
    """Returns MJCF, a text or a file, as a ``mujoco.MjSpec``; an included ``scene.xml`` is ours if none lies there."""
    import mujoco

    scene = {SCENE.name: SCENE.read_bytes()}
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return mujoco.MjSpec.from_string(source, scene)
    return mujoco.MjSpec.from_file(str(source), {} if Path(source).with_name(SCENE.name).exists() else scene)


def options_of(option: Any) -> dict[str, Any]:
    """Returns MuJoCo's options that :class:`SimConfig` replaces, by its fields."""
    import mujoco

    return {
        "sim_dt": float(option.timestep),
        "iterations": int(option.iterations),
        "ls_iterations": int(option.ls_iterations),
        "euler_damping": not option.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP),
        "integrator": mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower(),
    }


CONVERGED: dict[str, Any] = {"iterations": 100, "ls_iterations": 50, "euler_damping": True}
"""Settings of the protocol ``dm_control`` that differ from ``playground``, for any body."""


NO_ARGUMENTS = {
    "max_episode_steps": "pass episode_length, the control steps of an episode",
    "frame_skip": "pass ctrl_dt, the time between two actions, or use torchrl_loco.ActionRepeat",
    "render_mode": "call env.render(); the Gymnasium wrapper in torchrl_loco.wrappers takes a render_mode",
}
"""Arguments that other environments take, and what to do instead."""


def sim_config(
    defaults: SimConfig, protocol: str, num_envs: int, overrides: dict[str, Any], arguments: Collection[str] = ()
) -> SimConfig:
    """Returns the settings of an environment under ``protocol`` for ``num_envs`` worlds, with ``overrides`` on top.

    ``defaults`` are those of the class under ``playground``, with ``naconmax`` for 2048 worlds; ``arguments`` names
    others of the caller, for suggestions when a key is misspelt.

    Raises:
        ValueError: ``protocol`` or a key of ``overrides`` is unknown, or a value is out of range.
        TypeError: a value has the wrong type.
    """
    check_choice("protocol", protocol, PROTOCOLS)
    for key in overrides:
        if key in NO_ARGUMENTS:
            raise ValueError(f"{key} is no argument: {NO_ARGUMENTS[key]}")
        check_choice("argument", key, [*arguments, *(field.name for field in dataclasses.fields(SimConfig))])
    changes = CONVERGED if protocol == "dm_control" else {}
    config = dataclasses.replace(defaults, **{**changes, **overrides})
    if "naconmax" in overrides:
        return config
    scaled = math.ceil(config.naconmax * num_envs / NACONMAX_WORLDS)
    return dataclasses.replace(config, naconmax=min(max(scaled, NACONMAX_FLOOR), NACONMAX_CEILING))


def sim_of(info: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the arguments of the simulation that settings of a training name, or a policy's information."""
    return {name: value for name, value in info.get("sim", {}).items() if value is not None}


def arguments_of(info: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the arguments of an environment that settings of a training name, or a policy's information.

    They are those of the simulation, options of the task, pixels, the length of its episodes if it is another, and no
    variation if it was switched off.
    """
    arguments = sim_of(info) | info.get("options", {})
    arguments |= {"episode_length": info["full_length"]} if "full_length" in info else {}
    arguments |= {"randomize": ()} if info.get("randomize") is False else {}
    if info.get("from_pixels"):
        arguments |= {"from_pixels": True, "pixels_only": False, "camera": info["camera"] or None}
        arguments |= {name: info[name] for name in ("size", "frame_stack")}
    return arguments
