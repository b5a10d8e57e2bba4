"""Several beginnings of a run, of which the best goes on: often chance decides early what a policy becomes."""

import math
from collections.abc import Callable
from typing import Any

from tqdm.auto import tqdm

from torchrl_loco.training import distributed
from torchrl_loco.training.config import TrainingConfig


class Trials:
    """Policies that are trained for the same number of frames, one after the other; the best is then trained on.

    With one trial nothing is compared. All ranks make the same calls. A trial has whole batches.

    Args:
        config: settings of the run.
        frames_per_iteration: frames of a batch, over all ranks.
        begin_anew: begins a further trial as the run began.
        kept: returns a copy of what a trial has come to.
        restore: goes back to what ``kept`` returned.
    """

    def __init__(
        self,
        config: TrainingConfig,
        frames_per_iteration: int,
        begin_anew: Callable[[], None],
        kept: Callable[[], dict[str, Any]],
        restore: Callable[[dict[str, Any]], None],
    ) -> None:
        self._begin_anew, self._kept, self._restore = begin_anew, kept, restore
        self._count, self._total = config.trials, config.total_frames
        self._length = config.trial_frames // frames_per_iteration * frames_per_iteration
        self._ended = 0
        self._began = 0  # frames of the run at which the policy in training had none
        self._best: dict[str, Any] | None = None
        self._mean = -math.inf

    @property
    def running(self) -> bool:
        """Whether the policy in training is one of several that will be compared."""
        return self._count > 1 and self._ended < self._count

    @property
    def label(self) -> str:
        """The trial that is running, such as ``"1 of 3"``."""
        return f"{self._ended + 1} of {self._count}"

    def own_frames(self, frames: int) -> int:
        """Returns the frames that the policy in training has had after ``frames`` frames of the run."""
        return frames - self._began

    def progress(self, frames: int) -> float:
        """Returns the fraction of the policy's training that is done, in [0, 1], after ``frames`` frames of the run."""
        dropped = (self._count - 1) * self._length if self.running else self._began
        return min(1.0, self.own_frames(frames) / max(1, self._total - dropped))

    def is_over(self, frames: int) -> bool:
        """Returns whether a trial is running that is complete after ``frames`` frames of the run."""
        return self.running and self.own_frames(frames) >= self._length

    def end(self, frames: int, mean: float) -> None:
        """Ends a trial whose evaluation had this mean: the next begins, or after the last the best one goes on."""
        if distributed.is_first():
            tqdm.write(f"trial {self.label}: {mean:.1f} after {self.own_frames(frames):,} frames")
        is_best = mean > self._mean
        self._ended += 1
        if self.running:
            if is_best:
                self._mean, self._best = mean, self._kept()
            self._begin_anew()
            self._began = frames
            return
        if not is_best:
            assert self._best is not None
            self._restore(self._best)
        self._best = None

    def state_dict(self) -> dict[str, Any]:
        """Returns all that an exact continuation needs."""
        when = {"ended": self._ended, "began": self._began, "length": self._length}
        return {**when, "mean": self._mean, "best": self._best}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from a ``state`` that :meth:`state_dict` returned; a trial keeps the length with which it began."""
        self._ended, self._began, self._length = state["ended"], state["began"], state["length"]
        self._mean, self._best = state["mean"], state["best"]
