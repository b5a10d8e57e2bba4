"""The compiled step: a whole control step of one model as one kernel, without a table of constraints.

Small bodies are traced: the physics is written on symbolic scalars and run once for a model, so that its constants
fold, zeros vanish, and common terms are computed once. Larger ones are stepped by a group of lanes, in loops over
tables. What comes out is C++ for the CPU and for CUDA; ``source(model, substeps)`` shows it.

``ir`` has symbols and C++, ``physics`` the laws, ``collision`` which geoms touch, ``schedules`` what threads do.
"""

from torchrl_loco.sim.compiled.engine import CompiledEngine as CompiledEngine
from torchrl_loco.sim.compiled.engine import ground_bytes as ground_bytes
from torchrl_loco.sim.compiled.schedules import lanes as lanes
from torchrl_loco.sim.compiled.step import source as source
from torchrl_loco.sim.compiled.support import unsupported as unsupported
