"""The contacts that lanes find, which no array of the engine holds."""

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.config import SimConfig
from torchrl_loco.sim.compiled.collision.ground import Ground
from torchrl_loco.sim.compiled.engine import Chain, Data, _kernel, arrays_of
from torchrl_loco.sim.compiled.schedules import lanes
from torchrl_loco.sim.compiled.step import launch_size
from torchrl_loco.sim.engine import Setup

FIELDS = 8
"""Numbers of a contact: the pair, the distance less the margin, the point and the normal."""
DUMP = """
    const int found = frictional + frictionless;
    for (int i = 0; i < found; ++i) {
      const Contact c = contact(i);
      const Vec point = c.point + w.com[0];
      const float row[] = {(float)c.pair(), c.distance, point.x, point.y, point.z, c.normal.x, c.normal.y, c.normal.z};
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
    assert text.count("  jacobians();\n") == 1
    # A model without numbers of each world leaves their array alone.
    head = "static float* contact_dump;\ncontact_dump = numbers_out.data + world * numbers_out.shape[1];\n"

    before, after = Chain(()), Chain(())
    text = head + text.replace("  jacobians();\n", DUMP)
    kernel = _kernel(text, before, after)
    count = len(qpos)
    data = Data(Setup(m, SimConfig.of(m), count, wp.get_device("cpu")))
    data.qpos.assign(qpos.astype(np.float32))
    found = wp.zeros((count, FIELDS * most), dtype=float, device="cpu")
    everywhere = wp.ones(count, dtype=bool, device="cpu")
    size = launch_size(m, count, wp.get_device("cpu"))
    terrain = wp.array(Ground.of(m).numbers(), dtype=float, device="cpu")
    arrays = arrays_of(data, terrain, found)
    inputs = [size.worlds_per_warp, size.lanes, everywhere, before.args(()), after.args(()), arrays]
    wp.launch(kernel, dim=size.threads, inputs=inputs, device="cpu")
    result = []
    for rows in found.numpy().reshape(count, most, FIELDS):
        end = int(np.argmax(rows[:, 0] < 0))
        pairs = [(int(row[0]), row[1:].astype(float)) for row in rows[:end]]
        result.append([(description.pairs[i].geoms, row) for i, row in pairs if i < len(description.pairs)])
    return result
