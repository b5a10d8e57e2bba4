"""The contacts that lanes find, which no array of the engine holds."""

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.sim.compiled import lanes

FIELDS = 8
"""Numbers of a contact: the pair, the distance less the margin, the point and the normal."""
DUMP = """
    const int found = frictional + frictionless;
    for (int i = 0; i < found; ++i) {
      const Contact c = contact(i);
      const Vec point = c.point + w.com[0];
      const float row[] = {(float)c.pair, c.distance, point.x, point.y, point.z, c.normal.x, c.normal.y, c.normal.z};
      for (int k = 0; k < 8; ++k) contact_dump[8 * i + k] = row[k];
    }
    contact_dump[8 * found] = -1.0f;
    jacobians();
"""


def find_contacts(m: mujoco.MjModel, qpos: np.ndarray) -> list[list[tuple[tuple[int, int], np.ndarray]]]:
    """Returns the contacts of each state: geoms, then distance less margin, point and normal, ``(7,)``.

    Args:
        m: the model.
        qpos: states, ``(count, nq)``.
    """
    description = lanes.Description(m)
    most = description.layout.frictional + description.layout.frictionless + 1
    text = lanes.source(m, 1)
    assert text.count("    jacobians();\n") == 1
    head = "static float* contact_dump;\ncontact_dump = found_out.data + world * found_out.shape[1];\n"

    @wp.func_native(head + text.replace("    jacobians();\n", DUMP))
    def advance(
        world: int,
        lane: int,
        live: bool,
        ctrl_in: wp.array2d[float],
        qpos_out: wp.array2d[float],
        qvel_out: wp.array2d[float],
        qacc_warmstart_out: wp.array2d[float],
        time_out: wp.array[float],
        xpos_out: wp.array2d[wp.vec3],
        xmat_out: wp.array2d[wp.mat33],
        cvel_out: wp.array2d[wp.spatial_vector],
        sensordata_out: wp.array2d[float],
        overflow_out: wp.array[int],
        found_out: wp.array2d[float],
    ): ...

    @wp.kernel(enable_backward=False, module="unique")
    def find(
        ctrl_in: wp.array2d[float],
        qpos_out: wp.array2d[float],
        qvel_out: wp.array2d[float],
        qacc_warmstart_out: wp.array2d[float],
        time_out: wp.array[float],
        xpos_out: wp.array2d[wp.vec3],
        xmat_out: wp.array2d[wp.mat33],
        cvel_out: wp.array2d[wp.spatial_vector],
        sensordata_out: wp.array2d[float],
        overflow_out: wp.array[int],
        found_out: wp.array2d[float],
    ):
        advance(
            wp.tid(),
            0,
            True,
            ctrl_in,
            qpos_out,
            qvel_out,
            qacc_warmstart_out,
            time_out,
            xpos_out,
            xmat_out,
            cvel_out,
            sensordata_out,
            overflow_out,
            found_out,
        )

    count = len(qpos)
    found = wp.zeros((count, FIELDS * most), dtype=float, device="cpu")
    overflow = wp.zeros(count, dtype=int, device="cpu")
    arrays = [
        wp.zeros((count, max(m.nu, 1)), dtype=float, device="cpu"),
        wp.array(qpos.astype(np.float32), dtype=float, device="cpu"),
        wp.zeros((count, m.nv), dtype=float, device="cpu"),
        wp.zeros((count, m.nv), dtype=float, device="cpu"),
        wp.zeros(count, dtype=float, device="cpu"),
        wp.zeros((count, m.nbody), dtype=wp.vec3, device="cpu"),
        wp.zeros((count, m.nbody), dtype=wp.mat33, device="cpu"),
        wp.zeros((count, m.nbody), dtype=wp.spatial_vector, device="cpu"),
        wp.zeros((count, max(m.nsensordata, 1)), dtype=float, device="cpu"),
        overflow,
        found,
    ]
    wp.launch(find, dim=count, outputs=arrays, device="cpu")
    result = []
    for rows in found.numpy().reshape(count, most, FIELDS):
        end = int(np.argmax(rows[:, 0] < 0))
        pairs = [(int(row[0]), row[1:].astype(float)) for row in rows[:end]]
        result.append([(description.pairs[i].geoms, row) for i, row in pairs if i < len(description.pairs)])
    return result
