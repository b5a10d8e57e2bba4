"""What a run is handed, and its environments: where it trains, where it is evaluated, and what is filmed."""

import copy
import dataclasses
import inspect
import logging
import os
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torchrl.envs import Compose, EnvBase, FrameSkipTransform, Transform

from torchrl_loco.config import arguments_of
from torchrl_loco.envs import LocoEnv
from torchrl_loco.envs.access import set_stage
from torchrl_loco.envs.imagined import showing_states
from torchrl_loco.envs.transforms import ActionRepeat, TransformedEnv, named_transforms, unwrap
from torchrl_loco.policy import Policy, check_terms
from torchrl_loco.registry import make, resolve
from torchrl_loco.training import distributed
from torchrl_loco.training.actor import Network
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.config import TrainingConfig, is_runner
from torchrl_loco.training.run_folder import RunFolder

KEPT = ("play", "reward_terms", "observation_terms", "noise_scale", "compile_hooks", "on_overflow")
"""Arguments of an environment that was handed in which its evaluations keep, besides those of physics and pixels."""


@dataclasses.dataclass(frozen=True)
class Given:
    """What is handed to a trainer as objects, instead of being made from the settings of the run.

    The run's folder cannot hold them.

    Attributes:
        env: the environment in which it trains.
        network: makes the networks.
        algorithm: the class of the algorithm.
    """

    env: EnvBase | None = None
    network: Network | None = None
    algorithm: type[Algorithm] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is handed in."""
        return tuple(name for name in ("env", "network", "algorithm") if getattr(self, name) is not None)

    def check(self, run: RunFolder) -> None:
        """Checks that a run that is continued is handed what it was begun with.

        Raises:
            ValueError: it is not.
        """
        if self.names == run.given:
            return
        if extra := [name for name in self.names if name not in run.given]:
            raise ValueError(f"{run.path} was begun without {' and '.join(extra)} of yours: leave that out")
        raise ValueError(
            f"{run.path} was begun with {' and '.join(run.given)} of your own, which the folder does not hold: "
            f"continue it in Python with {_call_to_resume(run.path, run.given)}"
        )

    def way_to_resume(self, run: Path, ranks: int, task: str = "") -> str:
        """Returns the call, or the command with the same number of ranks, that continues a run of a task."""
        if self.names or task.startswith("__main__:") or "<locals>" in task:  # which no other process finds
            return _call_to_resume(run, self.names)
        if ranks > 1 and os.environ.get("LOCAL_WORLD_SIZE") != str(ranks):
            return f"torchrun, with the options of this launch, -m torchrl_loco resume {shlex.quote(str(run))}"
        return f"torchrl-loco resume {shlex.quote(str(run))}" + (f" --gpus {ranks}" if ranks > 1 else "")


def _call_to_resume(run: Path, given: tuple[str, ...]) -> str:
    arguments = ["env" if "env" in given else "task", *(f"{name}=..." for name in given if name != "env")]
    return f"torchrl_loco.training.train({', '.join(arguments)}, resume={str(run)!r})"


class Environments:
    """Makes the environments of a run, from its settings or after an environment that was handed in.

    Attributes:
        transforms: those of the environment that was handed in.
        full_length: control steps of an episode of an evaluation.
    """

    def __init__(self, config: TrainingConfig, given: EnvBase | None = None) -> None:
        self._config, self._given, self._evaluating = config, given, dict[int, LocoEnv]()
        self.transforms: tuple[Transform, ...] = ()
        if given is None:
            self._task: type[LocoEnv] = resolve(config.task)
            self._protocol: str = config.protocol
            self._arguments = {**config.of_env, "reward_terms": not is_runner(config.task)}
            self.full_length = self.length_of_task
        else:
            base, self.transforms = unwrapped(given)
            for one in named_transforms(given).values():
                if isinstance(one, FrameSkipTransform):  # frames are control steps
                    raise ValueError(f"leave {type(one).__name__} out, and pass action_repeat={one.frame_skip}")
            self._task, self._protocol = type(base), base.protocol
            _refuse_further_arguments(self._task)
            self._arguments = {**dataclasses.asdict(base.config), "randomize": base.randomize, **base.options_given}
            self._arguments |= {name: getattr(base, name) for name in KEPT}
            self._arguments |= base.pixels.arguments if base.pixels else {}
            del self._arguments["naconmax"]  # which is for the number of its worlds
            self.full_length = base.config.episode_length

    @property
    def length_of_task(self) -> int:
        """Control steps of the episodes of the task's class."""
        length = self._task.episode_length
        return self._task.config.episode_length if length is None else length

    @property
    def own(self) -> dict[str, Any]:
        """What a policy must be told of them: the length of episodes if it is another, the transforms' classes."""
        own: dict[str, Any] = {} if self.full_length == self.length_of_task else {"full_length": self.full_length}
        if self._given is not None and self.transforms:
            own["transforms"] = [type(one).__name__ for one in named_transforms(self._given).values()]
        return own

    def training(self, nan_dump: Path) -> EnvBase:
        """Returns the environment in which the run trains: actions are held for ``action_repeat`` frames.

        Its worlds are those of this rank: world k of rank r is world ``r * num_envs + k`` of the whole. It returns the
        terms of its reward, unless the task is one of dm_control's runners.

        If a world becomes non-finite, a NaN dump is written to ``nan_dump``, unless one is already there.
        """
        config, env = self._config, self._given
        if env is None:
            env = self._made(
                config.num_envs,
                config.seed,
                world_offset=distributed.rank() * config.num_envs,
                stagger=True,
                nan_dump=None if nan_dump.exists() else nan_dump,
                episode_length=config.episode_length or self.full_length,
            )
        if config.action_repeat == 1:
            return env
        # The runners' tasks end at the time limit alone, and TorchRL's transform, which goes on there, has less to do.
        base, _ = unwrapped(env)
        ends_between = base.config.episode_length % config.action_repeat
        plain = is_runner(config.task) and not (base.reward_terms or base.metric_names or ends_between)
        return TransformedEnv(env, (FrameSkipTransform if plain else ActionRepeat)(config.action_repeat))

    def evaluation(self, episodes: int, seed: int, info: Mapping[str, Any] | None = None) -> EnvBase:
        """Returns worlds in which a policy of the run can be played, each for an episode of the task's own length.

        They are made once for a number of episodes; then their random streams, memory and what they share begin anew.
        They have the settings and the transforms of the environment that was handed in. With transforms there
        are as many worlds as there, whatever ``episodes`` is: some transforms keep a row for each. Episodes
        begin at the stage of the curriculum
        that the information of a policy tells.
        """
        worlds = self._config.num_envs if self.transforms else episodes
        if worlds not in self._evaluating:
            self._evaluating[worlds] = self._made(worlds, seed)
            if self._given is not None:
                _warn_of_other_attributes(unwrapped(self._given)[0], self._evaluating[worlds])
        own = self._evaluating[worlds]
        own.set_seed(seed)
        own.world.forget()
        own.set_stage(own.stage_of(info or {}))
        env: EnvBase = own
        for transform in self.transforms:
            env = TransformedEnv(env, copy.deepcopy(transform.clone()))  # that it learns in evaluations stays apart
        return env

    def close(self) -> None:
        """Closes the worlds of evaluations."""
        for env in self._evaluating.values():
            env.close()
        self._evaluating.clear()

    def shown(self, episodes: int, seed: int, info: Mapping[str, Any]) -> Any:
        """Returns worlds whose first is filmed: of a task that plays cases, such as motions, one that plays the first.

        Else, and with transforms, those of the evaluation.
        """
        if self.transforms or not next(iter(self._evaluating.values())).cases():
            return self.evaluation(episodes, seed, info)
        return self._made(1, seed, play=True)

    def _made(self, worlds: int, seed: int, **settings: Any) -> LocoEnv:
        """Returns worlds as the run's, by themselves those of an evaluation."""
        config, own = self._config, {**self._arguments, "world_offset": 0, "metrics": True, **settings}
        place = worlds, config.device, seed, self._protocol
        if self._given is None:
            shows_states = config.shows_states and settings.get("stagger")  # evaluations do without
            return make(showing_states(self._task) if shows_states else self._task, *place, **own)
        if settings.get("play"):
            del own["episode_length"], own["noise_scale"]
        return self._task(*place, **own)


