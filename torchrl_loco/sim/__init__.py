"""The physics: worlds on a device and the graphs that advance them. Knows no task."""

from torchrl_loco.sim.graph import Graph as Graph
from torchrl_loco.sim.simulation import Simulation as Simulation
