"""``train``: from a task to a trained policy, for scripts, notebooks and the command line."""

import contextlib
import dataclasses
import logging
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torchrl.envs import EnvBase

from torchrl_loco.config import sim_config, sim_of
from torchrl_loco.envs import LocoEnv
from torchrl_loco.registry import check_is_run, is_place, task_name
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.config import (
    OF_PIXELS,
    Sim,
    TrainingConfig,
    check_setting,
    checked_sim,
    preset,
    register_config,
    tuning_note,
)
from torchrl_loco.training.environments import Given, unwrapped
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.trainer import NothingToLearnError, Trainer


def train(
    task: str | type[LocoEnv] | EnvBase,
    config: TrainingConfig | None = None,
    *,
    network: Network | None = None,
    algorithm: str | type[Algorithm] | None = None,
    out: Path | str | None = None,
    device: Any = None,
    resume: RunFolder | Path | str | None = None,
    **settings: Any,
) -> RunFolder:
    """Trains a policy: evaluation, learning curve and video included.

    Args:
        task: a class, an id, or a class in a file as ``"path/to/file.py:Class"``; or an environment that is made
            already, of this package, also with transforms. Its worlds, device and transforms are used then.
        config: the settings; ``None`` takes the preset of task, device and algorithm.
        network: a function of the numbers of inputs and outputs that returns a network, an ``nn.Sequential`` of the
            layers that a policy's file can hold. It makes the actor's, and PPO's critic with one output. What it
            returns is not initialised again. Observations are normalised before it.
        algorithm: ``"ppo"``, ``"reppo"``, ``"svg"`` or a subclass of
            :class:`torchrl_loco.training.algorithm.Algorithm`; ``None`` takes that of ``config``, or the
            default of the device.
        out: the folder in which the run's own folder is made.
        device: where to train; ``None`` takes CUDA if there is any, or the device of the run that is resumed.
        resume: a run that was stopped, to continue from its checkpoint with the same task, network and algorithm. The
            settings are the run's own; only ``device`` and ``total_frames`` can be others.
        settings: fields of the settings, on top of ``config`` or of the preset.

    Returns:
        The folder of the run. ``run.load_policy()`` gives the policy, ``run.read_metrics()`` and
        ``run.read_evaluations()`` its figures.

    Raises:
        ValueError: an argument is out of range or does not fit; the message names what is valid.
        TypeError: an argument has the wrong type, or the network has a layer that a policy's file cannot hold.
        RuntimeError: a script without ``if __name__ == "__main__"`` is read by a process that it has started.
        KeyboardInterrupt: Ctrl-C, after a checkpoint; the call that continues is printed.

    Example:
        >>> run = training.train("walker_walk", total_frames=4_000_000)  # doctest: +SKIP
        >>> policy = run.load_policy()  # doctest: +SKIP
    """
    check_is_run()
    given = Given(
        env=task if isinstance(task, EnvBase) else None,
        network=network,
        algorithm=algorithm if isinstance(algorithm, type) else None,
    )
    cls: Any = task if given.env is None else type(unwrapped(given.env)[0])
    if given.algorithm is not None:
        register_config(given.algorithm.config_type)  # by which the settings of the run are read again
    chosen = {name: value for name, value in (("out", out), ("device", device)) if value is not None}
    if resume is not None:
        changes = settings | chosen
        if config is not None or changes.keys() - {"total_frames", "device"} or isinstance(algorithm, str):
            raise ValueError("a run that is resumed keeps its settings: pass no other than total_frames and device")
        run = resumed(resume, cls)
        if given.env is not None:
            _check_same(run, given.env)
        return run_to_end(run, given, **changes)
    if given.env is not None:
        chosen |= _settings_of(given.env, {**settings, **chosen})
        _warn_of_what_is_not_kept(unwrapped(given.env)[0])
    config = _config(cls, config, algorithm, {**settings, **chosen})
    return run_to_end(config, given)


