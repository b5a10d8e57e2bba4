"""The bodies as MJCF files of our own writing; their figures are dm_control's (see NOTICE)."""

from pathlib import Path

import mujoco

_FOLDER = Path(__file__).parent
NAMES = ("walker", "humanoid")


def load(name: str) -> mujoco.MjModel:
    """Compiles one of the bodies, with dm_control's solver settings.

    Raises:
        ValueError: ``name`` is none of :data:`NAMES`.
    """
    if name not in NAMES:
        raise ValueError(f"unknown model {name!r}: choose one of {', '.join(NAMES)}")
    return mujoco.MjModel.from_xml_path(str(_FOLDER / f"{name}.xml"))
