"""What an environment's ``randomize`` means for its model: which numbers vary, their draws, and whether they can be."""

import difflib
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import torch

from torchrl_loco.envs import draws
from torchrl_loco.envs.names import Elements
from torchrl_loco.envs.vary import FIELDS, Vary
from torchrl_loco.sim.corners import corners_of
from torchrl_loco.sim.varied import Varied, why_not
from torchrl_loco.sim.varied import field as array_of

VALID = {
    "positive": "must be positive",
    "not negative": "must not be negative",
    "rising": "must have its lower limit below the upper one",
    "inertia": "must be positive, and none greater than the sum of the other two",
}
"""What must be true of a field's numbers, for messages."""

MOST_BITS = 12  # draws on which the numbers of an element may depend: all combinations are checked


class Change:
    """What a :class:`Vary` does to the numbers of a model. Its random stream depends on ``label``."""

    def __init__(self, vary: Vary, elements: Elements, label: str) -> None:
        m, groups = elements.mj_model, vary.groups
        ids, corners = _ids(vary, elements), corners_of(m) if FIELDS[vary.field].of == "geom" else {}
        of_solids = {corner for solid in corners.keys() & set(ids) for corner in corners[solid]}
        per_element = [_places(vary.field, m, i, corners.get(i, ())) for i in ids if i not in of_solids]
        self.vary, self.label = vary, label
        # Of each draw, the group of numbers of an element that it is for.
        self.group_of = list(range(len(groups))) * (1 if vary.shared else len(per_element))
        found = [
            ((name, index), group if vary.shared else rank * len(groups) + group, sign)
            for rank, numbers in enumerate(per_element)
            for group, components in enumerate(groups)
            for component in components
            for name, index, sign in numbers[component]
            if vary.how != "scale" or array_of(m, name).flat[index] != 0
        ]
        if not found:
            raise ValueError(f"{vary}: {vary.field} is 0 in the model, so nothing is scaled: use how='add' or 'set'")
        # Numbers that it changes, as fields and indices of their flattened arrays; of each of them the index of its
        # draw, and what an offset or number is multiplied by: -1 for the bias of kp and kv.
        self.places, self.which, self.signs = map(list, zip(*found, strict=True))


def _ids(vary: Vary, elements: Elements) -> list[int]:
    """Returns the ids of the elements that a Vary names; of a field of the model, ``[0]``."""
    m, kind = elements.mj_model, FIELDS[vary.field].of
    if not kind:
        return [0]
    known = elements.names(kind)
    try:
        found = range(len(known)) if vary.of is None else sorted(set(elements.ids(kind, vary.of)[0]))
    except KeyError as error:
        raise ValueError(f"{vary}: {error.args[0]}") from None
    if vary.of is None and kind == "joint":
        found = [i for i in found if m.jnt_type[i] != mujoco.mjtJoint.mjJNT_FREE]
    able = [i for i in found if _why_not(vary.field, m, i) is None]
    unable = [i for i in found if i not in able]
    if unable and (vary.of is not None or not able):
        names = ", ".join(known[i] or f"{kind} {i}" for i in unable)
        others = ", ".join(known[i] for i in range(len(known)) if known[i] and not _why_not(vary.field, m, i))
        why = _why_not(vary.field, m, unable[0])
        raise ValueError(f"{vary}: {why}: {names}; those that can vary are {others or 'none'}")
    if not able:
        raise ValueError(f"{vary}: the model has no {kind}")
    return able


def _why_not(name: str, m: mujoco.MjModel, i: int) -> str | None:
    """Returns why an element cannot have a field that varies, if it cannot."""
    if FIELDS[name].of == "body" and i == 0:
        return "the world has neither mass nor inertia"
    if name in ("kp", "kv") and name not in _gains(m, i):
        return f"{name} is of {'position' if name == 'kp' else 'position and velocity'} actuators"
    return why_not(m, name, i)


def _gains(m: mujoco.MjModel, i: int) -> tuple[str, ...]:
    """Returns which gains an actuator has: a position actuator both, a velocity actuator ``kv``, any other none."""
    fixed, affine = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    gain, bias = m.actuator_gainprm[i, 0], m.actuator_biasprm[i]
    if m.actuator_gaintype[i] != fixed or m.actuator_biastype[i] != affine or gain == 0:
        return ()
    if bias[1] == -gain:
        return "kp", "kv"
    return ("kv",) if bias[1] == 0 and bias[2] == -gain else ()


