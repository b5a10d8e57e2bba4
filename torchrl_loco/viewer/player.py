"""Steps worlds under a policy, and remembers what curves show."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

HISTORY = 20.0  # time that curves show (s)


class Player:
    """Worlds under a policy, without exploration: worlds whose episode ends begin the next.

    Arguments are those of :class:`torchrl_loco.viewer.viewer.Viewer`. Another policy may be set, which acts from the
    next step on; ``None`` leaves the worlds at the start. ``steps`` counts control steps.
    """

    def __init__(self, env: Any, policy: Callable[[Any], Any] | None, action_repeat: int | None = None) -> None:
        self.env, self.policy, self._action_repeat = env, policy, action_repeat
        self.dt = env.config.ctrl_dt
        self._room = round(HISTORY / self.dt)
        self.reset()
        if policy is not None:  # one of another task fails here, not in the viewer's thread
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
                policy(self._td.clone())

    @property
    def action_repeat(self) -> int:
        """Control steps for which an action is held."""
        of_policy = getattr(self.policy, "info", {}).get("action_repeat", 1)
        return of_policy if self._action_repeat is None else self._action_repeat

    @torch.no_grad()
    def reset(self) -> None:
        """Begins a new episode in every world, and forgets the curves."""
        self._td = self.env.reset()
        self._action: torch.Tensor | None = None
        self.steps = 0
        self._returns = np.zeros(self.env.num_envs)
        self._ended = np.zeros(self.env.num_envs, dtype=bool)
        self._curves = np.zeros((self._room, self.env.num_envs, 1 + len(self.term_names)))

    @torch.no_grad()
    def step(self) -> None:
        """Takes a control step in every world."""
        if self.policy is None:
            raise ValueError("there is no policy to step the worlds with")
        if self._action is None or self.steps % self.action_repeat == 0:
            with set_exploration_type(ExplorationType.DETERMINISTIC):
                self._td = self.policy(self._td)
            self._action = self._td["action"]
        self._td["action"] = self._action
        stepped, self._td = self.env.step_and_maybe_reset(self._td)
        self._remember(stepped["next"])
        self.steps += 1

    def _remember(self, after: Any) -> None:
        n = self.env.num_envs
        reward = after["reward"].reshape(n).cpu().numpy()
        self._returns = np.where(self._ended, 0.0, self._returns) + reward
        self._ended = after["done"].reshape(n).cpu().numpy()
        row = self._curves[self.steps % self._room]
        row[:, 0] = self._returns
        for column, name in enumerate(self.term_names, 1):
            row[:, column] = after["reward_terms", name].reshape(n).cpu().numpy()

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the reward's terms, of which there are curves; none if the environment does not return them."""
        return tuple(self.env.term_names) if self.env.reward_terms else ()

    def curves(self, world: int, points: int = 250) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the last 20 s of a world, thinned to about so many points.

        Returns:
            Times since the start (s), ``(n,)``; the return of the episode so far, of this world and on average over
            all, ``(n, 2)``; the terms of the reward, ``(n, terms)``.
        """
        first = max(0, self.steps - self._room)
        stride = -(-max(1, self.steps - first) // points)
        steps = np.arange(first + -first % stride, self.steps, stride)
        rows = self._curves[steps % self._room]
        returns = np.stack([rows[:, world, 0], rows[:, :, 0].mean(axis=1)], axis=1)
        return (steps + 1) * self.dt, returns, rows[:, world, 1:]

    def command(self, entry: str, world: int) -> list[float]:
        """Returns the numbers of a command of a world, now."""
        return self.env.world.memory[entry][world].reshape(-1).tolist()
