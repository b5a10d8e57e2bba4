"""Numbers of models that are drawn for each world."""

import mujoco
import numpy as np

from torchrl_loco.sim.varied import FIELDS, Varied, field


def candidates(model, name):
    """Returns the numbers of a field that a model can follow, as indices of the flattened array."""
    every = np.arange(field(model, name).size)
    if name == "actuator_forcerange":
        return every[model.actuator_forcelimited[every // 2] == 1]
    if name == "body_ipos":
        return every[model.body_simple[every // 3] != 1]
    if name == "jnt_stiffness":
        return every[model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)]
    return every


def all_varied(model):
    """Returns all that can vary."""
    return Varied(model, {name: candidates(model, name) for name in FIELDS})


def some_varied(model, rng):
    """Returns some numbers of some fields, of which gravity is one."""
    found = {name: at[rng.random(at.size) < 0.5] for name in FIELDS if (at := candidates(model, name)).size}
    return Varied(model, {name: at for name, at in found.items() if name == "gravity" or rng.random() < 0.7})


def draw_rows(varied, rng, count, names=FIELDS):
    """Returns rows whose numbers of some fields are drawn, and nominal otherwise, ``(count, varied.count)`` float32."""
    rows = np.repeat(varied.nominal()[None], count, axis=0)
    for name, columns in varied.columns.items():
        if name not in names:
            continue
        numbers = rows[:, columns]
        if name == "body_ipos":
            numbers += rng.uniform(-0.02, 0.02, numbers.shape)
            continue
        if name in ("dof_damping", "dof_frictionloss", "jnt_stiffness"):  # some that are zero, of which some stay so
            numbers += (numbers == 0) * rng.uniform(0, 0.5, numbers.shape) * rng.integers(0, 2, numbers.shape)
        numbers *= rng.uniform(0.6, 1.6, numbers.shape)
    return rows.astype(np.float32)
