"""A collector that never waits for the device."""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs import TransformedEnv as TorchRLTransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_loco.envs.state import State


class RolloutCollector:
    """Collects batches of consecutive steps, across episodes; iterable like TorchRL's ``Collector``.

    A batch has the layout of TorchRL's: shape ``(num_envs, steps)``, with observation and action at the root and the
    result of the step under ``"next"``. Each batch continues where the last one ended. Environment and policy run
    without gradients, and without synchronisation with the device unless the policy itself synchronises.

    Args:
        env: an environment of this package, or one in :class:`torchrl_loco.TransformedEnv`.
        policy: reads the observation ``(num_envs, n)`` from a TensorDict and writes the action ``(num_envs, nu)``.
        frames_per_batch: steps in a batch, over all worlds; a multiple of the number of worlds.
        total_frames: steps over all batches, rounded up to whole batches; -1 never ends.
        exploration_type: how a stochastic policy chooses actions.

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
        """Returns the next batch, of shape ``(num_envs, steps)``."""
        td = self._env.reset() if self._carried is None or self._env.is_closed else self._carried
        steps = []
        with set_exploration_type(self._exploration_type):
            for _ in range(self._steps):
                current, td = self._env.step_and_maybe_reset(self._policy(td))
                steps.append(current)
        self._carried = td
        return TensorDict.stack(steps, dim=-1).refine_names(..., "time")

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the worlds and the data that the next batch begins with."""
        if self._carried is None:
            return {}
        env = self._env.base_env if isinstance(self._env, TorchRLTransformedEnv) else self._env
        return {"carried": self._carried.to_dict(), "env": env.get_state().to_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a ``state`` that :meth:`state_dict` returned, in an environment of the same settings."""
        if not state:
            self._carried = None
            return
        size, device = self._env.batch_size, self._env.device
        self._env.reset(State(state["env"], batch_size=size, device=device), set_state=True)
        self._carried = TensorDict(state["carried"], batch_size=size, device=device)

    def shutdown(self) -> None:
        """Does nothing: TorchRL's ``Collector`` has this method."""
