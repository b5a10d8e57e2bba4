"""Which settings are used for a task on a device."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from torchrl_loco import tasks
from torchrl_loco.checks import check_choice, check_device
from torchrl_loco.registry import resolve, task_name
from torchrl_loco.training.config import CONFIGS, REPPOConfig, TrainingConfig

if TYPE_CHECKING:
    import torch

    from torchrl_loco.envs import LocoEnv

RUNNERS = ("walker", "humanoid", "cheetah", "hopper", "quadruped")
"""Bodies of dm_control's runners."""


def preset(
    task: "str | type[LocoEnv]",
    device: "torch.device | str | None" = None,
    algorithm: str | None = None,
    **overrides: Any,
) -> TrainingConfig:
    """Returns the settings for ``task`` on ``device``, with ``overrides`` on top.

    They are those of algorithm and device, tuned on the walker and the humanoid, and on CUDA the ``presets`` of the
    task's class on top: ``{"reppo": {"total_frames": 30_000_000}}``.

    Args:
        task: id of the environment, its class, or where that is: ``"path/to/file.py:Class"``.
        device: where to train; ``None`` takes CUDA if there is any.
        algorithm: "ppo" or "reppo"; ``None`` takes PPO on a CPU, and on CUDA the first of the task's ``presets``, REPPO
            if it has none.
        overrides: fields of the settings, and the task's own :attr:`torchrl_loco.LocoEnv.options`.

    Raises:
        ValueError: there is no such device, algorithm or setting, or one is out of range; the message names what is
            valid. It may be one in the ``presets`` of the class.
    """
    task, device = task_name(task, by_user=True), check_device(device)
    on_cuda = device.type == "cuda"
    own: Mapping[str, Mapping[str, Any]] = {}
    if on_cuda or task not in tasks.found():  # importing one of ours takes seconds
        checked = checked_presets(resolve(task))
        own = checked if on_cuda else {}
    if algorithm is None:
        algorithm = next(iter(own), "reppo") if on_cuda else "ppo"
    kind = CONFIGS[check_choice("algorithm", algorithm, CONFIGS)]
    fields = {field.name for field in dataclasses.fields(kind)}
    if not overrides.keys() <= fields:  # only then, since importing a task takes a while
        options = {name: overrides.pop(name) for name in resolve(task).options if name in overrides}
        overrides["options"] = {**overrides.get("options", {}), **options}
    for name in overrides:
        check_setting("setting", name, kind)
    if overrides.get("options"):
        overrides["options"] = resolve(task).checked_options(overrides["options"])
    settings = {**kind.presets[device.type], **({} if is_runner(task) else kind.of_others), **own.get(algorithm, {})}
    if not is_runner(task) and kind is REPPOConfig:  # returns of either sign
        settings.setdefault("min_value", -settings.get("max_value", REPPOConfig.max_value))
    return kind(task, **{"device": str(device), **settings, **overrides})


def checked_presets(cls: "type[LocoEnv]") -> Mapping[str, Mapping[str, Any]]:
    """Returns the ``presets`` of a task, by algorithm.

    Raises:
        ValueError: they name something that is no algorithm or no setting of it.
    """
    where = f"in the presets of {cls.__name__}"
    for algorithm, settings in cls.presets.items():
        kind = CONFIGS[check_choice(f"algorithm {where}", algorithm, CONFIGS)]
        for name in settings:
            check_setting(f"setting of {algorithm} {where}", name, kind)
    return cls.presets


def check_setting(what: str, name: str, kind: type[TrainingConfig]) -> None:
    """Checks that a name is that of a setting.

    Raises:
        ValueError: it is not; the message names the settings.
    """
    check_choice(what, name, [field.name for field in dataclasses.fields(kind) if field.name != "task"])


def is_runner(task: "str | type[LocoEnv]") -> bool:
    """Returns whether a task is one of dm_control's runners: their rewards lie in [0, 1], and they cannot fall."""
    name = task_name(task)
    return name in tasks.found() and tasks.found()[name].module.rpartition(".")[2] in RUNNERS


def tuning_note(config: TrainingConfig) -> str:
    """Returns a note if ``config.task`` was not tuned on the CPU by its algorithm, else an empty string."""
    if config.device != "cpu" or (config.algorithm == "ppo" and config.task in ("walker_stand", "walker_walk")):
        return ""
    return "On a CPU only walker_stand and walker_walk by ppo were tuned: other tasks need a GPU, or many more frames."
