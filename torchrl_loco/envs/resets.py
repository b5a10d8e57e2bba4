"""Steps and resets without a wait for the device: what TorchRL's own methods read from it, and why ours need not.

TorchRL asks after each step whether any world is done, which waits for the GPU, and checks each TensorDict on the
host, which takes longer than a step. Here worlds that are done are reset by a mask on the device, and a plain
TensorDict is not checked.
"""

import torch
from tensordict import LazyStackedTensorDict, TensorDict, TensorDictBase
from torchrl.envs import EnvBase

NESTED = ("reward_terms", "metrics", "observation_terms")  # entries of a step that are TensorDicts


class QuickResets(EnvBase):
    """TorchRL's ``step_and_maybe_reset`` and ``maybe_reset`` for worlds that a mask on the device resets."""

    _steps_as_base: bool  # whether step, _reset and maybe_reset are those of the package

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase, rewritten: frozenset[str] = frozenset()
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Returns what TorchRL's method returns; for a plain TensorDict, after a third of the work on the host.

        The next step need not begin with the entries ``rewritten``.
        """
        if not self._is_plain(tensordict):
            return super()._step_and_maybe_reset(tensordict)
        after = self._step(tensordict)
        self.world.reset_masked()
        done = after.get("done")
        # In the worlds that go on, nothing has changed.
        begin = self._outputs(lambda seen: seen.begin(after), unrewarded=done)
        # As in TorchRL, the policy's outputs are zero where a world was reset.
        for key, value in tensordict.items():
            if key not in begin and key not in rewritten and key != "reward":
                begin._set_str(key, value.masked_fill(rows_of(done, value), 0), inplace=False, validated=True)
        tensordict.set("next", after)
        return tensordict, begin

    def _is_plain(self, tensordict: TensorDictBase) -> bool:
        """Returns whether a step needs none of TorchRL's further features, nor a subclass's own step or reset."""
        return (
            self._steps_as_base
            and type(tensordict) is TensorDict
            and tensordict.batch_size == self.batch_size
            and tensordict.device == self.device
            and not self.run_type_checks
            and self._post_step_mdp_hooks is None
            and not tensordict._has_names()
            and all(isinstance(value, torch.Tensor) or key in NESTED for key, value in tensordict.items())
            and "_step" not in tensordict
        )

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns what :func:`reset_done_worlds` does, without reading from the device."""
        if "done" not in tensordict.keys():  # noqa: SIM118, no dict; it may have other signals
            return super().maybe_reset(tensordict)
        return reset_done_worlds(self, tensordict)


def rows_of(mask: torch.Tensor, entry: torch.Tensor) -> torch.Tensor:
    """Returns a mask of worlds, ``(*batch, 1)``, in a shape that broadcasts with an entry, ``(*batch, ...)``."""
    return mask.view((*mask.shape[:-1], *[1] * (entry.ndim - mask.ndim + 1)))


def reset_done_worlds(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Returns what TorchRL's ``maybe_reset`` does, without reading from the device.

    What is left out is TorchRL's check that no world is done after its reset; those of this package cannot be.
    """
    if isinstance(tensordict, LazyStackedTensorDict):  # what follows is by entry, not by world
        tensordict = tensordict.contiguous()
    mask, batch = tensordict.get("done").clone(), tensordict.batch_size
    request = TensorDict({"_reset": mask}, batch_size=batch, device=tensordict.device)
    fresh = env._reset(request, set_state=False, others=False)

    def merge(old: torch.Tensor, new: torch.Tensor | None) -> torch.Tensor:
        rows = rows_of(mask, old)
        return old.masked_fill(rows, 0) if new is None else torch.where(rows, new, old)

    # As in TorchRL, entries that a reset does not return (a policy's other outputs) are zero where a world was reset.
    merged = tensordict._fast_apply(merge, fresh.exclude("_reset"), default=None)
    return merged.update(fresh.exclude(*merged.keys(True, True)).exclude("_reset"))
