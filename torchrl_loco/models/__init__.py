"""The bodies as MJCF files of our own writing; their figures are dm_control's (see NOTICE)."""

from pathlib import Path

import mujoco

_FOLDER = Path(__file__).parent
PATHS = {name: _FOLDER / f"{name}.xml" for name in ("walker", "humanoid")}
SCENE = _FOLDER / "scene.xml"
"""What all bodies can include by its name: light, materials, the look of the floor."""


def load(name: str) -> mujoco.MjModel:
    """Returns one of the bodies, compiled with dm_control's solver settings.

    Raises:
        ValueError: ``name`` is none of :data:`PATHS`.
    """
    if name not in PATHS:
        raise ValueError(f"unknown model {name!r}: choose one of {', '.join(PATHS)}")
    return from_path(PATHS[name])


def from_path(path: Path) -> mujoco.MjModel:
    """Returns the model of an MJCF file. What it includes as ``scene.xml`` is ours, unless one lies beside it.

    Raises:
        ValueError: there is no such file, or it is no valid MJCF.
    """
    own = path.with_name(SCENE.name).exists()
    return mujoco.MjModel.from_xml_path(str(path), {} if own else {SCENE.name: SCENE.read_bytes()})
