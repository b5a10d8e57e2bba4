"""Contact forces of geoms in C MuJoCo."""

import mujoco
import numpy as np


def net_forces(model, data):
    """Returns what ``mj_contactForce`` finds, added up by geom: force (N), size of the forces (N), and any contact.

    Returns:
        ``(ngeom, 3)`` in the world's frame, ``(ngeom,)`` and ``(ngeom,)`` bool.
    """
    net, size, touches = np.zeros((model.ngeom, 3)), np.zeros(model.ngeom), np.zeros(model.ngeom, bool)
    for i, contact in enumerate(data.contact):
        if contact.efc_address < 0:
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, i, wrench)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]  # of the first geom on the second
        first, second = contact.geom
        net[first] -= force
        net[second] += force
        size[[first, second]] += np.linalg.norm(force)
        touches[[first, second]] = True
    return net, size, touches
