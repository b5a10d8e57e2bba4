"""Poses and velocities of bodies as functions of positions and velocities of joints, with gradients."""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from torchrl_loco.sim.corners import axes_of
from torchrl_loco.sim.graph import EXCLUSIVE, current_stream
from torchrl_loco.sim.warp_init import init_warp
from torchrl_loco.sim.world_func import fill_from_numbers

FREE, SLIDE, HINGE = (
    wp.constant(int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}"))) for kind in ("FREE", "SLIDE", "HINGE")
)
FIXED = wp.constant(-1)
BLOCK = 32  # worlds of a block of threads: few, so that a few thousand worlds keep all multiprocessors busy


@wp.struct
class Links:
    """A model as a tree of links, each with at most one joint. The last link of a body has the number of the body.

    A thread goes along one chain, from the world to a leaf. What lies in several chains is computed in each, so that
    threads need not wait for each other: it is a link of its own there.
    """

    first: wp.array[int]  # where each chain begins in order, and where the last one ends
    order: wp.array[int]  # the links of the chains, one chain after the other, parents first
    parent: wp.array[int]
    kind: wp.array[int]
    offset: wp.array[wp.vec3]  # place in the parent (m)
    turn: wp.array[wp.mat33]  # orientation in the parent, at rest
    anchor: wp.array[wp.vec3]  # point about which the joint turns (m)
    axis: wp.array[wp.vec3]
    q: wp.array[int]  # where positions of the joint are
    v: wp.array[int]  # where its velocities are
    rest: wp.array[float]  # its position at rest


SHAPES = (3,), (3, 3), (3,), (3,)  # of what is found of a link: place, orientation, velocities
TYPES = wp.float32, wp.float32, wp.vec3, wp.mat33, wp.vec3, wp.vec3  # of what the kernel reads and writes


@wp.kernel(module="unique")
def place_links(
    links: Links,
    qpos: wp.array3d[float],
    qvel: wp.array3d[float],
    pos: wp.array2d[wp.vec3],
    mat: wp.array2d[wp.mat33],
    lin: wp.array2d[wp.vec3],
    ang: wp.array2d[wp.vec3],
):
    """Places links ``(links, worlds)``, of which those of bodies are the first.

    Threads of neighbouring worlds read and write neighbouring numbers of a link.
    """
    c, w = wp.tid()
    pos[0, w] = wp.vec3()
    mat[0, w] = wp.identity(n=3, dtype=float)
    lin[0, w] = wp.vec3()
    ang[0, w] = wp.vec3()
    for i in range(links.first[c], links.first[c + 1]):
        k = links.order[i]
        p = links.parent[k]
        kind = links.kind[k]
        q = links.q[k]
        v = links.v[k]
        place = wp.vec3()
        frame = wp.identity(n=3, dtype=float)
        speed = wp.vec3()
        spin = wp.vec3()
        if kind == FREE:
            frame = wp.quat_to_matrix(
                wp.normalize(wp.quat(qpos[w, c, q + 4], qpos[w, c, q + 5], qpos[w, c, q + 6], qpos[w, c, q + 3]))
            )
            place = wp.vec3(qpos[w, c, q], qpos[w, c, q + 1], qpos[w, c, q + 2])
            speed = wp.vec3(qvel[w, c, v], qvel[w, c, v + 1], qvel[w, c, v + 2])
            spin = frame * wp.vec3(qvel[w, c, v + 3], qvel[w, c, v + 4], qvel[w, c, v + 5])
        else:
            of_parent = mat[p, w]
            turning = ang[p, w]
            offset = of_parent * links.offset[k]
            rest = of_parent * links.turn[k]
            place = pos[p, w] + offset
            frame = rest
            speed = lin[p, w] + wp.cross(turning, offset)
            spin = turning
            if kind == SLIDE:
                along = rest * links.axis[k]
                moved = (qpos[w, c, q] - links.rest[k]) * along
                place = place + moved
                speed = speed + wp.cross(turning, moved) + qvel[w, c, v] * along
            elif kind != FIXED:
                own = wp.vec3()
                if kind == HINGE:
                    frame = rest * wp.quat_to_matrix(
                        wp.quat_from_axis_angle(links.axis[k], qpos[w, c, q] - links.rest[k])
                    )
                    own = qvel[w, c, v] * (rest * links.axis[k])
                else:  # a ball
                    frame = rest * wp.quat_to_matrix(
                        wp.normalize(wp.quat(qpos[w, c, q + 1], qpos[w, c, q + 2], qpos[w, c, q + 3], qpos[w, c, q]))
                    )
                    own = frame * wp.vec3(qvel[w, c, v], qvel[w, c, v + 1], qvel[w, c, v + 2])
                lever = frame * links.anchor[k]
                swung = rest * links.anchor[k] - lever
                place = place + swung
                speed = speed + wp.cross(turning, swung) - wp.cross(own, lever)
                spin = turning + own
        pos[k, w] = place
        mat[k, w] = frame
        lin[k, w] = speed
        ang[k, w] = spin


