"""Pixels from Warp's ray tracer: all worlds at once, on the CPU or CUDA, without OpenGL."""

import copy

import mujoco
import torch
import warp as wp

from torchrl_loco.sim import EXCLUSIVE, Simulation, current_stream, mjw


def to_the_horizon(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of a model for pictures: its planes have no end, as in the physics, where their size is none."""
    seen = copy.copy(mj_model)
    seen.geom_size[seen.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0.0
    return seen


class Renderer:
    """Renders the first worlds of a simulation through one camera.

    Args:
        sim: the simulation whose current state is shown.
        camera: name of a camera of the model.
        width: pixels in a row, at least 1.
        height: rows, at least 1.
        worlds: how many worlds.
    """

    def __init__(self, sim: Simulation, camera: str, width: int, height: int, worlds: int) -> None:
        self._sim, self._worlds = sim, worlds
        seen = to_the_horizon(sim.mj_model)
        with EXCLUSIVE, wp.ScopedDevice(sim.device):
            self._model = mjw.put_model(seen)
            self._context = mjw.create_render_context(
                seen,
                nworld=worlds,
                cam_res=(width, height),
                render_rgb=True,
                use_shadows=True,
                render_skybox=True,
                cam_active=[camera],
            )
            self._rgb = wp.zeros((worlds, height, width), dtype=wp.vec3)
        self._pixels = wp.to_torch(self._rgb)
        wp.synchronize_device(sim.device)  # made on Warp's stream, used on torch's

    def render(self) -> torch.Tensor:
        """Returns the current state of the worlds as uint8 pixels, shape ``(worlds, height, width, 3)``."""
        sim = self._sim
        with EXCLUSIVE, wp.ScopedDevice(sim.device), wp.ScopedStream(current_stream(sim.device)):
            data = sim.mujoco_data(worlds=self._worlds)
            mjw.camlight(self._model, data)
            mjw.refit_bvh(self._model, data, self._context)
            mjw.render(self._model, data, self._context)
            mjw.get_rgb(self._context, 0, self._rgb)
        return self._pixels.clamp(0.0, 1.0).mul(255.0).round().to(torch.uint8)
