"""A snapshot of an environment's worlds."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_loco.envs.checks import check_count


class State(TensorDict):
    """What ``env.get_state()`` returns and ``env.reset(state, set_state=True)`` restores.

    A TensorDict of batch size ``(num_envs,)`` with

    ==================  ===========  =====================================================
    ``qpos``            ``(N, nq)``  positions (m, rad, unit quaternions)
    ``qvel``            ``(N, nv)``  velocities (m/s, rad/s)
    ``qacc_warmstart``  ``(N, nv)``  where the constraint solver starts
    ``elapsed_steps``   ``(N,)``     control steps since the world's reset
    ``episode``         ``(N,)``     episodes drawn so far: the world's random counter
    ==================  ===========  =====================================================

    The only difference to a TensorDict: a :meth:`select` of ``"_reset"`` keeps these entries too. ``TransformedEnv``
    hands down nothing else, and would lose the state on its way to the environment. It also returns the very TensorDict
    that it was given, state and all: exclude ``State.KEYS`` before you pass that on as a state again.

    To make a state by hand: ``State({"qpos": ..., "qvel": ...}, batch_size=[num_envs])``.
    """

    KEYS = ("qpos", "qvel", "qacc_warmstart", "elapsed_steps", "episode")

    def branch(self, world: int, num_envs: int | None = None) -> "State":
        """Returns a state in which every world is a copy of one, to try different futures from the same moment.

        Args:
            world: index of the world to copy.
            num_envs: number of copies; ``None`` takes as many worlds as there are.

        Raises:
            IndexError: there is no such world.
        """
        count = self.batch_size[0] if num_envs is None else check_count("num_envs", num_envs)
        copies = {key: value[world].expand(count, *value.shape[1:]).clone() for key, value in self.items()}
        return State(copies, batch_size=[count], device=self.device)

    def select(self, *keys: Any, inplace: bool = False, strict: bool = True) -> TensorDictBase:
        """Selects ``keys``, and the state if ``"_reset"`` is among them."""
        state = [key for key in self.KEYS if key in self] if "_reset" in keys else []
        return super().select(*keys, *state, inplace=inplace, strict=strict)


def write_state(state: TensorDictBase | None, targets: Mapping[str, torch.Tensor], mask: torch.Tensor) -> None:
    """Writes a state into what holds it; what it lacks beside qpos and qvel starts at zero, but for the episode.

    Args:
        state: the state, or whatever was passed for one.
        targets: the tensors of all worlds by key of :class:`State`, written in place.
        mask: worlds that are written, ``(num_envs,)``.

    Raises:
        ValueError: it lacks qpos or qvel, has another shape, or is not finite; then nothing is written.
    """
    new = {key: None if state is None else state.get(key, None) for key in targets}
    if new["qpos"] is None or new["qvel"] is None:
        raise ValueError(
            "set_state=True needs a state with 'qpos' and 'qvel', as env.get_state() returns it. TransformedEnv "
            "drops them from a plain TensorDict: pass torchrl_loco.State({'qpos': ..., 'qvel': ...}, batch_size)"
        )
    for key, value in new.items():
        if value is None:
            continue
        if value.shape != targets[key].shape:
            raise ValueError(f"{key} must have shape {tuple(targets[key].shape)}, got {tuple(value.shape)}")
        if not value[mask].isfinite().all():
            raise ValueError(f"{key} must be finite")
    for key, target in targets.items():
        value = new[key]
        if value is None:
            if key == "episode":
                continue  # the world goes on drawing where it was
            value = torch.zeros_like(target)
        rows = mask.view(-1, *[1] * (target.ndim - 1))
        target.copy_(torch.where(rows, value.detach().to(target), target))
