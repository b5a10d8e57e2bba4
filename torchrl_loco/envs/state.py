"""A snapshot of an environment's worlds."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_loco.checks import ANY, check_int


class State(TensorDict):
    """What ``env.get_state()`` returns and ``env.reset(state, set_state=True)`` restores.

    A TensorDict of batch size ``(num_envs,)`` with

    ==================  ===========  =====================================================
    ``qpos``            ``(N, nq)``  positions (m, rad, unit quaternions)
    ``qvel``            ``(N, nv)``  velocities (m/s, rad/s)
    ``qacc_warmstart``  ``(N, nv)``  initial guess of the constraint solver
    ``act``             ``(N, na)``  activations of the actuators, if the model has any
    ``memory``          nested       entries of the task's memory by name, if it has any
    ``shared``          nested       what worlds share, by name, the same in each row, if the task has any
    ``pictures``        ``(N, *)``   the last pixels, where ``frame_stack`` keeps several
    ``model``           nested       by field, ``(N, numbers that vary)``, if ``randomize`` names any
    ``elapsed_steps``   ``(N,)``     control steps since the world's reset
    ``episode``         ``(N,)``     episodes begun: index of the next random stream
    ==================  ===========  =====================================================

    To make a state by hand: ``State({"qpos": ..., "qvel": ...}, batch_size=[num_envs])``.

    It differs from a TensorDict in one method: ``select("_reset")`` also keeps these entries, because
    ``TransformedEnv`` passes only that selection to the inner environment. TorchRL's own ``TransformedEnv.reset``
    also writes into the TensorDict that it is given and returns it, with the state in it: pass it a copy, and exclude
    ``State.KEYS`` from what it returns.
    """

    PHYSICS = ("qpos", "qvel", "qacc_warmstart", "act")
    KEYS = (*PHYSICS, "memory", "shared", "model", "pictures", "elapsed_steps", "episode")

    def branch(self, world: int, num_envs: int | None = None) -> "State":
        """Returns a state in which every world is a copy of one, to try different futures from the same moment.

        Args:
            world: index of the world to copy, negative from the end; ignored without a batch dimension.
            num_envs: number of copies; ``None`` makes as many as there are worlds.

        Raises:
            IndexError: there is no such world.
            TypeError: ``world`` or ``num_envs`` is no integer.
            ValueError: ``num_envs`` is less than 1.
        """
        worlds, world = self.batch_size.numel(), check_int("world", world, ANY)
        count = worlds if num_envs is None else check_int("num_envs", num_envs)
        if self.batch_size and not -worlds <= world < worlds:
            raise IndexError(f"there is no world {world}: this state has the worlds 0 to {worlds - 1}")
        one = {key: value[world] if self.batch_size else value for key, value in self.items()}
        copies = {key: value.expand(count, *value.shape).clone() for key, value in one.items()}
        return State(copies, batch_size=[count], device=self.device)

    def select(self, *keys: Any, inplace: bool = False, strict: bool = True) -> TensorDictBase:
        """Returns what TensorDict's own does of ``keys``, and the state if ``"_reset"`` is among them."""
        state = [key for key in self.KEYS if key in self] if "_reset" in keys else []
        return super().select(*keys, *state, inplace=inplace, strict=strict)


torch.serialization.add_safe_globals([State])  # a file of tensors: torch.load reads it without weights_only=False


def before_reset(
    tensordict: TensorDictBase | None, after: TensorDictBase, device: torch.device | None
) -> TensorDictBase | None:
    """Returns what worlds that a reset leaves out keep: a TensorDict itself, or if it has a state, a new one without.

    The state would become stale. Without ``qpos`` and ``qvel`` it has none: an entry ``memory`` may be a recurrent
    policy's. Entries that were not passed are those of ``after``; TorchRL would pad them with zeros.
    """
    if tensordict is None:
        return None
    if "qpos" in tensordict and "qvel" in tensordict:
        kept = {key: value for key, value in tensordict.items() if key not in State.KEYS}
        tensordict = TensorDict(kept, batch_size=tensordict.batch_size, device=device)
    if "_reset" in tensordict:
        tensordict.update(after.exclude(*tensordict.keys(True, True)))
    return tensordict


def checked_state(
    state: TensorDictBase | None,
    targets: Mapping[str | tuple[str, str], torch.Tensor],
    mask: torch.Tensor,
    *,
    finite: bool = True,
) -> dict[Any, torch.Tensor]:
    """Returns the entries of a state that can be written into ``targets``, all worlds' by key, where a mask is set."""
    given: dict[Any, Any] = {key: None if state is None else state.get(key, None) for key in targets}
    for group, owner in (("memory", "the task"), ("shared", "the task"), ("model", "randomize")):
        entries = None if state is None else state.get(group, None)
        known = [key[1] for key in targets if key[0] == group]
        for name in [] if entries is None else entries.keys():
            if name not in known:
                raise ValueError(f"the state has {group} {name!r}, {owner} {', '.join(known) or 'has none'}")
    new = {key: value.detach().to(mask.device) for key, value in given.items() if value is not None}
    if not {"qpos", "qvel"} <= new.keys():
        raise ValueError(
            "set_state=True needs a state with 'qpos' and 'qvel', as env.get_state() returns it. TransformedEnv "
            "drops them from a plain TensorDict: pass torchrl_loco.State({'qpos': ..., 'qvel': ...}, batch_size)"
        )
    for key, value in new.items():
        if value.shape != targets[key].shape:
            raise ValueError(f"{key} must have shape {tuple(targets[key].shape)}, got {tuple(value.shape)}")
        if value.dtype != (dtype := targets[key].dtype) and not torch.can_cast(value.dtype, dtype):
            raise ValueError(f"{key} must be of {dtype}, got {value.dtype}: it is of an earlier version of the task")
        if key[0] == "shared" and not (value == value[:1]).all():
            raise ValueError(f"{key} must be the same in all worlds, which share it")
        if targets[key].dtype.is_floating_point:
            if finite and not value[mask].to(targets[key].dtype).isfinite().all():
                raise ValueError(f"{key} must be finite")
        elif key in ("elapsed_steps", "episode"):
            counts = value[mask].long()
            if not ((counts >= 0) & (counts < 2**31 - 1)).all():  # it will be counted up
                raise ValueError(f"{key} must lie in [0, 2**31 - 1)")
    return new


def write_state(
    new: Mapping[Any, torch.Tensor], targets: Mapping[str | tuple[str, str], torch.Tensor], mask: torch.Tensor
) -> None:
    """Writes what :func:`checked_state` returned. Missing entries become zero, but episode, model and shared stay.

    What worlds share is written where all of them are.
    """
    for key, target in targets.items():
        if (key == "episode" or key[0] in ("model", "shared")) and key not in new:
            continue  # the world's random stream goes on, and its numbers stay
        if key[0] == "shared":
            if mask.all():
                target[0].copy_(new[key][0])
            continue
        of_history = key[0] == "memory" and key[1].endswith(".history")  # NaN where a state has none
        value = new[key] if key in new else torch.full_like(target, float("nan") if of_history else 0)
        target.copy_(torch.where(by_world(mask, target), value.to(target.dtype), target))


def by_world(mask: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Returns a mask of worlds in a shape that broadcasts with ``(num_envs, ...)``."""
    return mask.view(-1, *[1] * (values.ndim - 1))
