"""The compiled step: a whole control step of one model as one kernel, without a table of constraints.

Small bodies are traced: the physics is written on symbolic scalars and run once for a model, so that its constants
fold, zeros vanish, and common terms are computed once. Larger ones are stepped by a group of lanes, in loops over
tables. What comes out is C++ for the CPU and for CUDA; ``source(model, substeps)`` shows it.

===================  =====================================================================
``engine``           all worlds at once
``step``             the choice of a schedule, and the size of a launch
``support``          which models are supported
``collision``        which geoms may touch, and with which parameters
``traced``           one thread a world: a control step from top to bottom
``symbols``          scalars whose arithmetic is traced, and blocks of C++
``spatial``          spatial algebra, of both schedules
``dynamics``         poses, inertias, forces; M x and (M + K)^-1 x by sweeps over the tree
``actuators``        force of an actuator
``constraints``      softness of constraints; rows of limits and dry friction
``pyramid``          rows of a contact
``ground_contacts``  contacts with planes of the world: a stiffness of a body each
``dense_contacts``   all other contacts, and limits of ball joints
``solver``           what Newton's loop, ``newton.h``, calls in traced code
``sensors``          velocities and momenta of subtrees, touch, and contact forces of geoms
``lanes``            a group of lanes a world: what ``lanes.h`` has to know about a model
``shared``           the C++ of both: arithmetic, laws, Newton's loop, line search
``links``            bodies that are welded together
``parameters``       numbers of the model that differ from world to world
``tables``           constants and tables as C++
``read_only``        the model that environments see
===================  =====================================================================
"""

from torchrl_loco.sim.compiled.engine import CompiledEngine as CompiledEngine
from torchrl_loco.sim.compiled.engine import data_bytes as data_bytes
from torchrl_loco.sim.compiled.step import source as source
from torchrl_loco.sim.compiled.support import unsupported as unsupported
