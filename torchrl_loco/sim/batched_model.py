"""MuJoCo-Warp's model with numbers of its own for each world."""

import copy

import mujoco
import numpy as np
import warp as wp

from torchrl_loco.sim import mjw
from torchrl_loco.sim.varied import Varied


@wp.kernel(enable_backward=False)
def write_field(
    mask_in: wp.array[bool],
    numbers_in: wp.array2d[float],
    first: int,
    places_in: wp.array[int],
    field_out: wp.array2d[float],
):
    world, i = wp.tid()
    if mask_in[world]:
        field_out[world, places_in[i]] = numbers_in[world, first + i]


@wp.kernel(enable_backward=False)
def add_up_masses(
    # Model:
    body_parentid: wp.array[int],
    body_mass: wp.array2d[float],
    mask_in: wp.array[bool],
    body_subtreemass_out: wp.array2d[float],
):
    world = wp.tid()
    if not mask_in[world]:
        return
    bodies = body_parentid.shape[0]
    for body in range(bodies):
        body_subtreemass_out[world, body] = body_mass[world, body]
    for i in range(1, bodies):
        body = bodies - i  # children before parents
        parent = body_parentid[body]
        body_subtreemass_out[world, parent] += body_subtreemass_out[world, body]


class BatchedModel:
    """Gives fields of ``model`` that vary a row for each world, and copies the numbers ``(nworld, varied.count)``."""

    def __init__(self, model: "mjw.Model", varied: Varied, numbers: wp.array) -> None:
        self.model, self._varied, self._numbers = model, varied, numbers
        device = numbers.device
        self._places = {name: wp.array(at, dtype=int, device=device) for name, at in varied.places.items() if at.size}
        self._flat = {name: self._batch(name) for name in self._places}
        if "body_mass" in self._places:
            self._flat["body_subtreemass"] = self._batch("body_subtreemass")

    def _batch(self, name: str) -> wp.array:
        """Returns a field as ``(nworld, size)`` floats, after it was given a row for each world."""
        owner = self.model.opt if name == "gravity" else self.model
        field, count = getattr(owner, name), self._numbers.shape[0]
        row = field.numpy().astype(np.float32).reshape(1, -1)
        flat = wp.array(np.repeat(row, count, axis=0), dtype=float, device=self._numbers.device)
        batched = wp.array(ptr=flat.ptr, dtype=field.dtype, shape=(count, *field.shape[1:]), device=flat.device)
        setattr(owner, name, batched)  # flat owns the memory
        return flat

    def update(self, mask: wp.array) -> None:
        """Copies the numbers of the worlds in ``mask`` ``(nworld,)``; ``body_subtreemass`` follows the masses."""
        m, count, device = self.model, self._numbers.shape[0], self._numbers.device
        for name, places in self._places.items():
            inputs = [mask, self._numbers, self._varied.columns[name].start, places]
            wp.launch(write_field, (count, places.size), inputs=inputs, outputs=[self._flat[name]], device=device)
        if "body_mass" in self._places:
            inputs = [m.body_parentid, m.body_mass, mask]
            wp.launch(add_up_masses, count, inputs=inputs, outputs=[m.body_subtreemass], device=device)


def nominal_numbers(varied: Varied | None, num_envs: int, device: wp.Device) -> wp.array:
    """Returns the numbers of the model in every world, ``(num_envs, varied.count)``; none without ``varied``."""
    row = np.zeros(0) if varied is None else varied.nominal()
    return wp.array(np.tile(row, (num_envs, 1)), shape=(num_envs, row.size), dtype=float, device=device)


def with_every_row(m: mujoco.MjModel, varied: Varied | None) -> mujoco.MjModel:
    """Returns a model for whose rows of dry friction there is room, also where only some worlds have any."""
    if varied is None or "dof_frictionloss" not in varied.places:
        return m
    m = copy.copy(m)
    m.dof_frictionloss[varied.places["dof_frictionloss"]] = 1.0
    return m


def batched_bytes(m: mujoco.MjModel, varied: Varied | None, num_envs: int) -> int:
    """Returns the memory of the rows of numbers and of the fields that have a row for each world (bytes)."""
    if varied is None:
        return 0
    sizes = [varied.full(name, varied.nominal()).size for name, places in varied.places.items() if places.size]
    if "body_mass" in varied.places and varied.places["body_mass"].size:
        sizes.append(m.nbody)
    return 4 * num_envs * (varied.count + sum(sizes))
