"""PPO as parts that read on their own: presets, networks, collection, update, evaluation, run folder, and the loop."""

from torchrl_loco.training.ppo import evaluate_run as evaluate_run
from torchrl_loco.training.ppo import report as report
from torchrl_loco.training.ppo import train as train
from torchrl_loco.training.presets import PPOConfig as PPOConfig
from torchrl_loco.training.presets import preset as preset
from torchrl_loco.training.run_folder import RunFolder as RunFolder
