"""REPPO's networks and losses on CUDA by kernels that are there at once; torch.compile takes seconds."""

from typing import Any

import torch
from torch import Tensor, nn

from torchrl_loco.policy import ObservationNorm
from torchrl_loco.training.adam import FlatAdam, aligned
from torchrl_loco.training.rows import Rows, normalised, triton_kernels


class ReppoRows:
    """Networks as functions of rows, with weights of another type.

    Args:
        actor: layers from normalised observations to what ``extract`` makes a distribution of.
        extract: gives means and deviations.
        critic: a ``DistributionalQ`` of observations.
        sizes: lengths of what the actor and the critic read, without the action.
        dtype: the type of rows and weights.
        n: rows of a minibatch.
    """

    def __init__(
        self,
        actor: nn.Sequential,
        extract: nn.Module,
        critic: Any,
        sizes: tuple[int, int],
        dtype: torch.dtype,
        n: int,
    ) -> None:
        self._extract, self._bins, self._reads, self._dtype = extract, critic.bins, sizes[1], dtype
        first, last = critic.encoder[0], critic.encoder[-1]
        self._mean, self._encoder = Rows(actor, sizes[0], dtype), Rows(critic.encoder, first.in_features, dtype)
        heads = critic.value_head, critic.predictor
        self._value, self._predictor = (Rows(head, last.out_features, dtype) for head in heads)
        self._weights: dict[nn.Parameter, Tensor] = {}
        self._kernels, of_norms = triton_kernels("reppo_kernels"), triton_kernels("normed")
        norms = [part for net in (actor, critic) for part in net.modules() if isinstance(part, nn.LayerNorm)]
        like, nu = last.weight.new_empty(0, dtype=dtype), first.in_features - sizes[1]
        with triton_kernels("mlp").all_at_once(like.device):
            of_norms.compile_ahead({part.normalized_shape[-1] for part in norms}, like, n)
            self._kernels.compile_ahead(critic.bins, like, n, last.out_features, sizes[1], nu)

    def take(self, *optimizers: FlatAdam) -> None:
        """Computes with the weights that optimizers have now; gradients flow to those that require them."""
        self._weights = {part: view for each in optimizers for part, view in each.wide(self._dtype).items()}

    def normalised(self, rows: Tensor, norm: ObservationNorm) -> Tensor:
        """Returns normalised rows as the networks read them, with zeros at their ends."""
        return normalised(rows, norm, self._dtype)

    def distribution(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Returns means and standard deviations of actions before tanh, each ``(..., nu)``."""
        loc, scale = self._extract(self._mean(rows, self._weights).float())
        return loc.contiguous(), scale.contiguous()

    def value_and_features(self, rows: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean return, shape ``(...)``, and the features, shape ``(..., width)``."""
        features = self._features(rows, action)
        logits = self._value(features, self._weights)
        value = self._kernels.BinMean.apply(logits.reshape(-1, logits.shape[-1]), self._bins.centers)
        return value.view(logits.shape[:-1]), features

    def losses(
        self, rows: Tensor, action: Tensor, returns: Tensor, features: Tensor, alive: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Returns the losses of ``DistributionalQ``."""
        found, kernels = self._features(rows, action), self._kernels
        logits, predicted = self._value(found, self._weights), self._predictor(found, self._weights)
        loss = kernels.MeanLoss.apply(logits, *kernels.entropy(logits.detach(), returns, self._bins))
        return loss, kernels.MeanLoss.apply(predicted, *kernels.squared_error(predicted.detach(), features, alive))

    def sample(self, loc: Tensor, scale: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Returns actions and their log-probabilities as :func:`.reppo.sample` does."""
        action, log_prob = self._kernels.Draw.apply(*(each.reshape(-1, each.shape[-1]) for each in (loc, scale, noise)))
        return action.view(loc.shape), log_prob.view(loc.shape[:-1])

    def actor_losses(self, own: tuple[Tensor, Tensor], *others: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Returns what :func:`.reppo.actor_losses` does, of the same."""
        loss, numbers = self._kernels.ActorLoss.apply(*own, *others)
        return loss, *numbers[1:].unbind()

    def _features(self, rows: Tensor, action: Tensor) -> Tensor:
        flat = (each.reshape(-1, each.shape[-1]) for each in (rows, action))
        reads = self._reads + action.shape[-1]
        read = self._kernels.Joined.apply(*flat, self._reads, aligned(reads))
        return self._encoder(read, self._weights).view(*rows.shape[:-1], -1)
