"""The compiled step: a whole control step of one model as one kernel, without a table of constraints.

Small bodies are traced: the physics is written on symbolic scalars and run once for a model, so that its constants
fold, zeros vanish, and common terms are computed once. Larger ones are stepped by a group of lanes, in loops over
tables. What comes out is C++ for the CPU and for CUDA; ``source(model, substeps)`` shows it.

===================  =====================================================================
``engine``           all worlds at once
``step``             the choice of a schedule, and the size of a launch
``support``          which models are supported
``read_only``        the model that environments see
``ir``               ``symbols``: scalars whose arithmetic is traced, and blocks of C++;
                     ``parameters``: numbers of the model that differ from world to world;
                     ``tables``: constants and tables as C++
``physics``          ``spatial``, ``links``, ``dynamics``, ``lengths``, ``actuators``,
                     ``constraints``, ``equalities``, ``pyramid``, ``sensors``, ``delicate``;
                     ``arithmetic.h``, ``laws.h``
``collision``        ``kinds``: how the shapes of two geoms touch; ``pairs``: which geoms may,
                     and with which parameters; ``planes``, ``meshes``
``schedules``        ``traced``, with ``solver``, ``ground_contacts``, ``dense_contacts``: one
                     thread a world, a control step from top to bottom;
                     ``lanes``: a group of lanes a world, by its headers;
                     ``newton.h``, ``line_search.h``, ``shared``: what both run
===================  =====================================================================
"""

from torchrl_loco.sim.compiled.engine import CompiledEngine as CompiledEngine
from torchrl_loco.sim.compiled.schedules import lanes as lanes
from torchrl_loco.sim.compiled.step import source as source
from torchrl_loco.sim.compiled.support import unsupported as unsupported
