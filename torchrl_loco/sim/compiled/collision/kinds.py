"""The shapes of geoms, and how two of them touch: each pair is an entry of :data:`KINDS` and a function of lanes."""

import dataclasses

import mujoco

PLANE, FIELD, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"))
    for kind in ("PLANE", "HFIELD", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
)
SHAPES = (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH)  # in the order of enum Shape in laws.h
SOLID = (ELLIPSOID, CYLINDER, BOX, MESH)  # shapes that are no segment with a radius


@dataclasses.dataclass(frozen=True)
class Kind:
    """How two shapes touch.

    Attributes:
        points: contacts that a pair of geoms can have; with a field, as far as a world has room for those of all pairs.
        function: the function of lanes that finds them, ``collide_...`` in ``schedules/lanes``.
        traced: whether the schedule of one thread a world has it too.
        searched: whether C MuJoCo finds the contacts by a general convex collider, which the flag nativeccd chooses.
        on_boxes: the function that finds them where the box is one of many of the world; without one, such a pair is
            not compiled.
    """

    points: int
    function: str
    traced: bool = False
    searched: bool = False
    on_boxes: str = ""


KINDS = {
    (PLANE, SPHERE): Kind(1, "round_on_plane", traced=True),
    (PLANE, CAPSULE): Kind(2, "round_on_plane", traced=True),
    (PLANE, ELLIPSOID): Kind(1, "solid_on_plane"),
    (PLANE, CYLINDER): Kind(4, "solid_on_plane"),
    (PLANE, BOX): Kind(4, "solid_on_plane"),
    (PLANE, MESH): Kind(4, "solid_on_plane"),
    (FIELD, SPHERE): Kind(8, "round_on_field"),
    (FIELD, CAPSULE): Kind(8, "round_on_field"),
    (SPHERE, SPHERE): Kind(1, "round_and_round", traced=True),
    (SPHERE, CAPSULE): Kind(1, "round_and_round", traced=True),
    (CAPSULE, CAPSULE): Kind(2, "round_and_round", traced=True),
    (SPHERE, ELLIPSOID): Kind(1, "round_and_solid", searched=True),
    (SPHERE, CYLINDER): Kind(1, "round_and_solid"),
    (CAPSULE, ELLIPSOID): Kind(1, "round_and_solid", searched=True),
    (CAPSULE, CYLINDER): Kind(2, "round_and_solid", searched=True),
    (SPHERE, BOX): Kind(1, "round_and_box", on_boxes="round_on_boxes"),
    (CAPSULE, BOX): Kind(2, "round_and_box", on_boxes="round_on_boxes"),
    (BOX, BOX): Kind(8, "box_and_box", on_boxes="box_on_boxes"),
}
"""What is compiled, by the two shapes, the one of the smaller number first. Planes and fields belong to the world."""

GROUND = (PLANE, FIELD)  # shapes that belong to the world, whose pairs are never listed

NOT_COMPILED = Kind(0, "")  # that of all other shapes

ON_BOXES = tuple(dict.fromkeys(kind.on_boxes for kind in KINDS.values() if kind.on_boxes))
FUNCTIONS = tuple(dict.fromkeys([*(kind.function for kind in KINDS.values()), *ON_BOXES]))
"""The functions of lanes, in the order in which they look at their pairs."""

ON_PLANES = {kind.function for (first, _), kind in KINDS.items() if first == PLANE}
GROUND_FUNCTIONS = {kind.function for (first, _), kind in KINDS.items() if first in GROUND} | {*ON_BOXES}
"""Those of contacts with planes, and with any ground. The others look at pairs whose bounding spheres are near."""

POINT_BITS = max(kind.points - 1 for kind in KINDS.values()).bit_length()
"""Bits of the number of a contact within its pair."""


def title(shape: int) -> str:
    """Returns the name of a shape, in lower case."""
    return mujoco.mjtGeom(shape).name.removeprefix("mjGEOM_").lower()


def described() -> str:
    """Returns which shapes touch which, in words."""
    with_: dict[int, list[str]] = {}
    for first, second in KINDS:
        with_.setdefault(first, []).append(title(second))
    titles = {shape: f"{title(shape)}{' (of the world)' * (shape in GROUND)}" for shape in with_}
    return "; ".join(f"{titles[shape]} with {', '.join(others)}" for shape, others in with_.items())
