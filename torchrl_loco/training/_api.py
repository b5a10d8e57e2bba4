"""What ``torchrl_loco.training`` offers under its own name, imported together."""

from torchrl_loco.training.config import PPOConfig as PPOConfig
from torchrl_loco.training.config import REPPOConfig as REPPOConfig
from torchrl_loco.training.config import TrainingConfig as TrainingConfig
from torchrl_loco.training.evaluation import describe as describe
from torchrl_loco.training.evaluation import has_display as has_display
from torchrl_loco.training.evaluation import record as record
from torchrl_loco.training.evaluation import view as view
from torchrl_loco.training.plots import plot_runs as plot_runs
from torchrl_loco.training.presets import preset as preset
from torchrl_loco.training.presets import untuned as untuned
from torchrl_loco.training.run_folder import RunFolder as RunFolder
from torchrl_loco.training.trainer import Trainer as Trainer
from torchrl_loco.training.trainer import evaluate_run as evaluate_run
