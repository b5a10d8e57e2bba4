"""Sorts the constraint rows of each world, so that a rollout on CUDA repeats bit for bit.

mujoco_warp allocates rows and contacts in the order in which its threads arrive, and the solver sums in that order,
which decides the rounding. Its own mode, ``opt.deterministic``, makes sums deterministic but, in 4.0, not the order.
"""

from typing import Any

import mujoco
import warp as wp

from torchrl_loco.sim import mjw

ROW_FIELDS = ("type", "id", "pos", "margin", "D", "vel", "aref", "frictionloss")
"""Fields of a constraint row, which move with its Jacobian."""

FIRST_CONTACT = wp.constant(int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS))
"""Lowest type of a row whose id is a contact; the ids of all other types are fixed by the model."""


@wp.func
def row_key(efc_type: int, efc_id: int, contact_geom: wp.array[wp.vec2i]) -> wp.vec4i:
    """Returns the sort key of a row, whose numbers are compared one after the other."""
    geoms = wp.vec2i()
    if efc_type >= FIRST_CONTACT:
        geoms = contact_geom[efc_id]  # contacts of the same two geoms come from one thread, and so in their order
    return wp.vec4i(efc_type, geoms[0], geoms[1], efc_id)


@wp.func
def comes_before(a: wp.vec4i, b: wp.vec4i, otherwise: bool) -> bool:
    for i in range(4):
        if a[i] != b[i]:
            return a[i] < b[i]
    return otherwise


@wp.kernel(enable_backward=False)
def rank_rows(
    nefc_in: wp.array[int],
    efc_type_in: wp.array2d[int],
    efc_id_in: wp.array2d[int],
    contact_geom_in: wp.array[wp.vec2i],
    rank_out: wp.array2d[int],
):
    """Counts the rows that come before each row: its rank."""
    world, row = wp.tid()
    rows = wp.min(nefc_in[world], rank_out.shape[1])
    if row >= rows:
        return
    key = row_key(efc_type_in[world, row], efc_id_in[world, row], contact_geom_in)
    rank = int(0)
    for other in range(rows):
        other_key = row_key(efc_type_in[world, other], efc_id_in[world, other], contact_geom_in)
        if comes_before(other_key, key, other < row):  # rows of one constraint stay in their order
            rank += 1
    rank_out[world, row] = rank


@wp.kernel(enable_backward=False)
def move_rows(nefc_in: wp.array[int], rank_in: wp.array2d[int], rows_out: wp.array3d[Any]):
    """Permutes a column of the rows in place: each cycle of the permutation starts at its lowest row."""
    world, column = wp.tid()
    for start in range(wp.min(nefc_in[world], rank_in.shape[1])):
        row = rank_in[world, start]
        while row > start:
            row = rank_in[world, row]
        if row < start:  # not the lowest of its cycle
            continue
        carried = rows_out[world, start, column]
        row = rank_in[world, start]
        while row != start:
            left = rows_out[world, row, column]
            rows_out[world, row, column] = carried
            carried = left
            row = rank_in[world, row]
        rows_out[world, start, column] = carried


@wp.kernel(enable_backward=False)
def follow_rows(
    nacon_in: wp.array[int],
    contact_worldid_in: wp.array[int],
    rank_in: wp.array2d[int],
    contact_efc_address_out: wp.array2d[int],
):
    """Updates the row addresses of the contacts."""
    contact, i = wp.tid()
    if contact >= nacon_in[0]:
        return
    row = contact_efc_address_out[contact, i]
    if row >= 0:
        contact_efc_address_out[contact, i] = rank_in[contact_worldid_in[contact], row]


class RowOrder:
    """Sorts the constraint rows of every world by type, then by joint or pair of geoms.

    :meth:`apply` moves the rows of ``data``, between ``mujoco_warp.step1`` and ``step2``.
    """

    def __init__(self, model: "mjw.Model", data: "mjw.Data") -> None:
        most = model.block_dim.contact_jac_tiled
        others = {  # what else varies in order before the solver starts
            "a sparse Jacobian": model.is_sparse,
            "elliptic friction cones": model.opt.cone == mjw.ConeType.ELLIPTIC,
            "gravity compensation": bool(model.body_gravcomp.numpy().any()),
            "tendons": model.ntendon > 0,
            "flexes": model.nflex > 0,
            # Beyond it several blocks of threads add to one row.
            f"more than {most} degrees of freedom": model.nv > most,
        }
        if found := [name for name, here in others.items() if here]:
            raise ValueError(f"deterministic=True does not support models with {', '.join(found)}: leave it out")
        self._data = data
        self._rank = wp.zeros((data.nworld, data.njmax), dtype=int, device=data.qpos.device)
        fields = [getattr(data.efc, name) for name in ROW_FIELDS]
        self._rows = [data.efc.J, *(field.reshape((*field.shape, 1)) for field in fields)]

    def apply(self) -> None:
        """Launches the kernels."""
        d, device = self._data, self._data.qpos.device
        inputs = [d.nefc, d.efc.type, d.efc.id, d.contact.geom]
        wp.launch(rank_rows, dim=self._rank.shape, inputs=inputs, outputs=[self._rank], device=device)
        for rows in self._rows:
            dim = rows.shape[0], rows.shape[2]
            wp.launch(move_rows, dim=dim, inputs=[d.nefc, self._rank], outputs=[rows], device=device)
        inputs, addresses = [d.nacon, d.contact.worldid, self._rank], d.contact.efc_address
        wp.launch(follow_rows, dim=addresses.shape, inputs=inputs, outputs=[addresses], device=device)
