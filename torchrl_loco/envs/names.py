"""Elements of a model by their names."""

import re
from collections.abc import Sequence

import mujoco

from torchrl_loco.checks import UnknownNameError, suggestion

Names = str | Sequence[str]  # a name, several names, or a regular expression that matches whole names

KINDS = {
    **{"body": "nbody", "joint": "njnt", "geom": "ngeom", "site": "nsite", "sensor": "nsensor", "actuator": "nu"},
    **{"pair": "npair", "camera": "ncam"},
}
"""What has names in a model, and how many there are."""


class Elements:
    """The elements of a model by name."""

    def __init__(self, mj_model: mujoco.MjModel) -> None:
        self.mj_model = mj_model
        self._names: dict[str, list[str]] = {}
        self._found: dict[tuple[str, str | tuple[str, ...]], tuple[list[int], bool]] = {}

    def names(self, kind: str) -> list[str]:
        """Returns the names of all elements of a kind, by their ids."""
        if kind not in self._names:
            element = getattr(self.mj_model, kind)
            self._names[kind] = [element(i).name for i in range(getattr(self.mj_model, KINDS[kind]))]
        return self._names[kind]

    def ids(self, kind: str, names: Names) -> tuple[list[int], bool]:
        """Returns the ids of elements, and whether one was named, so that results need no dimension for several."""
        several = [names] if isinstance(names, str) else names
        key = kind, names if isinstance(names, str) else tuple(names)
        if not (key[1] and all(several)):
            raise UnknownNameError(f"name a {kind}, several, or a regular expression, got {names!r}")
        if key not in self._found:
            known = self.names(kind)
            if isinstance(names, str) and names in known:
                self._found[key] = [known.index(names)], True
            else:
                self._found[key] = [i for name in several for i in self._matches(kind, name)], False
        return self._found[key]

    def _matches(self, kind: str, pattern: str) -> list[int]:
        known = self.names(kind)
        try:
            found = matching(known, pattern)
        except re.error as error:
            why = f"{pattern!r} is neither the name of a {kind} nor a regular expression: {error}"
            raise UnknownNameError(why) from None
        if not found:
            hint = suggestion(pattern, known)
            names = ", ".join(filter(None, known)) or "none"
            raise UnknownNameError(f"the model has no {kind} {pattern!r}{hint}: it has {names}")
        return found


def matching(names: Sequence[str], pattern: str) -> list[int]:
    """Returns where a name is, or if there is none, those that a regular expression matches as a whole."""
    if pattern in names:
        return [names.index(pattern)]
    return [i for i, name in enumerate(names) if name and re.fullmatch(pattern, name)]
