"""What a user hands to a training run as objects, which its folder cannot hold."""

import dataclasses
import os
from pathlib import Path

from torchrl.envs import EnvBase

from torchrl_loco.training.actor import Network
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.run_folder import RunFolder


@dataclasses.dataclass(frozen=True)
class Given:
    """What is handed to a trainer as objects, instead of being made from the settings of the run.

    Attributes:
        env: the environment in which it trains.
        network: makes the networks.
        algorithm: the class of the algorithm.
    """

    env: EnvBase | None = None
    network: Network | None = None
    algorithm: type[Algorithm] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what is handed in."""
        return tuple(name for name in ("env", "network", "algorithm") if getattr(self, name) is not None)

    def check(self, run: RunFolder) -> None:
        """Checks that a run that is continued is handed what it was begun with.

        Raises:
            ValueError: it is not.
        """
        if self.names == run.given:
            return
        if extra := [name for name in self.names if name not in run.given]:
            raise ValueError(f"{run.path} was begun without {' and '.join(extra)} of yours: leave that out")
        raise ValueError(
            f"{run.path} was begun with {' and '.join(run.given)} of your own, which the folder does not hold: "
            f"continue it in Python with {_call_to_resume(run.path, run.given)}"
        )

    def way_to_resume(self, run: Path, ranks: int) -> str:
        """Returns the call, or the command with the same number of ranks, that continues a run."""
        if self.names:
            return _call_to_resume(run, self.names)
        if ranks > 1 and os.environ.get("LOCAL_WORLD_SIZE") != str(ranks):
            return f"torchrun, with the options of this launch, -m torchrl_loco resume {run}"
        return f"torchrl-loco resume {run}" + (f" --gpus {ranks}" if ranks > 1 else "")


def _call_to_resume(run: Path, given: tuple[str, ...]) -> str:
    arguments = ["env" if "env" in given else "task", *(f"{name}=..." for name in given if name != "env")]
    return f"torchrl_loco.training.train({', '.join(arguments)}, resume={str(run)!r})"
