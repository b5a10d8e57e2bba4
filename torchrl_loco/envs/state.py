"""A snapshot of an environment's worlds."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from torchrl_loco.checks import check_count


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
            TypeError: ``num_envs`` is no integer.
            ValueError: ``num_envs`` is less than 1.
        """
        count = self.batch_size[0] if num_envs is None else check_count("num_envs", num_envs)
        copies = {key: value[world].expand(count, *value.shape[1:]).clone() for key, value in self.items()}
        return State(copies, batch_size=[count], device=self.device)

    def select(self, *keys: Any, inplace: bool = False, strict: bool = True) -> TensorDictBase:
        """Selects ``keys``, and the state if ``"_reset"`` is among them.

        Args:
            keys: names of entries.
            inplace: whether to remove the others instead of making a new TensorDict.
            strict: whether a key that is not there raises a KeyError.

        Returns:
            The selection, batch ``(num_envs,)``.
        """
        state = [key for key in self.KEYS if key in self] if "_reset" in keys else []
        return super().select(*keys, *state, inplace=inplace, strict=strict)


class Resumable(EnvBase):
    """Mixin: ``state_dict`` and ``load_state_dict`` of an environment that has :meth:`get_state`."""

    body: ClassVar[str]
    protocol: str
    num_envs: int
    seed: int

    def get_state(self) -> State:
        """Returns a copy of the state of all worlds."""
        raise NotImplementedError

    def get_extra_state(self) -> dict[str, Any]:
        """Returns what ``state_dict`` holds: the state of all worlds and the seed."""
        made_by = {"body": self.body, "protocol": self.protocol, "num_envs": self.num_envs}
        return {**made_by, "seed": self.seed, "worlds": self.get_state().to_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Goes on where ``state_dict`` was taken: the worlds, their random streams, and the seed.

        Raises:
            ValueError: it was taken from an environment of another body, protocol or number of worlds.
        """
        for name in ("body", "protocol", "num_envs"):
            if state[name] != getattr(self, name):
                raise ValueError(f"the state is of {name}={state[name]!r}, this environment of {getattr(self, name)!r}")
        self._set_seed(state["seed"])
        self.reset(State(state["worlds"], batch_size=self.batch_size, device=self.device), set_state=True)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, **kwargs: Any) -> Any:
        """Goes on where ``state_dict`` was taken; see :meth:`set_extra_state`.

        With ``strict`` False the worlds stay as they are: so TorchRL's ``EnvCreator`` hands what transforms share to
        every environment that it makes, which should begin anew.

        Returns:
            The keys that were missing or not expected, as torch's own does.
        """
        if not strict:
            state_dict = {name: value for name, value in state_dict.items() if not name.endswith("_extra_state")}
        return super().load_state_dict(state_dict, strict=strict, **kwargs)

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Returns what ``reset`` returns, without a state that was passed to it, which would grow stale."""
        if tensordict is not None and any(key in tensordict for key in State.KEYS):
            tensordict = TensorDict(
                {key: value for key, value in tensordict.items() if key not in State.KEYS},
                batch_size=tensordict.batch_size,
                device=self.device,
            )
        return super()._reset_proc_data(tensordict, tensordict_reset)


def write_state(state: TensorDictBase | None, targets: Mapping[str, torch.Tensor], mask: torch.Tensor) -> None:
    """Writes a state into what holds it; what it lacks beside qpos and qvel starts at zero, but for the episode.

    Args:
        state: the :class:`State`, or whatever was passed for one.
        targets: the tensors of all worlds by key of :class:`State`, written in place.
        mask: worlds that are written, ``(num_envs,)``.

    Raises:
        ValueError: it lacks qpos or qvel, has another shape, or is not finite; then nothing is written.
    """
    new = {key: None if state is None else state.get(key, None) for key in targets}
    new = {key: None if value is None else value.detach().to(mask.device) for key, value in new.items()}
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
        if targets[key].dtype.is_floating_point:
            if not value[mask].to(targets[key].dtype).isfinite().all():
                raise ValueError(f"{key} must be finite")
        elif not ((value[mask].long() >= 0) & (value[mask].long() < 2**31)).all():
            raise ValueError(f"{key} must lie in [0, 2**31)")
    for key, target in targets.items():
        value = new[key]
        if value is None:
            if key == "episode":
                continue  # the world goes on drawing where it was
            value = torch.zeros_like(target)
        rows = mask.view(-1, *[1] * (target.ndim - 1))
        target.copy_(torch.where(rows, value.to(target.dtype), target))