def links_of(m: mujoco.MjModel) -> dict[int, dict[str, Any]]:
    """Returns what :class:`Links` has of each link of a model by their numbers, parents first."""
    rows, further = dict[int, dict[str, Any]](), int(m.nbody)
    for body in range(m.nbody):
        first, count, parent = int(m.body_jntadr[body]), int(m.body_jntnum[body]), int(m.body_parentid[body])
        offset, turn = m.body_pos[body], axes_of(m.body_quat[body])
        for at in range(max(count, 1)):
            row: dict[str, Any] = {"parent": parent, "kind": -1, "offset": offset, "turn": turn}
            row |= {"anchor": np.zeros(3), "axis": np.zeros(3), "q": 0, "v": 0, "rest": 0.0}
            if count:
                joint, q = first + at, int(m.jnt_qposadr[first + at])
                row |= {"kind": int(m.jnt_type[joint]), "anchor": m.jnt_pos[joint], "axis": m.jnt_axis[joint]}
                row |= {"q": q, "v": int(m.jnt_dofadr[joint]), "rest": float(m.qpos0[q])}
            is_last = at + 1 >= count
            parent, further = (body, further) if is_last else (further, further + 1)
            rows[parent], offset, turn = row, np.zeros(3), np.eye(3)
    return rows


def chains_of(rows: dict[int, dict[str, Any]]) -> list[list[int]]:
    """Returns the links from the world to each leaf, and adds to ``rows`` those that an earlier chain has as well."""
    chains, taken = list[list[int]](), {0}
    for leaf in sorted(rows.keys() - {row["parent"] for row in rows.values()}):
        chain, link = list[int](), leaf
        while link:
            chain.insert(0, link)
            link = rows[link]["parent"]
        for i, link in enumerate(chain):
            chain[i] = len(rows) if link in taken else link
            rows[chain[i]] = {**rows[link], "parent": chain[i - 1] if i else 0}
        taken.update(chain)
        chains.append(chain)
    return chains


class Kinematics:
    """Where bodies are and how they move, as a differentiable function of positions and velocities."""

    def __init__(self, m: mujoco.MjModel, device: torch.device) -> None:
        init_warp()
        self._device, self.bodies = wp.device_from_torch(device), int(m.nbody)
        rows = links_of(m)
        chains = chains_of(rows)
        self.count, self.chains = len(rows), len(chains)  # of links, and of chains
        columns = {name: [rows[link][name] for link in range(self.count)] for name in rows[0]}
        ends, order = np.cumsum([0, *map(len, chains)]), [link for chain in chains for link in chain]
        self._links = fill_from_numbers(Links, self._device, first=ends, order=order, **columns)
        self._root = torch.tensor(m.body_rootid, device=device).long()

    def __call__(self, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Returns positions, orientations, linear and angular velocities of bodies, each ``(worlds, bodies, ...)``.

        All are those of the bodies' origins, in the world's frame.
        """
        return _Placed.apply(self, qpos, qvel)

    def named(self, bodies: Sequence[torch.Tensor]) -> dict[str, torch.Tensor]:
        """Returns these by MuJoCo's names: ``xpos``, ``xmat``, ``cvel`` and ``subtree_com``.

        The points ``subtree_com``, of whose velocities ``cvel`` tells, are the origins of the bodies' trees here.
        """
        pos, mat, lin, ang = bodies
        of_tree = lin + torch.linalg.cross(ang, pos.index_select(1, self._root) - pos)
        return {"xpos": pos, "xmat": mat, "cvel": torch.cat([ang, of_tree], dim=-1), "subtree_com": pos}

    def launch(self, tensors: Sequence[torch.Tensor], slopes: Sequence[torch.Tensor] = ()) -> None:
        """Launches the kernel on torch's current stream; with ``slopes``, its adjoint, which adds gradients to them.

        Tensors are qpos and qvel, for each chain, ``(worlds, chains, ...)``, and what is found of links.
        """
        arrays, gradients = (
            [wp.from_torch(each.detach(), dtype=kind) for each, kind in zip(every, TYPES, strict=False)]
            for every in (tensors, slopes)
        )
        adjoint: dict[str, Any] = {}
        if slopes:
            adjoint = {"adjoint": True, "adj_inputs": [Links(), *gradients[:2]], "adj_outputs": gradients[2:]}
        with EXCLUSIVE, wp.ScopedStream(current_stream(self._device), sync_enter=False):
            settings = {"device": self._device, "block_dim": BLOCK, **adjoint}
            wp.launch(place_links, (self.chains, len(tensors[0])), [self._links, *arrays[:2]], arrays[2:], **settings)


class _Placed(torch.autograd.Function):
    """What is found of all bodies, from positions ``(worlds, nq)`` and velocities ``(worlds, nv)``."""

    @staticmethod
    def forward(ctx: Any, of: Kinematics, qpos: torch.Tensor, qvel: torch.Tensor) -> tuple[torch.Tensor, ...]:
        inputs = [each.contiguous().unsqueeze(1).expand(-1, of.chains, -1) for each in (qpos, qvel)]
        links = [qpos.new_empty(of.count, len(qpos), *shape) for shape in SHAPES]
        of.launch([*inputs, *links])
        ctx.save_for_backward(*inputs, *links)
        ctx.of = of
        return tuple(each[: of.bodies].transpose(0, 1).contiguous() for each in links)

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        tensors, sizes = ctx.saved_tensors, [each.numel() for each in ctx.saved_tensors]
        parts = tensors[0].new_zeros(sum(sizes)).split(sizes)
        of_qpos, of_qvel, *links = [part.view(each.shape) for part, each in zip(parts, tensors, strict=True)]
        for link, slope in zip(links, slopes, strict=True):
            link[: ctx.of.bodies] = slope.transpose(0, 1)
        ctx.of.launch(tensors, [of_qpos, of_qvel, *links])
        return None, of_qpos.sum(1), of_qvel.sum(1)
