"""Rays from a site: how far what they meet lies."""

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.eyes.placing import Placed, Sight, origin_of, pose_of, turn_of
from torchrl_loco.eyes.scene import for_rays, mounts_at
from torchrl_loco.eyes.shapes import to_mesh, to_shape
from torchrl_loco.sim import EXCLUSIVE, Buffer
from torchrl_loco.sim.compiled.collision.kinds import MESH
from torchrl_loco.sim.corners import axes_of


@wp.kernel(enable_backward=False)
def cast(
    sight: Sight, mask: wp.array[bool], directions: wp.array[wp.vec3], far: float, distance_out: wp.array2d[float]
):
    world, ray = wp.tid()
    if mask and not mask[world]:
        return
    shapes, nearest = sight.shapes, float(far)
    for k in range(shapes.kind.shape[0]):
        pose, kind = pose_of(sight.poses, world, k), shapes.kind[k]
        o, d = origin_of(pose), turn_of(pose) @ directions[ray]
        t = to_shape(kind, o, d, shapes.size[k])
        if kind == MESH:
            t, _n, _f = to_mesh(shapes.mesh[k], o, d, nearest)
        nearest = wp.min(nearest, t)
    distance_out[world, ray] = nearest


class Rays:
    """Rays from a site, in each of several worlds of a model.

    They meet geoms of all groups, also of those that pictures do not show. Their directions are in the frame of the
    site, of length 1, ``(count, 3)``. ``distance`` tells how far what they meet lies, or ``far`` (m), ``(worlds,
    count)``.
    """

    def __init__(
        self, m: mujoco.MjModel, device: wp.Device, site: int, directions: np.ndarray, worlds: int, far: float
    ) -> None:
        place = {"body": m.site_bodyid[[site]], "pos": m.site_pos[[site]], "mat": axes_of(m.site_quat[site])[None]}
        mounts = mounts_at(m, device, **place, mode=np.zeros(1), target=-np.ones(1))
        self._placed = Placed(for_rays(m), device, mounts, worlds)
        self._device, self._far = device, far
        with EXCLUSIVE, wp.ScopedDevice(device):
            self._directions = wp.array(directions, wp.vec3, device=device)
            self._out = Buffer((worlds, len(directions)), float, device)
        self.distance = self._out.torch

    def launch(self, xpos: wp.array, xmat: wp.array, mask: wp.array | None = None) -> None:
        """Launches the kernels, on Warp's current stream; arguments as of :meth:`Placed.launch`."""
        self._placed.launch(xpos, xmat, mask)
        inputs, out = [self._placed.sight, mask, self._directions, self._far], self._out.warp
        wp.launch(cast, out.shape, inputs, [out], device=self._device)