def _config(
    task: Any, config: TrainingConfig | None, algorithm: str | type[Algorithm] | None, settings: dict[str, Any]
) -> TrainingConfig:
    name = algorithm.config_type.algorithm if isinstance(algorithm, type) else algorithm
    if config is None:
        return preset(task, settings.pop("device", None), name, **settings)
    if name is not None and name != config.algorithm:
        raise ValueError(f"config is of {config.algorithm}, but algorithm is {name}: pass one of them")
    if (named := task_name(task, by_user=True)) != config.task:
        raise ValueError(f"config is for {config.task}, but task is {named}")
    for setting in settings:
        check_setting("setting", setting, type(config))
    return dataclasses.replace(config, **settings)


def _settings_of(env: EnvBase, settings: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings that follow from an environment that is made already."""
    base, _ = unwrapped(env)
    own: dict[str, Any] = {"num_envs": base.num_envs, "device": str(base.device), "protocol": base.protocol}
    own |= {"episode_length": base.config.episode_length}
    if twice := [name for name in ("options", *base.options) if name in settings]:
        raise ValueError(f"{', '.join(twice)}: options are those of the environment, leave them out")
    own |= {"options": base.options_given} if base.options_given else {}
    as_made = sim_config(type(base).config, base.protocol, base.num_envs, {})
    names = {field.name for field in dataclasses.fields(Sim)} - {"naconmax"}  # which is for the number of its worlds
    own["sim"] = {name: new for name in sorted(names) if (new := getattr(base.config, name)) != getattr(as_made, name)}
    own["randomize"] = bool(base.randomize or not type(base).randomize)
    seen = base.pixels if "pixels" in env.observation_spec.keys() else None  # noqa: SIM118, else no network sees them
    if not seen and (needless := [name for name in ("from_pixels", *OF_PIXELS) if settings.get(name)]):
        raise ValueError(
            f"{needless[0]} needs an environment that returns 'pixels': make it with from_pixels=True, and leave "
            "transforms out that take them away"
        )
    own |= {"from_pixels": True, **seen.settings(base.mj_model)} if seen else {"from_pixels": False}
    given = {name: value for name, value in settings.items() if name != "randomize" or type(base).randomize}
    asked = sim_of({"sim": dataclasses.asdict(checked_sim(given.pop("sim", {})))})
    if wrong := [name for name, value in asked.items() if value != getattr(base.config, name)]:
        has = f"{wrong[0]}={getattr(base.config, wrong[0])!r}"
        raise ValueError(f"sim is that of the environment, with {has}: leave it out")
    for name, value in own.items():
        if name in given and str(given[name]) != str(value):
            raise ValueError(f"{name} is that of the environment, {value!r}: leave it out, got {settings[name]!r}")
    return {**own, "seed": settings.get("seed", base.seed), "action_repeat": settings.get("action_repeat", 1)}


def _warn_of_what_is_not_kept(env: LocoEnv) -> None:
    lost = [name for name, plain in (("noise_scale", 1.0), ("play", False)) if getattr(env, name) != plain]
    lost += ["randomize"] if env.randomize and list(env.randomize) != list(type(env).randomize) else []
    if lost and distributed.is_first():
        logging.getLogger("torchrl_loco").warning(
            "the environment has a %s of its own, which its run's folder does not hold: eval, play and record of the "
            "policy do without",
            " and a ".join(lost),
        )


def _check_same(run: RunFolder, env: EnvBase) -> None:
    """Checks that a run that is resumed goes on in an environment as that in which it was begun."""
    stored = dataclasses.asdict(run.load_config())
    stored["sim"] = sim_of(stored)
    found = {"options": {}, "sim": {}, **_settings_of(env, {})}
    for name in ("protocol", "options", "sim", "from_pixels", "camera", "size", "frame_stack"):
        if name in found and found[name] != stored[name]:
            raise ValueError(f"{run.path} was begun with {name}={stored[name]!r}, the environment has {found[name]!r}")


def resumed(resume: RunFolder | Path | str, task: Any) -> RunFolder:
    """Returns the folder of a run whose task is somewhere else now."""
    run = resume if isinstance(resume, RunFolder) else RunFolder(Path(resume))
    named, of = task_name(task, by_user=True), run.load_config().task
    moved = is_place(named) and is_place(of) and named.rpartition(":")[2] == of.rpartition(":")[2]
    if named.partition("~")[0] != of.partition("~")[0] and not moved:  # another class of a notebook may have the name
        raise ValueError(f"{run.path} is a run of {of}, but task is {named}")
    return RunFolder(run.path, named)


def as_they_are(*kinds: type[Exception]) -> Any:
    """Returns a context that tells no errors."""
    return contextlib.nullcontext()


def run_to_end(
    what: TrainingConfig | RunFolder, given: Given, errors: Callable[..., Any] = as_they_are, **changes: Any
) -> RunFolder:
    """Returns the folder of a run that it trains: a new one of these settings, or one whose settings it changes.

    ``errors`` makes a context that tells errors of the user: of any kind until the trainer is made, then of those that
    it is called with. Others are bugs, which keep their traceback.
    """
    with contextlib.ExitStack() as ranks:
        with errors():
            config = what.load_config(**changes) if isinstance(what, RunFolder) else what
            ranks.enter_context(distributed.joined(config.device))  # before it, each rank would be the first
            if not isinstance(what, RunFolder) and (done := distributed.from_first(_finished_before(what))):
                return RunFolder(done)
            trainer = Trainer(what, True, given, **changes) if isinstance(what, RunFolder) else begin(what, given)
        train_to_end(trainer, given, errors)
        return trainer.run


def _finished_before(config: TrainingConfig) -> Path | None:
    """Returns the folder of a run that was complete when torchrun started the ranks anew, of a script with several."""
    began = RunFolder.of_launch(config) if distributed.is_first() else None
    if began is None or not began.is_finished:
        return None
    print(f"run folder: {began.path}, which is complete", flush=True)
    return began.path


def train_to_end(trainer: Trainer, given: Given, errors: Callable[..., Any] = as_they_are) -> None:
    """Trains to the last frame; prints how to continue a run that has a checkpoint, if it is interrupted."""
    first, ranks = distributed.is_first(), distributed.ranks()
    try:
        with errors(OSError, NothingToLearnError):
            trainer.train()
    except (KeyboardInterrupt, SystemExit):
        if first and trainer.run.has_checkpoint:
            print(f"to continue: {given.way_to_resume(trainer.run.path, ranks, trainer.config.task)}", file=sys.stderr)
        raise
    finally:
        if given.env is None:
            trainer.env.close()
        trainer.environments.close()


def begin(config: TrainingConfig, given: "Given | None" = None) -> Trainer:
    """Makes the folder and the trainer of a run; in place of a process that died, those of its run.

    Args:
        config: the settings.
        given: what is handed in as objects.

    Returns:
        The trainer, which has collected nothing yet. Where it cannot be made, no folder is left.
    """
    given = given or Given()
    path, continues = Path(), ""
    if distributed.is_first():
        began = RunFolder.of_launch(config)
        if began is None and given.env is None and (note := tuning_note(config)):
            print(note)
        path = (began or RunFolder.create(config, given.names)).path
        continues = ", which torchrun continues after a failure" if began else ""
    run = RunFolder(distributed.from_first(path))
    had_checkpoint = run.has_checkpoint
    try:
        return Trainer(run, resume=had_checkpoint, given=given)
    except BaseException:
        if distributed.ranks() == 1 and not had_checkpoint:  # an empty run folder is of no use
            shutil.rmtree(run.path)
        raise
    finally:
        if distributed.is_first() and run.path.exists():
            print(f"run folder: {run.path}{continues}", flush=True)
