"""Pixels from Warp's ray tracer: all worlds at once, on the CPU or CUDA, without OpenGL."""

import copy
from typing import Any

import mujoco
import torch
import warp as wp

from torchrl_loco.sim import EXCLUSIVE, current_stream, mjw

GHOST, OPACITY = "ghost/", 0.4
"""What the names of a ghost's bodies begin with, and how much of it is seen."""
GHOST_COLOR = (0.2, 0.75, 0.35)
"""Of a ghost: red, green, blue."""


def to_the_horizon(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Returns a copy of a model for pictures: its planes have no end, as in the physics, where their size is none."""
    seen = copy.copy(mj_model)
    seen.geom_size[seen.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, :2] = 0.0
    return seen


def with_ghost(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Returns a model with its first body once more, which touches nothing: its positions follow those of the model."""
    seen, other = spec.copy(), spec.copy()
    for geom in other.geoms:
        geom.contype = geom.conaffinity = 0
        geom.material, geom.rgba = "", [*GHOST_COLOR, OPACITY]
    for kind in (other.actuators, other.sensors, other.cameras, other.lights, other.keys, other.pairs, other.excludes):
        for part in list(kind):
            other.delete(part)
    seen.worldbody.add_frame().attach_body(other.worldbody.bodies[0], GHOST, "")
    return seen.compile()


class Renderer:
    """Renders so many worlds of a model through one of its cameras, in ``height`` rows of ``width`` pixels."""

    def __init__(
        self, mj_model: mujoco.MjModel, device: wp.Device, camera: str, width: int, height: int, worlds: int
    ) -> None:
        self._device, self._worlds = device, worlds
        self._seen = to_the_horizon(mj_model)
        self._own: Any = None
        with EXCLUSIVE, wp.ScopedDevice(device):
            self._model = mjw.put_model(self._seen)
            self._context = mjw.create_render_context(
                self._seen,
                nworld=worlds,
                cam_res=(width, height),
                render_rgb=True,
                use_shadows=True,
                render_skybox=True,
                cam_active=[camera],
            )
            self._rgb = wp.zeros((worlds, height, width), dtype=wp.vec3)
        self._pixels = wp.to_torch(self._rgb)
        wp.synchronize_device(device)  # made on Warp's stream, used on torch's

    def render(self, data: Any) -> torch.Tensor:
        """Returns ``mjData`` of MuJoCo-Warp, with poses, as pixels in [0, 1], ``(worlds, height, width, 3)``."""
        with EXCLUSIVE, wp.ScopedDevice(self._device), wp.ScopedStream(current_stream(self._device)):
            mjw.camlight(self._model, data)
            mjw.refit_bvh(self._model, data, self._context)
            mjw.render(self._model, data, self._context)
            mjw.get_rgb(self._context, 0, self._rgb)
        return self._pixels.clamp(0.0, 1.0)

    def render_poses(self, qpos: torch.Tensor) -> torch.Tensor:
        """Returns poses ``(worlds, nq)`` as pixels in [0, 1], ``(worlds, height, width, 3)``."""
        with EXCLUSIVE, wp.ScopedDevice(self._device), wp.ScopedStream(current_stream(self._device)):
            if self._own is None:
                self._own = mjw.make_data(self._seen, nworld=self._worlds, naconmax=1, njmax=1)
            wp.copy(self._own.qpos, wp.from_torch(qpos.float().contiguous()))
            mjw.kinematics(self._model, self._own)
            mjw.com_pos(self._model, self._own)
        return self.render(self._own)


def to_bytes(pixels: torch.Tensor) -> torch.Tensor:
    """Returns pixels in [0, 1] as uint8."""
    return pixels.mul(255.0).round().to(torch.uint8)