def _places(name: str, m: mujoco.MjModel, i: int, alike: Sequence[int] = ()) -> list[list[tuple[str, int, float]]]:
    """Returns where each number of an element, and of those alike, is: fields, indices of flattened arrays, signs."""
    if name in ("kp", "kv"):
        gain, bias = ("actuator_gainprm", 10 * i, 1.0), ("actuator_biasprm", 10 * i + 1 + (name == "kv"), -1.0)
        return [[gain, bias] if _gains(m, i)[0] == name else [bias]]  # which the gain of the actuator is
    if name.startswith("dof_"):
        return [[(name, int(dof), 1.0) for dof in np.flatnonzero(m.dof_jntid == i)]]
    size = FIELDS[name].size
    return [[(name, size * each + component, 1.0) for each in (i, *alike)] for component in range(size)]


class Variation:
    """The numbers of a model that differ from world to world, one Vary after another, and their draws.

    ``varied`` says which they are, and where they are in the row of a world.
    """

    def __init__(self, varys: Sequence[Vary], mj_model: mujoco.MjModel, device: torch.device) -> None:
        self._device, self._elements = device, Elements(mj_model)
        labels = [f"{vary.field} of {vary.of}, {vary.component}" for vary in varys]
        self._changes = [
            Change(vary, self._elements, f"{label}, {labels[:i].count(label)}")
            for i, (vary, label) in enumerate(zip(varys, labels, strict=True))
        ]
        places: dict[str, set[int]] = {}
        for change in self._changes:
            for name, index in change.places:
                places.setdefault(name, set()).add(index)
        self._mj_model = mj_model
        self.varied = Varied(mj_model, {name: sorted(indices) for name, indices in places.items()})
        self._columns = {
            (name, int(index)): self.varied.columns[name].start + i
            for name, indices in self.varied.places.items()
            for i, index in enumerate(indices)
        }
        self._indices: list[torch.Tensor] = []
        self._plan(device)
        self._check()
        self._shown: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}

    # Their draws.

    def _plan(self, device: torch.device) -> None:
        """Makes the tensors that :meth:`_numbers` works with.

        They have a first dimension of 1: a row for each world would be taken for the worlds' when it is fused.
        """
        self._nominal = torch.tensor(self.varied.nominal()[None], dtype=torch.float32, device=device)
        self._steps: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]] = []
        latest = list(range(self.varied.count))  # where each number is among those that were made so far
        made = self.varied.count
        for change in self._changes:
            columns = [self._columns[place] for place in change.places]
            bounds = [change.vary.bounds[group] for group in change.group_of]
            ends = torch.tensor(bounds, dtype=torch.float64, device=device).T
            low, high = (ends.log() if change.vary.log else ends)[:, None]
            signs = torch.tensor([change.signs], dtype=torch.float32, device=device)
            sources = self._index([latest[column] for column in columns])
            self._steps.append((sources, self._index(change.which), low.float(), (high - low).float(), signs))
            for i, column in enumerate(columns):
                latest[column] = made + i
            made += len(columns)
        self._last = self._index(latest)
        self._draws_at = [draws.places(0, len(change.group_of), device)[None] for change in self._changes]

    def _index(self, values: Sequence[int]) -> torch.Tensor:
        self._indices.append(torch.tensor([list(values)], device=self._device))
        return self._indices[-1]

    def fixed(self) -> list[torch.Tensor]:
        """Returns the tensors of indices, which never change."""
        return list(self._indices)

    def _numbers(self, units: Sequence[torch.Tensor]) -> torch.Tensor:
        """Returns the numbers of worlds ``(n, count)`` from draws in [0, 1), of each Vary ``(n, its draws)``."""
        made = self._nominal.expand(units[0].shape[0], -1)
        for change, unit, (sources, which, low, width, signs) in zip(self._changes, units, self._steps, strict=True):
            drawn = low + width * unit
            drawn = (drawn.exp() if change.vary.log else drawn).index_select(1, which[0])
            before = made.index_select(1, sources[0])
            how = change.vary.how
            after = before * drawn if how == "scale" else before + drawn * signs if how == "add" else drawn * signs
            made = torch.cat([made, after], dim=1)
        return made.index_select(1, self._last[0])

    def vary(self, a: Mapping[str, torch.Tensor]) -> None:
        """At a reset, in the masked worlds, whose next episode is counted: draws ``numbers``."""
        units = []
        for change, at in zip(self._changes, self._draws_at, strict=True):
            zero = torch.zeros_like(a["episode"])
            episode = zero if change.vary.once else a["episode"]
            stream = draws.stream(a["seed"], a["world"], episode, zero, f"vary {change.label}")
            units.append(draws.to_unit(draws.mix(stream + at)))
        a["numbers"].copy_(torch.where(a["mask"].unsqueeze(1), self._numbers(units), a["numbers"]))

    # What they may become.

    def _check(self) -> None:
        """Checks the numbers at all combinations of least and greatest draws, between which they lie."""
        bits: list[list[int]] = []  # of each draw, which bit of a combination it takes
        for i, change in enumerate(self._changes):
            touched = self._touched(change)
            before = [b for b, other in zip(bits, self._changes[:i], strict=True) if touched & self._touched(other)]
            first = max((max(b) + 1 for b in before), default=0)
            bits.append([first + group for group in change.group_of])
        count = max(max(b) for b in bits) + 1
        if count > MOST_BITS:
            raise ValueError(f"randomize names the same elements too often: {count} draws for one, {MOST_BITS} at most")
        combinations = np.arange(2**count)[:, None] >> np.arange(count) & 1
        corners = torch.tensor(combinations, dtype=torch.float32, device=self._device)
        numbers = self._numbers([corners[:, b] for b in bits]).cpu().double().numpy()
        for change in self._changes:
            if wrong := self._impossible(change, numbers):
                what, values, rule = wrong
                raise ValueError(f"{change.vary}: {what} could become {values}, but it {rule}: change low or high")

    def _touched(self, change: Change) -> set[tuple[str, int]]:
        """Returns the elements that a change is about; gain and bias of an actuator belong together."""
        return {(name.replace("biasprm", "gainprm"), index // FIELDS[name].size) for name, index in change.places}

    def check(self, given: Mapping[str, torch.Tensor]) -> None:
        """Raises ValueError for numbers of worlds by field, ``(n, columns of the field)``, that are impossible."""
        n = max((len(rows) for rows in given.values()), default=0)
        numbers = np.repeat(self.varied.nominal()[None], n, axis=0)
        for name, rows in given.items():
            numbers[:, self.varied.columns[name]] = rows.cpu().numpy()
        for change in self._changes:
            if n and (wrong := self._impossible(change, numbers)):
                what, values, rule = wrong
                raise ValueError(f"the state's {what} is {values}, but it {rule}")

    def _impossible(self, change: Change, numbers: np.ndarray) -> tuple[str, str, str] | None:
        """Returns what is impossible among the numbers ``(rows, count)`` of what a Vary changes, if anything is.

        It is the element's field, its first impossible numbers, and what must be true of them.
        """
        field = FIELDS[change.vary.field]
        if field.valid == "finite":
            return None
        together = field.valid in ("rising", "inertia")  # the numbers of an element; of others each for itself
        size = field.size if together else 1
        groups = {(name, index // size): sign for (name, index), sign in zip(change.places, change.signs, strict=True)}
        for (name, group), sign in groups.items():
            indices = range(size * group, size * (group + 1))
            rows = sign * np.stack([self._column(numbers, name, index) for index in indices], axis=1)
            had = sign * array_of(self._mj_model, name).flat[indices] > 0
            wrong = rows < 0 if field.valid == "not negative" else (rows < 0) | (rows == 0) & had
            wrong = rows[:, 0] >= rows[:, 1] if field.valid == "rising" else wrong.any(1)
            if field.valid == "inertia":
                wrong |= 2 * rows.max(1) > rows.sum(1) * (1 + 1e-6)
            if wrong.any():
                element = indices[0] // FIELDS[name].size
                element = int(self._mj_model.dof_jntid[element]) if name.startswith("dof_") else element
                of = self._elements.names(field.of)[element] or f"{field.of} {element}"
                values = ", ".join(f"{number:.3g}" for number in rows[wrong][0])
                return f"{change.vary.field} of {of}", values, VALID[field.valid]
        return None

    def _column(self, numbers: np.ndarray, name: str, index: int) -> np.ndarray:
        """Returns a number of the model in all rows."""
        if (name, index) in self._columns:
            return numbers[:, self._columns[name, index]]
        return np.full(len(numbers), array_of(self._mj_model, name).flat[index])

    # What is shown of them.

    def field(self, name: str, numbers: torch.Tensor) -> torch.Tensor:
        """Returns a field that varies in all worlds, ``(n, *shape)``, from their numbers ``(n, count)``."""
        nominal = array_of(self._mj_model, name)
        if name not in self._shown:
            where = [self._columns.get((name, i), self.varied.count + i) for i in range(nominal.size)]
            constants = torch.tensor(np.ravel(nominal)[None], dtype=torch.float32, device=self._device)
            self._shown[name] = self._index(where), constants
        columns, constants = self._shown[name]
        everything = torch.cat([numbers, constants.expand(len(numbers), -1)], dim=1)
        return everything.index_select(1, columns[0]).view(len(numbers), *nominal.shape)


def constant_of(mj_model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns a field of a model, or the gravity of its options."""
    values = mj_model.opt.gravity if name == "gravity" else getattr(mj_model, name, None)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "biuf":
        arrays = [key for key in dir(mj_model) if isinstance(getattr(mj_model, key, None), np.ndarray)]
        near = difflib.get_close_matches(name, [*arrays, "gravity"], n=3)
        hint = f": did you mean {' or '.join(near)}?" if near else ""
        hint = ", gains are in actuator_gainprm and actuator_biasprm" if name in ("kp", "kv") else hint
        raise AttributeError(f"MjModel has no array {name!r}{hint}")
    return values
