"""Episodes that follow one another without the host having to ask whether any has ended."""

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv


class AsyncReset(EnvBase):
    """Mixin: ``step_and_maybe_reset`` resets by mask, always, where TorchRL first reads from the device if it must.

    The result is the same as TorchRL's. What is left out is the check that no world is done after its reset; the
    environments of this package cannot be.
    """

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Resets the worlds that are done, without synchronising with the device.

        Args:
            tensordict: what ``step_mdp`` makes of a step, batch ``(num_envs,)``.

        Returns:
            The same TensorDict, batch ``(num_envs,)``, with the first observation of the next episode in the worlds
            that were done.
        """
        mask = tensordict.get("done").clone()
        request = TensorDict({"_reset": mask}, batch_size=tensordict.batch_size, device=tensordict.device)
        fresh = self._reset(request, set_state=False)

        def merge(old: torch.Tensor, new: torch.Tensor | None) -> torch.Tensor:
            rows = mask.view(-1, *[1] * (old.ndim - 1))
            return old.masked_fill(rows, 0) if new is None else torch.where(rows, new, old)

        # As in TorchRL, what a reset does not bring (a policy's other outputs) is zero where a world was reset.
        merged = tensordict._fast_apply(merge, fresh.exclude("_reset"), default=None)
        return merged.update(fresh.exclude(*merged.keys(True, True)).exclude("_reset"))


class TransformedEnv(AsyncReset, TorchRLTransformedEnv):
    """TorchRL's ``TransformedEnv`` for the environments of this package, without waiting for the device.

    A stock one works too and gives the same data, but synchronises with the device at every step. Arguments are those
    of TorchRL's: an environment, and a transform or a ``Compose`` of them.
    """
