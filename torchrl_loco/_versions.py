"""Which versions of the libraries underneath this one was tested with."""

import warnings
from importlib import metadata

TESTED = {"mujoco-warp": "4.0", "torchrl": "0.14"}
"""Series (leading part of the version) of each library that the tests ran with."""


def warn_if_untested() -> None:
    """Warns of every library in :data:`TESTED` whose installed version is of another series."""
    for name, series in TESTED.items():
        installed = metadata.version(name)
        if not f"{installed}.".startswith(f"{series}."):
            warnings.warn(
                f"torchrl_loco was tested with {name} {series}, not with the installed {installed}; "
                f"if anything looks wrong, try: pip install '{name}=={series}.*'",
                stacklevel=3,
            )
