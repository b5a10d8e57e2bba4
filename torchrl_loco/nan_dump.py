"""NaN dumps: the state and action that led to a non-finite world, stepped again in Warp and in C MuJoCo."""

import contextlib
import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from torchrl_loco import storage
from torchrl_loco.config import SimConfig
from torchrl_loco.envs import LocoEnv, State
from torchrl_loco.envs.episode import MAX_VALUE
from torchrl_loco.envs.hooks import beyond
from torchrl_loco.envs.monitors import NAN_DUMP
from torchrl_loco.envs.vary import Vary
from torchrl_loco.known_files import UnnamedFileError, place_of
from torchrl_loco.registry import env_class, list_envs, resolve, task_name
from torchrl_loco.sim.simulation import set_options

RESETS = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
"""Warnings at which C MuJoCo resets a world."""


@dataclasses.dataclass(frozen=True)
class NanDump:
    """What led to a world that is not finite: its state and action before the control step, and its settings.

    Attributes:
        tensors: ``qpos`` ``(nq,)``, ``qvel`` ``(nv,)``, ``qacc_warmstart`` ``(nv,)``, ``act`` ``(na,)`` if there are
            activations, ``model.<field>`` (numbers that vary,) if ``randomize`` names any, and ``action`` ``(nu,)``,
            before the step.
        settings: ``env`` (module and name of the class), ``file`` (of the module), ``protocol``, ``config``,
            ``randomize``, ``options``, ``seed``, ``device``, ``num_envs``, ``world_offset``, and before the step
            ``world``, ``episode``, ``elapsed_steps``.
    """

    tensors: dict[str, torch.Tensor]
    settings: dict[str, Any]

    def make_env(self, device: torch.device | str | None = None, **config: Any) -> LocoEnv:
        """Returns an environment of that world alone with the settings of the dump, and ``config`` on top."""
        of_file = dataclasses.asdict(SimConfig(**self.settings["config"]))  # nothing else, such as a file to write
        env, settings = _class_of(self.settings), {**of_file, **self.settings.get("options", {}), **config}
        arguments = (1, device, self.settings["seed"], self.settings["protocol"])
        varys = [Vary(**vary) for vary in self.settings.get("randomize", [])]
        world = self.settings.get("world_offset", 0) + self.settings.get("world", 0)
        return env(*arguments, world_offset=world, on_overflow="ignore", randomize=varys, **settings)

    @property
    def state(self) -> State:
        """The state before the step, of one world, without memory and what worlds share, which a dump does not hold."""
        state = State({name: row[None] for name, row in self.physics.items()}, batch_size=[1])
        for name in {"episode", "elapsed_steps"} & self.settings.keys():
            state[name] = torch.tensor([self.settings[name]], dtype=torch.int32)
        for name, numbers in self.tensors.items():
            if name.startswith("model."):
                state["model", name.removeprefix("model.")] = numbers[None]
        return state

    @property
    def physics(self) -> dict[str, torch.Tensor]:
        """What of the state C MuJoCo's ``mjData`` holds, by name, without a dimension of worlds."""
        return {name: self.tensors[name] for name in State.PHYSICS if name in self.tensors}


def load(path: Path, task: str | type[LocoEnv] | None = None) -> NanDump:
    """Returns a NaN dump, read without executing code.

    Args:
        path: the file.
        task: the class of its environment, as :func:`torchrl_loco.make` takes it; ``None`` for what the file says.

    Raises:
        FileNotFoundError: there is no such file.
        UnnamedFileError: its class is in a file that the user has not named.
        ValueError: it is no NaN dump, damaged, or of an environment that is not installed.
    """
    dump = NanDump(*storage.load(path, NAN_DUMP))
    if missing := [name for name in ("env", "config", "seed", "protocol") if name not in dump.settings]:
        raise ValueError(f"{path} cannot be read as a {NAN_DUMP}: its settings lack {', '.join(missing)}")
    env, file = dump.settings["env"], dump.settings.get("file")
    if task is not None:
        dump.settings["task"] = task_name(task, by_user=True)
    elif file and env not in _classes() and not env.startswith("torchrl_loco."):
        dump.settings["task"] = place_of(f"{file}:{env.rpartition('.')[2]}", Path(path).parent)
    try:
        _class_of(dump.settings)
    except UnnamedFileError:
        raise
    except (KeyError, OSError, ImportError, ValueError) as error:
        names = ", ".join(_classes())
        raise ValueError(f"{path} is of {dump.settings['env']!r}, which is not there; installed are {names}") from error
    return dump


def _class_of(settings: dict[str, Any]) -> type[LocoEnv]:
    """Returns the class of a dump: the one that was named, or one that is installed."""
    return resolve(settings["task"]) if "task" in settings else _classes()[settings["env"]]


def _classes() -> dict[str, type[LocoEnv]]:
    """Returns the classes of all environments by module and name, without those of broken plug-ins."""
    classes: dict[str, type[LocoEnv]] = {}
    for id in list_envs():
        with contextlib.suppress(ImportError):
            env = env_class(id)
            classes[f"{env.__module__}.{env.__qualname__}"] = env
    return classes


def model_and_controls(dump: NanDump) -> tuple[mujoco.MjModel, torch.Tensor]:
    """Returns the world's model, and the controls that the action became, ``(nu,)``; memory is zero for that."""
    env = dump.make_env("cpu")
    env.reset(dump.state, set_state=True)
    model = env.mujoco_model()
    env.step(TensorDict({"action": dump.tensors["action"][None]}, batch_size=[1]))
    return model, env.sim.ctrl[0].clone()


