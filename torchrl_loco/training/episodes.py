"""What episodes earn while a policy trains."""

import collections
from typing import Any

import torch

WINDOW = 100  # episodes over which a mean is taken, at least, as soon as so many have ended


class Episodes:
    """Returns and lengths of the episodes that end in training.

    The return of an episode that terminated is the sum of its rewards. One that was truncated is taken to go on as it
    went: its mean reward times the task's own length, since episodes may be shorter in training; so is one that is
    longer than the task's own. So the mean compares with an evaluation, whether episodes fall or run to the time limit.
    An episode counts if it was seen from its start, which the first of a world is not where worlds are staggered.

    Sums of the episodes that are running lie on the device (``add``); the host keeps sums of the last batches, with
    at least 100 episodes as soon as so many have ended (``take``).

    Args:
        num_envs: number of worlds.
        device: where they are.
        action_repeat: control steps in a step of the policy.
        full_length: control steps of the task's own episodes.
        from_start: whether the first batch begins with new episodes.
    """

    def __init__(
        self, num_envs: int, device: torch.device | str, action_repeat: int, full_length: int, from_start: bool
    ) -> None:
        self._action_repeat, self._full_length = action_repeat, full_length
        self._sum = torch.zeros(num_envs, 1, device=device)
        self._steps = torch.zeros(num_envs, 1, device=device)
        self._whole = torch.full((num_envs, 1), from_start, device=device)
        self._window: collections.deque[tuple[float, float, float]] = collections.deque()

    @torch.no_grad()
    def add(self, reward: torch.Tensor, done: torch.Tensor, terminated: torch.Tensor) -> torch.Tensor:
        """Adds a batch, ``(num_envs, steps)`` each, without synchronising with the device.

        Returns:
            Number of the whole episodes that ended, sum of their returns, and sum of their lengths in control steps:
            shape ``(3,)``.
        """
        position = torch.arange(1, reward.shape[1] + 1, device=reward.device)
        ends = torch.where(done, position, 0).cummax(1).values  # steps of the batch up to the last end so far
        starts = torch.nn.functional.pad(ends[:, :-1], (1, 0))  # those before the present episode
        total = torch.nn.functional.pad(reward.cumsum(1), (1, 0))
        began_before = starts == 0
        sums = total[:, 1:] - total.gather(1, starts) + self._sum * began_before
        steps = position - starts + self._steps * began_before
        counts = done & (self._whole | ~began_before)
        lengths = steps * self._action_repeat
        fell = terminated & (lengths <= self._full_length)
        returns = torch.where(fell, sums, sums * (self._full_length / lengths))
        # The episodes that the next batch goes on with.
        last, none_ended = ends[:, -1:], ends[:, -1:] == 0
        self._sum = total[:, -1:] - total.gather(1, last) + self._sum * none_ended
        self._steps = reward.shape[1] - last + self._steps * none_ended
        self._whole = self._whole | ~none_ended
        return torch.stack([(counts * of_each).sum() for of_each in (torch.ones_like(sums), returns, lengths)])

    def take(self, count: float, returns: float, lengths: float) -> None:
        """Takes what ``add`` returned for a batch, over all ranks, as numbers of the host."""
        if count == 0:
            return
        self._window.append((count, returns, lengths))
        while self.count - self._window[0][0] >= WINDOW:
            self._window.popleft()

    @property
    def count(self) -> int:
        """Number of the episodes that the means are over."""
        return round(sum(row[0] for row in self._window))

    def metrics(self, mean_reward: float, time_limit: int) -> dict[str, float]:
        """Returns the mean return and length (control steps) of the last episodes, and their number.

        Until one has ended that was seen from its start, they are what follows from the mean reward of a control step
        if no episode ends before the time limit of the training (control steps), and their number is 0.
        """
        if not (count := self.count):
            return {"return": round(mean_reward * self._full_length, 3), "episode_length": time_limit, "episodes": 0}
        mean_return, mean_length = (sum(row[k] for row in self._window) / count for k in (1, 2))
        return {"return": round(mean_return, 3), "episode_length": round(mean_length, 1), "episodes": count}

    def restart(self) -> None:
        """Forgets all episodes, also those that are running: another policy plays from here on."""
        self._window.clear()
        self._whole = torch.zeros_like(self._whole)

    def state_dict(self) -> dict[str, Any]:
        """Returns the sums of the running episodes of this rank, and of the last batches of all."""
        return {"sum": self._sum, "steps": self._steps, "whole": self._whole, "window": list(self._window)}

    def load_state_dict(self, state: dict[str, Any], running: bool) -> None:
        """Continues from a ``state`` that :meth:`state_dict` returned; ``running`` episodes, too, if worlds go on."""
        self._window = collections.deque(state["window"])
        if running:
            self._sum, self._steps, self._whole = state["sum"], state["steps"], state["whole"]
