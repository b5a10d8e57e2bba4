"""Meshes on planes: which vertices of a convex hull touch one."""

import dataclasses

import mujoco
import numpy as np


@dataclasses.dataclass
class Mesh:
    """The convex hull of a mesh, as a plane meets it.

    Attributes:
        vertices: those of the hull, ``(n, 3)`` (m).
        corners: for each vertex its corners: the normal of a face, and those of its other vertices that are in contact
            with a plane where this one is the lowest, up to three.
    """

    vertices: np.ndarray
    corners: list[list[tuple[np.ndarray, list[int]]]]

    @classmethod
    def of(cls, m: mujoco.MjModel, mesh: int) -> "Mesh":
        """Returns a mesh of a model, without the vertices that lie inside of its hull."""
        first = int(m.mesh_vertadr[mesh])
        outside = np.flatnonzero(m.mesh_polymapnum[first : first + m.mesh_vertnum[mesh]])
        vertices = m.mesh_vert[first + outside].astype(float)
        place = {int(vertex): i for i, vertex in enumerate(outside)}
        corners: list[list[tuple[np.ndarray, list[int]]]] = []
        for vertex in outside:
            start = m.mesh_polymapadr[first + vertex]
            faces = m.mesh_polyadr[mesh] + m.mesh_polymap[start : start + m.mesh_polymapnum[first + vertex]]
            corners.append([])
            for face in faces:
                start = m.mesh_polyvertadr[face]
                around = [place[int(i)] for i in m.mesh_polyvert[start : start + m.mesh_polyvertnum[face]]]
                at = around.index(place[int(vertex)])
                corners[-1].append((m.mesh_polynormal[face], _widest(vertices, around[at:] + around[:at])[1:]))
        return cls(vertices, corners)


def _widest(vertices: np.ndarray, around: list[int]) -> list[int]:
    """Returns up to four vertices of a convex polygon, the first and those that make the quadrilateral large.

    As MuJoCo does, the other three move on in turn for as long as the area grows.
    """
    count = len(around)
    if count <= 4:
        return around

    def area(corners: list[int]) -> float:
        a, b, c, d = (vertices[around[i % count]] for i in corners)
        return float(np.linalg.norm(np.cross(a - c, b - d)))

    best, largest_area = [0, 1, 2, 3], area([0, 1, 2, 3])

    def grows(which: int) -> bool:
        nonlocal best, largest_area
        moved = [(i + (k == which)) % count for k, i in enumerate(best)]
        if area(moved) <= largest_area:
            return False
        best, largest_area = moved, area(moved)
        return True

    while grows(3):
        while grows(2):
            pass
        while grows(1):
            pass
    return [around[i] for i in best]
