"""Resets by mask, without reading from the device whether a world is done."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv


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
        rows = mask.view(*batch, *[1] * (old.ndim - len(batch)))
        return old.masked_fill(rows, 0) if new is None else torch.where(rows, new, old)

    # As in TorchRL, entries that a reset does not return (a policy's other outputs) are zero where a world was reset.
    merged = tensordict._fast_apply(merge, fresh.exclude("_reset"), default=None)
    return merged.update(fresh.exclude(*merged.keys(True, True)).exclude("_reset"))


class TransformedEnv(TorchRLTransformedEnv):
    """TorchRL's ``TransformedEnv`` for the environments of this package, without waiting for the device.

    TorchRL's own works too and gives the same data, but reads from the device at every step. The arguments are those
    of TorchRL's: an environment, and a transform or a ``Compose`` of them.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Resets the worlds that are done; see :func:`reset_done_worlds`.

        Args:
            tensordict: what ``step_mdp`` makes of a step, batch ``(num_envs,)``.

        Returns:
            The same, batch ``(num_envs,)``, with new episodes in the worlds that were done.
        """
        return reset_done_worlds(self, tensordict)