def warp_trace(dump: NanDump, device: torch.device | str | None = None) -> np.ndarray:
    """Returns qpos and qvel after each substep in Warp, shape ``(substeps + 1, nq + nv)``, the start included."""
    config = SimConfig(**dump.settings["config"])
    env = dump.make_env(device, ctrl_dt=config.sim_dt)  # one substep per step, to see them all
    sim, physics = env.sim, env.sim.capture(env.sim.step)  # without what the task does around it
    env.reset(dump.state.to(env.device), set_state=True)
    sim.ctrl.copy_(model_and_controls(dump)[1])
    trace = []
    for substep in range(config.substeps + 1):
        if substep:
            physics.replay()
        trace.append(torch.cat([sim.qpos[0], sim.qvel[0]]).cpu().numpy())
    return np.stack(trace)


def mujoco_trace(dump: NanDump) -> np.ndarray:
    """Returns the same as :func:`warp_trace`, from C MuJoCo in double precision.

    C MuJoCo resets a world that is not finite; from there on the trace is NaN.
    """
    config = SimConfig(**dump.settings["config"])
    model, controls = model_and_controls(dump)
    set_options(model, config)
    data = mujoco.MjData(model)
    for name, value in dump.physics.items():
        getattr(data, name)[:] = value.numpy()
    trace = [np.concatenate([data.qpos, data.qvel])]
    data.ctrl[:] = controls
    mujoco.set_mju_user_warning(lambda message: None)  # else it prints, and writes a log into the working directory
    try:
        for _ in range(config.substeps):
            mujoco.mj_step(model, data)
            lost = any(data.warning[kind].number for kind in RESETS)
            trace.append(np.full_like(trace[0], np.nan) if lost else np.concatenate([data.qpos, data.qvel]))
    finally:
        mujoco.set_mju_user_warning(None)
    return np.stack(trace)


def describe(dump: NanDump, device: torch.device | str | None = None) -> Iterator[str]:
    """Yields lines: where the world was, what is wrong with it, and the results of the step in Warp and in C MuJoCo."""
    settings = dump.settings
    env = settings["env"].split(".")[-1]
    yield (
        f"{env}, protocol {settings['protocol']}, seed {settings['seed']}: world {settings['world']} of "
        f"{settings['num_envs']} on {settings['device']}, episode {settings['episode']}, "
        f"after {settings['elapsed_steps']} steps"
    )
    if varied := [name.removeprefix("model.") for name in dump.tensors if name.startswith("model.")]:
        yield f"with numbers of its own of {', '.join(varied)}"
    cls = _class_of(settings)
    if remembers := bool(cls.memory or cls.shared):
        yield "memory, and what worlds share, are not in the file: hooks see zeros, and controls may differ"
    bad = {name: ~(value.abs() < MAX_VALUE) for name, value in dump.physics.items()}
    bad["action"] = ~dump.tensors["action"].isfinite()  # finite ones are clipped
    wrong = [name for name in bad if bad[name].any()]
    for name in wrong:
        entries = ", ".join(f"{i} is {dump.tensors[name][i]}" for i in bad[name].nonzero().flatten().tolist())
        yield f"{name} is not finite before the step: entry {entries}"
    if "action" in wrong:
        yield "an action that is not finite terminates its world, which is stepped with zeros instead"
    if any(name in State.PHYSICS for name in wrong):
        yield "the state was already non-finite before the step: there is nothing to step"
        return
    warp, c = warp_trace(dump, device), mujoco_trace(dump)
    yield f"{'substep':>7}  {'largest |qvel| in Warp':>22}  {'in C MuJoCo':>12}  {'largest difference':>18}"
    nq = len(dump.tensors["qpos"])
    for i, (ours, theirs) in enumerate(zip(warp, c, strict=True)):
        speeds = (np.abs(values[nq:]).max() for values in (ours, theirs))
        yield "{:>7}  {:>22.6g}  {:>12.6g}  {:>18.3g}".format(i, *speeds, np.abs(ours - theirs).max())
    lost = [np.flatnonzero(~(np.abs(trace) < MAX_VALUE).all(axis=1)) for trace in (warp, c)]
    for name, at in zip(("Warp", "C MuJoCo"), lost, strict=True):
        yield f"{name}: " + (f"not finite after substep {at[0]}" if len(at) else "finite to the end")
    if not wrong and not len(lost[0]):
        named, a_hook = ", ".join(hooks_that_give_nan(dump, device)), "a hook (control, reward, observation, memory)"
        gave = a_hook if remembers or not named else named
        also = f"; with zeros as memory: {named or 'none'}" if remembers else ""
        yield f"state, action and physics are finite: {gave} gave what is not{also}"


def hooks_that_give_nan(dump: NanDump, device: torch.device | str | None = None) -> list[str]:
    """Returns which hooks in torch return what is not finite in the step, as ``reward['height']``."""
    env, found = dump.make_env(device, compile_hooks=False), dict[str, None]()
    assert env.hooks is not None
    call = env.hooks._call

    def watched(hook: str, *args: Any, **settings: Any) -> Any:
        returned = call(hook, *args, **settings)
        found.update(dict.fromkeys(_not_finite(hook, returned)))
        return returned

    td = env.reset(dump.state.to(env.device), set_state=True)
    env.hooks._call = watched  # type: ignore[method-assign]
    env.step(td.set("action", dump.tensors["action"][None].to(env.device)))
    return list(found)


def _not_finite(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield from _not_finite(f"{name}[{key!r}]", part)
    elif isinstance(value, torch.Tensor) and value.is_floating_point() and beyond(value).any():
        yield name
