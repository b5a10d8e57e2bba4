"""Training as parts that read on their own: settings, networks, algorithms, evaluation, run folder, and the loop."""

from typing import TYPE_CHECKING

from torchrl_loco._lazy import lazy

if TYPE_CHECKING:
    from torchrl_loco.training._api import *

__all__ = [
    "PPOConfig",
    "REPPOConfig",
    "RunFolder",
    "Trainer",
    "TrainingConfig",
    "describe",
    "evaluate_run",
    "has_display",
    "plot_runs",
    "preset",
    "record",
    "untuned",
    "view",
]

if not TYPE_CHECKING:  # to a type checker it would mean that there is every name
    __getattr__, __dir__ = lazy(__name__, __all__)
