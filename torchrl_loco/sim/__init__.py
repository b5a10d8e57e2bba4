"""The physics: worlds on a device and the graphs that advance them. Knows no task."""

import warp as wp

from torchrl_loco.sim.buffer import Buffer as Buffer
from torchrl_loco.sim.buffer import PackedBuffers as PackedBuffers
from torchrl_loco.sim.graph import EXCLUSIVE as EXCLUSIVE
from torchrl_loco.sim.graph import Graph as Graph
from torchrl_loco.sim.graph import TorchGraph as TorchGraph
from torchrl_loco.sim.graph import current_stream as current_stream
from torchrl_loco.sim.graph import joined_to_torch as joined_to_torch
from torchrl_loco.sim.graph import torch_is_recording as torch_is_recording
from torchrl_loco.sim.overflow import Overflow as Overflow
from torchrl_loco.sim.simulation import Simulation as Simulation
from torchrl_loco.sim.world_func import Around as Around
from torchrl_loco.sim.world_func import WorldFunc as WorldFunc
from torchrl_loco.sim.world_func import fill as fill
from torchrl_loco.sim.world_func import fill_from_numbers as fill_from_numbers

# At its default level Warp prints a line for each of a hundred kernels that it loads. Set another level to see them.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING
