"""One world stepped by a group of lanes: the text of a compiled control step for bodies of more than a few joints.

:func:`source` puts what a model has (``members``: sizes, constants and tables) into the algorithm of the headers beside
this file, as functions of a struct ``Model``: a parameter that is the same everywhere is a constant there, any other a
table. Those that differ from world to world are functions of struct ``Varied``, which read the row of the world: its
numbers, and what follows from them, which is computed when the state is evaluated without stepping, or where a lane
needs it.
"""

import pathlib

import mujoco
import numpy as np

from torchrl_loco.sim.compiled.collision.kinds import FUNCTIONS
from torchrl_loco.sim.compiled.ir.parameters import VariedModel
from torchrl_loco.sim.compiled.physics import spatial
from torchrl_loco.sim.compiled.physics.constraints import Softness
from torchrl_loco.sim.compiled.schedules.lanes.description import Description as Description
from torchrl_loco.sim.compiled.schedules.lanes.description import is_implicitfast as is_implicitfast
from torchrl_loco.sim.compiled.schedules.lanes.members import members
from torchrl_loco.sim.compiled.schedules.shared import LAWS, LINE_SEARCH, NEWTON, NO_MORE, Asked

MEMBERS = (
    *("group", "kinematics", "welds", "dynamics"),
    *("contacts", "planes", "segments", "solids", "boxes", "box_pairs", "fields", "many_boxes", "collide"),
    *("rows", "sides", "eliminate", "limbs", "solve", "outputs", "site_sensors"),
)
"""The headers that are members of struct ``Step``: what the lanes of a world keep and do."""


TEMPLATE = pathlib.Path(__file__).with_name("step.h")  # a step of a world, by struct Step


def _read(*names: str) -> str:
    return "\n".join(TEMPLATE.with_name(f"{name}.h").read_text() for name in names)


HEADERS = "\n".join([_read("world", "friction"), "struct Step : Math {", _read(*MEMBERS), "};", TEMPLATE.read_text()])


def source(m: mujoco.MjModel, substeps: int, asked: Asked = NO_MORE) -> str:
    """Returns the C++ of a control step of one world, by the arguments of :func:`.step.source`."""
    d = Description(m)
    tables = members(d, substeps, asked)
    parts = {
        "ELLIPTIC": d.elliptic,
        "LIMBS": d.limbs is not None,
        "SOLIDS": d.has_solids or d.ground.boxes is not None,
        "GROUND": d.layout.near_ground > 0,
        **{function.upper(): function in d.functions for function in FUNCTIONS},
    }
    defined = [f"#define WITH_{part} {needed:d}" for part, needed in parts.items()]
    text = "\n".join([*defined, HEADERS, *(f"#undef WITH_{part}" for part in parts), ""])
    text = tables.use(text.replace("//ACTUATOR", d.actuator().as_cpp()))
    for mark, value in {
        "SHARED": LAWS,
        "SOFTNESS": Softness.as_cpp(),
        "SPATIAL": spatial.as_cpp(),
        "LINE_SEARCH": LINE_SEARCH,
        "NEWTON": NEWTON,
        "MODEL": tables.text(),
        "COLLIDE": d.collide(),
        "ELIMINATE": d.elimination(),
        "VARYING": tables.varied_text(),
        "DERIVE": "" if substeps else tables.row.derive(),
    }.items():
        text = text.replace(f"//{mark}\n", f"{value}\n")
    return text


def nominal_row(m: VariedModel) -> np.ndarray:
    """Returns what the lanes read of the model itself: its numbers, then what follows from them."""
    return members(Description(m), 0, NO_MORE).row.nominal(m.varied)
