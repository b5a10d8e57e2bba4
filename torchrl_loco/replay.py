"""What a bad world file holds, stepped again in Warp and in C MuJoCo."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from torchrl_loco import models, storage
from torchrl_loco.config import SimConfig
from torchrl_loco.envs import LocoEnv, State
from torchrl_loco.envs.bad_world import KIND
from torchrl_loco.envs.episode import MAX_VALUE
from torchrl_loco.registry import usable_classes
from torchrl_loco.sim.simulation import set_options

STATE = ("qpos", "qvel", "qacc_warmstart")
RESETS = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""Warnings with which C MuJoCo resets a world."""


@dataclasses.dataclass(frozen=True)
class BadWorld:
    """A world from which a control step made one that is not finite.

    Attributes:
        tensors: ``qpos`` ``(nq,)``, ``qvel`` ``(nv,)``, ``qacc_warmstart`` ``(nv,)`` and ``action`` ``(nu,)``, before
            the step.
        settings: ``env`` (module and name of the class), ``protocol``, ``config``, ``seed``, ``device``, ``num_envs``,
            and ``world``, ``episode`` and ``elapsed_steps`` at the time.
    """

    tensors: dict[str, torch.Tensor]
    settings: dict[str, Any]

    def make_env(self, device: torch.device | str | None = None, **config: Any) -> LocoEnv:
        """Returns an environment of one world as the file describes it, with ``config`` on top."""
        env, settings = _classes()[self.settings["env"]], {**self.settings["config"], **config}
        return env(1, device, self.settings["seed"], self.settings["protocol"], on_overflow="ignore", **settings)

    @property
    def state(self) -> State:
        """The state before the step, of one world."""
        return State({name: self.tensors[name][None] for name in STATE}, batch_size=[1])


def load(path: Path) -> BadWorld:
    """Returns what a bad world file holds, read without executing code.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is something else, damaged, or of an environment that is not here.
    """
    world = BadWorld(*storage.load(path, KIND))
    names = _classes()
    if world.settings["env"] not in names:
        raise ValueError(f"{path} is of {world.settings['env']!r}, there are {', '.join(names)}")
    return world


def _classes() -> dict[str, type[LocoEnv]]:
    """Returns the classes of all environments by module and name, as a bad world file names them."""
    return {f"{env.__module__}.{env.__qualname__}": env for env in usable_classes()}


def warp_trace(world: BadWorld, device: torch.device | str | None = None) -> np.ndarray:
    """Returns qpos and qvel after each substep in Warp, shape ``(substeps + 1, nq + nv)``, the start included."""
    config = SimConfig(**world.settings["config"])
    env = world.make_env(device, ctrl_dt=config.sim_dt)  # an action a substep, to see them all
    env.reset(world.state.to(env.device), set_state=True)
    action = TensorDict({"action": world.tensors["action"][None]}, batch_size=[1]).to(env.device)
    trace = [env.get_state()]
    for _ in range(config.substeps):
        env.step(action.clone())
        trace.append(env.get_state())
    return np.stack([torch.cat([state["qpos"][0], state["qvel"][0]]).cpu().numpy() for state in trace])


def c_trace(world: BadWorld) -> np.ndarray:
    """Returns the same as :func:`warp_trace`, from C MuJoCo in double precision.

    C MuJoCo resets a world that is not finite; from there on the trace is NaN.
    """
    config = SimConfig(**world.settings["config"])
    model = models.from_path(_classes()[world.settings["env"]].mjcf)
    set_options(model, config)
    data = mujoco.MjData(model)
    for name in STATE:
        getattr(data, name)[:] = world.tensors[name].numpy()
    trace = [np.concatenate([data.qpos, data.qvel])]
    data.ctrl[:] = world.tensors["action"].numpy()
    mujoco.set_mju_user_warning(lambda message: None)  # else it prints, and writes a log into the working directory
    try:
        for _ in range(config.substeps):
            mujoco.mj_step(model, data)
            lost = any(data.warning[kind].number for kind in RESETS)
            trace.append(np.full_like(trace[0], np.nan) if lost else np.concatenate([data.qpos, data.qvel]))
    finally:
        mujoco.set_mju_user_warning(None)
    return np.stack(trace)


def describe(world: BadWorld, device: torch.device | str | None = None) -> Iterator[str]:
    """Yields lines of text: where the world was, what is wrong with it, and how it goes on in Warp and C MuJoCo.

    Yields:
        The lines.
    """
    settings = world.settings
    env = settings["env"].split(".")[-1]
    yield (
        f"{env}, protocol {settings['protocol']}, seed {settings['seed']}: world {settings['world']} of "
        f"{settings['num_envs']} on {settings['device']}, episode {settings['episode']}, "
        f"after {settings['elapsed_steps']} steps"
    )
    bad = {name: ~(world.tensors[name].abs() < MAX_VALUE) for name in (*STATE, "action")}
    wrong = [name for name in bad if bad[name].any()]
    for name in wrong:
        entries = ", ".join(f"{i} is {world.tensors[name][i]}" for i in torch.nonzero(bad[name]).flatten().tolist())
        yield f"{name} is not finite before the step: entry {entries}"
    if "action" in wrong:
        yield "such an action ends its world, which is stepped with zeros instead"
    if any(name in STATE for name in wrong):
        yield "it was written into the simulation from outside: there is nothing to step"
        return
    warp, c = warp_trace(world, device), c_trace(world)
    yield f"{'substep':>7}  {'largest |qvel| in Warp':>22}  {'in C MuJoCo':>12}  {'largest difference':>18}"
    nq = len(world.tensors["qpos"])
    for i, (ours, theirs) in enumerate(zip(warp, c, strict=True)):
        speeds = (np.abs(values[nq:]).max() for values in (ours, theirs))
        yield "{:>7}  {:>22.6g}  {:>12.6g}  {:>18.3g}".format(i, *speeds, np.abs(ours - theirs).max())
    for name, trace in (("Warp", warp), ("C MuJoCo", c)):
        lost = np.flatnonzero(~(np.abs(trace) < MAX_VALUE).all(axis=1))
        yield f"{name}: " + (f"not finite after substep {lost[0]}" if len(lost) else "finite to the end")
