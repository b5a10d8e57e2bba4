"""Net contact forces of geoms under MuJoCo-Warp."""

from collections.abc import Sequence

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.sim import mjw

UNITS = wp.constant(wp.float64(2.0**32))
"""Units of a newton: forces are added up as integers, so that the sum does not depend on the order of contacts."""
LARGEST = wp.constant(2.0**24)
"""Component of a force (N) beyond which it is cut off, so that sums of 64 bits do not overflow."""


@wp.kernel(enable_backward=False)
def add_contacts(
    nacon_in: wp.array[int],
    contact_geom_in: wp.array[wp.vec2i],
    contact_efc_address_in: wp.array2d[int],
    contact_worldid_in: wp.array[int],
    index_in: wp.array[int],
    force_in: wp.array[wp.spatial_vector],
    sum_out: wp.array3d[wp.int64],
    touches_out: wp.array2d[bool],
):
    """Adds each contact that has constraint rows to its two geoms."""
    contact = wp.tid()
    if contact >= nacon_in[0] or contact_efc_address_in[contact, 0] < 0:
        return
    world, geoms, force = contact_worldid_in[contact], contact_geom_in[contact], wp.spatial_top(force_in[contact])
    for side in range(2):
        if geoms[side] < 0:  # a part of a flex
            continue
        geom = index_in[geoms[side]]
        if geom < 0:  # nobody asks for it
            continue
        touches_out[world, geom] = True
        for i in range(3):
            units = wp.int64(wp.float64(wp.clamp(force[i], -LARGEST, LARGEST)) * UNITS)
            wp.atomic_add(sum_out, world, geom, i, units if side == 1 else -units)


@wp.kernel(enable_backward=False)
def read_sums(
    mask_in: wp.array[bool],
    first_row: int,
    end_row: int,
    sum_in: wp.array3d[wp.int64],
    touches_in: wp.array2d[bool],
    force_out: wp.array2d[wp.vec3],
    in_contact_out: wp.array2d[bool],
):
    world, geom = wp.tid()
    if not mask_in[world]:
        return
    force = wp.vec3()
    for i in range(3):
        force[i] = float(wp.float64(sum_in[world, geom, i]) / UNITS)
    for row in range(first_row, end_row):
        place = row * touches_in.shape[1] + geom
        force_out[world, place] = force
        in_contact_out[world, place] = touches_in[world, geom]


class ContactForces:
    """Adds up the forces of the contacts on some geoms, the same to the bit for any order of the contacts.

    Attributes:
        rows: of how many substeps the sums are kept.
        force: net force of the contacts on each geom, in the world's frame (N), ``(nworld, rows * len(geoms))`` vec3,
            substep by substep.
        in_contact: whether it has any, ``(nworld, rows * len(geoms))`` bool.
    """

    def __init__(self, m: mujoco.MjModel, geoms: Sequence[int], data: "mjw.Data", rows: int = 1) -> None:
        shape, kept, device = (data.nworld, len(geoms)), (data.nworld, rows * len(geoms)), data.qpos.device
        self.rows = rows
        self.force = wp.zeros(kept, dtype=wp.vec3, device=device)
        self.in_contact = wp.zeros(kept, dtype=bool, device=device)
        self._sum = wp.zeros((*shape, 3), dtype=wp.int64, device=device)
        self._touches = wp.zeros(shape, dtype=bool, device=device)
        index = np.full(m.ngeom, -1)
        index[list(geoms)] = np.arange(len(geoms))
        self._index = wp.array(index, dtype=int, device=device)
        self._contacts = wp.array(np.arange(data.naconmax), dtype=int, device=device)
        self._of_contact = wp.zeros(data.naconmax, dtype=wp.spatial_vector, device=device)

    def update(self, model: "mjw.Model", data: "mjw.Data", mask: wp.array, row: int | None = None) -> None:
        """Adds up the contacts of the last physics step in the worlds where ``mask`` ``(nworld,)`` is set.

        The sums are kept in a row; ``None`` writes them into every row.
        """
        device, contact = data.qpos.device, data.contact
        mjw.contact_force(model, data, self._contacts, True, self._of_contact)  # in the world's frame
        sums, shape = [self._sum, self._touches], self._touches.shape
        for array in sums:
            array.zero_()
        inputs = [data.nacon, contact.geom, contact.efc_address, contact.worldid, self._index, self._of_contact]
        wp.launch(add_contacts, dim=data.naconmax, inputs=inputs, outputs=sums, device=device)
        inputs = [mask, *((0, self.rows) if row is None else (row, row + 1)), *sums]
        wp.launch(read_sums, dim=shape, inputs=inputs, outputs=[self.force, self.in_contact], device=device)
