"""A collection loop that never waits for the device."""

from collections.abc import Callable, Iterator

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type


class RolloutCollector:
    """Collects batches of consecutive steps, across episodes; iterable like TorchRL's ``Collector``.

    A batch has the layout of TorchRL's: shape ``(num_envs, steps)``, with what the policy saw and did at the root and
    what came of it under ``"next"``. The next batch goes on where the last one ended. Environment and policy run
    without gradients and, if neither does by itself, without any synchronisation with the device.

    Args:
        env: an environment of this package, or one in :class:`torchrl_loco.TransformedEnv`.
        policy: takes a TensorDict with the observation and writes the action.
        frames_per_batch: steps in a batch, over all worlds; a multiple of the number of worlds.
        total_frames: steps over all batches, rounded up to whole batches; -1 never ends.
        exploration_type: how actions are taken from a stochastic policy.

    Raises:
        ValueError: ``frames_per_batch`` is not a positive multiple of the number of worlds.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Callable[[TensorDictBase], TensorDictBase],
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
    ) -> None:
        worlds = env.batch_size.numel()
        if frames_per_batch < 1 or frames_per_batch % worlds:
            raise ValueError(
                f"frames_per_batch must be a positive multiple of the {worlds} worlds, got {frames_per_batch}"
            )
        self._env = env
        self._policy = policy
        self._steps = frames_per_batch // worlds
        self._frames_per_batch = frames_per_batch
        self._total_frames = total_frames
        self._exploration_type = exploration_type
        self._carried: TensorDictBase | None = None

    def __iter__(self) -> Iterator[TensorDictBase]:
        """Yields batches until ``total_frames`` are collected."""
        frames = 0
        while self._total_frames < 0 or frames < self._total_frames:
            yield self.rollout()
            frames += self._frames_per_batch

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Returns the next batch."""
        td = self._env.reset() if self._carried is None else self._carried
        steps = []
        with set_exploration_type(self._exploration_type):
            for _ in range(self._steps):
                current, td = self._env.step_and_maybe_reset(self._policy(td))
                steps.append(current)
        self._carried = td
        return TensorDict.stack(steps, dim=-1).refine_names(..., "time")

    def shutdown(self) -> None:
        """Does nothing; here so that a ``Collector`` can be exchanged for this."""
