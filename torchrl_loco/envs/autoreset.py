"""Resets by mask, without reading from the device whether a world is done."""

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import (
    CatTensors,
    CenterCrop,
    ClipTransform,
    Compose,
    Crop,
    DoubleToFloat,
    DTypeCastTransform,
    EnvBase,
    ExcludeTransform,
    FlattenObservation,
    FrameSkipTransform,
    GrayScale,
    InitTracker,
    ObservationNorm,
    PermuteTransform,
    RenameTransform,
    Resize,
    RewardClipping,
    RewardScaling,
    RewardSum,
    SelectTransform,
    SignTransform,
    SqueezeTransform,
    StepCounter,
    ToTensorImage,
    Transform,
    UnsqueezeTransform,
)
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv

from torchrl_loco.envs.state import without_state

if TYPE_CHECKING:
    from torchrl_loco.envs.base import LocoEnv


def is_plain(env: "LocoEnv", tensordict: TensorDictBase) -> bool:
    """Returns whether :func:`step_and_reset` does what TorchRL would do with ``tensordict``.

    TorchRL has further features: partial steps, results given in advance, nested entries, checks of types, hooks.
    """
    return (
        type(tensordict) is TensorDict
        and tensordict.batch_size == env.batch_size
        and tensordict.device == env.device
        and not env.reward_terms  # which are nested
        and not env.run_type_checks
        and env._post_step_mdp_hooks is None
        and all(isinstance(value, torch.Tensor) for value in tensordict.values())
        and "_step" not in tensordict
    )


def step_and_reset(
    env: "LocoEnv", tensordict: TensorDictBase, rewritten: frozenset[str]
) -> tuple[TensorDictBase, TensorDictBase]:
    """Steps an environment and begins new episodes in the worlds that are done.

    Args:
        env: the environment.
        tensordict: has an ``action``, batch ``(num_envs,)``; ``next`` is added to it.
        rewritten: entries that the next step need not begin with.

    Returns:
        It, and what the next step begins with, as TorchRL's ``step_and_maybe_reset``.
    """
    after = env._step(tensordict)
    env.world.reset_masked()
    begin = env._outputs()  # in the worlds that go on, nothing has changed
    done = after.get("done")
    # As in TorchRL, the policy's outputs are zero where a world was reset.
    for key, value in tensordict.items():
        if key not in begin and key not in rewritten and key != "reward":
            begin._set_str(key, value.masked_fill(rows_of(done, value), 0), inplace=False, validated=True)
    tensordict.set("next", after)
    return tensordict, begin


def rows_of(mask: torch.Tensor, entry: torch.Tensor) -> torch.Tensor:
    """Returns a mask of worlds, ``(*batch, 1)``, in a shape that broadcasts with an entry, ``(*batch, ...)``."""
    return mask.view(*mask.shape[:-1], *[1] * (entry.ndim - mask.ndim + 1))


def reset_done_worlds(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Does what TorchRL's ``maybe_reset`` does, without reading from the device.

    The result is the same. What is left out is TorchRL's check that no world is done after its reset; the environments
    of this package cannot be.

    Args:
        env: an environment of this package, or one around it.
        tensordict: what ``step_mdp`` makes of a step, batch ``(num_envs,)``.

    Returns:
        The same TensorDict, batch ``(num_envs,)``, with the first observation of the next episode in the worlds that
        were done.
    """
    mask, batch = tensordict.get("done").clone(), tensordict.batch_size
    request = TensorDict({"_reset": mask}, batch_size=batch, device=tensordict.device)
    fresh = env._reset(request, set_state=False)

    def merge(old: torch.Tensor, new: torch.Tensor | None) -> torch.Tensor:
        rows = rows_of(mask, old)
        return old.masked_fill(rows, 0) if new is None else torch.where(rows, new, old)

    # As in TorchRL, entries that a reset does not return (a policy's other outputs) are zero where a world was reset.
    merged = tensordict._fast_apply(merge, fresh.exclude("_reset"), default=None)
    return merged.update(fresh.exclude(*merged.keys(True, True)).exclude("_reset"))


PLAIN_TRANSFORMS = (
    *(ClipTransform, Compose, DoubleToFloat, FrameSkipTransform, InitTracker),
    *(ObservationNorm, RewardClipping, RewardScaling, RewardSum, StepCounter),
)
"""Transforms that can be recorded, as they keep nothing on the host; a reset changes only the worlds of its mask."""

STATELESS_TRANSFORMS = (
    *(CatTensors, CenterCrop, Crop, DTypeCastTransform, ExcludeTransform, FlattenObservation, GrayScale),
    *(PermuteTransform, RenameTransform, Resize, SelectTransform, SignTransform, SqueezeTransform),
    *(ToTensorImage, UnsqueezeTransform),
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


class TransformedEnv(TorchRLTransformedEnv):
    """TorchRL's ``TransformedEnv`` for the environments of this package; most transforms need not wait for the device.

    TorchRL's own works too and gives the same data, but reads from the device at every step, to reset only if a world
    is done. So does this one with a transform that has a reset of its own, unless ``PLAIN_TRANSFORMS`` or
    ``STATELESS_TRANSFORMS`` lists it. The arguments are those of TorchRL's: an environment, and a transform or a
    ``Compose`` of them.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Resets the worlds that are done; see :func:`reset_done_worlds`.

        Args:
            tensordict: what ``step_mdp`` makes of a step, batch ``(num_envs,)``.

        Returns:
            The same, batch ``(num_envs,)``, with new episodes in the worlds that were done.
        """
        env: EnvBase = self
        while isinstance(env, TorchRLTransformedEnv):
            if not resets_by_mask(env.transform):
                return super().maybe_reset(tensordict)
            env = env.base_env
        return reset_done_worlds(self, tensordict)

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Returns what ``reset`` returns, without a state that was passed to it, which would become stale."""
        return super()._reset_proc_data(without_state(tensordict, self.device), tensordict_reset)
