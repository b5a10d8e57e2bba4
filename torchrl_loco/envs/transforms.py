"""TransformedEnv, whose transforms need not wait for the device, and which transforms allow that."""

import contextlib
import logging
from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, FrameSkipTransform, Transform
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv
from torchrl.envs import transforms as t

from torchrl_loco.checks import check_int
from torchrl_loco.envs.resets import reset_done_worlds, rows_of
from torchrl_loco.envs.state import before_reset


class ActionRepeat(FrameSkipTransform):
    """Holds an action for several control steps and sums their rewards, up to the step that ends a world's episode.

    TorchRL's FrameSkipTransform goes on stepping a world whose episode has ended, and loses the end and the true
    terminal observation. Until the action ends such a world is stepped on here, too, unseen: ``adapt`` and ``health()``
    count its end more than once. ``RewardSum`` belongs behind it.
    """

    _checked = False

    def __init__(self, frame_skip: int = 1) -> None:
        super().__init__(check_int("frame_skip", frame_skip))

    def _check(self, parent: Any) -> None:
        """Warns of what lies below and goes wrong."""
        self._checked = True
        if any(isinstance(transform, t.RewardSum) for transform in named_transforms(parent).values()):
            logging.getLogger("torchrl_loco").warning(
                "RewardSum sums the last control step of each action alone: it belongs behind ActionRepeat"
            )
        if "adapt" in getattr(unwrap(parent)[0].hooks, "own", ()):
            logging.getLogger("torchrl_loco").warning(
                "adapt() counts an episode that ends within an action of ActionRepeat more than once: pass a longer "
                "ctrl_dt instead"
            )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parent: Any = self.parent
        if not self._checked:
            self._check(parent)
        for _ in range(self.frame_skip - 1):
            before, after = next_tensordict, parent._step(tensordict)
            over = before.get("done")
            for key in after.keys(True, True):
                if key == "reward" or key[0] == "reward_terms":
                    after.set(key, before.get(key) + after.get(key))

            def chosen(new: torch.Tensor, old: torch.Tensor, over: torch.Tensor = over) -> torch.Tensor:
                return torch.where(rows_of(over, new), old, new)

            next_tensordict = after.apply(chosen, before)
        return next_tensordict


BASE = "base_env."  # before the names of what the environment below transforms has in a state_dict
PLAIN_TRANSFORMS = (
    ActionRepeat,
    *(t.ClipTransform, Compose, t.DoubleToFloat, FrameSkipTransform, t.InitTracker, t.ObservationNorm),
    *(t.RewardClipping, t.RewardScaling, t.RewardSum, t.StepCounter),
)
"""Transforms that can be recorded, as they keep nothing on the host; a reset changes only the worlds of its mask."""

STATELESS_TRANSFORMS = (
    *(t.CatTensors, t.CenterCrop, t.Crop, t.DTypeCastTransform, t.ExcludeTransform, t.FlattenObservation, t.GrayScale),
    *(t.PermuteTransform, t.RenameTransform, t.Resize, t.SelectTransform, t.SignTransform, t.SqueezeTransform),
    *(t.ToTensorImage, t.UnsqueezeTransform),
)
"""Further transforms that compute the same of the same data, also at a reset."""


def resets_by_mask(transform: Transform) -> bool:
    """Returns whether the reset of a transform, and of those in it, changes nothing if no world is reset.

    Of other classes than the listed ones, those without a reset of their own qualify. ``VecNormV2`` does not: its reset
    counts the observations that it is given.
    """
    for part in (part for part in transform.modules() if isinstance(part, Transform)):
        kind = type(part)
        own = [getattr(kind, name) is not getattr(Transform, name) for name in ("_reset", "_reset_env_preprocess")]
        if any(own) and kind not in PLAIN_TRANSFORMS and kind not in STATELESS_TRANSFORMS:
            return False
    return True


def unwrap(env: EnvBase) -> tuple[Any, list[Transform]]:
    """Returns the environment below transforms, and them, the innermost first."""
    found: list[Transform] = []
    while isinstance(env, TorchRLTransformedEnv):
        found.insert(0, env.transform)
        env = env.base_env
    return env, found


