"""Ground to climb: patches by kind and difficulty, on a grid, as a height field and boxes of an MJCF.

A kind is a function of a difficulty from 0 to 1 and a generator that returns a :class:`Patch`; one of your own takes
five lines. The figures of those here are their keyword arguments, for ``functools.partial`` to change.

    >>> import torchrl_loco as loco
    >>> from torchrl_loco import terrain
    >>> ground = terrain.Terrain({"stairs": terrain.stairs, "slope": terrain.slope}, rows=3, columns=4)
    >>> spec = ground.under(loco.Go1Velocity.model)  # a task's model; robots begin at ground.origins
    >>> len(spec.hfields), ground.origins.shape
    (1, (3, 4, 3))
"""

from torchrl_loco.terrain.grid import Terrain as Terrain
from torchrl_loco.terrain.kinds import Kind as Kind
from torchrl_loco.terrain.kinds import Patch as Patch
from torchrl_loco.terrain.kinds import flat as flat
from torchrl_loco.terrain.kinds import gap as gap
from torchrl_loco.terrain.kinds import obstacles as obstacles
from torchrl_loco.terrain.kinds import pit as pit
from torchrl_loco.terrain.kinds import rough as rough
from torchrl_loco.terrain.kinds import slope as slope
from torchrl_loco.terrain.kinds import stairs as stairs
from torchrl_loco.terrain.kinds import stepping_stones as stepping_stones
from torchrl_loco.terrain.kinds import wave as wave
