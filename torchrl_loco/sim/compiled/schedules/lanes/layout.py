"""Sizes of the state of a world that lanes step, and the limbs of its body."""

import dataclasses
import itertools
from collections.abc import Sequence

MOST_TRUNK, MOST_LIMB = 8, 8
"""Degrees of freedom of the trunk, and of a limb, of a body whose limbs are eliminated side by side.

With 9 of the trunk (G1, the humanoid), a longer text costs more than the shorter elimination saves (measured).
"""


@dataclasses.dataclass
class Layout:
    """Sizes of the state of a world, as ``struct World`` has them; each is a constant of ``struct Model``, too.

    Attributes:
        limb_numbers: what the elimination by limbs holds for all lanes.
        directions: in which a contact with friction acts, each with a row of the Jacobian: the normal, two tangents,
            and turning about these three as far as any contact resists it.
        contact_rows: constraint rows of such a contact.
    """

    positions: int
    activations: int
    weld_rows: int
    dofs: int
    links: int
    geoms: int
    trees: int
    limits: int
    friction_losses: int
    touch: int
    candidates: int
    near_ground: int
    near_pairs: int
    directions: int
    contact_rows: int
    frictional: int
    frictionless: int
    jacobian_rows: int
    limb_numbers: int

    @property
    def stride(self) -> int:
        """Length of a row of a matrix."""
        return pad(self.dofs, 4)

    @property
    def rows(self) -> int:
        """Constraint rows: several for a contact with friction, one for anything else."""
        left = self.jacobian_rows - self.directions * self.frictional
        contacts = self.contact_rows * self.frictional + min(self.frictionless, left)
        return pad(contacts + self.limits + self.friction_losses, 4) or 4

    @property
    def bytes(self) -> int:
        """Size of ``struct World``."""
        contacts = self.frictional + self.frictionless
        vectors = (
            pad(self.positions, 4)
            + pad(self.activations, 4)
            + pad(self.weld_rows, 4)
            + 4 * self.stride
            + self.dofs * self.stride
        )
        vectors += max(8 * self.dofs, self.stride + 2 * self.rows)
        before = 32 * contacts + 12 * (self.frictional + 1)
        quads = self.stride // 4
        solving = 4 * max(16 * (quads | 1) + 8 + 12 * quads, self.limb_numbers, self.rows)
        kinematics = 32 * self.dofs + 112 * self.links + 32 * (self.geoms + 1)
        kinematics += 4 * self.near_ground + 2 * self.near_pairs + 2 * self.candidates
        total = 4 * vectors + pad(max(before, solving, 32 * self.links), 16)
        total = pad(total + 4 * self.jacobian_rows, 16)
        total += pad(max(kinematics, 4 * self.jacobian_rows * self.stride), 16)
        total += 12 * self.trees + self.limits + 1
        return pad(pad(total, 4) + 4 * (contacts if self.touch else 1), 16)


@dataclasses.dataclass(frozen=True)
class Limbs:
    """The degrees of freedom of a body whose limbs are eliminated side by side.

    Attributes:
        trunk: those with several ends of limbs below them.
        limbs: the others, those of each limb from the trunk to its end: they are neighbours.
    """

    trunk: list[int]
    limbs: list[range]

    @classmethod
    def of(cls, parents: Sequence[int]) -> "Limbs | None":
        """Returns them, by parents of degrees of freedom, or ``None`` if whole rows are as good, or all that fits."""
        ends = [0] * len(parents)
        for d in reversed(range(len(parents))):
            ends[d] = ends[d] or 1
            if parents[d] >= 0:
                ends[parents[d]] += ends[d]
        trunk = [d for d, count in enumerate(ends) if count > 1]
        limbs: list[range] = []
        for d in sorted(set(range(len(parents))) - set(trunk)):
            if limbs and parents[d] == limbs[-1][-1]:
                limbs[-1] = range(limbs[-1].start, d + 1)
            else:
                limbs.append(range(d, d + 1))
        found = cls(trunk, limbs)
        fits = 0 < len(trunk) <= MOST_TRUNK and found.longest <= MOST_LIMB and len(found.rows) - len(trunk) <= 32
        return found if len(limbs) > 1 and fits and min(limb.stop for limb in limbs) >= found.longest else None

    @property
    def longest(self) -> int:
        """Degrees of freedom of the longest limb."""
        return max(map(len, self.limbs))

    @property
    def rows(self) -> list[int]:
        """All degrees of freedom, those of limbs first."""
        return [*itertools.chain(*self.limbs), *self.trunk]

    @property
    def numbers(self) -> int:
        """Numbers that the lanes share: two pivots of each limb, and what they leave of the trunk."""
        trunk = len(self.trunk)
        corner = pad(pad(trunk, 4) + trunk * (trunk + 1) // 2, 4)
        return 2 * len(self.limbs) * pad(trunk + self.longest + 1, 4) + corner

    def crosses(self, dofs: int) -> bool:
        """Returns whether several limbs are among the bits of degrees of freedom."""
        return sum(any(dofs >> d & 1 for d in limb) for limb in self.limbs) > 1


def pad(x: int, unit: int) -> int:
    """Returns ``x`` rounded up to a multiple of a unit."""
    return -(-x // unit) * unit