def named_transforms(env: EnvBase) -> dict[str, Transform]:
    """Returns the transforms of an environment by number and class, the innermost first, those of a Compose singly."""
    parts = [one for each in unwrap(env)[1] for one in (each if isinstance(each, Compose) else [each])]
    return {f"{i} {type(transform).__name__}": transform for i, transform in enumerate(parts)}


def state_of_transforms(env: EnvBase) -> dict[str, Any]:
    """Returns a copy of the ``state_dict`` of each transform that has one of tensors, numbers and text."""
    states = {}
    for name, transform in named_transforms(env).items():
        with contextlib.suppress(TypeError):  # what else there is could not be read from a file without running code
            states[name] = _copied(transform.state_dict())
    return states


def load_transforms(env: EnvBase, states: Mapping[str, Any]) -> None:
    """Gives transforms the ``states`` that :func:`state_of_transforms` returned, and logs which there is none for."""
    anew = []
    for name, transform in named_transforms(env).items():
        try:
            if name in states or transform.state_dict():
                transform.load_state_dict(_copied(states[name], env.device))
        except (KeyError, RuntimeError):
            anew.append(name.split()[1])
    if anew:
        logging.getLogger("torchrl_loco").warning("transforms that begin anew: %s", ", ".join(anew))


def _copied(value: Any, device: torch.device | None = None) -> Any:
    """Returns a copy of tensors, numbers and text in dictionaries."""
    if isinstance(value, torch.Tensor):
        return value.detach().to(device, copy=True)
    if isinstance(value, Mapping):
        return {key: _copied(entry, device) for key, entry in value.items()}
    if isinstance(value, bool | int | float | str | None):
        return value
    raise TypeError(f"a state has a {type(value).__name__}")


class TransformedEnv(TorchRLTransformedEnv):
    """TorchRL's ``TransformedEnv`` for the environments of this package; most transforms need not wait for the device.

    TorchRL's own works too and gives the same data, but reads from the device at every step, to reset only if a world
    is done. So does this one with a transform that has a reset of its own, unless ``PLAIN_TRANSFORMS`` or
    ``STATELESS_TRANSFORMS`` lists it. The arguments are those of TorchRL's: an environment, and a transform or a
    ``Compose`` of them.
    """

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Returns the state of the transforms, and with ``"base_env."`` before its names that of the environment."""
        of_env = {BASE + name: value for name, value in self.base_env.state_dict().items()}
        return {**super().state_dict(*args, **kwargs), **of_env}

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, **kwargs: Any) -> None:
        """Restores a ``state_dict``; without ``strict`` the worlds stay (see :meth:`LocoEnv.load_state_dict`)."""
        of_env = {name: value for name, value in state_dict.items() if name.startswith(BASE)}
        of_transforms = {name: value for name, value in state_dict.items() if name not in of_env}
        super().load_state_dict(of_transforms, strict=strict, **kwargs)
        self.base_env.load_state_dict({name.removeprefix(BASE): value for name, value in of_env.items()}, strict=strict)

    def view(
        self, policy: Callable[[TensorDictBase], TensorDictBase], action_repeat: int | None = None, **server: Any
    ) -> Any:
        """Plays a policy, which reads what the transforms make, in the browser.

        Args:
            policy: reads what the transforms return.
            action_repeat: as for :meth:`LocoEnv.view`.
            server: as for it, too.

        Returns:
            The viewer.

        Raises:
            ValueError: a transform holds actions, which is :meth:`LocoEnv.view`'s ``action_repeat``.
        """
        if any(isinstance(transform, FrameSkipTransform) for transform in named_transforms(self).values()):
            raise ValueError("view holds actions itself: leave ActionRepeat out, and pass action_repeat")
        return type(unwrap(self)[0]).view(self, policy, action_repeat, **server)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns what ``step_mdp`` makes of a step, with new episodes in the worlds that were done."""
        if "done" not in tensordict.keys() or not all(map(resets_by_mask, unwrap(self)[1])):  # noqa: SIM118, no dict
            return super().maybe_reset(tensordict)
        return reset_done_worlds(self, tensordict)

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Returns what ``reset`` returns, in worlds that it leaves out what was passed, or what there is."""
        before = before_reset(tensordict, tensordict_reset, self.device)
        return super()._reset_proc_data(before, tensordict_reset)