def _refuse_further_arguments(cls: type[LocoEnv]) -> None:
    """Refuses a class that takes arguments of its own: worlds for evaluations are made anew, without their values."""
    known = inspect.signature(LocoEnv.__init__).parameters
    kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    parameters = inspect.signature(cls.__init__).parameters.values()
    if own := [each.name for each in parameters if each.name not in known and each.kind not in kinds]:
        raise ValueError(
            f"{cls.__name__} takes {', '.join(own)}, which evaluations in worlds of their own do not know: make a "
            "subclass with these values as attributes, and pass that"
        )


def _warn_of_other_attributes(given: LocoEnv, own: LocoEnv) -> None:
    """Warns where hooks read something else in evaluations than in the environment that was handed in."""
    for name in sorted(set().union(*given.hooks.read.values())):
        values = [getattr(env, name, None) for env in (given, own)]
        tensors = [value for value in values if isinstance(value, torch.Tensor)]
        if len(tensors) == 2:
            same = tensors[0].shape == tensors[1].shape and bool((tensors[0] == tensors[1].to(given.device)).all())
        else:
            same = not all(isinstance(value, bool | int | float | str) for value in values) or values[0] == values[1]
        if not same:
            logging.getLogger("torchrl_loco").warning(
                "hooks read %s, which is %s in the environment that trains and %s in its evaluations, as %s has it",
                *(name, *values, type(given).__name__),
            )


def unwrapped(env: EnvBase) -> tuple[LocoEnv, tuple[Transform, ...]]:
    """Returns the environment of this package that lies below transforms, and them, the innermost first."""
    base, transforms = unwrap(env)
    if not isinstance(base, LocoEnv):
        raise TypeError(f"train takes a LocoEnv, or one in TransformedEnv, got {type(base).__name__}")
    if not base.batch_size:
        raise ValueError("train takes a batch of worlds: make the environment with num_envs=1 or more, not None")
    return base, tuple(part for part in transforms if not isinstance(part, Compose) or len(part))


def make_for(policy: Policy, num_envs: int, device: Any, seed: int, **settings: Any) -> LocoEnv:
    """Returns new worlds of the task of a policy, under the protocol that it was trained under, and at its stage.

    Arguments are those of :class:`torchrl_loco.LocoEnv`, and its errors those of :func:`refuse_transforms` and
    :func:`torchrl_loco.registry.resolve`.
    """
    refuse_transforms(policy)
    info = policy.info
    place = resolve(info["task"]), num_envs, device, seed, info["protocol"]
    env = make(*place, **{**arguments_of(info), "world_offset": 0, **settings})
    check_terms(info.get("terms", ()), env.observation_layout.get(policy.in_keys[0], {}), info["task"])
    set_stage(env, env.stage_of(info))
    return env


def refuse_transforms(policy: Policy) -> None:
    """Refuses a policy that was trained behind transforms."""
    if names := policy.info.get("transforms"):
        raise ValueError(
            f"this policy was trained behind {', '.join(names)}, which its file does not hold: play it in an "
            "environment with these transforms, by env.rollout(steps, policy)"
        )
